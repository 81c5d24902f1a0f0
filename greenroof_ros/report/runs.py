"""Where a report's runs come from: studies by their ``results.csv``, run directories, and bags."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache, partial
from pathlib import Path

import numpy as np
import polars as pl

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import file_digest, read_text
from greenroof_ros.common.times import to_people
from greenroof_ros.model.metrics import METRICS
from greenroof_ros.model.sensor_pump_errors import PARAMETERS
from greenroof_ros.model.site import read_site
from greenroof_ros.recording.bag_reader import Recorded
from greenroof_ros.recording.results_table import row_parameters
from greenroof_ros.recording.trajectory import read_parquet
from greenroof_ros.report.about import (
    NO_ERRORS,
    Row,
    Run,
    labels,
    meaning_of_initial,
    notes_of,
    parameters,
)
from greenroof_ros.report.bags import read_run, run_directory

_NEEDED = (
    "run", "site", "weather", "start", "hours", "evapotranspiration", "controller", "initial",
    "cistern_m3", "roof_m3", "status", "error", "total_deviation_m3",
)
# Those of a study's table that are numbers; all else is text.
_NUMBERS = (
    "hours", "cistern_m3", "roof_m3", "fallbacks", "filled_hours", "frost_hours", "bound_m3",
    *PARAMETERS, *(metric.name for metric in METRICS),
)


_STATUS = ("done", "failed", "not run")


@dataclass
class Sources:
    """All that a report is made from.

    Attributes:
        runs: those that left something to show.
        failed: the others, each with ``run``, ``what`` it was and its ``error``.
        configuration: name and text of each further file that decided the numbers.
    """

    runs: list[Run] = field(default_factory=list)
    failed: list[Row] = field(default_factory=list)
    configuration: dict[str, str] = field(default_factory=dict)


def find_runs(paths: list[Path], site_file: Path | None) -> Sources:
    """Find the runs under some paths; what happened in them is read later, one by one.

    Args:
        paths: study directories, run directories and bags.
        site_file: the site of all bags, instead of the one that lies beside each.

    Raises:
        ConfigurationError: a path is none of these, or what it holds is wrong.
    """
    sources = Sources()
    for path in paths:
        if not path.is_dir():
            wrong = "must be a directory: of a study, of a run, or a bag"
            raise ConfigurationError(wrong if path.exists() else "does not exist", file=path)
    places = [run_directory(path).resolve() for path in paths]
    for path, place in zip(paths, places, strict=True):
        name = _name(place, places)
        if (path / "results.csv").is_file():
            if site_file is not None:
                raise ConfigurationError(
                    f"is for bags; {path} is a study and has its own sites", key="--site"
                )
            _read_study(path, name, f"{name}/" if len(paths) > 1 else "", sources)
        elif (path / "runs").is_dir() or (path / "configuration" / "study.json").is_file():
            raise ConfigurationError("is a study without results.csv", file=path)
        else:
            run = read_run(path, name, site_file)
            if isinstance(run, Run):
                sources.runs.append(run)
            else:
                sources.failed.append(run)
    for name, count in Counter(run.name for run in sources.runs).items():
        if count > 1:
            raise ConfigurationError(f"two runs are named {name}; give each path once")
    sources.runs = _told_apart(sources.runs)
    return sources


def _name(place: Path, places: list[Path]) -> str:
    """Return as much of the end of a path as distinguishes it from the others."""
    others = [other.parts for other in places if other != place]
    return next(
        "/".join(place.parts[-count:]) for count in range(1, len(place.parts) + 1)
        if all(other[-count:] != place.parts[-count:] for other in others)
    )


def _told_apart(runs: Sequence[Run]) -> list[Run]:
    """Give different things of one name different names: the source is added to each.

    Equal ones keep an equal name, their first source's, so that their runs are compared.
    """
    told = list(runs)
    for key, columns in (
        ("site", ["site"]), ("weather", ["weather"]), ("from", ["from"]),
        ("forecast", ["forecast", "model", "kind of forecast"]),
    ):
        sources: dict[str, dict[object, str]] = {}
        for run in told:
            sources.setdefault(run.row[key], {}).setdefault(run.meant.get(key), run.source)
        for place, run in enumerate(told):
            of = sources[run.row[key]]
            if len({*of.values()}) > 1:  # a source tells nothing apart that is all in it
                source = of[run.meant.get(key)]
                own = {column: f"{run.row[column]} ({source})" for column in columns}
                told[place] = replace(run, row=run.row | own)
    return told


def _read_study(path: Path, source: str, prefix: str, sources: Sources) -> None:
    """Add the runs of a study, whose names begin with a prefix."""
    configuration, sites = path / "configuration", set[str]()
    # Files that hundreds of runs share.
    read, digest = cache(read_site), cache(file_digest)
    for row in read_results(path / "results.csv").to_dicts():
        run, given = row["run"], parameters(row_parameters(row))
        row |= {**labels(row), **_season(row), "run": prefix + run}
        if row["status"] != "done":
            sources.failed.append(_failed(row, given))
            continue
        site = read(configuration / row["site"])
        sites.add(row["site"])
        # In simulations nothing is pumped in frost.
        row["frost_pumped_m3"] = 0.0
        trajectory = path / "runs" / run / "trajectory.parquet"
        forecasts = (row.get(key) for key in ("forecast", "forecast_skill", "forecast_dressed"))
        sources.runs.append(Run(
            row=row,
            site=site,
            parameters=given,
            load=partial(_load, trajectory) if trajectory.exists() else None,
            notes=tuple(notes_of(row)),
            source=source,
            meant={
                "site": site,
                "weather": digest(configuration / row["weather"]) or source,
                "forecast": tuple(digest(configuration / (name or "")) for name in forecasts),
                "from": meaning_of_initial(row),
            },
        ))
    for further in sorted(configuration.glob("*")):
        # Sites appear as a table of their own; weather files are long, and named with each run.
        if further.suffix in (".json", ".yaml") and further.name not in sites:
            sources.configuration[prefix + further.name] = read_text(further)


def read_results(file: Path) -> pl.DataFrame:
    """Return a study's table as it is, a row a run; an empty cell is null.

    Raises:
        ConfigurationError: it is another table, or was cut short.
    """
    text = read_text(file)
    try:
        table = pl.read_csv(io.StringIO(text), infer_schema=False)
    except pl.exceptions.PolarsError as error:
        reason = str(error).partition("\n")[0]
        raise ConfigurationError(f"is no table of a study: {reason}", file=file) from error
    missing = [column for column in _NEEDED if column not in table.columns]
    if missing:
        raise ConfigurationError(
            f"has no column {', '.join(missing)}; is it the results.csv of a study?",
            file=file, line=1,
        )
    if not text.endswith("\n"):
        raise ConfigurationError(
            "ends within a line, as a copy that was cut short; copy it again",
            file=file, line=text.count("\n") + 1,
        )
    rows = csv.reader(io.StringIO(text))
    for cells in rows:  # polars takes what a short row lacks as empty
        if len(cells) != len(table.columns):
            raise ConfigurationError(
                f"must have {len(table.columns)} cells, not {len(cells)}", file=file,
                line=rows.line_num,
            )
    if table.is_empty():
        raise ConfigurationError("has a header but no runs", file=file)
    names = [column for column in _NUMBERS if column in table.columns]
    numbers = table.with_columns(pl.col(names).cast(pl.Float64, strict=False))
    outside = pl.col("run").is_null() | pl.col("run").str.contains("/|^[.]*$")
    for key, wrong, expected in (
        ("run", outside, "the name of a directory under runs/"),
        ("status", ~pl.col("status").fill_null("").is_in(_STATUS), "done, failed or not run"),
        *((name, pl.col(name).is_not_null() & numbers[name].is_null(), "a number")
          for name in names),
    ):
        for place in table.select(wrong.arg_true()).to_series():
            before = "".join(cell or "" for row in table[:place].rows() for cell in row)
            raise ConfigurationError(
                f"must be {expected}", file=file, line=place + 2 + before.count("\n"), key=key,
                value=table[key][place],
            )
    volumes = pl.col("hours", "cistern_m3", "roof_m3").fill_null(0.0)
    return numbers.with_columns(volumes)


def _failed(row: Row, given: dict[str, float | str]) -> Row:
    """Return what is said of a run that failed or was not begun."""
    errors = row["sensor and pump errors"]
    parts = (
        row["site"], row["weather"], row["start"], row["evapotranspiration"], row["forecast"],
        "" if errors == NO_ERRORS else errors, row["controller"],
        ", ".join(f"{key} {value}" for key, value in given.items()), row["from"],
    )
    return {
        "run": row["run"], "what": ", ".join(filter(None, parts)),
        "error": row["error"] or row["status"],
    }


def _season(row: Row) -> Row:
    """Return the start of a run as headings name it, and of one of a week or more its season.

    That is the year, when it begins in it, and the deviation of each whole week (m3).
    """
    try:
        start = datetime.fromisoformat(row["start"])
        weeks = [float(week) for week in (row.get("weekly_deviation_m3") or "").split()]
    except ValueError:
        return {}
    whole = int(row["hours"] // 168)
    season = {"year": start.year, "begins": f"{start:%d %B %H:%M}", "season": weeks[:whole]}
    return {"start": to_people(start), **(season if 0 < whole <= len(weeks) else {})}


def _load(path: Path) -> Recorded:
    """Read the trajectory of a study's run."""
    trajectory = read_parquet(path)
    if len(trajectory.time) < 2 or not (np.diff(trajectory.time) > 0).all():
        raise ConfigurationError("must have two samples or more, in the order of time", file=path)
    return Recorded(trajectory)
