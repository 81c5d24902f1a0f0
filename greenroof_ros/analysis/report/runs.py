"""The runs of a report, of studies, of run directories, and from bags; and their cases.

A study has a ``results.csv``, a run directory of the graph a bag. The directory of a simulation in
one process contains the trajectory instead, or only the results. The runs of a case differ only in
their seeds and, for a season, in the year.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import polars

from greenroof_ros.analysis.case import tell_apart
from greenroof_ros.analysis.tables import BOUNDS, COLUMNS, TOTAL, choose_metrics
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file, read_text, read_yaml
from greenroof_ros.base.text import number_of
from greenroof_ros.base.times import to_minutes
from greenroof_ros.results.bag_read import load_bag
from greenroof_ros.results.bag_write import METADATA
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import format_exactly, make_frame, summary_columns
from greenroof_ros.results.trajectory import (
    CSV,
    TRAJECTORY,
    Trajectory,
    compute_results,
    read_trajectory,
)
from greenroof_ros.simulation.output import DONE, SITE_FILE, SUMMARY
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.climate import CLIMATE

_NEEDED = ("run", "site", "start", "initial", "status", "error", "window", "case", "season")
_NUMBERS = {"fallbacks", *BOUNDS.values(), *(metric.name for metric in METRICS)}
# Metrics of which more is better.
_MORE = {
    "near_target_hours", "evapotranspiration_ratio", "roof_retention_share", "demand_met_share",
    "retention_share",
}


@dataclass(frozen=True)
class ReportedRun:
    """A run with results.

    Attributes:
        site: site of the run.
        row: results of the run, as the columns of a study's ``results.csv``.
        kept: trajectory of the run, or the file that contains it; None if it was not kept.
        notes: notes about the recording for the reader.
    """

    site: Site
    row: dict[str, Any]
    kept: Trajectory | Path | None = None
    notes: Sequence[str] = ()

    def trajectory(self) -> Trajectory | None:
        """Return the trajectory of the run, if there is one.

        Raises:
            ConfigurationError: if the file is damaged.
        """
        return read_trajectory(self.kept) if isinstance(self.kept, Path) else self.kept


@dataclass
class Sources:
    """The runs and files from which a report is made.

    Attributes:
        runs: runs with results.
        failed: runs that failed or did not finish, each with the reason.
        read: sentences on what was read.
        show: metrics that the first study asks for.
    """

    runs: list[ReportedRun] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)
    read: list[str] = field(default_factory=list)
    show: list[str] = field(default_factory=list)


def read_about(run: Path) -> dict[str, Any]:
    """Return the content of the summary in a run directory, empty if there is none.

    Raises:
        ConfigurationError: if the summary is damaged.
    """
    file = run / SUMMARY
    try:
        return {**json.loads(read_text(file))} if file.is_file() else {}
    except (ValueError, TypeError) as error:
        raise ConfigurationError(f"is not the summary of a run: {error}", file=file) from error


def run_directory(path: Path) -> Path:
    """Return the directory with a run's configuration: the path, or the parent of its bag."""
    return next((place for place in (path, path.resolve().parent)
                 if (place / "configuration").is_dir()), path)


def find_runs(paths: Sequence[Path], site_file: Path | None = None) -> Sources:
    """Find the runs in studies, run directories and bags, and read them.

    What cannot be read counts as a run that failed. Runs are named by what differs in their
    settings, or else by their directories.

    Args:
        paths: study directories, run directories and bags.
        site_file: site file for all bags; None to use the site file next to each bag.

    Raises:
        ConfigurationError: if no run has results.
    """
    sources, abouts = Sources(), [read_about(run_directory(path)) for path in paths]
    settings = [_describe_settings(about) for about in abouts]
    cases = tell_apart([
        texts | {"directory": run_directory(path).resolve().name, "path": str(path)}
        for path, texts in zip(paths, settings, strict=True)
    ])
    for path, about, texts, case in zip(paths, abouts, settings, cases, strict=True):
        reason, case = "", case or run_directory(path).resolve().name
        if (path / "results.csv").is_file():
            _read_study(path, f"{path}, " if len(paths) > 1 else "", sources)
            continue
        try:
            run = read_run(path, site_file)
        except ConfigurationError as error:
            reason = str(error)
        else:
            run.row["case"] = case
            sources.runs.append(run)
            sources.read.append(f"{path}: {', '.join(texts.values()) or 'no summary'}")
        if (status := about.get("status", DONE)) != DONE:
            ended = f"{status}, {' '.join((about.get('reason') or 'no reason known').split())}"
            reason = f"{ended}; {reason or 'its results are for the recorded part only'}"
        if reason:
            sources.failed.append((case, reason))
    if not sources.runs:
        raise ConfigurationError(
            f"no run has results; {len(sources.failed)} failed or did not finish, such as "
            + ": ".join(sources.failed[0])
        )
    return sources


