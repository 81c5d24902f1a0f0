"""How far the planning controllers trust the level sensor and the forecast."""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, paper_run, planner, site_file
from places import CONFIG

from greenroof_ros.controllers import regret_limit
from greenroof_ros.controllers.anticipating_onoff import AnticipatingOnOff
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.controllers.regret_limit import RegretLimit
from greenroof_ros.controllers.roof_observer import RoofObserver
from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import maximum_pump_flow

EMPTY_HOUR = 3600 * PAPER_SITE.x2_star  # m3 s
STEPS = len(growing_steps(12)) - 1
MEASURED = ("--site", str(CONFIG / "site_neubrandenburg.yaml"))


# --- the sensor ---------------------------------------------------------------------------------


def test_estimate_is_the_truth_where_model_and_sensor_are_exact() -> None:
    """Over the paper's window, with rain, drainage of nothing, and pumps at work."""
    run = paper_run("--controller", "onoff")
    estimate = RoofObserver(PAPER_SITE, 300.0)
    for tick in closed_loop(run, run.make_controller(), Metrics()):
        x2 = estimate.correct(tick.roof_level)
        assert x2 == pytest.approx(tick.x2, abs=1e-9)
        estimate.predict(x2, tick.precipitation, tick.evapotranspiration, tick.flows.pump)


def test_estimate_of_a_roof_that_drains() -> None:
    """Above the soil's capacity Darcy's law is a part of the prediction."""
    estimate = RoofObserver(PAPER_SITE, 300.0)
    expected = estimate.predict(35.0, 0.0, 0.0, 0.0)
    depth = (35.0 / PAPER_SITE.a2 + PAPER_SITE.z_soil) / PAPER_SITE.z_soil
    assert 35.0 - expected == pytest.approx(PAPER_SITE.K * PAPER_SITE.a2 * depth, rel=1e-9)


def test_estimate_of_a_measured_roof() -> None:
    """What percolates and what dry plants do not evaporate is a part of the prediction."""
    run = paper_run("--controller", "onoff", *MEASURED, "--start", "2021-07-08T05:00")
    estimate = RoofObserver(run.site, 300.0)
    for tick in closed_loop(run, run.make_controller(), Metrics()):
        x2 = estimate.correct(tick.roof_level)
        assert x2 == pytest.approx(tick.x2, abs=1e-9)
        estimate.predict(x2, tick.precipitation, tick.evapotranspiration, tick.flows.pump)


def test_noise_is_smoothed() -> None:
    """Exponential observer_time_constant with gain g leaves sqrt(g / (2 - g)) of white noise."""
    noise, ticks = 0.001, 100_000
    estimate = RoofObserver(PAPER_SITE, 300.0)
    readings = 0.04 + noise * np.random.default_rng(1).standard_normal(ticks)
    errors = []
    for reading in readings:
        x2 = estimate.correct(float(reading))
        estimate.predict(x2, 0.0, 0.0, 0.0)
        errors.append(PAPER_SITE.roof_level(x2) - 0.04)
    gain = 1 / 300
    # Some 300 of them are worth one: 330 independent ones, whose spread is known to 4 %.
    assert np.std(errors[3000:]) == pytest.approx(noise * math.sqrt(gain / (2 - gain)), rel=0.2)


def test_it_begins_with_the_mean() -> None:
    """The first reading is as good as any of the next: after n of them, their mean is the best."""
    estimate = RoofObserver(PAPER_SITE, 300.0)
    readings = 0.04 + 0.0005 * np.random.default_rng(2).standard_normal(300)
    for number, reading in enumerate(readings, start=1):
        x2 = estimate.correct(float(reading))
        estimate.predict(x2, 0.0, 0.0, 0.0)
        assert PAPER_SITE.roof_level(x2) == pytest.approx(readings[:number].mean(), abs=1e-12)


@pytest.mark.parametrize("tau", [1.0, 10.0])
@pytest.mark.parametrize("noise", [0.001, 0.003, 0.005])
def test_noise_of_any_size_is_noise(noise: float, tau: float) -> None:
    """It is averaged over 300 s: the error is that of the average alone, with no jumps to it."""
    site = replace(PAPER_SITE, tau=tau)
    estimate = RoofObserver(site, 300.0)
    errors = []
    for deviate in np.random.default_rng(3).standard_normal(43_200 // int(tau)):
        x2 = estimate.correct(0.06 + noise * float(deviate))
        estimate.predict(x2, 0.0, 0.0, 0.0)
        errors.append(site.roof_level(x2) - 0.06)
    gain = tau / 300
    expected = noise * math.sqrt(gain / (2 - gain))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected, rel=0.25)


