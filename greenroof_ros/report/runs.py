"""Where the report's runs come from: a study, run directories, or bags alone."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone, tzinfo
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.errors import ConfigurationError
from greenroof_ros.files import YamlMapping, read_text, read_yaml, shared_directory
from greenroof_ros.forecast_models import OPTIONS, PERFECT
from greenroof_ros.site import Site, read_site
from greenroof_ros.topics import read_topics
from greenroof_ros.trajectory import Trajectory, read_parquet

_TYPE = "std_msgs/msg/Float64"
# Topic: attribute of a trajectory. A sample needs the first four; the others count as 0.
_NEEDED = {
    "/roof/level": "roof",
    "/cistern/level": "cistern",
    "/pump/command": "command",
    "/pump/flow": "pump_flow",
}
_OPTIONAL = {
    "/weather/precipitation": "precipitation",
    "/weather/evapotranspiration": "evapotranspiration",
    "/cistern/outflow": "outflow",
    "/roof/drainage": "drainage",
    "/weather/frost": "frost",
}
_RESULT_COLUMNS = (
    "run", "site", "weather", "evapotranspiration", "controller", "initial",
    "cistern_m3", "roof_m3", "status", "error", "total_deviation_m3",
)
_EPOCH = datetime.fromisoformat("1970-01-01T00:00+00:00")

Parameters = dict[str, "float | str"]


@dataclass(frozen=True)
class RunEntry:
    """A finished run, and how to read what happened in it.

    Attributes:
        name: of the run, unique in the report.
        site_name: where its site comes from.
        site: Table I.
        weather: name of the weather.
        variant: of the evapotranspiration.
        controller: its name, ``unknown`` where nobody wrote it down.
        parameters: the controller's; no entry where there is no bound.
        initial: name of the initial state, or its volumes.
        notes: what a reader should know of it.
        load: reads the trajectory, and returns it with further notes.
        forecast: what the controller was told of the weather to come; empty where that was what
            came, or nobody wrote it down.
    """

    name: str
    site_name: str
    site: Site
    weather: str
    variant: str
    controller: str
    parameters: Parameters
    initial: str
    notes: tuple[str, ...]
    load: Callable[[], tuple[Trajectory, tuple[str, ...]]]
    forecast: str = ""


@dataclass(frozen=True)
class FailedRun:
    """A run of a study that came to no end, or was not begun, and why."""

    name: str
    what: str
    error: str


@dataclass
class Sources:
    """All that a report is made from.

    Attributes:
        runs: the finished ones.
        failed: the others.
        configuration: name and text of each further file that decided the numbers.
    """

    runs: list[RunEntry] = field(default_factory=list)
    failed: list[FailedRun] = field(default_factory=list)
    configuration: dict[str, str] = field(default_factory=dict)


def find_runs(paths: list[Path], site_file: Path | None) -> Sources:
    """Find the runs under some paths; their trajectories are read later, one by one.

    Args:
        paths: study directories, run directories and bags.
        site_file: the site of all bags, instead of the one that lies beside each.

    Raises:
        ConfigurationError: a path is none of these, or what it holds is wrong.
    """
    sources = Sources()
    given = read_site(site_file) if site_file is not None else None
    for path in paths:
        if not path.exists():
            raise ConfigurationError("does not exist", file=path)
        if not path.is_dir():
            raise ConfigurationError(
                "must be a directory: of a study, of a run, or a bag", file=path
            )
        prefix = f"{path.resolve().name}/" if len(paths) > 1 else ""
        if (path / "results.csv").is_file():
            if site_file is not None:
                raise ConfigurationError(
                    f"is for bags; {path} is a study and has its own sites", key="--site"
                )
            _read_study(path, prefix, sources)
        elif (path / "runs").is_dir() or (path / "configuration" / "study.json").is_file():
            raise ConfigurationError("is a study without results.csv", file=path)
        else:
            sources.runs.append(_bag_entry(path, site_file, given))
    names = [run.name for run in sources.runs]
    for name in names:
        if names.count(name) > 1:
            raise ConfigurationError(f"two runs are named {name}; give each path once")
    if not sources.runs:
        raise ConfigurationError(
            f"holds no finished run; {len(sources.failed)} failed or did not run",
            file=paths[0] / "results.csv",
        )
    return sources


# --- studies -----------------------------------------------------------------------------------


def _read_study(path: Path, prefix: str, sources: Sources) -> None:
    """Add the runs of a study."""
    file = path / "results.csv"
    reader = csv.DictReader(io.StringIO(read_text(file)))
    header = list(reader.fieldnames or ())
    missing = [column for column in _RESULT_COLUMNS if column not in header]
    if missing:
        raise ConfigurationError(
            f"has no column {', '.join(missing)}; is it the results.csv of a study?",
            file=file, line=1,
        )
    # A controller's parameters are the columns between the initial state and the status, whatever
    # the controller.
    parameter_columns = header[header.index("roof_m3") + 1 : header.index("status")]
    sites: dict[str, Site] = {}
    for row in reader:
        line = reader.line_num
        if None in row or None in row.values():
            raise ConfigurationError(f"must have {len(header)} cells", file=file, line=line)
        name = row["run"]
        if not name or Path(name).name != name:
            raise ConfigurationError(
                "must be the name of a directory under runs/",
                file=file, line=line, key="run", value=name,
            )
        parameters = _parameters({column: row[column] for column in parameter_columns})
        initial = _initial_label(
            row["initial"],
            _cell(file, line, row, "cistern_m3"),
            _cell(file, line, row, "roof_m3"),
        )
        forecast = _forecast_label(
            row.get("forecast"), {option: row.get(f"forecast_{option}") for option in OPTIONS}
        )
        if row["status"] in ("failed", "not run"):
            setting = ", ".join(f"{key} {value}" for key, value in parameters.items())
            what = ", ".join(
                part
                for part in (
                    row["site"], row["weather"], row.get("start", ""), row["evapotranspiration"],
                    forecast, row["controller"], setting, initial,
                )
                if part
            )
            sources.failed.append(FailedRun(prefix + name, what, row["error"] or row["status"]))
            continue
        if row["status"] != "done":
            raise ConfigurationError(
                "must be done, failed or not run",
                file=file, line=line, key="status", value=row["status"],
            )
        if row["site"] not in sites:
            sites[row["site"]] = read_site(path / "configuration" / row["site"])
        sources.runs.append(
            RunEntry(
                name=prefix + name,
                site_name=row["site"],
                site=sites[row["site"]],
                weather=row["weather"],
                variant=row["evapotranspiration"],
                controller=row["controller"],
                parameters=parameters,
                initial=initial,
                notes=_study_notes(file, line, row),
                load=partial(_load_parquet, path / "runs" / name / "trajectory.parquet"),
                forecast=forecast,
            )
        )
    if not sources.runs and not sources.failed:
        raise ConfigurationError("has a header but no runs", file=file)
    for further in sorted((path / "configuration").glob("*")):
        # Sites appear as a table of their own; weather files are long, and named with each run.
        if further.suffix in (".json", ".yaml") and further.name not in sites:
            sources.configuration[prefix + further.name] = read_text(further)


def _load_parquet(path: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """Read the trajectory of a study's run."""
    trajectory = read_parquet(path)
    if len(trajectory.time) < 2 or not (np.diff(trajectory.time) > 0).all():
        raise ConfigurationError("must have two samples or more, in the order of time", file=path)
    return trajectory, ()


