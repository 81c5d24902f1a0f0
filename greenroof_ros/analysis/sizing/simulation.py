"""The simulation of all designs in all seasons, many of them at the same time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.analysis.workers.processes import processes
from greenroof_ros.analysis.workers.progress import ShareFile
from greenroof_ros.common.processes import scratch_directory
from greenroof_ros.experiment.batch import Batch, BatchWeather, simulate_batch

Values = NDArray[np.float64]

HALF = 0.5
"""share of the cistern that is full when a season begins"""

_REFRESH_S = 0.5


class Case(NamedTuple):
    """A design in a season."""

    design: Design
    season: int
    filled: float = HALF
    """share of the cistern that is full when the season begins"""


def simulate_cases(
    cases: Sequence[Case], weather: Sequence[BatchWeather], jobs: int,
    show: Callable[[float], None], check: Callable[[], None],
) -> dict[str, Values]:
    """Return the metrics of cases, by name, each with shape (cases,).

    Args:
        cases: the designs and seasons to run.
        weather: weather of the seasons.
        jobs: number of processes; with 1, this process does the work.
        show: callback that receives the share of the work that is done, 0 to 1.
        check: callback that raises an error if the runs must stop.

    Raises:
        WorkersLostError: if a process ended unexpectedly.
    """
    def report(share: float) -> None:
        check()
        show(share)

    if jobs == 1:
        return simulate_batch(_make_batch(cases, weather), progress=report).metrics
    # Every process takes whole seasons, because its steps are short where it does not rain.
    by_season = np.argsort([case.season for case in cases], kind="stable")
    parts = np.array_split(by_season, min(jobs, len(cases)))
    with scratch_directory() as scratch, processes(jobs, {}, [__name__]) as workers:
        files = [ShareFile(scratch / f"{number}") for number in range(len(parts))]
        pending = {
            workers.submit(
                _simulate_part, _make_batch([cases[row] for row in part], weather), file
            ): number
            for number, (part, file) in enumerate(zip(parts, files, strict=True))
        }
        results: dict[int, dict[str, Values]] = {}
        while len(results) < len(parts):
            report(sum(file.read() for file in files) / len(parts))
            for future in wait(pending, timeout=_REFRESH_S, return_when=FIRST_COMPLETED).done:
                results[pending.pop(future)] = workers.result(future)
    metrics = {name: np.empty(len(cases)) for name in results[0]}
    for number, result in results.items():
        for name, values in result.items():
            metrics[name][parts[number]] = values
    return metrics


def _make_batch(cases: Sequence[Case], weather: Sequence[BatchWeather]) -> Batch:
    return Batch(
        sites=[case.design.site for case in cases], weather=weather,
        weather_of=np.array([case.season for case in cases], dtype=np.intp),
        parameters=[case.design.parameters for case in cases],
        x1=np.array([case.filled * case.design.volume for case in cases]),
        x2=np.array([case.design.site.x2_star for case in cases]),
        with_forecast=False,
    )


def _simulate_part(_: Path, batch: Batch, progress: ShareFile) -> dict[str, Values]:
    return simulate_batch(batch, progress=progress.write).metrics
