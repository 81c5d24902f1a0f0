"""One run of a study, on any machine, by either engine: the node graph or in process."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_OCCUPIED
from greenroof_ros.common.processes import asked_to_end_with_this
from greenroof_ros.common.times import read_start
from greenroof_ros.experiment import summary
from greenroof_ros.experiment.clairvoyant import clairvoyant_bound
from greenroof_ros.experiment.closed_loop import closed_loop, record
from greenroof_ros.experiment.run import Run, build_run, count_ticks
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.sensor_pump_errors import Pump
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.recording.bag_reader import load_bag
from greenroof_ros.recording.results_table import summary_columns
from greenroof_ros.study.grid import Case, in_directory
from greenroof_ros.weather.reading import read_weather

ENGINES = ("inprocess", "ros")
# ROS domains to try in turn until one is free (bringup refuses an occupied one). Lower numbers are
# left for graphs that somebody starts while a study runs.
_DOMAINS = range(51, 102)


@dataclass(frozen=True)
class Outcome:
    """The results of a run.

    Attributes:
        results: columns of the table; the same for both engines and in every repetition.
        timings: wall-clock times (s), which differ.
        files: content of the files that are kept, by name.
    """

    results: dict[str, Any]
    timings: dict[str, float]
    files: dict[str, bytes]


def run_case(case: Case, engine: str, trajectory_every: float | None) -> Outcome:
    """Run a case.

    Args:
        case: to run.
        engine: one of :data:`ENGINES`.
        trajectory_every: time between the samples of the trajectory (s), rounded to whole ticks, at
            least one; None to keep only the results.

    Raises:
        ConfigurationError: the case is wrong, or the engine is not installed.
        RuntimeError: the graph failed; the message is what it printed.
    """
    with _laid_out(case) as directory:
        if engine == "ros":
            return _run_graph(case, directory, trajectory_every)
        return _run_in_process(_build(case, directory), trajectory_every)


def bound_case(case: Case) -> float:
    """Return the least total deviation (m3) that a controller with commands up to 1 could reach.

    See :func:`greenroof_ros.experiment.clairvoyant.clairvoyant_bound`.
    """
    with _laid_out(case) as directory:
        run = _build(case, directory)
    block = None if case.bound_block is None else round(case.bound_block / run.site.tau)
    return clairvoyant_bound(run, block=block).bound_m3


@contextmanager
def _laid_out(case: Case) -> Iterator[Path]:
    """Write the case's files to a temporary directory."""
    with tempfile.TemporaryDirectory(prefix="greenroof_ros-") as name:
        directory = Path(name)
        for file in case.files:
            (directory / file.name).write_bytes(file.content)
        yield directory


def _build(case: Case, directory: Path) -> Run:
    site_file = directory / case.site.name
    site = read_site(site_file)
    weather = read_weather(
        [directory / file.name for file in case.weather], site, case.evapotranspiration, case.gaps
    )
    return build_run(
        site_file, site, weather, case.start, count_ticks(site, case.hours, "hours"),
        case.controller, case.parameters, case.initial, (case.cistern, case.roof),
        in_directory(case.forecast, case.forecast_files, directory), case.sensor_pump_errors,
    )


def _every(site: Site, trajectory_every: float) -> int:
    """Return the number of ticks between samples that are kept."""
    return max(1, round(trajectory_every / site.tau))


def _run_in_process(run: Run, trajectory_every: float | None) -> Outcome:
    controller = run.make_controller()
    metrics = Metrics()
    began = time.monotonic()
    ticks = closed_loop(run, controller, metrics)
    trajectory = None
    if trajectory_every is None:
        for _ in ticks:
            pass
    else:
        trajectory = record(run, ticks, _every(run.site, trajectory_every))
    wall = time.monotonic() - began
    result = summary.build(
        run, metrics.results(), metrics.weekly_deviations(), wall_s=wall,
        solver=controller.statistics(),
    )
    files = {} if trajectory is None else {"trajectory.parquet": trajectory.to_parquet()}
    return Outcome(summary_columns(result), _timings(result), files)


