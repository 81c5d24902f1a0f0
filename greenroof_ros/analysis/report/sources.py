"""The sources of a report's runs: studies with a ``results.csv``, run directories and bags."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from greenroof_ros.analysis.report.bags import (
    ReportedRun,
    Row,
    read_about,
    read_run,
    run_directory,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_text, read_yaml
from greenroof_ros.base.text import number_of
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import find_differing_keys, format_exactly, row_parameters
from greenroof_ros.results.trajectory import TRAJECTORY
from greenroof_ros.site.file import read_site

_NEEDED = {
    "run", "site", "start", "hours", "controller", "initial", "cistern_m3", "roof_m3", "status",
    "error", "window", "case", "season",
}
_NUMBERS = {
    "hours", "cistern_m3", "roof_m3", "fallbacks", "filled_hours", "frost_hours", "bound_m3",
    "bound_wet_discharge_m3", "bound_mains_m3", *(metric.name for metric in METRICS),
}


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
            content is invalid, or if no run has results.
    """
    sources, single = Sources(), dict[Path, ReportedRun]()
    for number, path in enumerate(paths):
        show(f"reading {path}", number / len(paths))
        if not path.is_dir() and not (path.is_file() and path.suffix.lower() == ".mcap"):
            raise ConfigurationError(
                "must be the directory of a study, a run or a bag, or an .mcap file"
                if path.exists() else "does not exist", file=path,
            )
        if (path / "results.csv").is_file():
            if site_file is not None:
                raise ConfigurationError(
                    f"applies only to bags, but {path} is a study, which has its own sites",
                    key="--site",
                )
            _read_study(path, f"{path}/" if len(paths) > 1 else "", sources)
            continue
        try:
            single[path] = read_run(path, site_file)
            sources.read.append(f"{path}: one run")
        except ConfigurationError as error:
            if not read_about(run_directory(path)).ending:
                raise
            sources.failed.append((run_directory(path).resolve().name, "", str(error)))
    _name_by_difference(single)
    sources.runs += single.values()
    if not sources.runs:
        run, _, reason = sources.failed[0]
        raise ConfigurationError(
            f"there is no finished run; {len(sources.failed)} failed or did not run. For example, "
            f"{run} {reason}"
        )
    return sources


def _name_by_difference(runs: Mapping[Path, ReportedRun]) -> None:
    """Name the cases of runs that do not belong to a study by the parameters that differ.

    Runs whose windows have the same name share the window, unless their files differ.
    """
    windows, cases = dict[str, tuple[object, ...]](), set[tuple[str, ...]]()
    apart = find_differing_keys([row_parameters(run.row) for run in runs.values()])
    for path, run in runs.items():
        row, given = run.row, row_parameters(run.row)
        weather = sorted((run_directory(path) / "configuration" / "weather").glob("*"))
        identity = (run.site, row["cistern_m3"], row["roof_m3"], *map(_digest, weather))
        if windows.setdefault(row["window"], identity) != identity:
            row["window"] += f" ({path})"
        row["case"] = " ".join([row["controller"], *(
            f"{key} {format_exactly(given[key]) if isinstance(given[key], float) else given[key]}"
            for key in apart if key in given
        )])
        if (case := (row["window"], row["initial"], row["case"])) in cases:
            row["case"] += f" ({path})"
        cases.add(case)


def _digest(*files: Path) -> str:
    """Return the first digits of the SHA-256 of some files, which identify them."""
    content = b"".join(file.read_bytes() for file in files)
    return hashlib.sha256(content).hexdigest()[:12]


def _read_study(path: Path, prefix: str, sources: Sources) -> None:
    """Add the runs of a study, with a prefix added to their names and windows."""
    configuration, weather = path / "configuration", path / "configuration" / "weather.yaml"
    read = cache(read_site)  # hundreds of runs can share a file
    rows = _read_results(path / "results.csv")
    for row in rows:
        trajectory = path / "runs" / row["run"] / TRAJECTORY
        row |= {"run": prefix + row["run"], "window": prefix + row["window"]}
        if row["status"] == "done":
            sources.runs.append(ReportedRun(
                site=read(configuration / row["site"]), row=row,
                kept=trajectory if trajectory.exists() else None,
            ))
        else:
            case = ", ".join([row["case"], row["initial"], row["window"]])
            sources.failed.append((row["run"], case, row["error"] or row["status"]))
    inputs = [file for file in sorted(configuration.glob("*")) if file != weather]
    sources.read.append(
        f"{path}: {number_of(len(rows), 'run')}, results.csv {_digest(path / 'results.csv')}; "
        f"{number_of(len(inputs), 'input file')}, {_digest(*inputs)} (SHA-256 of all)"
    )
    if weather.is_file():
        for name, lines in read_yaml(weather).items():
            sources.read += [f"{name}: {line}" for line in lines]
    study = configuration / "study.json"
    asked = json.loads(read_text(study)).get("show", []) if study.is_file() else []
    sources.show = sources.show or asked


def _read_results(file: Path) -> list[Row]:
    """Return the rows of a study's table; an empty cell of a numeric column becomes None.

    Raises:
        ConfigurationError: if the file is not a study's table, or is damaged.
    """
    table = csv.DictReader(io.StringIO(read_text(file)), restkey="further cells", restval="cut")
    if missing := _NEEDED - set(table.fieldnames or ()):
        raise ConfigurationError(
            f"has no column {', '.join(sorted(missing))}; if it is the results.csv of a study, "
            "repeat the command greenroof study, which writes the table again", file=file, line=1,
        )
    rows = list[Row]()
    for cells in table:
        row: Row = dict(cells)
        for column in _NUMBERS.intersection(cells):
            try:
                row[column] = float(cells[column]) if cells[column] else None
            except ValueError as error:
                raise ConfigurationError(
                    "is not a number; copy the table again", file=file, line=table.line_num,
                    key=column, value=cells[column],
                ) from error
        rows.append(row)
    if not rows:
        raise ConfigurationError("contains a header but no runs", file=file)
    return rows