def _cell(file: Path, line: int, row: Mapping[str, str], key: str) -> float:
    """Return a number of the results; a blank counts as 0."""
    try:
        return float(row.get(key) or 0)
    except ValueError as error:
        raise ConfigurationError(
            "must be a number", file=file, line=line, key=key, value=row[key]
        ) from error


def _study_notes(file: Path, line: int, row: Mapping[str, str]) -> tuple[str, ...]:
    """Say what the study knows of a run that its trajectory does not show."""
    notes = []
    filled = _cell(file, line, row, "filled_hours")
    if filled:
        notes.append(f"{filled:g} hours of its weather were missing and filled in")
    fallbacks = _cell(file, line, row, "fallbacks")
    if fallbacks:
        notes.append(f"the controller's solver found no answer in {fallbacks:g} ticks")
    if row.get("forecast_repeats_from"):
        notes.append(
            f"the forecast repeats its last record from {row['forecast_repeats_from']} on"
        )
    limited = _cell(file, line, row, "limited_steps")
    if limited:
        notes.append(f"a tank ran empty in {limited:g} ticks, and what left it was limited")
    return tuple(notes)


def _parameters(cells: Mapping[str, object]) -> Parameters:
    """Return the parameters that are there and mean something: no blank, no infinite bound."""
    parameters: Parameters = {}
    for key, cell in cells.items():
        if cell is None or cell == "":
            continue
        try:
            value = float(str(cell))
        except ValueError:
            parameters[key] = str(cell)
            continue
        if math.isfinite(value):
            parameters[key] = value
    return parameters


def _forecast_label(name: str | None, options: Mapping[str, object]) -> str:
    """Return a name for forecasts with those of their options that are there; none if perfect."""
    if not name or name == PERFECT:
        return ""
    given = {option: options.get(option) for option in OPTIONS}
    texts = [f"{option} {value}" for option, value in given.items() if value not in (None, "")]
    return " ".join([Path(name).name, *texts])


