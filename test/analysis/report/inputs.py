"""Inputs for the tests of the report: studies, bags and run directories, as others leave them."""

from __future__ import annotations

import csv
import dataclasses
import shutil
from collections.abc import Sequence
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from paper import paper_run
from places import CONFIG
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from greenroof_ros.analysis.figures import Figure
from greenroof_ros.analysis.report.figures import make_figures
from greenroof_ros.analysis.report.runs import Report, find_runs
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.simulation.loop import Simulation, record
from greenroof_ros.simulation.output import make_unfinished_summary, write_summary
from greenroof_ros.simulation.run import Run

START = datetime.fromisoformat("2021-07-07T02:00-05:00")
START_NS = 1_625_641_200 * 10**9  # date -d 2021-07-07T02:00-05:00 +%s
# The drainage layer is not in files.
NAMES = [field.name for field in dataclasses.fields(Trajectory)[1:] if field.name != "layer"]
TYPES = get_typestore(Stores.ROS2_JAZZY)
TOPICS = {
    "/cistern/level": "cistern", "/roof/level": "roof", "/pump/command": "command",
    "/pump/flow": "pump_flow", "/weather/precipitation": "precipitation",
    "/weather/evapotranspiration": "evapotranspiration", "/cistern/outflow": "outflow",
    "/roof/drainage": "drainage", "/weather/frost": "frost",
}
MINUTE = 60 * 10**9


def trajectory_of(time: Sequence[float], **values: ArrayLike) -> Trajectory:
    """Return a trajectory at these times (s), in which all values are 0 except the given ones."""
    given = {name: np.asarray(values.get(name, 0.0), dtype=float) for name in NAMES}
    given["time"] = np.asarray(time, dtype=float)
    columns = {name: np.broadcast_to(column, len(time)) for name, column in given.items()}
    return Trajectory(start=START, **columns)


class Simulated(NamedTuple):
    """A run done in this process, with its row in a study's table."""

    trajectory: Trajectory
    row: dict[str, Any]
    run: Run


@cache
def simulate(controller: str, option: str, initial: str, hours: str = "0.2") -> Simulated:
    """Do a run of the paper, but a shorter one."""
    key = {"mpc": "weight", "onoff": "fraction"}[controller]
    run = paper_run(
        "--controller", controller, f"--{key}", option, "--initial", initial, "--hours", hours
    )
    simulation = Simulation(run)
    trajectory = record(run, simulation.ticks())
    return Simulated(trajectory, {
        "site": "site.yaml", "start": run.start.isoformat(), "initial": initial, "window": "July",
        "season": "", "case": f"{controller} {key} {option}", "status": "done", "error": "",
        **simulation.metrics.results(simulation.site.state).metrics,
    }, run)


def write_study(
    directory: Path, runs: Sequence[tuple[dict[str, Any], Trajectory | None]]
) -> Path:
    """Write a study's directory."""
    configuration = directory / "configuration"
    configuration.mkdir(parents=True)
    shutil.copy(CONFIG / "site.yaml", configuration / "site.yaml")
    (configuration / "study.json").write_text("{}")
    header = dict.fromkeys(["run", *(key for row, _ in runs for key in row)])
    with (directory / "results.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, header, restval="")
        writer.writeheader()
        for number, (row, trajectory) in enumerate(runs, start=1):
            name = f"{number:03}"
            writer.writerow({"run": name, **row})
            if trajectory is not None:
                (directory / "runs" / name).mkdir(parents=True)
                (directory / "runs" / name / "trajectory.parquet").write_bytes(
                    trajectory.to_parquet()
                )
    return directory


def report_of(*paths: Path) -> Report:
    """Read and judge the runs under these paths."""
    return Report(find_runs(list(paths)))


def study_of(directory: Path, *rows: dict[str, Any]) -> Report:
    """Return the report of a study without trajectories."""
    return report_of(write_study(directory, [(row, None) for row in rows]))


def figures_of(report: Report) -> dict[str, Figure]:
    """Return the figures by name."""
    return {figure.name: figure for figure in make_figures(report)}


def write_bag(
    directory: Path,
    messages: dict[str, tuple[Sequence[int], Sequence[float]]],
    storage: StoragePlugin = StoragePlugin.MCAP,
    msgtype: str = "std_msgs/msg/Float64",
) -> Path:
    """Write a foreign bag: stamps (ns since the start) and values of each topic.

    A clock's values are its times (s since the start).
    """
    Time = TYPES.types["builtin_interfaces/msg/Time"]
    queue = []
    with Writer(directory, version=9, storage_plugin=storage) as writer:
        for topic, (stamps, values) in messages.items():
            clock = topic.endswith("/clock")
            name = "rosgraph_msgs/msg/Clock" if clock else msgtype
            connection = writer.add_connection(topic, name, typestore=TYPES)
            queue += [
                (stamp, connection, Time(START_NS // 10**9 + int(value), 0) if clock else value)
                for stamp, value in zip(stamps, values, strict=True)
            ]
        for stamp, connection, value in sorted(queue, key=lambda item: item[0]):
            message = TYPES.types[connection.msgtype](value)
            writer.write(
                connection, START_NS + int(stamp),
                bytes(TYPES.serialize_cdr(message, connection.msgtype)),
            )
    return directory


def messages_of(trajectory: Trajectory) -> dict[str, tuple[Sequence[int], Sequence[float]]]:
    """Return the messages of a run; all messages of a tick have one time."""
    area = {"cistern": 25.0, "roof": 68.8}
    stamps = [round(time * 1e9) for time in trajectory.time]
    return {
        topic: (stamps, (getattr(trajectory, name) / area.get(name, 1.0)).tolist())
        for topic, name in TOPICS.items()
    }


def small_bag(directory: Path, **changes: list[float]) -> Path:
    """Write a bag with a sample a second, by default three, with other values for some topics."""
    values = {
        "roof_level": [0.03] * 3, "cistern_level": [2.0] * 3, "pump_command": [0.1] * 3,
        "pump_flow": [0.001] * 3, **changes,
    }
    return write_bag(directory, {
        f"/{name.replace('_', '/')}": ([second * 10**9 for second in range(len(column))], column)
        for name, column in values.items()
    })


def ended_run(
    directory: Path, status: str = "done", example: Simulated | None = None, **known: Any
) -> Path:
    """Write a run directory as bringup leaves it, by default 720 ticks of MPC, without metrics."""
    example = example or simulate("mpc", "0.001", "low-low")
    ticks = known.get("last_tick") or example.run.steps
    columns = {
        name: values[: ticks + 1] for name in NAMES
        if (values := getattr(example.trajectory, name)) is not None
    }
    write_bag(directory / "bag", messages_of(Trajectory(start=START, **columns)))
    (directory / "configuration" / "weather").mkdir(parents=True)
    for name in ("site.yaml", "weather/toronto_2021-07.csv"):
        shutil.copy(CONFIG / name, directory / "configuration" / name)
    write_summary({**make_unfinished_summary(example.run, status), **known}, directory)
    return directory
