"""The simulation of all designs in all seasons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.simulation import season
from greenroof_ros.simulation.run import Run

Values = NDArray[np.float64]

HALF = 0.5
"""share of the cistern that is full when a season begins"""


class Case(NamedTuple):
    """A design in a season."""

    design: Design
    season: int
    filled: float = HALF
    """share of the cistern that is full when the season begins"""


def simulate_cases(
    cases: Sequence[Case], seasons: Sequence[Run], threads: int, progress: Callable[[float], None]
) -> dict[str, Values]:
    """Return the metrics of cases, by name, each with shape (cases,); NaN if it is undefined.

    Args:
        cases: the designs and seasons to run.
        seasons: run of a site with the same roof in each season.
        threads: number of threads that share the cases.
        progress: callback that receives the completed share of the work (1); an error that it
            raises ends the runs.
    """
    results, _ = season.simulate_season([
        season.Case(
            case.design.site, case.design.parameters, seasons[case.season],
            case.filled * case.design.volume, case.design.site.x2_star, with_forecast=False,
        ) for case in cases
    ], progress=progress, threads=threads)
    return {
        metric.name: np.array([made.get(metric.name, np.nan) for (made, *_), _ in results])
        for metric in METRICS
    }
