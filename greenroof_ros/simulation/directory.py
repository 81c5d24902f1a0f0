"""The directory of a run, with its bag, its summary, its logs and its exact configuration."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import datetime
from itertools import count
from pathlib import Path

import yaml

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors, unique_name
from greenroof_ros.physics.storm_water import WITHOUT_RAIN
from greenroof_ros.simulation.inputs import find_needs
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import format_site
from greenroof_ros.weather.records import write_records

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
        site_file = configuration / "site.yaml"
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
