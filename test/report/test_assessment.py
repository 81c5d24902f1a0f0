"""The results of a run, against sums by hand, and against the simulation's own tally."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper import PAPER_SITE, paper_run, site_file, site_with
from places import CONFIG

from greenroof_ros.experiment.closed_loop import closed_loop, record
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import head_loss
from greenroof_ros.model.site import edited
from greenroof_ros.recording.trajectory import Trajectory
from greenroof_ros.report.assessment import Assumptions, assess

START = datetime.fromisoformat("2021-07-07T02:00-05:00")
TARGET = 68.8 * 0.0457


def trajectory(samples: int, dt: float = 1.0, **values: object) -> Trajectory:
    """A trajectory in which nothing happens but what is given."""
    columns = {
        name: np.broadcast_to(np.asarray(values.get(name, 0.0), dtype=float), (samples,))
        for name in (
            "cistern", "roof", "precipitation", "evapotranspiration", "command", "pump_flow",
            "outflow", "drainage", "frost",
        )
    }
    return Trajectory(start=START, time=dt * np.arange(samples), **columns)


def test_an_hour_of_constant_flow() -> None:
    """0.002 m3/s for an hour from a cistern at 2 m: 7.2 m3.

    L = (3.56 18.4 / 0.2 + 0.6) 0.002^2 / (2 9.81 (0.01 pi)^2) + 16 - 2
      = 328.12 4e-6 / (19.62 9.8696044e-4) + 14 = 14.0677788 m;
    the power is 1000 9.81 0.002 L = 276.00982 W, over an efficiency of 0.5 552.0196 Wh.
    """
    run = trajectory(
        3601, cistern=50.0, roof=TARGET, command=0.25, pump_flow=np.full(3601, 0.002)
    )
    found = assess(PAPER_SITE, run, Assumptions(energy_price=0.2, water_price=4.0, band=0.05))
    assert found.hours == 1
    assert found.metrics["pumped_m3"] == pytest.approx(7.2, rel=1e-12)
    assert found.metrics["hydraulic_energy_kwh"] == pytest.approx(0.27600982, rel=1e-6)
    assert found.metrics["electric_energy_kwh"] == pytest.approx(0.5520196, rel=1e-6)
    assert found.energy_cost == pytest.approx(0.11040392, rel=1e-6)
    assert found.water_value == pytest.approx(28.8, rel=1e-12)
    assert found.metrics["pump_starts"] == 1
    assert found.metrics["pump_hours"] == pytest.approx(1, rel=1e-12)
    assert (found.metrics["beyond_hours"], found.metrics["max_command"]) == (0, 0.25)
    assert found.band_hours == 1
    assert found.metrics["total_deviation_m3"] == pytest.approx(0, abs=1e-9)
    # Nothing in the volumes shows this flow: all of it is unexplained.
    assert found.cistern_residual_m3 == pytest.approx(7.2, rel=1e-12)
    assert found.roof_residual_m3 == pytest.approx(-7.2, rel=1e-12)


def test_samples_of_a_real_site() -> None:
    """Samples at 0, 10, 40 and 100 s, deviations of 1, 2, 3 and 4 m3, by hand."""
    run = replace(
        trajectory(
            4, cistern=[10, 9, 8, 7], roof=TARGET + np.array([1, 2, 3, 4]),
            precipitation=[1e-5, 0, 2e-5, 9], evapotranspiration=[1e-3, 2e-3, 0, 9],
            command=[0, 1.5, 0.5, 9], pump_flow=[0, 0.01, 0.002, 9], outflow=[1e-3, 0, 5e-4, 9],
            drainage=[0, 1e-4, 0, 9], frost=[0, 1, 0, 1],
        ),
        time=np.array([0.0, 10, 40, 100]),
    )
    found = assess(PAPER_SITE, run, Assumptions())
    # The last sample counts for tau = 1 s in the deviation, and nowhere else.
    assert found.metrics["total_deviation_m3"] == pytest.approx(10 + 60 + 180 + 4, rel=1e-12)
    assert found.metrics["rain_roof_m3"] == pytest.approx(68.8 * (1e-4 + 1.2e-3), rel=1e-12)
    assert found.metrics["rain_cistern_m3"] == pytest.approx(
        np.pi * 0.305**2 * (1e-4 + 1.2e-3), rel=1e-12
    )
    assert found.metrics["pumped_m3"] == pytest.approx(0.3 + 0.12, rel=1e-12)
    assert found.metrics["outflow_m3"] == pytest.approx(0.01 + 0.03, rel=1e-12)
    assert found.metrics["evapotranspiration_m3"] == pytest.approx(0.01 + 0.06, rel=1e-12)
    assert found.metrics["drainage_m3"] == pytest.approx(0.003, rel=1e-12)
    assert (found.cistern_change_m3, found.roof_change_m3) == pytest.approx((-3, 3))
    assert found.metrics["pump_hours"] == pytest.approx(90 / 3600)
    assert found.metrics["pump_starts"] == 1
    assert found.metrics["beyond_hours"] == pytest.approx(30 / 3600)
    assert found.metrics["max_command"] == 1.5
    assert found.frost_hours == pytest.approx(30 / 3600)
    assert found.frost_pumped_m3 == pytest.approx(0.3)


def test_a_longer_tick_gives_the_papers_sum() -> None:
    """With tau = 10 s the sum is over ticks, not seconds."""
    site = site_with(tau=10.0)
    run = trajectory(3, dt=10.0, roof=[TARGET + 1, TARGET - 2, TARGET + 3])
    metrics = assess(site, run, Assumptions()).metrics
    assert metrics["total_deviation_m3"] == pytest.approx(6, rel=1e-12)


def test_band_includes_its_edges_and_counts_time() -> None:
    """5 % of 3.14416 m3 is 0.157208 m3."""
    run = trajectory(4, dt=1800.0, roof=TARGET + np.array([0.1572, -0.1573, 0.1573, 0]))
    assert assess(PAPER_SITE, run, Assumptions(band=0.05)).band_hours == 0.5


@pytest.mark.parametrize(
    ("flow", "starts"),
    [([0, 0, 0, 0], 0), ([1, 1, 1, 1], 1), ([0, 1, 0, 1], 1), ([1, 0, 1, 1], 2),
     ([0, 0, 0, 1], 0)],
)
def test_pump_starts(flow: list[int], starts: int) -> None:
    """A flow at the first sample is a start; at the last, after which the run ends, it is none."""
    run = trajectory(4, cistern=50.0, roof=1.0, pump_flow=np.array(flow) / 1000)
    assert assess(PAPER_SITE, run, Assumptions()).metrics["pump_starts"] == starts


@given(
    level=st.floats(0, 16), flow=st.floats(0, 0.02)
)
def test_head_loss_is_that_of_the_paper(level: float, flow: float) -> None:
    """Eq. (3c) once more, from its text."""
    friction = (3.56 * 18.4 / 0.2 + 0.6) * flow**2 / (2 * 9.81 * (0.01 * np.pi) ** 2)
    found = head_loss(PAPER_SITE, np.array([25 * level]), np.array([flow]))
    assert found[0] == pytest.approx(friction + 16 - level, abs=1e-9)


@pytest.mark.parametrize(
    "options",
    [
        ("--initial", "high-low", "--controller", "onoff", "--fraction", "2"),
        ("--initial", "low-low", "--controller", "mpc", "--weight", "1e-5"),
        ("--initial", "high-high", "--controller", "onoff", "--hours", "1.5"),
        # An empty roof gives less than evaporates, until it rains.
        ("--cistern", "10", "--roof", "0.001", "--controller", "onoff"),
        # A drainage layer, computed from what percolates.
        (
            "--controller", "onoff", "--start", "2021-07-08T04:00",
            "--site", str(CONFIG / "site_neubrandenburg.yaml"),
        ),
    ],
)
def test_the_simulations_own_tally(options: tuple[str, ...]) -> None:
    """The same bits from a run under way and from its trajectory; the balance closes."""
    hours = () if "--hours" in options else ("--hours", "3")
    run = paper_run(*options, *hours)
    metrics = Metrics()
    controller = run.make_controller()
    found = assess(run.site, record(run, closed_loop(run, controller, metrics)), Assumptions())
    results = metrics.results()
    limited = results.pop("limited_steps")
    if limited:
        # What a limited roof gave is worked out from the trajectory in another way.
        for name in ("evapotranspiration_m3", "evapotranspiration_ratio"):
            assert found.metrics.pop(name) == pytest.approx(results.pop(name), rel=1e-9)
    assert found.metrics == results
    assert found.cistern_residual_m3 == pytest.approx(0, abs=1e-9)
    assert found.roof_residual_m3 == pytest.approx(0, abs=1e-9)
    if "--roof" in options:
        assert limited > 0


def test_what_a_layer_holds_at_first_is_a_part_of_the_balance(tmp_path: Path) -> None:
    """A site's own initial state: all metrics from its trajectory, and nothing unexplained."""
    file = tmp_path / "site.yaml"
    measured = edited(CONFIG / "site_neubrandenburg.yaml", {})
    file.write_text(
        f"{measured}initial_cistern: 61.0\ninitial_roof: 2.7\ninitial_layer: 0.3\n",
        encoding="utf-8",
    )
    run = paper_run("--controller", "onoff", "--hours", "0.5", "--site", str(file))
    metrics = Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    found = assess(run.site, happened, Assumptions())
    assert found.metrics["final_layer_m3"] == metrics["final_layer_m3"] < 0.3
    assert found.metrics["drainage_m3"] == metrics["drainage_m3"] > 0.1
    assert found.roof_residual_m3 == pytest.approx(0, abs=1e-9)