def _describe_settings(about: Mapping[str, Any]) -> dict[str, str]:
    """Return what a summary tells about the settings of its run, in words, by name."""
    forecast = about.get("forecast")
    if isinstance(forecast, dict):
        forecast = " ".join(str(value) for value in forecast.values() if value is not None)
    # First what a person chose, because parameters can follow from the site.
    values = {
        "outlet": about.get("parameters", {}).get("outlet"), "forecast": forecast,
        **{name: Path(about[name]).name for name in ("site", "weather") if name in about},
        **{name: about.get(name) for name in CLIMATE}, **about.get("sensor_and_pump", {}),
    } | about.get("parameters", {})
    return {"controller": about.get("controller", "")} | {
        name: f"{name.replace('_', ' ')} {value}" for name, value in values.items()
        if value is not None
    }


def _read_study(path: Path, prefix: str, sources: Sources) -> None:
    """Add the runs of a study, with a prefix added to their windows."""
    configuration, weather = path / "configuration", path / "configuration" / "weather.yaml"
    read = functools.cache(read_site)  # hundreds of runs can share a file
    rows = _read_table(path / "results.csv")
    for row in rows:
        row["window"] = prefix + row["window"]
        if row["status"] == "done":
            kept = path / "runs" / row["run"] / TRAJECTORY
            site = read(configuration / row["site"])
            sources.runs.append(ReportedRun(site, row, kept if kept.exists() else None))
        else:
            name = ", ".join([row["case"], row["window"], f"initial state {row['initial']}"])
            sources.failed.append((name, row["error"] or row["status"]))
    sources.read.append(f"{path / 'results.csv'}: {number_of(len(rows), 'run')}")
    if weather.is_file():
        for name, lines in read_yaml(weather).items():
            sources.read += [f"{name}: {line}" for line in lines]
    study = configuration / "study.json"
    if study.is_file() and not sources.show:
        sources.show = json.loads(read_text(study)).get("show", [])


def _read_table(file: Path) -> list[dict[str, Any]]:
    """Return the rows of a study's table; an empty cell becomes None.

    Raises:
        ConfigurationError: if the file is not a study's table, or is damaged.
    """
    try:
        table = polars.read_csv(file, infer_schema=False)
        numbers = _NUMBERS.intersection(table.columns)
        return table.with_columns(*_NEEDED, polars.col(numbers).cast(polars.Float64)).to_dicts()
    except polars.exceptions.PolarsError as error:
        raise ConfigurationError(
            f"is not the table of a study: {str(error).splitlines()[0]}", file=file
        ) from error


