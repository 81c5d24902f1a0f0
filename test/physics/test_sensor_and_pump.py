"""A level sensor with errors and pumps with minimum times: by hand, by statistics, by rule."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from paper import PAPER_SITE, paper_run

from greenroof_ros.physics.plant import Plant
from greenroof_ros.physics.sensor_and_pump import Pump, RoofSensor, SensorAndPump
from greenroof_ros.simulation.loop import Simulation

EMPTY, FULL = 0.0, PAPER_SITE.a2 * PAPER_SITE.z_veg


def readings(errors: SensorAndPump, ticks: Sequence[int], level: float) -> list[float]:
    """Return the readings of a new sensor at these ticks."""
    sensor = RoofSensor(errors)
    return [sensor.reading(tick, level) for tick in ticks]


def test_noise_is_normal_and_independent() -> None:
    """Mean, spread, shape and correlation of 200,000 readings, each within five standard errors."""
    count, noise = 200_000, 0.001
    imperfect = SensorAndPump(roof_noise=noise, roof_offset=0.002, noise_seed=7)
    errors = (np.array(readings(imperfect, range(count), 0.045)) - 0.047) / noise
    assert errors.mean() == pytest.approx(0, abs=5 / math.sqrt(count))
    assert errors.std() == pytest.approx(1, abs=5 / math.sqrt(2 * count))
    for width, share in ((1, 0.682689), (2, 0.954500), (3, 0.997300)):
        spread = math.sqrt(share * (1 - share) / count)
        assert (np.abs(errors) < width).mean() == pytest.approx(share, abs=5 * spread)
    for lag in (1, 2, 4096):
        together = (errors[lag:] * errors[:-lag]).mean()
        assert together == pytest.approx(0, abs=5 / math.sqrt(count - lag))


def test_noise_follows_from_seed_and_tick_alone() -> None:
    """In any order, read twice, or by another sensor; no two seeds have the same noise."""
    imperfect = SensorAndPump(roof_noise=0.001, noise_seed=3)
    ticks = [0, 1, 4095, 4096, 5, 100_000, 4096, 0]
    expected = {tick: readings(imperfect, [tick], 0.045)[0] for tick in ticks}
    assert readings(imperfect, ticks, 0.045) == [expected[tick] for tick in ticks]
    assert readings(imperfect, ticks[::-1], 0.045) == [expected[tick] for tick in ticks[::-1]]
    assert len(set(expected.values())) == 6
    pairs = [
        readings(replace(imperfect, noise_seed=seed), [0, 4096], 0.045) for seed in range(100)
    ]
    assert len({value for pair in pairs for value in pair}) == 200


def test_offset_by_hand() -> None:
    """0.5 m read as 0.75 m, or as 0.25 m; 0.125 m less 0.25 m is 0, the sensor's end."""
    assert readings(SensorAndPump(roof_offset=0.25), [0, 5000], 0.5) == [0.75, 0.75]
    assert readings(SensorAndPump(roof_offset=-0.25), [0, 5000], 0.5) == [0.25, 0.25]
    assert readings(SensorAndPump(roof_offset=-0.25), [0], 0.125) == [0.0]
    noisy = readings(SensorAndPump(roof_noise=1.0), range(1000), 0.0)
    assert min(noisy) == 0 and 400 < noisy.count(0.0) < 600


def commands_let_through(
    pump_with: SensorAndPump,
    commands: Sequence[float],
    frost: Sequence[bool] = (),
    roofs: Sequence[float] = (),
    tau: float = 1.0,
) -> list[float]:
    """Return the share of the maximum flow delivered in each tick, from 75 m3 in the cistern."""
    pump = Pump(pump_with, tau)
    most = Plant(PAPER_SITE, 75.0, EMPTY).flows(0.0, 0.0, 1.0).pump
    shares = []
    for command, cold, roof in itertools.zip_longest(commands, frost, roofs, fillvalue=0.0):
        flows = Plant(PAPER_SITE, 75.0, roof).flows(0.0, 0.0, pump.switch(command, not cold))
        pump.observe(flows.pump)
        shares.append(flows.pump / most)
    return shares


@pytest.mark.parametrize(
    ("on", "off", "commands", "expected"),
    [
        # A short command is extended, a short pause, too; the rest passes unchanged.
        (
            3, 2, [0, 0.5, 0, 0, 0, 0, 1, 1, 1, 1, 0, 1, 0, 1, 0.25, 0, 0],
            [0, 0.5, 0.5, 0.5, 0, 0, 1, 1, 1, 1, 0, 0, 0, 1, 0.25, 0.25, 0],
        ),
        # The pumps may start in the first tick: they have been off long enough.
        (3, 0, [1, 0, 0, 0, 1, 0, 1, 1], [1, 1, 1, 0, 1, 1, 1, 1]),
        (0, 4, [1, 0, 0, 0, 1, 0, 1, 1], [1, 0, 0, 0, 0, 0, 1, 1]),
    ],
)
def test_minimum_times_by_hand(
    on: int, off: int, commands: list[float], expected: list[float]
) -> None:
    times = SensorAndPump(pump_min_on=on, pump_min_off=off)
    assert commands_let_through(times, commands) == expected


@pytest.mark.parametrize(
    ("seconds", "tau", "ticks"),
    [(6, 2.5, 3), (5, 2.5, 2), (1.1, 0.1, 11), (0.01, 1, 1)],
)
def test_minimum_times_last_whole_ticks(seconds: float, tau: float, ticks: int) -> None:
    """The first whole number of ticks that is not shorter, for any binary digits of tau."""
    commands = commands_let_through(SensorAndPump(pump_min_on=seconds), [1] + [0] * 20, tau=tau)
    assert commands == [1] * ticks + [0] * (21 - ticks)


def test_a_full_roof_stops_them_and_begins_a_time_off() -> None:
    """Eq. (3a) uses the true level; a flow that stops because of it is treated as switched off."""
    times = SensorAndPump(pump_min_on=10, pump_min_off=3)
    roofs = [EMPTY, EMPTY, FULL, EMPTY, EMPTY, EMPTY, FULL]
    assert commands_let_through(times, [1] * 7, roofs=roofs) == [1, 1, 0, 0, 0, 1, 0]


def test_frost_switches_off_at_once() -> None:
    """Long before the end of the minimum time on; then the minimum time off is kept."""
    times = SensorAndPump(pump_min_on=100, pump_min_off=3)
    frost = [False, False, True, True, False, False, False]
    commands = [1, 1, 0, 0, 1, 1, 1]
    assert commands_let_through(times, commands, frost) == [1, 1, 0, 0, 0, 1, 1]
    assert commands_let_through(times, [1, 1, 0], [False, False, True]) == [1, 1, 0]


def test_the_controller_sees_the_reading_and_the_sums_the_truth() -> None:
    """If the sensor reads 4 mm too high, on/off stops 4 mm too early, 0.2752 m3."""
    run = paper_run("--controller", "onoff", "--hours", "0.2", "--roof-offset", "0.004")
    site, simulation = run.site, Simulation(run)
    ticks, metrics = list(simulation.ticks()), simulation.metrics
    highest = max(tick.x2 for tick in ticks)
    assert site.x2_star - highest == pytest.approx(0.2752, abs=0.009)
    assert ticks[5].roof_level == ticks[5].x2 / site.a2 + 0.004
    total = sum(abs(tick.x2 - site.x2_star) for tick in ticks)
    assert metrics["total_deviation_m3"] == pytest.approx(total, rel=1e-12)
    assert metrics["final_roof_m3"] == ticks[-1].x2
