"""When the members of an ensemble of forecasts will be known apart: a tree of scenarios."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Groups = NDArray[np.intp]


def halved_by_rain(rain: Array, edges: Array, recourse: float) -> Groups:
    """Return the group of each member in each step, by the least index in the group.

    What is pumped is the same for all members of a group, since nothing tells them apart yet. All
    are one group at first. At each ``recourse`` each group is halved: into the members with less
    and with more rain until then, and where that is equal, in the next step, and so on; of an odd
    number the wetter half has one more. So the groups of a step are the groups of the step before,
    or parts of them, and in the end each member is alone.

    That each may be answered on its own at once is what no forecast gives: a controller that
    believes it waits, since soon it will know all. A tree from scenarios that are alike until each
    stage is that of Heitsch and Roemisch (2009, Scenario tree modeling for multistage stochastic
    programs, doi:10.1007/s10107-007-0197-2); here the members part by rank, so that it is as large
    whatever the rain. In which order the members are given does not matter.

    Args:
        rain: forecast (m/s), shape (members, n).
        edges: ends of the steps (s from now), the first 0, shape (n + 1,).
        recourse: from one halving to the next (s).

    Returns:
        Shape (members, n).
    """
    members, n = rain.shape
    groups = np.zeros((members, n), dtype=np.intp)
    fallen = np.cumsum(rain * np.diff(edges), axis=1)
    halvings = np.diff(edges[:-1] // recourse)
    for step in np.repeat(np.arange(1, n), halvings.astype(int)):
        labels = np.unique(groups[:, step])
        if len(labels) == members:
            break
        order = np.lexsort(fallen[:, step - 1 :].T[::-1])
        for label in labels:
            together = order[groups[order, step] == label]
            for half in np.split(together, [len(together) // 2]):
                groups[half, step:] = half.min(initial=members)
    return groups
