"""The results of a bag's run, compared with sums by hand and with the simulation's own tally."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inputs import trajectory_of
from paper import PAPER_SITE, paper_run, site_file

from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.trajectory import compute_results
from greenroof_ros.simulation.loop import simulate

TARGET = 68.8 * 0.0457


def test_samples_of_a_real_site() -> None:
    """Samples at 0, 10, 40 and 100 s, deviations of 1, 2, 3 and 4 m3, by hand."""
    trajectory = trajectory_of(
        [0, 10, 40, 100], cistern=[10, 9, 8, 7], roof=TARGET + np.array([1, 2, 3, 4]),
        precipitation=[1e-5, 0, 2e-5, 9], evapotranspiration=[1e-3, 2e-3, 0, 9],
        command=[0, 1.5, 0.5, 9], pump_flow=[0, 0.01, 0.002, 9], outflow=[1e-3, 0, 5e-4, 9],
        drainage=[0, 1e-4, 0, 9], frost=[0, 1, 0, 1],
    )
    row = compute_results(PAPER_SITE, trajectory)
    # The last sample counts for tau = 1 s in the deviation, and nowhere else.
    expected = {
        "total_deviation_m3": 10 + 60 + 180 + 4, "rain_roof_m3": 68.8 * (1e-4 + 1.2e-3),
        "rain_cistern_m3": np.pi * 0.305**2 * (1e-4 + 1.2e-3), "pumped_m3": 0.3 + 0.12,
        "outflow_m3": 0.01 + 0.03, "evapotranspiration_m3": 0.01 + 0.06, "drainage_m3": 0.003,
        "pump_hours": 90 / 3600, "pump_starts": 1, "beyond_hours": 30 / 3600, "max_command": 1.5,
        "final_cistern_m3": 7, "roof_retention_share": 1 - 0.003 / (68.8 * 1.3e-3 + 0.42),
    }
    assert {name: row[name] for name in expected} == pytest.approx(expected, rel=1e-12)
    for unknown in ("precipitation", "drainage"):
        assert "roof_retention_share" not in compute_results(PAPER_SITE, trajectory, [unknown])


def check_tally(*options: str) -> dict[str, float]:
    """Check a run of on/off, which is kept tick by tick, against its own tally; return the tally.

    Its samples may also be a little early or late, as at a live site.
    """
    run = paper_run("--controller", "onoff", *options)
    results, trajectory = simulate(run, every=1)
    assert trajectory is not None
    jitter = np.random.default_rng(1).uniform(-0.45, 0.45, len(trajectory.time))
    late = replace(trajectory, time=trajectory.time + run.site.tau * jitter)
    known = {metric.name for metric in METRICS} - {"limited_steps"}
    if run.site.low_outlet_level is not None and not run.site.low_outlet_valve:
        known -= {"overflow_m3", "overflow_days"}  # no topic has what an outlet without valve takes
    for kept in (trajectory, late):
        row = compute_results(run.site, kept)
        assert row == {name: value for name, value in results.items() if name in known}
    return results


def test_the_simulations_own_tally(tmp_path: Path) -> None:
    """The run itself and its trajectory give the same bits.

    First an empty roof loses less than the potential evapotranspiration, until mains water has
    filled the cistern. Then a field-capacity soil has a drainage layer that is not empty at first,
    and its cistern a catchment and a low outlet. At last this outlet has a valve, and the drainage
    flows into the cistern, which is full or filled by the mains.
    """
    mains = site_file(tmp_path, mains_level=0.8, mains_flow=0.004)
    row = check_tally("--cistern", "10", "--roof", "0.001", "--hours", "1", "--site", str(mains))
    assert row["mains_m3"] > 0.9 and row["limited_steps"] > 0 and row["pumped_m3"] > 0
    layer = site_file(
        tmp_path, base="site_neubrandenburg.yaml", initial_cistern=76.0, initial_roof=2.7,
        initial_layer=0.3, a_in=100.0, runoff_coefficient=0.5, low_outlet_level=2.0,
        low_outlet_radius=0.05,
    )
    row = check_tally("--start", "2021-07-08T08:00", "--hours", "2", "--site", str(layer))
    assert row["outflow_m3"] > 20 and row["rain_cistern_m3"] > 0
    assert row["final_layer_m3"] < 0.3 and row["drainage_m3"] > 0.1
    valve = site_file(
        tmp_path, base="site_neubrandenburg.yaml", initial_cistern=76.0, initial_roof=2.7,
        initial_layer=0.3, a_in=100.0, low_outlet_level=2.9, low_outlet_radius=0.05,
        low_outlet_valve=True, drainage_to_cistern=0.8, mains_level=2.0, mains_flow=0.002,
    )
    options = "--start", "2021-07-08T08:00", "--hours", "2", "--site", str(valve), "--outlet"
    row = check_tally(*options, "open")
    assert row["overflow_m3"] > 0.1 and row["overflow_days"] == 1 and row["mains_m3"] == 0
    assert row["discharge_m3"] == pytest.approx(row["outflow_m3"] + 0.2 * row["drainage_m3"])
    row = check_tally(*options, "drain", "--cistern", "45", "--roof", "2.7")
    assert row["mains_m3"] > 0.1 and row["overflow_m3"] == row["overflow_days"] == 0
    assert row["discharge_m3"] == pytest.approx(0.2 * row["drainage_m3"])
