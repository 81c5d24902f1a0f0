"""The roof under a record's rain behaves like the plant; what its runoff meter shows of that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from twins import TWIN, a_record, storms

from greenroof_ros.analysis.calibration.fit import find_min_reading, simulate
from greenroof_ros.analysis.calibration.record import StepRecord
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.tick import step
from greenroof_ros.site.site import Site

TICK_S = 5.0


def by_the_plant(site: Site, record: StepRecord, filled: float) -> tuple[np.ndarray, np.ndarray]:
    """Return runoff (mm) and level (m) of each step, from the plant with ticks of seconds."""
    p = plant_parameters(replace(site, tau=TICK_S, z_o=1e9))
    state = State(1e6, site.wilting_volume + filled * site.available_volume, 0.0)
    runoff, level = [], []
    flow = site.a2 / 1000 / record.step_s
    for fell, wanted, came in zip(record.rain, record.reference, record.pumped, strict=True):
        level.append(state.roof / site.a2)
        rain, drained = float(fell / 1000 / record.step_s), 0.0
        potential, pumped = float(wanted * site.crop_coefficient * flow), float(came * flow)
        for _ in range(round(record.step_s / TICK_S)):
            state, flows = step(p, state, rain, potential, 0.0, 1.0, pumped)
            drained += flows.drainage * TICK_S
        runoff.append(drained * 1000 / site.a2)
    return np.array(runoff), np.array(level)


@pytest.mark.parametrize(
    ("step_s", "days", "exponent"),
    [(300.0, 5, 2.0), (300.0, 5, 1.3), (3600.0, 5, 2.0), (6 * 3600.0, 10, 2.0)],
)
def test_the_plant_does_the_same(step_s: float, days: int, exponent: float) -> None:
    """With long steps, rain or pumping of an hour is as much as five minutes' in other records."""
    site = replace(TWIN, percolation_exponent=exponent)
    random = np.random.default_rng(3)
    steps = round(days * 86400 / step_s)
    rain = np.resize(storms(20, random)[1000:], steps)
    reference = np.maximum(0.0, random.normal(3e-5, 3e-5, steps)) * step_s
    pumped = np.where(random.random(steps) < max(0.01, 3 / steps), 1.5, 0.0)
    record = a_record(rain, step_s, reference=reference, pumped=pumped)
    simulated = simulate(site, record, 0.7)
    runoff, level = by_the_plant(site, record, 0.7)
    assert pumped.any()
    assert runoff.sum() > 0.5
    assert simulated["level"] == pytest.approx(level, abs=1e-4)
    assert simulated["runoff"].sum() == pytest.approx(runoff.sum(), rel=0.005)
    assert simulated["runoff"] == pytest.approx(runoff, abs=0.01 * runoff.max())


def test_a_counter_of_tips_misses_nothing() -> None:
    """Tips of a litre from 194 m2, as in Berlin, or printed with two decimals; a flow meter does.

    Nor does anything get lost without a meter.
    """
    tip = 1 / 194
    counts = np.random.default_rng(4).geometric(0.1, 500)
    assert counts.max() > 40
    printed = np.array([float(f"{count * 0.0297:.2f}") for count in counts])
    flows = np.round(0.02 + np.random.default_rng(5).exponential(0.2, 500), 2)
    for runoff, minimum in (
        (np.zeros(6), 0.0), (np.array([0, tip, 2 * tip, 0, 60 * tip, np.nan]), 0.0),
        (printed, 0.0), (flows, flows.min()),
    ):
        assert find_min_reading(a_record(np.zeros(6), runoff=runoff)) == minimum
    assert find_min_reading(a_record(np.zeros(6), level=np.ones(6))) == 0.0


def test_a_flow_meter_shows_nothing_below_its_minimum() -> None:
    """The lowest readings of Neubrandenburg's meter, which are not multiples of a tip."""
    readings = np.array([0, 0.00605509, 0.01215386, 0.01829655, 0.02448339, 0.03071464])
    minimum = find_min_reading(a_record(np.zeros(6), runoff=readings))
    assert minimum == pytest.approx(0.00605509)
    record = a_record(np.where(np.arange(600) == 5, 20.0, 0.0))
    runoff, shown = (simulate(TWIN, record, 1.0, reading)["runoff"] for reading in (0.0, minimum))
    small = (runoff > 0) & (runoff < minimum)
    assert small.any()
    assert not shown[small].any()
    assert np.array_equal(shown[~small], runoff[~small])