def read_run(path: Path, site: Path | Site | None = None) -> ReportedRun:
    """Read a run directory, a bag or an .mcap file.

    The results of a finished run are taken from its summary; all other results are computed from
    the trajectory.

    Args:
        path: path of the run directory, bag or file.
        site: the site, or its file; by default the site file next to the bag, or else the paper's
            site.

    Raises:
        ConfigurationError: if the bag is damaged or was not recorded by this package, or if there
            is neither a bag nor a result.
    """
    run, name, notes = run_directory(path), "", list[str]()
    about = read_about(run)
    if not isinstance(site, Site):
        own = run / "configuration" / SITE_FILE
        if site is None and not own.is_file():
            notes.append("there is no site file beside the bag: the paper's site, and UTC, assumed")
        file = site or (own if own.is_file() else default_site_file())
        site, name = read_site(file), Path(about.get("site", file) if file == own else file).name
    zone = timezone.utc if notes else site.zone
    results, unknown, trajectory = summary_columns(about), frozenset[str](), None
    start = datetime.fromisoformat(about.get("start", "1970-01-01"))
    hours = about.get("steps", 0) * about.get("tau_s", 0) / 3600
    bag = path / "bag" if (path / "bag").is_dir() else path
    kept = next((path / name for name in (TRAJECTORY, CSV) if (path / name).is_file()), None)
    if bag.is_file() or (bag / METADATA).is_file() or any(bag.glob("*.mcap")):
        trajectory, further, unknown = load_bag(
            bag, site, start.tzinfo or zone,
            own=bool(about) and "drive_at" not in about,  # live sensors can report anything
            external_pump="/pump/flow" in about.get("refused", {}),
            repair=f"greenroof recover {run} makes another bag of the remaining data",
        )
        notes += further
    elif kept is not None:
        trajectory = read_trajectory(kept)
    if trajectory is not None:
        start, hours = trajectory.start, float(trajectory.time[-1]) / 3600
        if TOTAL not in results:
            results |= compute_results(site, trajectory, unknown)
    elif TOTAL not in results:
        raise ConfigurationError(
            "must be the directory of a study (with results.csv), of a run with results, or of a "
            "bag, or an .mcap file", file=path,
        )
    forecast = about.get("forecast")
    if changes := about.get("parameter_change_count"):
        notes.append(f"{changes} changes of parameters during the run, listed in summary.json")
    return ReportedRun(site, {
        **results, "site": name, "start": start.isoformat(),
        "forecast": forecast["model"] if isinstance(forecast, dict) else forecast,
        "initial": (about.get("initial") or {"name": "as recorded"})["name"] or "own volumes",
        "window": f"from {to_minutes(start)}, {format_exactly(round(hours, 5))} h",
    }, trajectory, notes)


class Report:
    """All results, grouped into cases.

    Attributes:
        sources: where the runs are from.
        show: the known metrics by which the cases are sorted, the most important one first.
        metrics: all metrics of which a result is known.
        years: the mean of each metric in each year, for each ``place`` and ``case``; the year is
            null for runs of no season.
        places: a table for each window and initial state, with a row for each case, the best first:
            ``case``; ``place``, in what the window and the state differ from the others; the mean
            of each metric, with the lowest and the highest run in ``..._min`` and ``..._max``; the
            number of ``runs``, and the index of the ``first`` one.
    """

    def __init__(self, sources: Sources) -> None:
        """Group and compare the runs."""
        self.sources = sources
        show = sources.show or choose_metrics(run.site for run in sources.runs)
        keys = "case", *COLUMNS, *BOUNDS.values()
        windows, states = ({run.row[key] for run in sources.runs} for key in ("window", "initial"))
        rows = make_frame([{
            **{key: run.row.get(key) for key in keys}, "first": first,
            "place": ", ".join([
                *[run.row["window"]] * (len(windows) > 1),
                *[f"initial state {run.row['initial']}"] * (len(states) > 1),
            ]),
            "year": int(run.row["start"][:4]) if run.row.get("season") else None,
        } for first, run in enumerate(sources.runs)], infer_schema_length=None)
        known = [name for name in keys[1:] if rows[name].null_count() < len(rows)]
        self.metrics = [name for name in COLUMNS if name in known]
        self.show = [name for name in show if name in known] or [TOTAL]
        case, values = ["place", "case"], polars.col(known)
        self.years = rows.group_by(*case, "year", maintain_order=True).agg(values.mean())
        means = self.years.group_by(case, maintain_order=True).agg(values.mean())
        ranges = rows.group_by(case).agg(
            values.min().name.suffix("_min"), values.max().name.suffix("_max"),
            polars.len().alias("runs"), polars.col("first").first(),
        )
        self.places = [
            place.sort(map(rank, self.show), nulls_last=True, maintain_order=True)
            for place in means.join(ranges, on=case, maintain_order="left").partition_by(
                "place", maintain_order=True
            )
        ]


def rank(metric: str) -> polars.Expr:
    """Return a number that is the lower, the better a metric is."""
    return -polars.col(metric) if metric in _MORE else polars.col(metric)
