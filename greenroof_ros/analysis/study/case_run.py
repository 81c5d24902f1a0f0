"""One run of a study, on any machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.study.case import Case
from greenroof_ros.controllers.outlet import PRICE
from greenroof_ros.experiment.clairvoyant import clairvoyant_bound
from greenroof_ros.experiment.closed_loop import Simulation, record
from greenroof_ros.experiment.discharge_bound import simulate_frontier
from greenroof_ros.recording.events_table import EVENTS, format_events
from greenroof_ros.recording.results_table import summary_columns
from greenroof_ros.recording.trajectory import TRAJECTORY


@dataclass(frozen=True)
class Outcome:
    """The results of a run.

    Attributes:
        results: columns of the table; the same in every repetition.
        files: content of the files that are kept, by name.
    """

    results: dict[str, Any]
    files: dict[str, bytes]


def run_case(directory: Path, case: Case, trajectory_every: float | None) -> Outcome:
    """Run a case.

    Args:
        directory: with the case's input files.
        case: to run.
        trajectory_every: time between the samples of the trajectory (s), rounded to whole ticks, at
            least one; None to keep only the results.

    Raises:
        ConfigurationError: the case is wrong.
    """
    run = case.find_inputs(directory).build()
    simulation, files = Simulation(run), dict[str, bytes]()
    if trajectory_every is None:
        for _ in simulation.ticks():
            pass
    else:
        every = run.count_ticks_between(trajectory_every)
        files[TRAJECTORY] = record(run, simulation.ticks(), every).to_parquet()
    results = simulation.summary()
    files[EVENTS] = format_events(results["events"]).encode()
    return Outcome(summary_columns(results), files)


def bound_case(directory: Path, case: Case) -> float:
    """Return the minimum total deviation (m3) that a controller with commands up to 1 could reach.

    See :func:`greenroof_ros.experiment.clairvoyant.clairvoyant_bound`.
    """
    run = case.find_inputs(directory).build()
    return clairvoyant_bound(run, case.bound_block)


def bound_discharge(directory: Path, case: Case) -> dict[str, float]:
    """Return the columns of the minimum discharge in wet weather, for on/off control's irrigation.

    Of the frontier it is the point where mains water costs as much as ``plan`` assumes.
    """
    frontier = simulate_frontier(case.plain.find_inputs(directory).build())
    point = frontier.at(PRICE)
    return {
        "bound_wet_discharge_m3": point.wet_discharge_m3, "bound_mains_m3": point.mains_m3,
    }
