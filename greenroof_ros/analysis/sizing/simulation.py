"""The simulation of all designs in all seasons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import Batch, SeasonWeather, simulate_season

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
    result = simulate_season(Batch(
        sites=[case.design.site for case in cases],
        weather=[SeasonWeather.of_run(run, 1.0) for run in seasons],
        weather_of=np.array([case.season for case in cases]),
        parameters=[case.design.parameters for case in cases],
        x1=np.array([case.filled * case.design.volume for case in cases]),
        x2=np.array([case.design.site.x2_star for case in cases]),
        beds=np.ones(len(cases)), with_forecast=False,
    ), progress=progress, threads=threads)
    return {
        metric.name: np.array([made.get(metric.name, np.nan) for made in result.metrics])
        for metric in METRICS
    }
