"""The run of a case, and its bounds, on any machine."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.study.case import Case
from greenroof_ros.controllers.outlet import PRICE
from greenroof_ros.results.table import EVENTS, format_events, summary_columns
from greenroof_ros.results.trajectory import TRAJECTORY
from greenroof_ros.simulation import bound
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.run import Run
from greenroof_ros.weather.read import read_weather

# Cases with the same weather follow each other, so a worker reads its files once.
_read_weather = functools.lru_cache(2)(read_weather)


@dataclass(frozen=True)
class Outcome:
    """The results of a run.

    Attributes:
        results: columns of the table, which do not depend on the duration of the run.
        files: contents of the files that are kept, by name.
    """

    results: dict[str, Any]
    files: dict[str, bytes]


def run_case(directory: Path, case: Case, trajectory_every: float | None) -> Outcome:
    """Run a case.

    Args:
        directory: directory with the case's input files.
        case: case to run.
        trajectory_every: time between the samples of the trajectory (s), rounded to at least one
            whole tick; None to keep only the results.

    Raises:
        ConfigurationError: if the case is invalid.
    """
    run, every = _build(directory, case), 0
    if trajectory_every is not None:
        every = run.count_ticks_between(trajectory_every)
    results, trajectory = simulate(run, every=every)
    files = {EVENTS: format_events(results["events"]).encode()}
    if trajectory is not None:
        files[TRAJECTORY] = trajectory.to_parquet()
    return Outcome(summary_columns(results), files)


def _build(directory: Path, case: Case) -> Run:
    inputs = case.find_inputs(directory)
    place = inputs.read_site().place
    weather = _read_weather(inputs.weather, place, inputs.evapotranspiration, inputs.gaps)
    return replace(inputs, weather=weather).build()


def bound_case(directory: Path, case: Case) -> dict[str, float]:
    """Return the column of the minimum total deviation of controllers with commands up to 1.

    See :func:`greenroof_ros.simulation.bound.clairvoyant_bound`.
    """
    return {"bound_m3": bound.clairvoyant_bound(_build(directory, case), case.bound_block)}


def bound_discharge(directory: Path, case: Case) -> dict[str, float]:
    """Return the columns of the minimum wet-weather discharge given on/off control's irrigation.

    The columns describe the point of the frontier at which mains water costs as much as ``plan``
    assumes. The mains water is left out if the site has no mains top-up.
    """
    run = _build(directory, case.plain)
    _, trajectory = simulate(run, every=1)
    assert trajectory is not None
    (point,) = bound.bound_discharge(run, trajectory, [PRICE])
    bounds = {"bound_wet_discharge_m3": point.wet_discharge_m3}
    return bounds if run.site.mains_level is None else bounds | {"bound_mains_m3": point.mains_m3}
