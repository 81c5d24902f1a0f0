"""Where a report's runs come from: studies by their ``results.csv``, run directories, and bags."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from pathlib import Path

from greenroof_ros.analysis.report.bags import (
    Recording,
    load_trajectory,
    read_recording,
    row_of,
    run_directory,
)
from greenroof_ros.analysis.report.run import Row, read_about
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.model.metrics import METRICS
from greenroof_ros.model.sensor_pump_errors import PARAMETERS
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.recording.results_table import differing, row_parameters, shortest
from greenroof_ros.recording.trajectory import TRAJECTORY, Trajectory

_NEEDED = (
    "run", "site", "start", "hours", "evapotranspiration", "controller", "initial", "cistern_m3",
    "roof_m3", "status", "error", "total_deviation_m3", "window", "case", "season",
)
_NUMBERS = (
    "hours", "cistern_m3", "roof_m3", "fallbacks", "filled_hours", "frost_hours", "bound_m3",
    *PARAMETERS, *(metric.name for metric in METRICS),
)
# How a column of a study's table is read; the others are text.
_READ: dict[str, Callable[[str], object]] = {
    **dict.fromkeys(_NUMBERS, lambda cell: float(cell) if cell else None),
    "start": lambda cell: datetime.fromisoformat(cell).isoformat() if cell else "",
    "weekly_deviation_m3": lambda cell: list(map(float, cell.split())),
}


@dataclass(frozen=True)
class ReportedRun:
    """A run with results.

    Attributes:
        site: where it took place.
        row: its results: the columns of a study's ``results.csv``. In ``case`` is its label.
        notes: what a reader should know about it.
        alarms: recorded ones, each a row for a table.
        kept: its trajectory, or the file with it; None if none was kept.
        bag: None if it is not from a bag.
    """

    site: Site
    row: Row
    notes: tuple[str, ...] = ()
    alarms: Sequence[dict[str, str]] = ()
    kept: Trajectory | Path | None = None
    bag: Path | None = None

    @property
    def name(self) -> str:
        """Name of the run, unique in the report."""
        return str(self.row["run"])

    def trajectory(self) -> Trajectory | None:
        """Return its trajectory, if any.

        Raises:
            ConfigurationError: the file is damaged.
        """
        return load_trajectory(self.kept) if isinstance(self.kept, Path) else self.kept


@dataclass
class Sources:
    """The runs and files that a report is made from.

    Attributes:
        runs: those with results.
        failed: the others, each a row for a table.
        configuration: name and text of each further file that affects the results.
    """

    runs: list[ReportedRun] = field(default_factory=list)
    failed: list[dict[str, str]] = field(default_factory=list)
    configuration: dict[str, str] = field(default_factory=dict)


def find_runs(
    paths: Sequence[Path], site_file: Path | None = None,
    track: Callable[[Sequence[Path]], Iterable[Path]] = iter,
) -> Sources:
    """Find the runs under some paths, and read the bags.

    Args:
        paths: study directories, run directories and bags.
        site_file: the site of all bags, instead of the site file next to each.
        track: shows the progress.

    Raises:
        ConfigurationError: a path is none of these, its content is wrong, two have one name, or no
            run has results.
    """
    named: dict[str, Path] = {}
    for path in paths:
        if not path.is_dir() and not (path.is_file() and path.suffix.lower() == ".mcap"):
            wrong = "must be a directory (of a study, of a run, or a bag), or an .mcap file"
            if path.suffix == ".db3":
                wrong += f"; this file's bag is {path.parent}"
            raise ConfigurationError(wrong if path.exists() else "does not exist", file=path)
        name = run_directory(path).resolve().name
        if name in named:
            raise ConfigurationError(
                f"{named[name]} and {path} have one name, {name}: give each path once, or rename "
                "one of the directories"
            )
        named[name] = path
    sources, recordings = Sources(), dict[str, Recording]()
    for path in track(paths):
        name = run_directory(path).resolve().name
        if (path / "results.csv").is_file():
            if site_file is not None:
                raise ConfigurationError(
                    f"is for bags; {path} is a study and has its own sites", key="--site"
                )
            _read_study(path, f"{name}/" if len(paths) > 1 else "", sources)
        elif (path / "runs").is_dir() or (path / "configuration" / "study.json").is_file():
            raise ConfigurationError("is a study without results.csv", file=path)
        else:
            try:
                recordings[name] = read_recording(path, site_file)
            except ConfigurationError as error:
                if not read_about(run_directory(path)).ending:
                    raise
                sources.failed.append({
                    "run": name, "case": "", "from": "", "window": "", "error": str(error)
                })
    sources.runs += _of_recordings(recordings)
    if not sources.runs:
        first = sources.failed[0]
        raise ConfigurationError(
            f"holds no finished run; {len(sources.failed)} failed or did not run, the first: "
            f"{first['run']} {first['error']}"
        )
    return sources


def _of_recordings(recordings: Mapping[str, Recording]) -> list[ReportedRun]:
    """Return runs that are no study's; those of one window and controller are named by parameters.

    A name stands for one window, unless the files of two runs with this name differ.
    """
    runs, windows = list[ReportedRun](), dict[str, tuple[object, ...]]()
    apart = differing([row_parameters(each.about.row) for each in recordings.values()])
    for name, recording in recordings.items():
        row, identity = row_of(recording, name)
        if windows.setdefault(row["window"], identity) != identity:
            row["window"] += f" ({name})"
        given = row_parameters(row)
        shown = [f"{key} {_text(given[key])}" for key in apart if key in given]
        row["case"] = " ".join([row["controller"], *shown])
        runs.append(ReportedRun(
            site=recording.site, row=row, notes=(*recording.notes, *recording.about.notes),
            alarms=recording.alarms, bag=recording.bag,
            kept=recording.trajectory,
        ))
        if recording.about.ending:
            row["ended"] = recording.about.ending
    cases = [(run.row["window"], run.row["initial"], run.row["case"]) for run in runs]
    for run, case in zip(runs, cases, strict=True):
        if cases.count(case) > 1:
            run.row["case"] += f" ({run.name})"
    return runs


def _text(value: object) -> str:
    return shortest(value) if isinstance(value, float) else str(value)


def _read_study(path: Path, prefix: str, sources: Sources) -> None:
    """Add the runs of a study, with a prefix before their names and windows."""
    configuration, sites = path / "configuration", set[str]()
    read = cache(read_site)  # hundreds of runs can share a file
    for row in read_results(path / "results.csv"):
        trajectory = path / "runs" / row["run"] / TRAJECTORY
        row |= {"run": prefix + row["run"], "window": prefix + row["window"]}
        if row["status"] == "done":
            sites.add(row["site"])
            sources.runs.append(ReportedRun(
                site=read(configuration / row["site"]), row=row,
                kept=trajectory if trajectory.exists() else None,
            ))
        else:
            sources.failed.append({
                "run": row["run"], "case": row["case"], "from": row["initial"],
                "window": row["window"], "error": row["error"] or row["status"],
            })
    for further in sorted(configuration.glob("*")):
        # Sites have their own table. Weather files are long, and are named with each run.
        if further.suffix in (".json", ".yaml") and further.name not in sites:
            sources.configuration[prefix + further.name] = read_text(further)


def read_results(file: Path) -> list[Row]:
    """Return the rows of a study's table; an empty cell of a number is None.

    Raises:
        ConfigurationError: it is not a study's table, or a row was cut short or has a wrong value.
    """
    table = csv.reader(io.StringIO(read_text(file)))
    header, rows = next(table, []), list[Row]()
    missing = [column for column in _NEEDED if column not in header]
    if missing:
        raise ConfigurationError(
            f"has no column {', '.join(missing)}; is it the results.csv of a study? Then repeat "
            "the command greenroof study, which writes the table again", file=file, line=1,
        )
    for cells in table:
        if len(cells) != len(header):
            raise ConfigurationError(
                f"must have {len(header)} cells, not {len(cells)}", file=file, line=table.line_num
            )
        row: Row = {}
        for column, cell in zip(header, cells, strict=True):
            try:
                row[column] = _READ[column](cell) if column in _READ else cell
            except ValueError as error:
                raise ConfigurationError(
                    "cannot be read; copy the table again", file=file, line=table.line_num,
                    key=column, value=cell,
                ) from error
        rows.append(row)
    if not rows:
        raise ConfigurationError("has a header but no runs", file=file)
    return rows
