"""The runs of a study, from its ``results.csv``."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from datetime import datetime
from functools import cache, partial
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import file_digest, read_text
from greenroof_ros.common.times import to_people
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.model.metrics import METRICS
from greenroof_ros.model.sensor_pump_errors import PARAMETERS
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.recording.bag_reader import Recorded
from greenroof_ros.recording.results_table import row_parameters
from greenroof_ros.recording.trajectory import read_parquet
from greenroof_ros.report.about import (
    LABELLED,
    forecast_label,
    initial_label,
    parameters,
    run_notes,
    sensor_pump_errors_label,
    suspicion,
    what_initial,
)
from greenroof_ros.report.entries import (
    FailedRun,
    Note,
    RunEntry,
    Season,
    Seeded,
    Sources,
    known_bound,
)

_RESULT_COLUMNS = (
    "run", "site", "weather", "evapotranspiration", "controller", "initial",
    "cistern_m3", "roof_m3", "status", "error", "total_deviation_m3",
)

_WEEK_H = 168


def read_study(path: Path, source: str, prefix: str, sources: Sources) -> None:
    """Add the runs of a study, whose names begin with a prefix."""
    file = path / "results.csv"
    reader = csv.DictReader(io.StringIO(read_text(file)))
    header = list(reader.fieldnames or ())
    missing = [column for column in _RESULT_COLUMNS if column not in header]
    if missing:
        raise ConfigurationError(
            f"has no column {', '.join(missing)}; is it the results.csv of a study?",
            file=file, line=1,
        )
    sites: dict[str, Site] = {}
    configuration = path / "configuration"
    digest = cache(file_digest)  # of files that hundreds of runs share
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
        given = parameters(row_parameters(row))
        volumes = (_cell(file, line, row, "cistern_m3"), _cell(file, line, row, "roof_m3"))
        initial = initial_label(row["initial"], *volumes)
        options = {option: row.get(f"forecast_{option}") for option in LABELLED}
        forecast = forecast_label(row.get("forecast"), options)
        sensor_pump_errors = sensor_pump_errors_label(
            {key: _cell(file, line, row, key) for key in PARAMETERS if key in row}
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
            sites[row["site"]] = read_site(configuration / row["site"])
        bound = _cell(file, line, row, "bound_m3") if row.get("bound_m3") else None
        seeded = Seeded(
            model=forecast_label(row.get("forecast"), {"members": options["members"]}),
            skill=options["skill"] or "",
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
                load=partial(
                    _load_parquet, path / "runs" / name / "trajectory.parquet",
                    sites[row["site"]].tau,
                ),
                forecast=forecast,
                bound=known_bound(bound),
                sensor_pump_errors=sensor_pump_errors,
                seeded=seeded,
                season=_season(file, line, row, bound),
                source=source,
                meant={
                    "site_name": sites[row["site"]],
                    "weather": digest(configuration / row["weather"]) or source,
                    "forecast": (
                        digest(configuration / row.get("forecast", "")),
                        digest(configuration / (options["skill"] or "")),
                        digest(configuration / (options["dressed"] or "")),
                    ),
                    "initial": what_initial(row["initial"], *volumes),
                },
            )
        )
    if not sources.runs and not sources.failed:
        raise ConfigurationError("has a header but no runs", file=file)
    for further in sorted(configuration.glob("*")):
        # Sites appear as a table of their own; weather files are long, and named with each run.
        if further.suffix in (".json", ".yaml") and further.name not in sites:
            sources.configuration[prefix + further.name] = read_text(further)


def _season(
    file: Path, line: int, row: Mapping[str, str], bound: float | None
) -> Season | None:
    """Return what a row says of a run of a week or more; None of a shorter one."""
    hours = _cell(file, line, row, "hours")
    try:
        start = datetime.fromisoformat(row.get("start", ""))
        weeks = tuple(map(float, row.get("weekly_deviation_m3", "").split()))
    except ValueError:
        return None
    whole = int(hours // _WEEK_H)
    if not whole or len(weeks) < whole:
        return None
    options = {option: row.get(f"forecast_{option}") for option in LABELLED if option != "seed"}
    return Season(
        year=start.year,
        begins=f"{start:%d %B %H:%M}",
        hours=hours,
        metrics={
            metric.name: _cell(file, line, row, metric.name)
            for metric in METRICS if row.get(metric.name)
        },
        weeks=weeks[:whole],
        forecast=forecast_label(row.get("forecast"), options) or PERFECT,
        seed=row.get("forecast_seed", ""),
        bound_m3=bound,
    )


def _load_parquet(path: Path, tau: float) -> Recorded:
    """Read the trajectory of a study's run, whose ticks last tau (s)."""
    if not path.is_file():
        raise ConfigurationError(
            "is not there; was the study made with --no-trajectories? that is enough for runs of "
            "several forecast seeds, or of the same season of several years, only: make it again "
            "without, in another directory", file=path,
        )
    trajectory = read_parquet(path)
    if len(trajectory.time) < 2 or not (np.diff(trajectory.time) > 0).all():
        raise ConfigurationError("must have two samples or more, in the order of time", file=path)
    spacing = float(np.diff(trajectory.time).max())
    if spacing < 1.5 * tau:
        return Recorded(trajectory)
    return Recorded(trajectory, (
        f"samples every {spacing:g} s were kept, of ticks of {tau:g} s: its sums, counts and times "
        "are those of the samples; the study's table has the exact ones",
    ))


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
        return to_people(datetime.fromisoformat(text))
    except ValueError:
        return text


def _study_notes(file: Path, line: int, row: Mapping[str, str]) -> tuple[Note, ...]:
    """Say what the study knows of a run that its trajectory does not show."""
    notes = []
    hours = _cell(file, line, row, "filled_hours")
    if hours:
        since = _start(row.get("start", "its start"))
        notes.append(Note(
            f"{hours:g} hours of the weather from {since} were missing and filled in",
            listed=row.get("filled", ""),
        ))
    if row.get("weather_notes"):
        notes.append(Note(row["weather_notes"]))
    if row.get("suspicious"):
        notes.append(suspicion(row["suspicious"]))
    fallbacks, limited = (_cell(file, line, row, key) for key in ("fallbacks", "limited_steps"))
    return (*notes, *run_notes(fallbacks, row.get("forecast_repeats_from"), limited))
