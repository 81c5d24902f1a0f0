"""The sources of a report's runs: studies with a ``results.csv``, run directories and bags."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars

from greenroof_ros.analysis.report.bags import (
    ReportedRun,
    describe_ending,
    read_about,
    read_run,
    run_directory,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text, read_yaml
from greenroof_ros.base.text import number_of
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.trajectory import TRAJECTORY
from greenroof_ros.site.file import read_site

BOUNDS = {
    "total_deviation_m3": "bound_m3", "wet_discharge_m3": "bound_wet_discharge_m3",
    "mains_m3": "bound_mains_m3",
}
"""the columns of the minimum possible values, by metric"""

_NEEDED = ("run", "site", "start", "initial", "status", "error", "window", "case", "season")
_NUMBERS = {"fallbacks", "filled_hours", *BOUNDS.values(), *(metric.name for metric in METRICS)}


@dataclass
class Sources:
    """The runs and files from which a report is made.

    Attributes:
        runs: runs with results.
        failed: runs without results: run, case, and reason.
        read: sentences on what was read.
        show: metrics that the first study asks for.
    """

    runs: list[ReportedRun] = field(default_factory=list)
    failed: list[tuple[str, str, str]] = field(default_factory=list)
    read: list[str] = field(default_factory=list)
    show: list[str] = field(default_factory=list)


def find_runs(paths: Sequence[Path], site_file: Path | None = None) -> Sources:
    """Find the runs in studies, run directories and bags, and read them.

    What cannot be read counts as a run without results.

    Args:
        paths: study directories, run directories and bags.
        site_file: site file for all bags; None to use the site file next to each bag.

    Raises:
        ConfigurationError: if no run has results.
    """
    sources, names = Sources(), [run_directory(path).resolve().name for path in paths]
    for path, name in zip(paths, names, strict=True):
        case = name if names.count(name) == 1 else str(path)
        try:
            if (path / "results.csv").is_file():
                _read_study(path, f"{path}/" if len(paths) > 1 else "", sources)
                continue
            run = read_run(path, site_file)
        except ConfigurationError as error:
            ended = describe_ending(read_about(run_directory(path)))
            sources.failed.append((name, case, "; ".join(filter(None, [ended, str(error)]))))
            continue
        run.row["case"] = case
        sources.runs.append(run)
        sources.read += [f"{path}: {line}" for line in run.read]
    if not sources.runs:
        raise ConfigurationError("; ".join([
            f"{sources.failed[0][0]} has no results: {sources.failed[0][2]}",
            *[f"{len(sources.failed)} runs have none"] * (len(sources.failed) > 1),
        ]))
    return sources


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
            case = ", ".join([row["case"], row["window"], f"from {row['initial']}"])
            sources.failed.append((row["run"], case, row["error"] or row["status"]))
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
