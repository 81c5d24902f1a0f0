"""Hydrographs for EPA's SWMM: their volumes, and a combined sewer with an overflow weir."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from districts import edit, simulate_here
from places import CONFIG

from greenroof_ros.analysis.district.buildings import Values
from greenroof_ros.analysis.district.swmm import NETWORK, format_network, format_series
from greenroof_ros.analysis.district.totals import AS_IS, Flow

solver = pytest.importorskip("swmm.toolkit.solver")  # of the extra test
swmm_run = pytest.importorskip("swmm_run")

START = datetime.fromisoformat("2021-07-07T22:30")
# A storm of half an hour on 24 ha, and what a valve lets out instead, for hours (m3 in a minute).
STORM = np.interp(np.arange(720.0), (60, 75, 90), (0, 80, 0))
VALVE = np.concatenate((np.zeros(240), np.full(400, STORM.sum() / 400), np.zeros(80)))


def read_seconds(line: str) -> float:
    """Return the time of a line since the start (s): month, day, year, and the time of day."""
    date, clock, _ = line.split()
    month, day, year = date.split("/")
    return (datetime.fromisoformat(f"{year}-{month}-{day}T{clock}") - START).total_seconds()


def test_series_has_the_same_volume() -> None:
    """Lines between its points, as SWMM interpolates; constant flows need only their ends."""
    rng = np.random.default_rng(1)
    for volumes in (STORM, VALVE, rng.random(500), np.full(7, 3.0), np.array([2.0])):
        lines = format_series(START, 60.0, volumes, "test").splitlines()[2:]
        seconds = [read_seconds(line) for line in lines]
        flows = [float(line.split()[2]) for line in lines]
        assert (seconds[0], seconds[-1]) == (0, 60 * len(volumes))
        means = np.add(flows[1:], flows[:-1]) / 2
        assert means @ np.diff(seconds) == pytest.approx(volumes.sum(), rel=1e-7)
    assert len(format_series(START, 60.0, VALVE, "").splitlines()) == 2 + 2 + 4


class Routed(NamedTuple):
    """What SWMM finds."""

    inflow: float
    """external, without sewage (m3)"""
    treated: float
    river: float
    error: float
    """of continuity (%)"""


def route(directory: Path, volumes: Values) -> Routed:
    """Route a hydrograph through the example network."""
    (directory / "series.dat").write_text(format_series(START, 60.0, volumes, "test"))
    model = directory / NETWORK
    model.write_text(format_network(START, len(volumes) / 60, "series.dat"))
    volumes_of, errors = swmm_run.run_swmm(model, lambda: (
        solver.system_get_routing_totals().exInflow,
        *(solver.node_get_total_inflow(index) for index in (2, 3)),
    ))
    return Routed(*volumes_of, errors.routing)


def test_overflow_of_a_combined_sewer(tmp_path: Path) -> None:
    """The storm overflows into the river; the same water does not, let out by valves for hours."""
    storm, valve = (route(tmp_path, volumes) for volumes in (STORM, VALVE))
    for routed, volumes in ((storm, STORM), (valve, VALVE)):
        assert abs(routed.error) < 0.2
        assert routed.inflow == pytest.approx(volumes.sum(), rel=1e-6)
    assert storm.river > 0.25 * STORM.sum()
    assert valve.river == 0


def test_valves_of_a_district_keep_the_river_clean(tmp_path: Path) -> None:
    """Two storms of July 2021, on as many buildings of the district as the network is for."""
    text = edit("valve_share: 0.5", "outlets: [drain]").replace("site_valve", "districts/house")
    run, totals = simulate_here(tmp_path, text)
    scale = 240_000 / totals.area
    river = {}
    for flow in (AS_IS, Flow("none", 1.0), Flow("drain", 0.5), Flow("drain", 1.0)):
        volumes = scale * totals.discharge(flow)
        routed = route(tmp_path, volumes)
        assert abs(routed.error) < 0.2
        assert routed.inflow == pytest.approx(volumes.sum(), rel=1e-5)
        river[flow] = routed.river
    as_is, overflow_only, half, everywhere = river.values()
    assert as_is > half > everywhere
    assert overflow_only > everywhere
    assert run.runs[0].start.isoformat().startswith("2021-07-07T00:00")


def test_network_is_complete_as_it_is(tmp_path: Path) -> None:
    """Its file names the series that a user provides."""
    text = (CONFIG / "swmm" / NETWORK).read_text()
    assert 'FILE "inflow.dat"' in text
    assert 'FILE "series.dat"' in format_network(START, 12.0, "series.dat")