def _initial_label(name: str, cistern: float, roof: float) -> str:
    """Return a name for an initial state, its volumes where it has none."""
    return f"{cistern:.4g} / {roof:.4g} m3" if name in ("", "custom") else name


# --- bags --------------------------------------------------------------------------------------


def _bag_entry(path: Path, site_file: Path | None, given: Site | None) -> RunEntry:
    """Return the run of a run directory or a bag."""
    bag = path / "bag" if (path / "bag").is_dir() else path
    mend = f"python -m greenroof_ros.recover {path} makes a whole one"
    if not (bag / "metadata.yaml").is_file():
        if any(bag.glob("*.mcap")) or any(bag.glob("*.db3")):
            raise ConfigurationError(f"has no metadata.yaml, its recorder was killed; {mend}",
                                     file=bag)
        raise ConfigurationError(
            "must be a study (with results.csv), a run (with bag/) or a bag (with metadata.yaml)",
            file=path,
        )
    # The bag in a run directory may be named itself.
    run = next((place for place in (path, bag.resolve().parent)
                if (place / "configuration").is_dir()), path)
    own_site = run / "configuration" / "site.yaml"
    notes = []
    if given is not None:
        site, site_name = given, str(site_file)
    elif own_site.is_file():
        site, site_name = read_site(own_site), f"{run.resolve().name}/configuration/site.yaml"
    else:
        site = read_site(shared_directory() / "config" / "site.yaml")
        site_name = "the paper's"
        notes.append("no site file came with the bag: the site is the paper's, config/site.yaml")
    about = _about(run)
    initial: dict[str, Any] = about.get("initial") or {}
    forecast: dict[str, Any] = about.get("forecast") or {}
    if about.get("limited_steps"):
        notes.append(
            f"a tank ran empty in {about['limited_steps']} ticks, and what left it was limited"
        )
    for quantity, hours in (about.get("filled") or {}).items():
        notes.append(f"{quantity} was missing and filled in: {', '.join(hours)}")
    zone: tzinfo = timezone.utc
    try:
        zone = datetime.fromisoformat(about["start"]).tzinfo or zone
    except (KeyError, ValueError):
        notes.append("times are in UTC: no configuration says the offset")
    return RunEntry(
        name=run.resolve().name,
        site_name=site_name,
        site=site,
        weather=Path(about.get("weather") or "as recorded").name,
        variant=str(about.get("evapotranspiration_variant") or "unknown"),
        controller=str(about.get("controller") or "unknown"),
        parameters=_parameters(about.get("parameters") or {}),
        initial=(
            _initial_label(initial.get("name", ""), initial["cistern_m3"], initial["roof_m3"])
            if initial else "as recorded"
        ),
        notes=tuple(notes),
        load=partial(_load_bag, bag, site, zone, mend),
        forecast=_forecast_label(forecast.get("file") or forecast.get("model"), forecast),
    )


def _about(run: Path) -> dict[str, Any]:
    """Return what a run wrote about itself: its summary, or the parameters of its nodes."""
    summary = run / "summary.json"
    if summary.is_file():
        try:
            content = json.loads(read_text(summary))
        except ValueError as error:
            raise ConfigurationError(f"is not valid JSON: {error}", file=summary) from error
        if not isinstance(content, dict):
            raise ConfigurationError("must hold one object", file=summary)
        return content
    file = run / "configuration" / "parameters.yaml"
    if not file.is_file():
        return {}
    nodes: dict[str, YamlMapping] = {}
    for key, section in read_yaml(file).items():
        values = section.get("ros__parameters") if isinstance(section, YamlMapping) else None
        if not isinstance(values, YamlMapping):
            raise ConfigurationError("must hold 'ros__parameters:'", file=file, key=key)
        nodes[key.removeprefix("/**/")] = values
    empty = YamlMapping()
    plant, weather = nodes.get("plant", empty), nodes.get("weather", empty)
    controller = nodes.get("recorder", empty).get("controller")
    about: dict[str, Any] = {
        "controller": controller,
        "parameters": {
            key: value
            for key, value in nodes.get(str(controller), empty).items() if key != "site_file"
        },
        "weather": weather.get("weather_file"),
        "evapotranspiration_variant": weather.get("evapotranspiration"),
        "forecast": {
            "model": weather.get("forecast"),
            **{option: weather.get(f"forecast_{option}") for option in OPTIONS},
        },
    }
    if "cistern" in plant and "roof" in plant:
        about["initial"] = {"cistern_m3": plant["cistern"], "roof_m3": plant["roof"]}
    if "start" in plant:
        about["start"] = plant["start"]
    return about


