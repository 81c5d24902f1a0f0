"""The results of a bag's run, compared with sums by hand and with the simulation's own tally."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inputs import START
from paper import PAPER_SITE, paper_run, site_file
from places import CONFIG

from greenroof_ros.experiment.closed_loop import closed_loop, record
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.site import Site, edited
from greenroof_ros.recording.bag_reader import Recorded
from greenroof_ros.recording.trajectory import Trajectory
from greenroof_ros.report.about import Row, Run
from greenroof_ros.report.bags import measured, near_hours

TARGET = 68.8 * 0.0457


def trajectory(samples: int, dt: float = 1.0, **values: object) -> Trajectory:
    """Return a trajectory in which all values are 0 except the given ones."""
    columns = {
        name: np.broadcast_to(np.asarray(values.get(name, 0.0), dtype=float), (samples,))
        for name in (
            "cistern", "roof", "precipitation", "evapotranspiration", "command", "pump_flow",
            "outflow", "drainage", "frost",
        )
    }
    return Trajectory(start=START, time=dt * np.arange(samples), **columns)


def found_in(happened: Trajectory, site: Site = PAPER_SITE) -> Row:
    """Return the results computed from a bag."""
    return measured(Run(site=site, row={"run": "bag"}), Recorded(happened))


def test_samples_of_a_real_site() -> None:
    """Samples at 0, 10, 40 and 100 s, deviations of 1, 2, 3 and 4 m3, by hand."""
    row = found_in(replace(
        trajectory(
            4, cistern=[10, 9, 8, 7], roof=TARGET + np.array([1, 2, 3, 4]),
            precipitation=[1e-5, 0, 2e-5, 9], evapotranspiration=[1e-3, 2e-3, 0, 9],
            command=[0, 1.5, 0.5, 9], pump_flow=[0, 0.01, 0.002, 9], outflow=[1e-3, 0, 5e-4, 9],
            drainage=[0, 1e-4, 0, 9], frost=[0, 1, 0, 1],
        ),
        time=np.array([0.0, 10, 40, 100]),
    ))
    # The last sample counts for tau = 1 s in the deviation, and nowhere else.
    expected = {
        "total_deviation_m3": 10 + 60 + 180 + 4, "rain_roof_m3": 68.8 * (1e-4 + 1.2e-3),
        "rain_cistern_m3": np.pi * 0.305**2 * (1e-4 + 1.2e-3), "pumped_m3": 0.3 + 0.12,
        "outflow_m3": 0.01 + 0.03, "evapotranspiration_m3": 0.01 + 0.06, "drainage_m3": 0.003,
        "pump_hours": 90 / 3600, "pump_starts": 1, "beyond_hours": 30 / 3600, "max_command": 1.5,
        "frost_hours": 30 / 3600, "frost_pumped_m3": 0.3, "cistern_m3": 10,
        "final_cistern_m3": 7, "hours": 100 / 3600,
    }
    assert {name: row[name] for name in expected} == pytest.approx(expected, rel=1e-12)


def test_band_includes_its_edges_and_counts_time() -> None:
    """5 % of 3.14416 m3 is 0.157208 m3; the last sample lasts a tick."""
    run = trajectory(4, dt=1800.0, roof=TARGET + np.array([0.1572, -0.1573, 0.1573, 0]))
    assert near_hours(PAPER_SITE, run, 0.05) == pytest.approx(0.5 + 1 / 3600)


def own_tally(options: tuple[str, ...]) -> dict[str, float]:
    """Check a run against its own tally, and return the tally."""
    run = paper_run(*options)
    metrics = Metrics()
    row = found_in(record(run, closed_loop(run, run.make_controller(), metrics)), run.site)
    results = metrics.results()
    if results["limited_steps"]:
        # The losses of a limited roof are derived differently from the trajectory.
        for name in ("evapotranspiration_m3", "evapotranspiration_ratio"):
            assert row[name] == pytest.approx(results[name], rel=1e-9)
            row[name] = results[name]
    assert {name: row[name] for name in results if name != "limited_steps"} == {
        name: value for name, value in results.items() if name != "limited_steps"
    }
    return results


def test_the_simulations_own_tally(tmp_path: Path) -> None:
    """The run itself and its trajectory give the same bits.

    An empty roof loses less than the potential evapotranspiration until it rains; a layer is not
    empty at first; there are a low outlet, a catchment, and mains water.
    """
    own_tally(("--cistern", "10", "--roof", "0.001", "--controller", "onoff", "--hours", "3"))
    measured_roof = edited(CONFIG / "site_neubrandenburg.yaml", {})
    layer, mains = tmp_path / "layer.yaml", tmp_path / "mains.yaml"
    layer.write_text(
        f"{measured_roof}initial_cistern: 61.0\ninitial_roof: 2.7\ninitial_layer: 0.3\n"
    )
    row = own_tally(("--controller", "onoff", "--hours", "0.5", "--site", str(layer)))
    assert row["final_layer_m3"] < 0.3 and row["drainage_m3"] > 0.1
    low = site_file(
        tmp_path, a_in=100.0, runoff_coefficient=0.5, low_outlet_level=2.0, low_outlet_radius=0.05
    )
    row = own_tally((
        "--controller", "onoff", "--cistern", "76", "--roof", "1", "--hours", "2",
        "--start", "2021-07-08T08:00", "--site", str(low),
    ))
    assert row["outflow_m3"] > 20 and row["rain_cistern_m3"] > 0
    mains.write_text((CONFIG / "site.yaml").read_text() + "mains_level: 0.8\nmains_flow: 0.004\n")
    row = own_tally((
        "--controller", "onoff", "--cistern", "20", "--roof", "1", "--hours", "1",
        "--site", str(mains),
    ))
    assert row["mains_m3"] > 0.9
