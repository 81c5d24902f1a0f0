"""The sources of a report's runs: studies with a ``results.csv``, run directories and bags."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import sys
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path

from greenroof_ros.analysis.report.bags import read_run, run_directory
from greenroof_ros.analysis.report.run import ReportedRun, Row, read_about
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text
from greenroof_ros.physics.sensor_and_pump import PARAMETERS
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import EVENTS, find_differing_keys, format_exactly, row_parameters
from greenroof_ros.results.trajectory import TRAJECTORY
from greenroof_ros.site.file import read_site

_NEEDED = {
    "run", "site", "start", "hours", "evapotranspiration", "controller", "initial", "cistern_m3",
    "roof_m3", "status", "error", "total_deviation_m3", "window", "case", "season",
}
_NUMBERS = (
    "hours", "cistern_m3", "roof_m3", "fallbacks", "filled_hours", "frost_hours", "bound_m3",
    "bound_wet_discharge_m3", "bound_mains_m3", *PARAMETERS, *(metric.name for metric in METRICS),
)


def _read_number(cell: str, low: float = -sys.float_info.max) -> float:
    """Return a number that is finite and not below a limit."""
    if not low <= (number := float(cell)) < math.inf:
        raise ValueError
    return number


# How a column of a study's table is read; the other columns are text.
_READ: dict[str, Callable[[str], object]] = {
    **dict.fromkeys(_NUMBERS, lambda cell: _read_number(cell) if cell else None),
    **dict.fromkeys(
        ("hours", "total_deviation_m3", "bound_m3"),
        lambda cell: _read_number(cell, 0.0) if cell else None,
    ),
    "start": lambda cell: datetime.fromisoformat(cell).isoformat() if cell else "",
}


@dataclass
class Sources:
    """The runs and files from which a report is made.

    Attributes:
        runs: runs with results.
        failed: runs without results, each a row for a table.
        configuration: name and text of every other file that affects the results.
    """

    runs: list[ReportedRun] = field(default_factory=list)
    failed: list[dict[str, str]] = field(default_factory=list)
    configuration: dict[str, str] = field(default_factory=dict)


def find_runs(
    paths: Sequence[Path], site_file: Path | None = None,
    show: Callable[[str, float], None] = lambda text, share: None,
) -> Sources:
    """Find the runs in studies, run directories and bags, and read them.

    Args:
        paths: study directories, run directories and bags.
        site_file: site file for all bags; None to use the site file next to each bag.
        show: callback for the progress, which receives a text and the share of the paths that have
            been read.

    Raises:
        ConfigurationError: if a path is not a study directory, a run directory or a bag, if its
            content is invalid, if two paths have the same name, or if no run has results.
    """
    named: dict[str, Path] = {}
    for path in paths:
        if not path.is_dir() and not (path.is_file() and path.suffix.lower() == ".mcap"):
            raise ConfigurationError(
                "must be the directory of a study, a run or a bag, or an .mcap file"
                if path.exists() else "does not exist", file=path,
            )
        name = run_directory(path).resolve().name
        if name in named:
            raise ConfigurationError(
                f"{named[name]} and {path} have the same name, {name}: list each path only once, "
                "or rename one of the directories"
            )
        named[name] = path
    sources, single = Sources(), dict[Path, ReportedRun]()
    for number, path in enumerate(paths):
        show(f"reading {path}", number / len(paths))
        name = run_directory(path).resolve().name
        if (path / "results.csv").is_file():
            if site_file is not None:
                raise ConfigurationError(
                    f"applies only to bags, but {path} is a study, which has its own "
                    "sites", key="--site"
                )
            _read_study(path, f"{name}/" if len(paths) > 1 else "", sources)
            continue
        try:
            single[path] = read_run(path, site_file)
        except ConfigurationError as error:
            if not read_about(run_directory(path)).ending:
                raise
            sources.failed.append(
                {"run": name, "case": "", "from": "", "window": "", "error": str(error)}
            )
    _name_by_difference(single)
    sources.runs += single.values()
    if not sources.runs:
        first = sources.failed[0]
        raise ConfigurationError(
            f"there is no finished run; {len(sources.failed)} failed or did not run. For example, "
            f"{first['run']} {first['error']}"
        )
    return sources


def _name_by_difference(runs: Mapping[Path, ReportedRun]) -> None:
    """Name the cases of runs that do not belong to a study by the parameters that differ.

    Runs whose windows have the same name share the window, unless their files differ.
    """
    windows = dict[str, tuple[object, ...]]()
    apart = find_differing_keys([row_parameters(run.row) for run in runs.values()])
    for path, run in runs.items():
        row = run.row
        weather = sorted((run_directory(path) / "configuration" / "weather").glob("*"))
        digests = [hashlib.sha256(file.read_bytes()).digest() for file in weather]
        identity = (run.site, row["cistern_m3"], row["roof_m3"], *digests)
        if windows.setdefault(row["window"], identity) != identity:
            row["window"] += f" ({run.name})"
        given = row_parameters(row)
        shown = [f"{key} {_text(given[key])}" for key in apart if key in given]
        row["case"] = " ".join([row["controller"], *shown])
    cases = [(run.row["window"], run.row["initial"], run.row["case"]) for run in runs.values()]
    for run, case in zip(runs.values(), cases, strict=True):
        if cases.count(case) > 1:
            run.row["case"] += f" ({run.name})"


def _text(value: object) -> str:
    return format_exactly(value) if isinstance(value, float) else str(value)


def _read_study(path: Path, prefix: str, sources: Sources) -> None:
    """Add the runs of a study, with a prefix added to their names and windows."""
    configuration, sites = path / "configuration", set[str]()
    read = cache(read_site)  # hundreds of runs can share a file
    for row in _read_results(path / "results.csv"):
        directory = path / "runs" / row["run"]
        trajectory, events = directory / TRAJECTORY, directory / EVENTS
        row |= {"run": prefix + row["run"], "window": prefix + row["window"]}
        if row["status"] == "done":
            sites.add(row["site"])
            sources.runs.append(ReportedRun(
                site=read(configuration / row["site"]), row=row,
                kept=trajectory if trajectory.exists() else None,
                kept_events=events if events.exists() else (),
            ))
        else:
            sources.failed.append({
                "run": row["run"], "case": row["case"], "from": row["initial"],
                "window": row["window"], "error": row["error"] or row["status"],
            })
    for further in sorted(configuration.glob("*")):
        # Sites have their own table. Weather files are long, and are named with every run.
        if further.suffix in (".json", ".yaml") and further.name not in sites:
            sources.configuration[prefix + further.name] = read_text(further)


def _read_results(file: Path) -> list[Row]:
    """Return the rows of a study's table; an empty cell of a numeric column becomes None.

    Raises:
        ConfigurationError: if the file is not a study's table, is truncated, or contains an invalid
            value.
    """
    text = read_text(file)
    table = csv.DictReader(io.StringIO(text), restkey="", restval=None)
    missing = _NEEDED - set(table.fieldnames or ())
    if missing:
        raise ConfigurationError(
            f"has no column {', '.join(sorted(missing))}; if it is the results.csv of a study, "
            "repeat the command greenroof study, which writes the table again", file=file, line=1,
        )
    if not text.endswith("\n"):
        raise ConfigurationError(
            "ends in the middle of a line; copy the table again", file=file,
            line=text.count("\n") + 1,
        )
    rows = dict[str, Row]()
    for cells in table:
        for column, cell in cells.items():
            try:
                if not isinstance(cell, str):
                    raise ValueError("there is one cell too many or too few")
                cells[column] = _READ.get(column, str)(cell)
            except ValueError as error:
                raise ConfigurationError(
                    "is not a valid value; copy the table again", file=file, line=table.line_num,
                    key=column, value=cell,
                ) from error
        for column, damage in _find_damage(cells, rows):
            raise ConfigurationError(
                f"{damage}; copy the table again", file=file, line=table.line_num, key=column,
                value=cells[column],
            )
        rows[cells["run"]] = cells
    if not rows:
        raise ConfigurationError("contains a header but no runs", file=file)
    return list(rows.values())


def _find_damage(row: Row, earlier: Container[str]) -> Iterable[tuple[str, str]]:
    """Yield the columns with values that no study writes, each with the rule that it breaks."""
    if not row["run"].strip(".") or "/" in row["run"] or row["run"] in earlier:
        yield "run", "must be the name of a directory under runs/, and must appear in one row only"
    if row["status"] not in ("done", "failed", "not run"):
        yield "status", "must be done, failed or not run"
    if row["status"] == "done":
        empty = [column for column in row if row[column] in ("", None)]
        for column in (_NEEDED - {"error", "season"}).intersection(empty):
            yield column, "must not be empty, because the run is done"
