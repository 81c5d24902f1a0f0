"""The output of a run: a directory with its exact configuration, its bag, and its summary.

The summary, ``summary.json``, exists from the start of the run.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

import yaml

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors, replace_text, unique_name
from greenroof_ros.base.parameter import replace_infinity
from greenroof_ros.base.versions import versions
from greenroof_ros.physics.storm_water import WITHOUT_RAIN, Event
from greenroof_ros.results.table import EVENTS, event_rows, format_events
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import format_site
from greenroof_ros.weather.records import write_records

# The file's name in the directory of a run.
SUMMARY = "summary.json"
# The site file's name in the configuration of a run.
SITE_FILE = "site.yaml"
# Status of a run. It is RUNNING until the run ends, and remains so if the process was killed.
RUNNING, DONE, FAILED, INTERRUPTED = "running", "done", "failed", "interrupted"
# Parent of the runs' directories, unless a user chooses one.
_RUNS = Path("runs")


def make_run_directory(output: Path | None, controller: str) -> Path:
    """Create the directory of a run: ``output``, or a dated directory in ``runs/``.

    Raises:
        ConfigurationError: if the directory is not empty.
        OSError: if the directory cannot be created or written to.
    """
    directory = output or _make_dated_directory(controller)
    directory.mkdir(parents=True, exist_ok=True)
    if any(directory.iterdir()):
        raise ConfigurationError(
            "exists and is not empty; a run never overwrites files",
            key="--output", value=str(directory),
        )
    (directory / "configuration").mkdir()
    return directory.resolve()


def _make_dated_directory(controller: str) -> Path:
    """Create a directory named after the current second, with a suffix such as -2 if it exists."""
    name = f"{datetime.now().astimezone().strftime('%Y-%m-%dT%H-%M-%S')}-{controller}"
    _RUNS.mkdir(exist_ok=True)
    for number in count(1):
        directory = _RUNS / (name if number == 1 else f"{name}-{number}")
        with suppress(FileExistsError):
            directory.mkdir()
            break
    return directory


def write_configuration(directory: Path, run: Run, nodes: dict[str, object]) -> Path:
    """Copy a run's input files, and write the parameters of its nodes.

    Args:
        directory: directory of the run.
        run: the run.
        nodes: parameters of the plant that the run does not set.

    Returns:
        The ROS 2 parameter file that all nodes of the run read.

    Raises:
        OSError: if the directory cannot be written to.
    """
    configuration = directory / "configuration"
    with add_path_to_errors(directory):
        site_file = configuration / SITE_FILE
        site_file.write_text(format_site(run.site), encoding="utf-8")
        weather = configuration / "weather"
        weather.mkdir(exist_ok=True)
        weather_files: list[str] = []
        for file in run.weather.files:
            named = file if file.suffix else Path("weather.csv")  # of a data frame
            copy = weather / unique_name(named, [Path(each).name for each in weather_files])
            if run.records is None:
                shutil.copyfile(file, copy)
            else:
                copy.write_text(write_records(run.records, copy.name), encoding="utf-8")
            weather_files.append(str(copy))
        choice = run.forecast_choice
        if choice.file is not None:
            name = choice.file.resolve().name
            choice = replace(choice, file=_copy(choice.file, configuration / "forecast" / name))
        common = {"site_file": str(site_file)}
        before = {**common, WITHOUT_RAIN.name: run.without_rain_s}
        all_members, outlet_horizon = find_needs(run.controller, run.parameters)
        span = {"start": run.start.isoformat(), "run_length": run.steps}
        parameters = {
            "plant": {
                **before, **span, "initial_cistern_volume": run.x1, "initial_roof_volume": run.x2,
                **run.sensor_and_pump.values(), **nodes,
            },
            "weather": {
                **common, **span, "weather_files": weather_files,
                "evapotranspiration": run.weather.method, "gaps": run.weather.gaps,
                **asdict(run.weather.climate),
                "horizon": run.parameters.get("horizon", 0.0), "outlet_horizon": outlet_horizon,
                "all_members": all_members, "forecast": str(choice),
                **{f"forecast_{name}": value for name, value in choice.options().items()},
            },
            run.controller.name: {**before, **run.parameters},
            "recorder": {
                **common,
                "directory": str(directory / "bag"),
                "controller": run.controller.reference,
            },
        }
        return write_parameters(configuration, parameters)


def write_parameters(directory: Path, parameters: Mapping[str, Mapping[str, object]]) -> Path:
    """Write a ROS 2 parameter file for the given nodes, and return the path of the file.

    Args:
        directory: directory of the file.
        parameters: parameters of each node, by the name of the node.
    """
    file = directory / "parameters.yaml"
    of_nodes = {f"/**/{name}": {"ros__parameters": values} for name, values in parameters.items()}
    file.write_text(yaml.safe_dump(of_nodes, sort_keys=False), encoding="utf-8")
    return file


def _copy(source: Path, copy: Path) -> Path:
    copy.parent.mkdir(exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, copy)
    else:
        shutil.copyfile(source, copy)
    return copy


def make_summary(
    run: Run, metrics: Mapping[str, float], events: Sequence[Event], *, wall_s: float,
    solver: Mapping[str, float] | None, messages: Mapping[str, int] | None = None, **happened: Any,
) -> dict[str, Any]:
    """Assemble the summary of a completed run, in the same form for ``simulate`` and the graph.

    Args:
        run: the run.
        metrics: results of the run, by their names in
            :data:`greenroof_ros.results.metrics.METRICS`.
        events: rain events.
        wall_s: wall time of the run (s).
        solver: statistics of the controller's solver; None if there is no solver.
        messages: number of messages on each topic in the bag.
        happened: what happened in the run, as for :func:`make_unfinished_summary`.
    """
    return {
        **make_unfinished_summary(run, DONE, **happened | {"last_tick": run.steps}),
        "frost_hours": run.series.frost_hours,
        "precipitation_in_frost_mm": run.series.precipitation_in_frost,
        **metrics,
        "events": event_rows(run.start, events),
        "solver": solver and dict(solver),
        "wall_s": wall_s,
        "times_real_time": run.steps * run.site.tau / wall_s,
        "messages": dict(messages or {}),
    }


def make_unfinished_summary(run: Run, status: str, **happened: Any) -> dict[str, Any]:
    """Assemble the summary of an unfinished run, without metrics, which apply only to whole runs.

    Args:
        run: the run.
        status: status of the run, such as :data:`RUNNING`.
        happened: what happened so far, under the keys of the summary: ``reason``, why the run
            ended; ``last_tick``, the last tick that the plant reported; ``refused``, the number of
            rejected values by topic; ``parameter_changes``, the latest ones with their ticks, and
            ``parameter_change_count``, the number of all.
    """
    choice = run.forecast_choice
    return {
        "status": status,
        "reason": None,
        "last_tick": None,
        "controller": run.controller.name,
        "controller_reference": run.controller.reference,
        "parameters": replace_infinity(run.parameters),
        **describe_setting(run),
        "gaps": run.weather.gaps,
        **asdict(run.weather.climate),
        "forecast": {
            "model": choice.model,
            **choice.options(),
            **({"file": str(choice.file)} if choice.file is not None else {}),
        },
        "sensor_and_pump": run.sensor_and_pump.values(),
        "filled_hours": run.series.filled_hours,
        "refused": {},
        "parameter_changes": [],
        "parameter_change_count": 0,
        "versions": dict(versions()),
        **happened,
    }


def describe_setting(run: Run) -> dict[str, Any]:
    """Return the location and time of a run, and the notes that precede its results."""
    weather = run.weather
    layer = {} if run.site.drainage_storage is None else {"layer_m3": run.site.initial_layer}
    return {
        "initial": {"name": run.initial, "cistern_m3": run.x1, "roof_m3": run.x2, **layer},
        "start": run.start.isoformat(),
        "steps": run.steps,
        "tau_s": run.site.tau,
        "site": str(run.site_file or SITE_FILE),
        "place": [run.site.latitude, run.site.longitude],
        "weather": weather.source,
        "weather_places": [list(place) for place in dict.fromkeys(weather.places.values())],
        "weather_from": weather.first.isoformat(),
        "weather_until": weather.end.isoformat(),
        "evapotranspiration_method": weather.method,
        "notes": run.notes(),
        "weather_notes": run.weather_notes(),
        "weather_summary": run.series.summary,
    }


def write_summary(summary: Mapping[str, Any], directory: Path) -> None:
    """Write a summary to the directory of its run, atomically if possible.

    The table of events is written together with the summary of a completed run. If the disk is too
    full for a second file, the old file is overwritten, so that the end of the run is still
    recorded.

    Raises:
        OSError: if the summary cannot be written.
    """
    path = directory / SUMMARY
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    try:
        replace_text(path, text)
    except OSError as error:
        try:
            with path.open("r+", encoding="utf-8") as stream:
                stream.write(text)
                stream.truncate()
        except OSError:
            # The error from a write does not name the file.
            raise OSError(error.errno, error.strerror, str(path)) from error
    if "events" in summary:
        replace_text(directory / EVENTS, format_events(summary["events"]))