def _load_bag(
    bag: Path, site: Site, zone: tzinfo, mend: str
) -> tuple[Trajectory, tuple[str, ...]]:
    """Read what happened from a bag alone.

    A sample is a message of /roof/level, at the time at which it was logged; every other topic
    has its last value at or before it. The bags of this package have all topics of a tick at one
    time, so that this is exact for them.

    Raises:
        ConfigurationError: the bag is damaged, foreign, or its values cannot be true.
    """
    times, values = _read_topics(bag, mend)
    notes = [f"{topic} is not in the bag and counts as 0" for topic in _OPTIONAL
             if topic not in times]
    stamps = times["/roof/level"]
    # Of messages with one stamp the last counts.
    last = np.append(np.diff(stamps) > 0, True)
    first = max(times[topic][0] for topic in _NEEDED)
    samples = stamps[last]
    samples = samples[samples >= first]
    if len(samples) < 2:
        raise ConfigurationError(
            f"must hold two samples of {', '.join(_NEEDED)} at least, not {len(samples)}",
            file=bag,
        )
    columns: dict[str, NDArray[np.float64]] = {}
    for topic, name in {**_NEEDED, **_OPTIONAL}.items():
        columns[name] = np.zeros(len(samples))
        if topic in times:
            index = np.searchsorted(times[topic], samples, side="right") - 1
            columns[name] = np.where(index >= 0, values[topic][np.maximum(index, 0)], 0.0)
    if columns["roof"].max() > 2 * site.z_soil:
        raise ConfigurationError(
            f"/roof/level reaches {columns['roof'].max():g} m, more than twice the soil's depth of "
            f"{site.z_soil:g} m; is a unit wrong?",
            file=bag,
        )
    columns["roof"] = columns["roof"] * site.a2
    columns["cistern"] = columns["cistern"] * site.a1
    start = _EPOCH + timedelta(microseconds=int(samples[0]) // 1000)
    time = (samples - samples[0]) / 1e9
    return Trajectory(start.astimezone(zone), time, **columns), tuple(notes)


def _read_topics(
    bag: Path, mend: str
) -> tuple[dict[str, NDArray[np.int64]], dict[str, NDArray[np.float64]]]:
    """Return the log times (ns) and values of each topic that the report uses, in time's order."""
    highlevel, typesys = _rosbags()
    wanted = {**_NEEDED, **_OPTIONAL}
    times: dict[str, list[int]] = {}
    values: dict[str, list[float]] = {}
    try:
        with highlevel.AnyReader(
            [bag], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
        ) as reader:
            found = {connection.topic: connection.msgtype for connection in reader.connections}
            _check_topics(bag, found)
            connections = [one for one in reader.connections if one.topic in wanted]
            for connection, stamp, raw in reader.messages(connections=connections):
                value = reader.deserialize(raw, connection.msgtype).data
                times.setdefault(connection.topic, []).append(stamp)
                values.setdefault(connection.topic, []).append(value)
    except ConfigurationError:
        raise
    except Exception as error:  # rosbags hands on whatever its storages and codecs raise
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigurationError(
            f"cannot be read as a bag: {reason} If its recorder was killed, {mend}", file=bag
        ) from error
    silent = [topic for topic in _NEEDED if topic not in times]
    if silent:
        raise ConfigurationError(f"holds no message of {', '.join(silent)}", file=bag)
    contract = read_topics()
    arrays = {topic: np.array(column) for topic, column in values.items()}
    for topic, column in arrays.items():
        low, high = contract[topic].low, contract[topic].high
        wrong = np.flatnonzero(~((column >= low) & (column <= high)))  # a NaN is neither
        if len(wrong):
            when = _EPOCH + timedelta(microseconds=times[topic][wrong[0]] // 1000)
            raise ConfigurationError(
                f"must be from {low:g} to {high:g} {contract[topic].unit}, but is "
                f"{column[wrong[0]]:g} at {when.isoformat()}; is a unit wrong?",
                file=bag, key=topic,
            )
    return {topic: np.array(stamps) for topic, stamps in times.items()}, arrays


def _check_topics(bag: Path, found: Mapping[str, str]) -> None:
    """Refuse a bag that lacks a needed topic, or has one of another type."""
    missing = [topic for topic in _NEEDED if topic not in found]
    if missing:
        there = ", ".join(sorted(found)) or "none"
        raise ConfigurationError(
            f"has no {', '.join(missing)}, which the report needs; its topics are: {there}",
            file=bag,
        )
    for topic in (*_NEEDED, *_OPTIONAL):
        if found.get(topic, _TYPE) != _TYPE:
            raise ConfigurationError(
                f"must be of type {_TYPE}, not {found[topic]}", file=bag, key=topic
            )


def _rosbags() -> tuple[ModuleType, ModuleType]:
    """Import rosbags, which a plain installation does not have."""
    try:
        from rosbags import highlevel, typesys
    except ModuleNotFoundError as error:
        raise ConfigurationError("needs rosbags: pip install 'greenroof_ros[study]'") from error
    return highlevel, typesys