def test_the_low_outlet_is_a_part_of_the_balance(tmp_path: Path) -> None:
    """Rain on 100 m2 of which half arrives; what both outlets take is the outflow."""
    file = site_file(
        tmp_path, a_in=100.0, runoff_coefficient=0.5, low_outlet_level=2.0, low_outlet_radius=0.05
    )
    run = paper_run(
        "--controller", "onoff", "--cistern", "76", "--roof", "1", "--hours", "2",
        "--start", "2021-07-08T08:00", "--site", str(file),
    )
    metrics = Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    found = assess(run.site, happened, Assumptions())
    assert found.metrics["outflow_m3"] == metrics["outflow_m3"] > 20
    assert found.metrics["rain_cistern_m3"] == metrics["rain_cistern_m3"] > 0
    assert found.metrics["rain_cistern_m3"] / 50 == pytest.approx(
        found.metrics["rain_roof_m3"] / run.site.a2, rel=1e-12
    )
    assert found.cistern_residual_m3 == pytest.approx(0, abs=1e-9)


def test_mains_water_is_a_part_of_the_balance(tmp_path: Path) -> None:
    """Half of what is pumped comes from the mains; both tallies have it, and the balance closes."""
    file = tmp_path / "site.yaml"
    text = (CONFIG / "site.yaml").read_text(encoding="utf-8")
    file.write_text(text + "mains_level: 0.8\nmains_flow: 0.004\n", encoding="utf-8")
    run = paper_run(
        "--controller", "onoff", "--cistern", "20", "--roof", "1", "--hours", "1",
        "--site", str(file),
    )
    metrics = Metrics()
    happened = record(run, closed_loop(run, run.make_controller(), metrics))
    found = assess(run.site, happened, Assumptions())
    assert found.metrics["mains_m3"] == metrics["mains_m3"] > 0.9
    assert found.cistern_residual_m3 == pytest.approx(0, abs=1e-9)


