"""A level sensor with errors and pumps with minimum times: by hand, by statistics, by rule."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from paper import PAPER_SITE, exact_flows, paper_run, tick_of

from greenroof_ros.physics.pump import (
    SensorAndPump,
    make_switch,
    observe_pump,
    read_errors,
    switch_pump,
)
from greenroof_ros.physics.virtual_site import VirtualSite
from greenroof_ros.simulation.loop import Simulation

EMPTY, FULL = 0.0, PAPER_SITE.a2 * PAPER_SITE.z_veg


def test_noise_is_normal_and_independent() -> None:
    """Mean, spread, shape and correlation of 200,000 readings, each within five standard errors."""
    count, noise = 200_000, 0.001
    imperfect = SensorAndPump(roof_noise=noise, roof_offset=0.002, noise_seed=7)
    errors = (read_errors(imperfect, count) - 0.002) / noise
    assert errors.mean() == pytest.approx(0, abs=5 / math.sqrt(count))
    assert errors.std() == pytest.approx(1, abs=5 / math.sqrt(2 * count))
    for width, share in ((1, 0.682689), (2, 0.954500), (3, 0.997300)):
        spread = math.sqrt(share * (1 - share) / count)
        assert (np.abs(errors) < width).mean() == pytest.approx(share, abs=5 * spread)
    for lag in (1, 2, 4096):
        together = (errors[lag:] * errors[:-lag]).mean()
        assert together == pytest.approx(0, abs=5 / math.sqrt(count - lag))


def test_noise_follows_from_seed_and_tick_alone() -> None:
    """However many ticks a run has; no two seeds have the same noise."""
    noise = [read_errors(SensorAndPump(roof_noise=0.1, noise_seed=k), 5000) for k in range(100)]
    for ticks in (1, 4095, 4096, 4097):
        few = read_errors(SensorAndPump(roof_noise=0.1, noise_seed=3), ticks)
        assert few.tolist() == noise[3][:ticks].tolist()
    assert len(np.unique(noise)) == 100 * 5000


@pytest.mark.parametrize(("sensor", "roof", "reading"), [
    ({}, 0.5, 0.5), ({"roof_offset": 0.25}, 0.5, 0.75), ({"roof_offset": -0.25}, 0.5, 0.25),
    ({"roof_offset": -0.25}, 0.125, 0.0),  # the sensor's end
])
def test_offset_by_hand(sensor: dict[str, float], roof: float, reading: float) -> None:
    site = VirtualSite(PAPER_SITE, 75.0, roof * PAPER_SITE.a2, 0, SensorAndPump(**sensor), 1)
    assert site.observe() == (3.0, reading)
    assert site.levels() == (3.0, roof)


def commands_let_through(
    errors: SensorAndPump,
    commands: Sequence[float],
    frost: Sequence[bool] = (),
    roofs: Sequence[float] = (),
) -> list[float]:
    """Return the share of the maximum flow delivered in each tick, from 75 m3 in the cistern."""
    switch, shares = [*make_switch(errors, 1.0)], []
    most = tick_of(PAPER_SITE, 75.0, EMPTY, command=1.0)[1].pump
    for command, cold, roof in itertools.zip_longest(commands, frost, roofs, fillvalue=0.0):
        passed = switch_pump(switch, command, not cold)
        flow = tick_of(PAPER_SITE, 75.0, roof, command=passed)[1].pump
        observe_pump(switch, flow)
        shares.append(flow / most)
    return shares


@pytest.mark.parametrize(("on", "off", "commands", "expected"), [
    # A short command is extended, a short pause, too; the rest passes unchanged.
    (
        3, 2, [0, 0.5, 0, 0, 0, 0, 1, 1, 1, 1, 0, 1, 0, 1, 0.25, 0, 0],
        [0, 0.5, 0.5, 0.5, 0, 0, 1, 1, 1, 1, 0, 0, 0, 1, 0.25, 0.25, 0],
    ),
    # The pumps may start in the first tick: they have been off long enough.
    (3, 0, [1, 0, 0, 0, 1, 0, 1, 1], [1, 1, 1, 0, 1, 1, 1, 1]),
    (0, 4, [1, 0, 0, 0, 1, 0, 1, 1], [1, 0, 0, 0, 0, 0, 1, 1]),
])
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
    times = SensorAndPump(pump_min_on=seconds, pump_min_off=2 * tau)
    assert make_switch(times, tau) == (0, 2, 0, ticks, 2)


def test_what_stops_them_at_once() -> None:
    """A full roof, since Eq. (3a) uses the true level, and frost; then a time off begins."""
    times = SensorAndPump(pump_min_on=10, pump_min_off=3)
    roofs = [EMPTY, EMPTY, FULL, EMPTY, EMPTY, EMPTY, FULL]
    assert commands_let_through(times, [1] * 7, roofs=roofs) == [1, 1, 0, 0, 0, 1, 0]
    frost = [False, False, True, True, False, False, False]
    assert commands_let_through(times, [1, 1, 0, 0, 1, 1, 1], frost) == [1, 1, 0, 0, 0, 1, 1]
    assert commands_let_through(times, [1, 1, 0], [False, False, True]) == [1, 1, 0]


@pytest.mark.parametrize(("frost", "seconds", "runs"), [
    (0.0, 12 * 3600, True), (1.0, 12 * 3600, False), (math.nan, 12 * 3600, False),
    # Quiet from 22:00 to 06:00, to the second; the clock is at UTC.
    (0.0, 22 * 3600 - 1, True), (0.0, 22 * 3600, False), (0.0, 24 * 3600, False),
    (0.0, 6 * 3600 - 1, False), (0.0, 6 * 3600, True),
])
def test_when_the_pumps_may_run(frost: float, seconds: int, runs: bool) -> None:
    """Not in frost, also if that is unknown, nor in quiet hours; a driver has rules of its own."""
    quiet = replace(PAPER_SITE, quiet_hours=("22:00-06:00",))
    site = VirtualSite(quiet, 75.0, 1.0, (seconds - 1) * 10**9, SensorAndPump())
    site.act(0.0, 0.0, 0.0)
    site.step()
    site.frost = frost
    flow = exact_flows(PAPER_SITE, 75.0, 1.0, 0.5)[1] if runs else 0.0
    assert site.act(0.0, 0.0, 0.5).pump == pytest.approx(flow, rel=1e-12)
    assert site.act(0.0, 0.0, 0.5, pumped=0.003).pump == 0.003


def test_the_controller_sees_the_reading_and_the_sums_the_truth() -> None:
    """If the sensor reads 4 mm too high, on/off stops 4 mm too early, 0.2752 m3."""
    run = paper_run("--controller", "onoff", "--hours", "0.2", "--roof-offset", "0.004")
    site, simulation = run.site, Simulation(run)
    ticks = list(simulation.ticks())
    metrics = simulation.metrics.results(simulation.site.state).metrics
    highest = max(tick.x2 for tick in ticks)
    assert site.x2_star - highest == pytest.approx(0.2752, abs=0.009)
    assert ticks[5].roof_level == ticks[5].x2 / site.a2 + 0.004
    total = sum(abs(tick.x2 - site.x2_star) for tick in ticks)
    assert metrics["total_deviation_m3"] == pytest.approx(total, rel=1e-12)
    assert metrics["final_roof_m3"] == ticks[-1].x2
