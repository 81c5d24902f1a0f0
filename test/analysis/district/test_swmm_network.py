"""Routing with EPA's SWMM: time series, the scaled network, and a district's columns."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from studies import edit_district, write_district

import greenroof_ros as gr
from greenroof_ros.analysis.district.swmm import format_network, format_series, run_network

pytest.importorskip("swmm.toolkit.solver")  # of the extra test

START = datetime.fromisoformat("2021-07-07T22:30")
# A storm of half an hour on 24 ha, and what a valve lets out instead, for hours (m3 in a minute).
STORM = np.interp(np.arange(720.0), (60, 75, 90), (0, 80, 0))
VALVE = np.concatenate((np.zeros(240), np.full(400, STORM.sum() / 400), np.zeros(80)))


def test_series_has_the_same_volume() -> None:
    """Lines between its points, as SWMM interpolates; constant flows need only their ends."""
    rng = np.random.default_rng(1)
    for volumes in (STORM, VALVE, rng.random(500), np.full(7, 3.0), np.array([2.0])):
        durations = np.full(len(volumes), 60.0)
        lines = format_series(START, durations, volumes).splitlines()
        times = pl.Series([line[:19] for line in lines]).str.to_datetime("%m/%d/%Y %H:%M:%S")
        seconds = (times - START).dt.total_seconds()
        flows = [float(line.split()[2]) for line in lines]
        assert (seconds[0], seconds[-1]) == (0, durations.sum())
        means = np.add(flows[1:], flows[:-1]) / 2
        assert means @ np.diff(seconds.to_numpy()) == pytest.approx(volumes.sum(), rel=1e-7)
    assert len(format_series(START, np.full(len(VALVE), 60.0), VALVE).splitlines()) == 2 + 4


@pytest.mark.parametrize(("area", "capacity"), [(24_000.0, 5.0), (240_000.0, 10.0), (1e6, 2.0)])
def test_capacity_of_the_scaled_network(tmp_path: Path, area: float, capacity: float) -> None:
    """A steady flow somewhat below the capacity does not overflow, and one above it does."""
    flow = capacity / 1000 / 60 * area  # m3 in a minute, half of which enters at each of two nodes
    model, minutes = tmp_path / "model.inp", 600
    for share in (0.8, 1.3):
        halves = np.full(minutes, share * flow / 2)
        (tmp_path / "half.dat").write_text(format_series(START, np.full(minutes, 60.0), halves))
        model.write_text(format_network(
            start=START, end=START + timedelta(minutes=minutes), series=["half.dat"] * 2, area=area,
            capacity=capacity,
        ))
        overflow = run_network(model)["routed_overflow_m3"]
        assert (overflow > 0.01 * minutes * flow) == (share > 1), share


def test_district(tmp_path: Path) -> None:
    """Two storms of July 2021: with valves the river gets less, and the headline is routed."""
    text = edit_district("draws: 1", "draws: 1\noutlets: [drain]")
    file = write_district(tmp_path, text.replace("site_valve", "districts/house"))
    result = gr.district(file, swmm=tmp_path / "swmm")
    rows = {(row["outlet"], row["adoption"]): row for row in result.all_rows.to_dicts()}
    as_is, drain = rows["none", 0.0], rows["drain", 1.0]
    assert as_is["routed_overflow_m3"] > drain["routed_overflow_m3"]
    # The wettest hour is steady for so short a trunk, which also carries 1 % of sewage.
    area = result.buildings["connected_area_m2"].sum()
    assert as_is["routed_peak_l_s"] == pytest.approx(7.6 * area / 3600, rel=0.02)
    assert rows["drain", 0.5]["routed_overflow_m3"] is None
    assert "(routed, first draw)" in result.sentence
    assert (tmp_path / "swmm" / "2021" / "drain_100.rpt").exists()
