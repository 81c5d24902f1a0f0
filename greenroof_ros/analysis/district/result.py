"""The results of a district: tables, hydrographs, page, and the directory that contains them."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from greenroof_ros.analysis.district import page, swmm
from greenroof_ros.analysis.district.district_file import code_share
from greenroof_ros.analysis.district.run import DistrictRun
from greenroof_ros.analysis.district.totals import Flow, Totals
from greenroof_ros.base.files import claim_directory, replace_file, replace_text
from greenroof_ros.base.text import number_of

PAGE = "page.html"


@dataclass(frozen=True, eq=False)
class DistrictResult:
    """The discharge of many buildings to one sewer.

    Attributes:
        run: the simulated district.
        totals: sums over the district's buildings.
    """

    run: DistrictRun
    totals: Totals

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """Rows for each adoption level and kind of outlet, beginning with the district as it is."""
        return self.totals.rows()

    @property
    def sentence(self) -> str:
        """The main result, in a sentence or two."""
        return page.summarise(self.run, self.rows)

    @property
    def warnings(self) -> list[str]:
        """Warnings about the district; usually there are none."""
        return page.warn(self.run, self.rows)

    @property
    def table(self) -> pl.DataFrame:
        """The rows as a data frame; the columns' names include their units."""
        return pl.DataFrame(self.rows)

    @property
    def buildings(self) -> pl.DataFrame:
        """A row for every building: the level of adoption at which it adopts, and its results."""
        return pl.DataFrame(list(self._list_buildings()), infer_schema_length=None)

    @property
    def hydrographs(self) -> pl.DataFrame:
        """Flows (m3/s) and rain (mm/h), with the time at which every interval begins."""
        run, totals = self.run, self.totals
        start, seconds = run.runs[0].start, totals.seconds
        first = start.replace(tzinfo=None)
        last = first + timedelta(seconds=seconds * (totals.rain.shape[1] - 1))
        return pl.DataFrame({
            f"time_utc{start.isoformat()[-6:]}": pl.datetime_range(
                first, last, timedelta(seconds=seconds), eager=True
            ),
            **{
                f"rain_{cell}_mm_h" if cell else "rain_mm_h": 3.6e6 / seconds * rain
                for cell, rain in zip(run.cells or ("",), totals.rain, strict=True)
            },
            "wet": totals.wet,
            **{
                f"{name_flow(flow)}_m3_s": totals.discharge(flow) / seconds
                for flow in totals.flows
            },
        })

    def save(self, directory: str | os.PathLike[str], *, with_swmm: bool = False) -> None:
        """Write all results to a directory.

        Args:
            directory: output directory, which is created if it does not exist, and must be empty.
            with_swmm: whether time series for SWMM are also written.

        Raises:
            ConfigurationError: if the directory is not empty.
            OSError: if writing fails, for instance because the disk is full.
        """
        directory = Path(directory)
        claim_directory(directory)
        shutil.copyfile(self.run.district.path, directory / "district.yaml")
        replace_text(directory / "results.csv", self.table.write_csv())
        replace_text(directory / "buildings.csv", self.buildings.write_csv())
        flows = io.BytesIO()  # to a file, polars would not raise an OSError
        self.hydrographs.write_parquet(flows)
        replace_file(
            directory / "hydrographs.parquet", lambda stream: stream.write(flows.getbuffer())
        )
        if with_swmm:
            self._save_for_swmm(directory / "swmm")
        figures = [*page.draw_figures(self.run, self.totals, self.rows)]
        (directory / "figures").mkdir()
        for figure in figures:
            figure.save(directory / "figures")
        text = page.render(self.run, self.totals.area, self.rows, figures)
        replace_text(directory / PAGE, text)

    def _list_buildings(self) -> Iterator[dict[str, Any]]:
        run, totals, adoption = self.run, self.totals, self.run.adoption
        buildings = run.buildings
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
                    f"{outlet}:{metric}":
                        None if np.isnan(values[place]) else float(values[place])
                    for outlet in totals.outlets
                    for metric, values in totals.metrics[outlet].items()
                },
            }

    def _save_for_swmm(self, directory: Path) -> None:
        """Write a time series for every flow, and a network that receives the first time series."""
        directory.mkdir()
        run, totals = self.run, self.totals
        start = run.runs[0].start.replace(tzinfo=None)
        for flow in totals.flows:
            outlet = page.LABELS[flow.outlet] if flow.adoption else page.AS_IS_LABEL
            share = page.percent(flow.adoption)
            text = swmm.format_series(
                start, totals.seconds, totals.discharge(flow),
                f"{number_of(len(run.buildings), 'building')}, {share} with a cistern, {outlet}",
            )
            replace_text(directory / f"{name_flow(flow)}.dat", text)
        hours = totals.rain.shape[1] * totals.seconds / 3600
        network = swmm.format_network(start, hours, f"{name_flow(totals.flows[0])}.dat")
        replace_text(directory / swmm.NETWORK, network)


def name_flow(flow: Flow) -> str:
    """Return the name of a hydrograph: ``as_is``, or ``drain_050`` for half the buildings."""
    return f"{flow.outlet}_{code_share(flow.adoption)}" if flow.adoption else "as_is"
