"""The runs of a study, one by one or many together, on any machine."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from greenroof_ros.analysis.study.case import Case
from greenroof_ros.analysis.workers.progress import ShareFile
from greenroof_ros.controllers.outlet import PRICE
from greenroof_ros.experiment.batch_runs import simulate_runs
from greenroof_ros.recording.events_table import EVENTS, format_events
from greenroof_ros.recording.results_table import summary_columns
from greenroof_ros.recording.trajectory import TRAJECTORY
from greenroof_ros.simulation.bound import clairvoyant_bound
from greenroof_ros.simulation.discharge_bound import simulate_frontier
from greenroof_ros.simulation.loop import Simulation, record
from greenroof_ros.simulation.run import Run
from greenroof_ros.weather.reading import read_weather

# Fewer cases are quicker alone; of more, an interruption would lose too many, and memory grows.
_MIN_GROUP, _MAX_GROUP = 4, 100


@dataclass(frozen=True)
class Outcome:
    """The results of a run.

    Attributes:
        results: columns of the table. The results do not depend on the duration of the run, and
            only their last digits depend on the cases with which the run was simulated.
        files: contents of the files that are kept, by name.
    """

    results: dict[str, Any]
    files: dict[str, bytes]


def group_cases(
    cases: Sequence[Case], workers: int, trajectory_every: float | None
) -> list[tuple[Case, ...]]:
    """Return the cases in groups, each for one worker; most groups consist of one case.

    Args:
        cases: cases to run.
        workers: number of groups that run at the same time.
        trajectory_every: time between samples, as for :func:`run_case` (s).
    """
    together: dict[object, list[Case]] = {}
    for case in cases:
        alone = case.together is None or trajectory_every is not None
        together.setdefault(case.identity if alone else case.together, []).append(case)
    groups: list[tuple[Case, ...]] = []
    for alike in together.values():
        # Cases with the same weather are next to each other.
        alike.sort(key=lambda case: (case.weather_name, case.start))
        if len(alike) < _MIN_GROUP:
            parts = len(alike)
        else:
            rounds = -(-len(alike) // (workers * _MAX_GROUP))
            parts = min(workers * rounds, len(alike) // _MIN_GROUP)
        ends = [number * len(alike) // parts for number in range(parts + 1)]
        groups += [tuple(alike[first:last]) for first, last in pairwise(ends)]
    return groups


def run_cases(
    directory: Path, cases: Sequence[Case], trajectory_every: float | None, progress: ShareFile
) -> list[Outcome | Exception]:
    """Run a group from :func:`group_cases`; return the outcome of each case, or its error.

    Args:
        directory: directory with the cases' input files.
        cases: cases to run.
        trajectory_every: time between samples, as for :func:`run_case` (s).
        progress: file to which the completed share is written.
    """
    if len(cases) == 1:
        return [run_case(directory, cases[0], trajectory_every)]
    read = functools.cache(read_weather)
    results: dict[str, Outcome | Exception] = {}
    runs: dict[str, Run] = {}
    for case in cases:
        try:
            runs[case.identity] = case.find_inputs(directory).build(read)
        except Exception as error:  # it concerns only this case
            results[case.identity] = error
    summaries = simulate_runs(list(runs.values()), progress.write)
    for identity, made in zip(runs, summaries, strict=True):
        results[identity] = _make_outcome(made, {})
    return [results[case.identity] for case in cases]


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
    run = case.find_inputs(directory).build()
    simulation, files = Simulation(run), dict[str, bytes]()
    if trajectory_every is None:
        for _ in simulation.ticks():
            pass
    else:
        every = run.count_ticks_between(trajectory_every)
        files[TRAJECTORY] = record(run, simulation.ticks(), every).to_parquet()
    return _make_outcome(simulation.summary(), files)


def _make_outcome(results: Mapping[str, Any], files: Mapping[str, bytes]) -> Outcome:
    """Return the outcome of a run from the content of its ``summary.json`` and of other files."""
    events = format_events(results["events"]).encode()
    return Outcome(summary_columns(results), {**files, EVENTS: events})


def bound_case(directory: Path, case: Case) -> float:
    """Return the minimum total deviation achievable by a controller with commands up to 1 (m3).

    See :func:`greenroof_ros.simulation.bound.clairvoyant_bound`.
    """
    run = case.find_inputs(directory).build()
    return clairvoyant_bound(run, case.bound_block)


def bound_discharge(directory: Path, case: Case) -> dict[str, float]:
    """Return the columns of the minimum wet-weather discharge given on/off control's irrigation.

    The columns describe the point of the frontier at which mains water costs as much as ``plan``
    assumes. The mains water is left out if the site has no mains top-up.
    """
    run = case.plain.find_inputs(directory).build()
    point = simulate_frontier(run).at(PRICE)
    bounds = {"bound_wet_discharge_m3": point.wet_discharge_m3}
    return bounds if run.site.mains_level is None else bounds | {"bound_mains_m3": point.mains_m3}