@given(data=st.data(), samples=st.integers(2, 40))
def test_properties(data: st.DataObject, samples: int) -> None:
    """Twice the flow is twice the water; a split run gives the sum of its parts."""
    draw = data.draw
    column = st.lists(st.floats(0, 1e-2), min_size=samples, max_size=samples)
    flow, outflow, roof = (np.array(draw(column)) for _ in range(3))
    run = trajectory(samples, cistern=60.0, roof=3 + roof, pump_flow=flow, outflow=outflow)
    whole = assess(PAPER_SITE, run, Assumptions())
    double = assess(PAPER_SITE, replace(run, pump_flow=2 * flow), Assumptions())
    assert double.metrics["pumped_m3"] == pytest.approx(2 * whole.metrics["pumped_m3"])
    energy = "hydraulic_energy_kwh"
    assert double.metrics[energy] >= 2 * whole.metrics[energy] * (1 - 1e-12)
    assert whole.metrics["pump_hours"] <= whole.hours * (1 + 1e-12)
    cut = draw(st.integers(1, samples - 1))
    if 1 <= cut < samples - 1:
        parts = []
        for piece in (slice(None, cut + 1), slice(cut, None)):
            names = ("cistern", "roof", "precipitation", "evapotranspiration", "command",
                     "pump_flow", "outflow", "drainage", "frost")
            part = Trajectory(
                start=START, time=run.time[piece],
                **{name: getattr(run, name)[piece] for name in names},
            )
            parts.append(assess(PAPER_SITE, part, Assumptions()))
        for name in ("pumped_m3", "outflow_m3", "hydraulic_energy_kwh", "pump_hours"):
            total = sum(part.metrics[name] for part in parts)
            assert total == pytest.approx(whole.metrics[name], abs=1e-12)
        total = sum(part.band_hours for part in parts)
        assert total == pytest.approx(whole.band_hours, abs=1e-12)
