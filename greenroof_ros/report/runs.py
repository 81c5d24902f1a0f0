"""Where the report's runs come from: a study, run directories, or bags alone."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text, shared_directory
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.clairvoyant import NoBoundError, clairvoyant_bound
from greenroof_ros.experiment.run import build_run
from greenroof_ros.forecast.choice import OPTIONS, ForecastChoice
from greenroof_ros.model.sensor_pump_errors import RANGES
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.recording.bag_reader import load_bag
from greenroof_ros.recording.trajectory import Trajectory, read_parquet
from greenroof_ros.report.about import (
    Parameters,
    forecast_label,
    initial_label,
    parameters,
    read_about,
    run_notes,
    sensor_pump_errors_label,
)
from greenroof_ros.weather.reading import read_weather

_RESULT_COLUMNS = (
    "run", "site", "weather", "evapotranspiration", "controller", "initial",
    "cistern_m3", "roof_m3", "status", "error", "total_deviation_m3",
)


@dataclass(frozen=True)
class Seeded:
    """What the table of a study says of a run whose forecasts had random errors.

    Attributes:
        model: the forecasts, without the size and the seed of their errors.
        size: of the errors (1).
        seed: of the errors.
        start: of the run, as headings name it.
        hours: its length (h).
        total_deviation_m3: what it came to.
        bound_m3: the least that any controller could reach; None if unknown.
    """

    model: str
    size: float
    seed: str
    start: str
    hours: float
    total_deviation_m3: float
    bound_m3: float | None


def _unknown_bound(_trajectory: Trajectory) -> float | None:
    return None


@dataclass(frozen=True)
class RunEntry:
    """A finished run, and how to read what happened in it.

    Attributes:
        name: of the run, unique in the report.
        site_name: where its site comes from.
        site: Table I.
        weather: name of the weather.
        method: of the evapotranspiration.
        controller: its name, ``unknown`` where nobody wrote it down.
        parameters: the controller's; no entry where there is no bound.
        initial: name of the initial state, or its volumes.
        notes: what a reader should know of it.
        load: reads the trajectory, and returns it with further notes.
        forecast: what the controller was told of the weather to come; empty where that was what
            came, or nobody wrote it down.
        bound: the least total deviation (m3) that a controller with commands up to 1 could reach,
            given the trajectory; None where it is unknown.
        sensor_pump_errors: of level sensor and pumps; empty where there were none, or nobody wrote
            them down.
        seeded: what a study's table says of it; None unless its forecasts had random errors.
    """

    name: str
    site_name: str
    site: Site
    weather: str
    method: str
    controller: str
    parameters: Parameters
    initial: str
    notes: tuple[str, ...]
    load: Callable[[], tuple[Trajectory, tuple[str, ...]]]
    forecast: str = ""
    bound: Callable[[Trajectory], float | None] = _unknown_bound
    sensor_pump_errors: str = ""
    seeded: Seeded | None = None


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
    names = _names([_run_directory(path).resolve() for path in paths])
    for path, name in zip(paths, names, strict=True):
        if (path / "results.csv").is_file():
            if site_file is not None:
                raise ConfigurationError(
                    f"is for bags; {path} is a study and has its own sites", key="--site"
                )
            _read_study(path, f"{name}/" if len(paths) > 1 else "", sources)
        elif (path / "runs").is_dir() or (path / "configuration" / "study.json").is_file():
            raise ConfigurationError("is a study without results.csv", file=path)
        else:
            sources.runs.append(_bag_entry(path, name, site_file, given))
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


def _names(places: list[Path]) -> list[str]:
    """Return as much of the end of each path as tells it from the others that are not the same."""

    def name(place: Path) -> str:
        return next(
            "/".join(place.parts[-count:])
            for count in range(1, len(place.parts) + 1)
            if all(
                other == place or other.parts[-count:] != place.parts[-count:] for other in places
            )
        )

    return [name(place) for place in places]


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
        given = parameters({column: row[column] for column in parameter_columns})
        initial = initial_label(
            row["initial"],
            _cell(file, line, row, "cistern_m3"),
            _cell(file, line, row, "roof_m3"),
        )
        options = {option: row.get(f"forecast_{option}") for option in OPTIONS}
        forecast = forecast_label(row.get("forecast"), options)
        sensor_pump_errors = sensor_pump_errors_label(
            {key: _cell(file, line, row, key) for key in RANGES if key in row}
        )
        if row["status"] in ("failed", "not run"):
            setting = ", ".join(f"{key} {value}" for key, value in given.items())
            what = ", ".join(
                part
                for part in (
                    row["site"], row["weather"], row.get("start", ""), row["evapotranspiration"],
                    forecast, sensor_pump_errors, row["controller"], setting, initial,
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
        bound = _cell(file, line, row, "bound_m3") if row.get("bound_m3") else None
        seeded = Seeded(
            model=forecast_label(row.get("forecast"), {"members": options["members"]}),
            size=_cell(file, line, row, "forecast_size"),
            seed=options["seed"],
            start=_start(row.get("start", "")),
            hours=_cell(file, line, row, "hours"),
            total_deviation_m3=_cell(file, line, row, "total_deviation_m3"),
            bound_m3=bound,
        ) if options["seed"] else None
        sources.runs.append(
            RunEntry(
                name=prefix + name,
                site_name=row["site"],
                site=sites[row["site"]],
                weather=row["weather"],
                method=row["evapotranspiration"],
                controller=row["controller"],
                parameters=given,
                initial=initial,
                notes=_study_notes(file, line, row),
                load=partial(_load_parquet, path / "runs" / name / "trajectory.parquet"),
                forecast=forecast,
                bound=_as_given(bound),
                sensor_pump_errors=sensor_pump_errors,
                seeded=seeded,
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
    if not path.is_file():
        raise ConfigurationError(
            "is not there; was the study made with --no-trajectories? that is enough for runs of "
            "several forecast seeds only: make it again without, in another directory", file=path,
        )
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


def _start(text: str) -> str:
    """Return a start as headings name it; as it is where it is no time."""
    try:
        return datetime.fromisoformat(text).isoformat(" ", "minutes")
    except ValueError:
        return text


def _as_given(bound: float | None) -> Callable[[Trajectory], float | None]:
    """Return a bound (m3) whatever the trajectory: a study's own, or None where it is unknown."""
    return lambda _trajectory: bound


