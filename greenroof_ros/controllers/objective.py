"""What planning controllers look for: apart from their program, whose solver is slow to import."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.controllers.cistern_ahead import CisternAhead
from greenroof_ros.controllers.scenario_tree import Groups

Array = NDArray[np.float64]


class Prices(NamedTuple):
    """What counts beside the deviation."""

    energy: float = 0.0
    """of a kWh of hydraulic energy, as deviation (m3 s, or m6 s where that is squared)"""
    start: float = 0.0
    """of a pump start at full flow, likewise"""


class Program(Protocol):
    """What a planner solves; see :class:`greenroof_ros.controllers.planner.Planner`.

    Attributes:
        status: of the last program by OSQP's numbers, 1 = solved.
        cost: its objective (m3; m6 where the deviation is squared); NaN if it was not solved.
    """

    status: int
    cost: float

    def solve(
        self,
        mean: Array,
        most: Array,
        full: float,
        flow: float,
        guess: Array | None,
        groups: Groups,
        ahead: CisternAhead | None = None,
    ) -> Array | None:
        """Return the volumes pumped, and kept, until each step's end (m3), shape (members, n).

        Args:
            mean: of the roof's deviation in each step without pumping (m3), shape (members, n).
            most: upper bound of the volumes (m3), not falling, shape (members, n).
            full: the pumps' flow at command 1 (m3/s), as far as the soil keeps it.
            flow: what is pumped now (m3/s), likewise.
            guess: of the answer.
            groups: of the members for which the volumes of a step are the same, by the least index
                of a member; a group is part of one of the step before; shape (members, n).
            ahead: the cistern, volumes and flows likewise; None where it has no low outlet.

        Returns:
            None where there is no solution; ``status`` says why.
        """
        ...


NO_PRICES = Prices()