@pytest.mark.parametrize("off", [-0.045, 0.045])
def test_a_single_reading_is_no_reason(off: float) -> None:
    """One of them far off counts as one of 300."""
    estimate = RoofObserver(PAPER_SITE, 300.0)
    for _ in range(300):
        estimate.predict(estimate.correct(0.05), 0.0, 0.0, 0.0)
    x2 = estimate.correct(0.05 + off)
    assert PAPER_SITE.roof_level(x2) == pytest.approx(0.05 + off / 300, abs=1e-5)


def test_level_that_cannot_be_noise() -> None:
    """A centimetre off is followed after fifteen ticks, a millimetre slowly."""
    off, near = RoofObserver(PAPER_SITE, 300.0), RoofObserver(PAPER_SITE, 300.0)
    x2_off = x2_near = PAPER_SITE.roof_volume(0.03)
    for estimate in (off, near):
        for _ in range(300):
            estimate.predict(estimate.correct(0.03), 0.0, 0.0, 0.0)
    for _ in range(15):
        x2_off, x2_near = off.correct(0.04), near.correct(0.031)
        off.predict(x2_off, 0.0, 0.0, 0.0)
        near.predict(x2_near, 0.0, 0.0, 0.0)
    # By the mean of the surprises, of which the slow correction has taken some away already.
    assert 0.0400 < PAPER_SITE.roof_level(x2_off) < 0.0405
    assert PAPER_SITE.roof_level(x2_near) == pytest.approx(
        0.03 + 0.001 * (1 - (1 - 1 / 300) ** 15)
    )


def test_after_ticks_unseen() -> None:
    """After a few the average goes on; after more the next reading is taken as it is."""
    for unseen, starts_again in ((1, False), (15, False), (16, True)):
        estimate = RoofObserver(PAPER_SITE, 300.0)
        for _ in range(300):
            estimate.predict(estimate.correct(0.03), 0.0, 0.0, 0.0)
        for _ in range(unseen):
            estimate.skip()
        x2 = estimate.correct(0.0305)
        assert (x2 == PAPER_SITE.roof_volume(0.0305)) is starts_again
        assert PAPER_SITE.roof_level(x2) == pytest.approx(
            0.0305 if starts_again else 0.03 + 0.0005 / 300, abs=1e-6
        )


CONTROLLERS = {
    "anticipating_onoff": lambda: AnticipatingOnOff(PAPER_SITE, 12, 1.0, 300.0, math.inf),
    "planning_mpc": lambda: planner(observer_time_constant=300.0),
}


@pytest.mark.parametrize("kind", CONTROLLERS.values())
def test_a_roof_that_filled_unseen_is_not_pumped_on(kind: Callable[..., Any]) -> None:
    """Below its target before hours of frost, a millimetre above after them."""
    controller = kind()
    steps = [0.0] * STEPS
    assert controller.command(2.3, 0.0375, steps, steps) > 0
    for _ in range(3600):
        controller.skip()
    for _ in range(100):
        assert controller.command(2.3, 0.0467, steps, steps) == 0.0


@pytest.mark.parametrize("kind", CONTROLLERS.values())
@pytest.mark.parametrize("strength", [0.3, 1.6, 3.0])
def test_pumps_of_another_flow(kind: Callable[..., Any], strength: float) -> None:
    """A driver that does what is commanded, with pumps that give more or less than the model's.

    Nothing but the controller stops them. The roof ends near its target: what comes in the fifteen
    seconds until the sensor is believed, and a millimetre, are too much at most.
    """
    controller = kind()
    level, steps = 0.035, [0.0] * STEPS
    full = maximum_pump_flow(PAPER_SITE, PAPER_SITE.cistern_volume(2.3)) / PAPER_SITE.a2
    for _ in range(3600):
        level += controller.command(2.3, level, steps, steps) * strength * full
    slack = 0.001 + 15 * max(0.0, strength - 1) * full
    assert PAPER_SITE.z_veg - 5e-4 < level < PAPER_SITE.z_veg + slack


def test_no_observer() -> None:
    """Each reading is taken as it is, bit for bit."""
    estimate = RoofObserver(PAPER_SITE, 0.0)
    for level in (0.03, 0.0301, 0.0299):
        assert estimate.correct(level) == PAPER_SITE.roof_volume(level)
        estimate.predict(1.0, 0.0, 0.0, 0.0)


# --- the forecast -------------------------------------------------------------------------------


class Lie:
    """A forecast of rain (m/s) in each step after the first, whatever comes."""

    repeats_from: datetime | None = None

    def __init__(self, run: Run, rain: list[float]) -> None:
        self._truth = run.forecast
        self._rain = rain

    def precipitation(self, tick: int) -> array[float]:
        """Return what is so now, and the lie about the rest."""
        return array("d", [self._truth.precipitation(tick)[0], *self._rain])

    def evapotranspiration(self, tick: int) -> array[float]:
        """Return the truth."""
        return self._truth.evapotranspiration(tick)