def _study_notes(file: Path, line: int, row: Mapping[str, str]) -> tuple[str, ...]:
    """Say what the study knows of a run that its trajectory does not show."""
    notes = []
    hours = _cell(file, line, row, "filled_hours")
    if hours:
        note = f"{hours:g} hours of its weather were missing and filled in"
        named = row.get("filled")
        notes.append(f"{note}: {named}" if named else note)
    if row.get("weather_notes"):
        notes.append(row["weather_notes"])
    fallbacks, limited = (_cell(file, line, row, key) for key in ("fallbacks", "limited_steps"))
    return (*notes, *run_notes(fallbacks, row.get("forecast_repeats_from"), limited))


# --- bags --------------------------------------------------------------------------------------


def _run_directory(path: Path) -> Path:
    """Return the directory in which a run wrote about itself: the path, or that of its bag."""
    # The bag in a run directory may be named itself.
    bag = path / "bag" if (path / "bag").is_dir() else path
    return next((place for place in (path, bag.resolve().parent)
                 if (place / "configuration").is_dir()), path)


def _bag_entry(path: Path, name: str, site_file: Path | None, given: Site | None) -> RunEntry:
    """Return the run of a run directory or a bag, under a name."""
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
    run = _run_directory(path)
    own_site = run / "configuration" / "site.yaml"
    notes = []
    if given is not None:
        site, site_name = given, str(site_file)
    elif own_site.is_file():
        site, site_name = read_site(own_site), f"{name}/configuration/site.yaml"
    else:
        site = read_site(shared_directory() / "config" / "site.yaml")
        site_name = "the paper's"
        notes.append("no site file came with the bag: the site is the paper's, config/site.yaml")
    about = read_about(run)
    if about.zone is None:
        notes.append("times are in UTC: no configuration says the offset")
    return RunEntry(
        name=name,
        site_name=site_name,
        site=site,
        weather=about.weather,
        method=about.method,
        controller=about.controller,
        parameters=about.parameters,
        initial=about.initial,
        notes=(*notes, *about.notes),
        load=partial(load_bag, bag, site, about.zone or timezone.utc, mend, about.own),
        forecast=about.forecast,
        # What a sensor reads is neither the roof's initial volume nor its deviation.
        bound=(
            partial(_own_bound, run / "configuration" / "weather", own_site, site,
                    about.method)
            if about.exact_sensor else _as_given(None)
        ),
        sensor_pump_errors=about.sensor_pump_errors,
    )


def _own_bound(
    weather: Path, site_file: Path, site: Site, method: str, trajectory: Trajectory
) -> float | None:
    """Return the least total deviation (m3) that a controller could reach in a run's own weather.

    None where that is unknown: there are no weather files, or they are not what the bag has.
    """
    steps = len(trajectory.time) - 1
    weather_files = sorted(weather.glob("*"))
    if not weather_files or not np.allclose(
        trajectory.time, site.tau * np.arange(steps + 1), rtol=0, atol=1e-6
    ):
        return None
    try:
        run = build_run(
            site_file, site, read_weather(weather_files, site, method),
            trajectory.start.isoformat(), steps, find_controller("onoff"), {}, "custom",
            (float(trajectory.cistern[0]), float(trajectory.roof[0])), ForecastChoice(),
        )
        for ours, theirs in (
            (run.series.precipitation, trajectory.precipitation),
            (run.series.evapotranspiration, trajectory.evapotranspiration),
        ):
            if not np.allclose(ours[:steps], theirs[:-1], rtol=1e-9, atol=0):
                return None
        return clairvoyant_bound(run).bound_m3
    except (ConfigurationError, NoBoundError):
        return None
