"""The directory of a district's results: page, tables and hydrographs."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from greenroof_ros.analysis.district import page, swmm
from greenroof_ros.analysis.district.run import DistrictRun
from greenroof_ros.analysis.district.totals import Flow, Totals
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import add_path_to_errors, replace_text
from greenroof_ros.experiment.run_directory import writable

PAGE = "page.html"


def make_directory(directory: Path) -> None:
    """Make the directory of the results.

    Raises:
        ConfigurationError: it holds something, or cannot be written.
    """
    with writable(directory):
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.iterdir()):
            raise ConfigurationError(
                "exists and is not empty; nothing is overwritten", key="--output",
                value=str(directory),
            )


def write(
    directory: Path, run: DistrictRun, totals: Totals, rows: Sequence[dict[str, Any]],
    with_swmm: bool,
) -> None:
    """Write all results.

    Args:
        directory: an empty one.
        run: what was simulated.
        totals: the sums.
        rows: of ``results.csv``.
        with_swmm: whether time series for SWMM are written, too.

    Raises:
        OSError: for instance on a full disk.
    """
    shutil.copyfile(run.district.path, directory / "district.yaml")
    replace_text(directory / "results.csv", _format(rows))
    replace_text(directory / "buildings.csv", _format(_list_buildings(run, totals)))
    _write_hydrographs(directory / "hydrographs.parquet", run, totals)
    if with_swmm:
        _write_swmm(directory / "swmm", run, totals)
    replace_text(directory / PAGE, page.render(run, totals, rows))


def _format(rows: Iterable[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    writer: csv.DictWriter[str] | None = None
    for row in rows:
        if writer is None:
            writer = csv.DictWriter(text, [*row], lineterminator="\n")
            writer.writeheader()
        writer.writerow(row)  # floats keep all their digits
    return text.getvalue()


def _list_buildings(run: DistrictRun, totals: Totals) -> Iterable[dict[str, Any]]:
    """Yield each building: what it is, from which adoption on it takes part, and its results."""
    buildings, adoption = run.buildings, run.adoption
    groups, valves = adoption.groups(buildings.ranks), adoption.have_valve(buildings.ranks)
    for place, name in enumerate(buildings.ids):
        takes_part = groups[place] < len(adoption.shares)
        yield {
            "id": name,
            **({"cell": run.cells[buildings.cells[place]]} if run.cells else {}),
            **{key: values[place] for key, values in buildings.values.items()},
            "connected_area_m2": float(totals.areas[place]),
            "adopts_at": adoption.shares[groups[place]] if takes_part else None,
            "low_outlet": bool(valves[place]) if takes_part else None,
            **{
                f"{outlet}:{metric}": None if np.isnan(values[place]) else float(values[place])
                for outlet in totals.outlets for metric, values in totals.metrics[outlet].items()
            },
        }


def _name(flow: Flow) -> str:
    """Return the name of a hydrograph: ``as_is``, or ``drain_050`` for half of the buildings."""
    return f"{flow.outlet}_{100 * flow.adoption:03g}" if flow.adoption else "as_is"


def _write_hydrographs(file: Path, run: DistrictRun, totals: Totals) -> None:
    """Write the flows (m3/s), with the time at which each interval begins, and rain (mm/h)."""
    start = run.runs[0].start
    count = totals.rain.shape[1]
    offset = f"{start.isoformat()[-6:]}"
    first = start.replace(tzinfo=None)
    columns: dict[str, Any] = {
        f"time_utc{offset}": pl.datetime_range(
            first, first + timedelta(seconds=totals.seconds * (count - 1)),
            timedelta(seconds=totals.seconds), eager=True,
        ),
        **{
            f"rain_{cell}_mm_h" if run.cells else "rain_mm_h": 3.6e6 / totals.seconds * rain
            for cell, rain in zip(run.cells or ("",), totals.rain, strict=True)
        },
        "wet": totals.wet,
        **{f"{_name(flow)}_m3_s": totals.discharge(flow) / totals.seconds for flow in totals.flows},
    }
    with add_path_to_errors(file):
        pl.DataFrame(columns).write_parquet(file)


def _write_swmm(directory: Path, run: DistrictRun, totals: Totals) -> None:
    """Write a time series for each flow, and a network that takes the first of them."""
    directory.mkdir()
    start = run.runs[0].start.replace(tzinfo=None)
    for flow in totals.flows:
        volumes = totals.discharge(flow)
        outlet = page.LABELS[flow.outlet] if flow.adoption else page.AS_IS_LABEL
        share = page.percent(flow.adoption)
        text = swmm.format_series(
            start, totals.seconds, volumes,
            f"{len(run.buildings)} buildings, {share} of them with a cistern: {outlet}",
        )
        replace_text(directory / f"{_name(flow)}.dat", text)
    hours = totals.rain.shape[1] * totals.seconds / 3600
    network = swmm.format_network(start, hours, f"{_name(totals.flows[0])}.dat")
    replace_text(directory / swmm.NETWORK, network)