def _run_graph(case: Case, directory: Path, trajectory_every: float | None) -> Outcome:
    """Run bringup in its own ROS domain; keep bag and summary if a trajectory is kept."""
    parameters = directory / "parameters.yaml"
    parameters.write_text(
        yaml.safe_dump({f"/**/{case.controller.name}": {"ros__parameters": case.parameters}}),
        encoding="utf-8",
    )
    output = directory / "run"
    forecast = in_directory(case.forecast, case.forecast_files, directory)
    command = [
        sys.executable, "-m", "greenroof_ros.bringup", "--json", "--output", str(output),
        *(["--no-record"] if trajectory_every is None else []),
        "--site", str(directory / case.site.name),
        "--weather", *(str(directory / file.name) for file in case.weather),
        "--evapotranspiration", case.evapotranspiration, "--gaps", case.gaps,
        "--start", case.start,
        "--hours", repr(case.hours), "--controller", case.controller.reference,
        "--parameters", str(parameters), "--cistern", repr(case.cistern), "--roof", repr(case.roof),
        "--forecast", str(forecast),
    ]
    for name, value in forecast.options().items():
        command += [f"--forecast-{name}", str(value)]
    if case.sensor_pump_errors is not None:
        # As one word: -1e-05 by itself would be read as an option.
        command += [
            f"--{name.replace('_', '-')}={value!r}"
            for name, value in case.sensor_pump_errors.values().items()
        ]
    for domain in _domains(case):
        process = subprocess.run(
            command, env={**asked_to_end_with_this(), "ROS_DOMAIN_ID": str(domain)},
            capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
        )
        if process.returncode == EXIT_DONE:
            break
        if process.returncode != EXIT_OCCUPIED:
            raise RuntimeError(process.stderr.strip())
    else:
        raise RuntimeError(f"no ROS domain from {_DOMAINS[0]} to {_DOMAINS[-1]} is free")
    result = json.loads((output / "summary.json").read_text(encoding="utf-8"))
    if trajectory_every is None:
        return Outcome(summary_columns(result), _timings(result), {})
    site = read_site(output / "configuration" / "site.yaml")
    zone = read_start(case.start).tzinfo
    assert zone is not None
    trajectory = load_bag(output / "bag", site, zone, own=True).trajectory
    if case.sensor_pump_errors is not None and not case.sensor_pump_errors.exact_sensor:
        roof = _true_roof(_build(case, directory), trajectory.command.tolist())
        trajectory = replace(trajectory, roof=roof)
    trajectory = trajectory.thinned(_every(site, trajectory_every))
    kept = ("summary.json", "bag/metadata.yaml", "bag/bag_0.mcap")
    files = {name: (output / name).read_bytes() for name in kept}
    return Outcome(
        summary_columns(result), _timings(result),
        {"trajectory.parquet": trajectory.to_parquet(), **files},
    )


def _true_roof(run: Run, commands: Sequence[float]) -> NDArray[np.float64]:
    """Return the true volume on the roof (m3), shape (N+1,), if a bag has only sensor readings.

    The plant is run again with the bag's commands; during frost and quiet hours nothing is pumped.
    """
    series, hours, until = run.series, run.site.quiet, 0
    plant, pump = Plant(run.site, run.x1, run.x2), Pump(run.sensor_pump_errors, run.site.tau)
    roof = np.empty(run.steps + 1)
    for k, command in enumerate(commands):
        roof[k] = plant.x2
        if k == until:
            rain, evapotranspiration, frost, until = series.at(k)
        quiet = hours is not None and hours.quiet_at(run.time_ns(k))
        pumped = pump.flow(plant, command, frost > 0 or quiet)
        plant.step(rain, plant.flows(rain, evapotranspiration, pumped))
    return roof


def _domains(case: Case) -> Iterator[int]:
    """Yield every domain once, beginning with one that the case's identity selects."""
    first = int(case.identity, 16) % len(_DOMAINS)
    yield from _DOMAINS[first:]
    yield from _DOMAINS[:first]


def _timings(result: dict[str, Any]) -> dict[str, float]:
    solver = result["solver"] or {}
    return {
        "wall_s": result["wall_s"],
        **{key: solver[key] for key in ("mean_s", "p99_s", "max_s") if key in solver},
    }