def lied_to(run: Run, rain: list[float], **parameters: float) -> tuple[float, RegretLimit]:
    """Return the result of a run (m3 s) with this forecast, and its regret limit."""
    controller = run.controller.make(run.site, {**run.parameters, **parameters})
    metrics = Metrics()
    for _ in closed_loop(replace(run, forecast=Lie(run, rain)), controller, metrics):
        pass
    loss: RegretLimit = controller._regret_limit  # type: ignore[attr-defined]
    return metrics["total_deviation_m3"] * run.site.tau, loss


def onoff(*options: str, fraction: float = 1.0) -> float:
    """Return the result of plain on/off (m3 s)."""
    run = paper_run("--controller", "onoff", *options)
    metrics = Metrics()
    for _ in closed_loop(run, OnOff(run.site, fraction), metrics):
        pass
    return metrics["total_deviation_m3"] * run.site.tau


DRIZZLE = [1 / 3.6e6] * (STEPS - 1)


@pytest.mark.parametrize("controller", ["anticipating_onoff", "planning_mpc"])
@pytest.mark.parametrize("start", ["2021-07-07T02:00", "2021-07-08T05:00"])
def test_loss_is_what_two_runs_differ_by(
    controller: str, start: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It follows the difference alone; here it is held to two whole runs. Nothing fades."""
    monkeypatch.setattr(regret_limit, "_FADING_S", math.inf)
    run = paper_run("--controller", controller, "--start", start)
    reached, loss = lied_to(run, DRIZZLE, max_waiting_loss=1e6)
    assert loss.loss == pytest.approx(reached - onoff("--start", start), rel=2e-3)
    assert not loss.exhausted


@settings(max_examples=15, phases=[Phase.explicit, Phase.generate])
@given(
    st.lists(st.floats(0, 20), min_size=STEPS - 1, max_size=STEPS - 1),
    st.sampled_from([0.0, 0.01, 0.1]),
    st.sampled_from([1.0, 0.02]),
)
def test_trust_costs_at_most_the_limit(
    rain: list[float], max_waiting_loss: float, fraction: float
) -> None:
    """Whatever the forecast says, for three hours without a drop; with weak pumps, too."""
    run = paper_run("--controller", "anticipating_onoff", "--hours", "3")
    rates = [rate / 3.6e6 for rate in rain]
    reached, _ = lied_to(run, rates, max_waiting_loss=max_waiting_loss, fraction=fraction)
    plain = onoff("--hours", "3", fraction=fraction)
    # It is seen a tick too late; and on/off overshoots by a tick's pumping here or there.
    assert reached <= plain + max_waiting_loss * EMPTY_HOUR * 1.02 + 60


@pytest.mark.parametrize("controller", ["anticipating_onoff", "planning_mpc"])
@pytest.mark.parametrize("low", [0.76, 0.8])
def test_waiting_while_a_low_outlet_takes_the_water(
    tmp_path: Path, low: float, controller: str
) -> None:
    """Ten hours of rain that is always an hour ahead; the cistern is empty after one of them.

    A roof of 1 m3 lacks 2.1 m3. Above the suction level of 0.75 m stays 0.25 m3, or 1.25 m3.
    """
    file = site_file(tmp_path, low_outlet_level=low, low_outlet_radius=0.06)
    options = ("--site", str(file), "--cistern", "40", "--roof", "1", "--hours", "10")
    rain = [25 / 3.6e6 if end > 3600 else 0.0 for end in growing_steps(12)[2:]]
    run = paper_run("--controller", controller, *options)
    reached, _ = lied_to(run, rain)
    plain = onoff(*options)
    assert reached <= plain + EMPTY_HOUR * 1.02 + 60
    without = paper_run("--controller", controller, *options[2:])
    assert lied_to(without, rain)[0] > reached


def test_a_low_outlet_limits_the_waiting_by_hand() -> None:
    """On/off pumps 0.00828 m3/s from 40 m3: after 151 s more than the 1.25 m3 which stay.

    A week of what is beyond costs the limit of 11 319 m3 s where that is 0.0187 m3, 3 s later.
    """
    site = replace(PAPER_SITE, low_outlet_level=0.8, low_outlet_radius=0.06)
    loss = RegretLimit(site, 1.0)
    seconds = 0
    while not loss.judge(40.0, 1.0, 1.0):
        loss.move(40.0, 1.0, 1.0, 0.0)
        seconds += 1
    assert seconds == pytest.approx(153, abs=1)
    without = RegretLimit(PAPER_SITE, 1.0)
    for _ in range(seconds + 60):
        assert not without.judge(40.0, 1.0, 1.0)
        without.move(40.0, 1.0, 1.0, 0.0)


def test_lies_that_come_and_go() -> None:
    """Half an hour of each: what filling costs after a lie counts, though it is dry again."""
    run = paper_run("--controller", "anticipating_onoff", "--start", "2021-07-07T14:00")
    forecast = Lie(run, DRIZZLE)
    lies = forecast.precipitation

    def now_and_then(tick: int) -> array[float]:
        return lies(tick) if tick // 1800 % 2 == 0 else run.forecast.precipitation(tick)

    forecast.precipitation = now_and_then  # type: ignore[method-assign]
    controller = find_controller("anticipating_onoff").make(
        run.site, {**run.parameters, "fraction": 0.005, "max_waiting_loss": 0.1}
    )
    metrics = Metrics()
    for _ in closed_loop(replace(run, forecast=forecast), controller, metrics):
        pass
    plain = onoff("--start", "2021-07-07T14:00", fraction=0.005)
    lost = metrics["total_deviation_m3"] - plain
    assert 0.02 * EMPTY_HOUR < lost < 0.102 * EMPTY_HOUR


def test_ticks_in_frost_count() -> None:
    """Nothing may be pumped in them, but who waited before is worse off in each."""
    loss = RegretLimit(PAPER_SITE, 1.0)
    loss.judge(50.0, 2.0, 1.0)
    loss.move(50.0, 2.0, 1.0, 0.0)  # on/off pumps for a tick
    more = loss._more
    assert more == pytest.approx(maximum_pump_flow(PAPER_SITE, 50.0))
    for _ in range(999):
        loss.skip()
    loss.judge(50.0, 2.0, 1.0)
    assert loss.loss == pytest.approx(1000 * more, rel=1e-6)


def test_the_count_on_a_measured_roof_is_what_onoff_has() -> None:
    """Beside a plant that is watered by on/off: the roof which never was has all it lacks.

    Rain comes on two roofs, one of them wetter, and more of it percolates there; so the difference
    is right only if that is followed.
    """
    run = paper_run("--controller", "onoff", *MEASURED, "--start", "2021-07-08T05:00")
    onoff_roof = [tick.x2 for tick in closed_loop(run, run.make_controller(), Metrics())]
    loss = RegretLimit(run.site, 1e6)
    idle = paper_run("--controller", "onoff", "--fraction", "1e-9", *MEASURED,
                     "--start", "2021-07-08T05:00")
    lacks = []
    for tick, theirs in zip(
        closed_loop(idle, idle.make_controller(), Metrics()), onoff_roof, strict=True
    ):
        assert loss._more == pytest.approx(theirs - tick.x2, abs=0.01)  # a tick
        lacks.append(theirs - tick.x2)
        loss.judge(tick.x1, tick.x2, 1.0)
        loss.move(
            tick.x1, tick.x2, 1.0, tick.flows.pump, tick.precipitation, tick.evapotranspiration
        )
    assert max(lacks) > 0.7
    assert lacks[-1] < 0.7 * max(lacks)


def test_planner_that_is_lied_to(caplog: pytest.LogCaptureFixture) -> None:
    """Drizzle for ever in a dry night: on/off in the end, and it says so once."""
    options = ("--hours", "3")
    run = paper_run("--controller", "planning_mpc", *options)
    trusting, _ = lied_to(run, DRIZZLE, max_waiting_loss=1e6)
    with caplog.at_level(logging.WARNING):
        wary, loss = lied_to(run, DRIZZLE, max_waiting_loss=0.05)
    assert loss.exhausted
    assert len(caplog.records) == 1
    assert "more than plain on/off" in caplog.text
    plain = onoff(*options)
    assert plain < wary < plain + 0.1 * EMPTY_HOUR < trusting


def test_a_loss_without_rain_ahead_is_no_waiting() -> None:
    """Energy so dear that nothing is pumped, in dry weather: that has nothing to do with trust."""
    run = paper_run("--controller", "planning_mpc", "--hours", "2")
    dry = [0.0] * (STEPS - 1)
    reached, loss = lied_to(run, dry, energy_weight=1e7, max_waiting_loss=0.05)
    assert reached > onoff("--hours", "2") + 0.1 * EMPTY_HOUR
    assert loss.loss <= 0
    assert not loss.exhausted


def test_trust_comes_back() -> None:
    """When half of the loss has faded, after a week's time times the logarithm of 2."""
    loss = RegretLimit(PAPER_SITE, 0.01)
    ticks = 0
    while not loss.judge(50.0, 2.0, 1.0):
        loss.move(50.0, 2.0, 1.0, 0.0)
        ticks += 1
        assert ticks < 1000
    loss._more, loss.loss = 0.0, 0.01 * EMPTY_HOUR  # the roof is filled
    days = 0.0
    while loss.judge(50.0, 2.0, 1.0):
        days += 1 / 86400
    assert days == pytest.approx(7 * math.log(2), rel=1e-3)
