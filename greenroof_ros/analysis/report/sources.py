"""Where a report's runs come from: studies by their ``results.csv``, run directories, and bags."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache, partial
from pathlib import Path

import polars as pl

from greenroof_ros.analysis.report.bags import load_trajectory, read_run, run_directory
from greenroof_ros.analysis.report.run import (
    NO_ERRORS,
    ReportedRun,
    Row,
    labels,
    meaning_of_initial,
    notes_of,
    parameters,
)
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import file_digest, read_text
from greenroof_ros.common.times import to_people
from greenroof_ros.model.metrics import METRICS
from greenroof_ros.model.sensor_pump_errors import PARAMETERS
from greenroof_ros.model.site import read_site
from greenroof_ros.recording.results_table import row_parameters
from greenroof_ros.recording.trajectory import TRAJECTORY

_NEEDED = (
    "run", "site", "weather", "start", "hours", "evapotranspiration", "controller", "initial",
    "cistern_m3", "roof_m3", "status", "error", "total_deviation_m3",
)
# The numeric columns of a study's table; the others are text.
_NUMBERS = (
    "hours", "cistern_m3", "roof_m3", "fallbacks", "filled_hours", "frost_hours", "bound_m3",
    *PARAMETERS, *(metric.name for metric in METRICS),
)


@dataclass
class Sources:
    """The runs and files that a report is made from.

    Attributes:
        runs: those with results.
        failed: the others, each with ``run``, a description ``what`` and its ``error``.
        configuration: name and text of each further file that affects the results.
    """

    runs: list[ReportedRun] = field(default_factory=list)
    failed: list[Row] = field(default_factory=list)
    configuration: dict[str, str] = field(default_factory=dict)


def find_runs(paths: list[Path], site_file: Path | None) -> Sources:
    """Find the runs under some paths. Trajectories are read later, one by one.

    Args:
        paths: study directories, run directories and bags.
        site_file: the site of all bags, instead of the site file next to each.

    Raises:
        ConfigurationError: a path is none of these, its content is wrong, or two have one name.
    """
    sources = Sources()
    for path in paths:
        if not path.is_dir() and not (path.is_file() and path.suffix.lower() == ".mcap"):
            wrong = "must be a directory (of a study, of a run, or a bag), or an .mcap file"
            if path.suffix == ".db3":
                wrong += f"; this file's bag is {path.parent}"
            raise ConfigurationError(wrong if path.exists() else "does not exist", file=path)
    named: dict[str, Path] = {}
    for path in paths:
        name = run_directory(path).resolve().name
        if name in named:
            raise ConfigurationError(
                f"{named[name]} and {path} have one name, {name}: give each path once, or rename "
                "one of the directories"
            )
        named[name] = path
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
            if isinstance(run, ReportedRun):
                sources.runs.append(run)
            else:
                sources.failed.append(run)
    sources.runs = _with_sources(sources.runs)
    return sources


def _with_sources(runs: Sequence[ReportedRun]) -> list[ReportedRun]:
    """Add the source to a name that means different things in different sources.

    Things that are equal share a name, with their first source, so their runs are compared.
    """
    named = list(runs)
    for key, columns in (
        ("site", ["site"]), ("weather", ["weather"]), ("from", ["from"]),
        ("forecast", ["forecast", "model", "kind of forecast"]),
    ):
        sources: dict[str, dict[object, str]] = {}
        for run in named:
            sources.setdefault(run.row[key], {}).setdefault(run.meant.get(key), run.source)
        for place, run in enumerate(named):
            of = sources[run.row[key]]
            if len({*of.values()}) > 1:  # or else all are from one source
                source = of[run.meant.get(key)]
                own = {column: f"{run.row[column]} ({source})" for column in columns}
                named[place] = replace(run, row=run.row | own)
    return named


def _read_study(path: Path, source: str, prefix: str, sources: Sources) -> None:
    """Add the runs of a study, with a prefix before their names."""
    configuration, sites = path / "configuration", set[str]()
    # Cached, because hundreds of runs can share a file.
    read, digest = cache(read_site), cache(file_digest)
    for row in read_results(path / "results.csv").to_dicts():
        run, given = row["run"], parameters(row_parameters(row))
        row |= {**labels(row), **_season(row), "run": prefix + run}
        if row["status"] != "done":
            sources.failed.append(_failed(row, given))
            continue
        site = read(configuration / row["site"])
        sites.add(row["site"])
        # Simulations pump nothing during frost.
        row["frost_pumped_m3"] = 0.0
        trajectory = path / "runs" / run / TRAJECTORY
        forecasts = (row.get(key) for key in ("forecast", "forecast_skill"))
        sources.runs.append(ReportedRun(
            row=row,
            site=site,
            parameters=given,
            load=partial(load_trajectory, trajectory) if trajectory.exists() else None,
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
        # Sites have their own table. Weather files are long, and are named with each run.
        if further.suffix in (".json", ".yaml") and further.name not in sites:
            sources.configuration[prefix + further.name] = read_text(further)


def read_results(file: Path) -> pl.DataFrame:
    """Return a study's table: a row for each run, null for an empty cell.

    Raises:
        ConfigurationError: it is not a study's table, or it was cut short or has a wrong value.
    """
    text = read_text(file)
    rows = csv.reader(io.StringIO(text))
    header = next(rows, [])
    missing = [column for column in _NEEDED if column not in header]
    if missing:
        raise ConfigurationError(
            f"has no column {', '.join(missing)}; is it the results.csv of a study?",
            file=file, line=1,
        )
    if not text.endswith("\n"):
        raise ConfigurationError(
            "ends in the middle of a line, as if a copy was cut short; copy it again",
            file=file, line=text.count("\n") + 1,
        )
    for name, count in Counter(header).items():
        if count > 1:
            raise ConfigurationError(
                f"is the name of {count} columns; delete all but one", file=file, line=1, key=name
            )
    cells, lines = list[list[str | None]](), list[int]()
    for row in rows:
        if len(row) != len(header):
            raise ConfigurationError(
                f"must have {len(header)} cells, not {len(row)}", file=file, line=rows.line_num
            )
        cells.append([cell or None for cell in row])
        lines.append(rows.line_num)
    table = pl.DataFrame(cells, dict.fromkeys(header, pl.String), orient="row")
    if table.is_empty():
        raise ConfigurationError("has a header but no runs", file=file)
    names = [column for column in _NUMBERS if column in table.columns]
    numbers = table.with_columns(pl.col(names).cast(pl.Float64, strict=False))
    outside = pl.col("run").is_null() | pl.col("run").str.contains("/|^[.]*$")
    done = pl.col("status") == "done"
    for key, wrong, expected in (
        ("run", outside, "the name of a directory under runs/"),
        ("status", ~pl.col("status").fill_null("").is_in(("done", "failed", "not run")),
         "done, failed or not run"),
        *((name, done & pl.col(name).is_null(), "given, because the run is done")
          for name in _NEEDED if name != "error"),
        *((name, pl.col(name).is_not_null() & ~numbers[name].is_finite().fill_null(False),
           "a number") for name in names),
        ("hours", pl.lit(numbers["hours"] <= 0), "more than 0"),
        *((name, pl.lit(~numbers[name].is_between(0, most)), expected) for name, most, expected in (
            ("total_deviation_m3", math.inf, "0 or more"), ("bound_m3", math.inf, "0 or more"),
            ("near_target_hours", numbers["hours"] + 1, "from 0 to the run's hours and a tick"),
        ) if name in names),
        ("start", _unreadable(datetime.fromisoformat, table["start"]),
         "a time such as 2021-07-07T02:00:00-05:00"),
        ("weekly_deviation_m3", _unreadable(
            lambda text: all(0 <= week < math.inf for week in _weeks(text)),
            table.to_dict().get("weekly_deviation_m3", ()),
        ), "numbers, 0 or more, with spaces between"),
        ("run", ~pl.col("run").is_first_distinct(), "in one row; an earlier row has the same run"),
    ):
        for place in table.select(wrong.arg_true()).to_series():
            raise ConfigurationError(
                f"must be {expected}", file=file, line=lines[place], key=key,
                value=table[key][place],
            )
    return numbers.with_columns(pl.col("hours", "cistern_m3", "roof_m3").fill_null(0.0))


def _unreadable(read: Callable[[str], object], cells: Iterable[str | None]) -> pl.Expr:
    """Mark the cells that are neither empty nor readable."""
    marks = []
    for cell in cells:
        try:
            marks.append(cell is not None and not read(cell))
        except ValueError:
            marks.append(True)
    return pl.lit(pl.Series(marks, dtype=pl.Boolean))


def _weeks(text: str) -> list[float]:
    """Return the deviation of each week (m3) in a cell of ``weekly_deviation_m3``."""
    return [float(week) for week in text.split()]


def _failed(row: Row, given: dict[str, float | str]) -> Row:
    """Return the entry of a run that failed or was not begun."""
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
    """Return the start of a run as shown in headings and, if it lasts a week or more, its season.

    A season is the year, the date and time of its start, and the deviation of each whole week (m3).
    """
    if row["start"] is None:  # of a run that failed
        return {}
    start = datetime.fromisoformat(row["start"])
    weeks = _weeks(row.get("weekly_deviation_m3") or "")
    whole = int(row["hours"] // 168)
    season = {"year": start.year, "begins": f"{start:%d %B %H:%M}", "season": weeks[:whole]}
    return {"start": to_people(start), **(season if 0 < whole <= len(weeks) else {})}
