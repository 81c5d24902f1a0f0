"""How far the controllers that look ahead trust the level sensor and the forecast."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adversaries import TOGETHER, with_forecasts
from numpy.typing import NDArray
from paper import PAPER_SITE, deviation_of, lookahead, paper_run, rain_scaled, site_file
from places import CONFIG, DATA

from greenroof_ros.controllers.anticipating_onoff import AnticipatingOnOff
from greenroof_ros.controllers.regret_budget import RegretBudget
from greenroof_ros.controllers.roof_observer import RoofObserver
from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.plant import Plant, maximum_pump_flow
from greenroof_ros.model.site import read_site

Array = NDArray[np.float64]

EMPTY_HOUR = 3600 * PAPER_SITE.x2_star  # m3 s
STEPS = len(growing_steps(12)) - 1
MEASURED = ("--site", str(CONFIG / "site_neubrandenburg.yaml"))


# --- the sensor ---------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [(), ("--cistern", "60", "--roof", "35"), MEASURED])
def test_estimate_is_the_truth_where_model_and_sensor_are_exact(options: tuple[str, ...]) -> None:
    """With rain, running pumps, a soil that drains, and one that percolates and dries."""
    run = paper_run(
        "--controller", "onoff", "--start", "2021-07-08T05:00", "--hours", "2", *options
    )
    estimate = RoofObserver(run.site, 300.0)
    for tick in closed_loop(run, run.make_controller(), Metrics()):
        x2 = estimate.correct(tick.roof_level)
        assert x2 == pytest.approx(tick.x2, abs=1e-9)
        estimate.predict(x2, tick.precipitation, tick.evapotranspiration, tick.flows.pump)


def test_it_begins_with_the_mean() -> None:
    """Each of the first n readings is equally good, so their mean is the best estimate."""
    estimate = RoofObserver(PAPER_SITE, 300.0)
    readings = 0.04 + 0.0005 * np.random.default_rng(2).standard_normal(300)
    for number, reading in enumerate(readings, start=1):
        x2 = estimate.correct(float(reading))
        estimate.predict(x2, 0.0, 0.0, 0.0)
        assert PAPER_SITE.roof_level(x2) == pytest.approx(readings[:number].mean(), abs=1e-12)


@pytest.mark.parametrize("tau", [1.0, 10.0])
def test_noise_of_any_size_is_noise(tau: float) -> None:
    """It is averaged over 300 s: the error is only the average's, without jumps."""
    site, noise = replace(PAPER_SITE, tau=tau), 0.005
    estimate = RoofObserver(site, 300.0)
    errors = []
    for deviate in np.random.default_rng(3).standard_normal(43_200 // int(tau)):
        x2 = estimate.correct(0.06 + noise * float(deviate))
        estimate.predict(x2, 0.0, 0.0, 0.0)
        errors.append(site.roof_level(x2) - 0.06)
    gain = tau / 300
    expected = noise * math.sqrt(gain / (2 - gain))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected, rel=0.25)


CONTROLLERS = {
    "anticipating_onoff": lambda: AnticipatingOnOff(PAPER_SITE, 12, 10, 1.0, 300.0, math.inf, 0.0),
    "lookahead": lambda: lookahead(observer_time_constant=300.0),
}


@pytest.mark.parametrize("kind", CONTROLLERS.values())
def test_a_roof_that_filled_unseen_is_not_pumped_on(kind: Callable[..., Any]) -> None:
    """Below its target before hours of frost, a millimetre above it afterwards."""
    controller = kind()
    steps = [0.0] * STEPS
    assert controller.command(2.3, 0.0375, steps, steps) > 0
    for _ in range(3600):
        controller.skip()
    for _ in range(100):
        assert controller.command(2.3, 0.0467, steps, steps) == 0.0


@pytest.mark.parametrize("kind", CONTROLLERS.values())
@pytest.mark.parametrize("strength", [0.3, 3.0])
def test_pumps_of_another_flow(kind: Callable[..., Any], strength: float) -> None:
    """A driver obeys the commands, with pumps that deliver more or less than the model's.

    Only the controller stops them. The roof ends near its target: at most a millimetre plus the
    inflow during the fifteen seconds until the sensor is believed is too much.
    """
    controller = kind()
    level, steps = 0.035, [0.0] * STEPS
    full = maximum_pump_flow(PAPER_SITE, PAPER_SITE.cistern_volume(2.3)) / PAPER_SITE.a2
    for _ in range(3600):
        level += controller.command(2.3, level, steps, steps) * strength * full
    slack = 0.001 + 15 * max(0.0, strength - 1) * full
    assert PAPER_SITE.z_veg - 5e-4 < level < PAPER_SITE.z_veg + slack


# --- the forecast -------------------------------------------------------------------------------


BUDGET_H, SHARE = 6.0, 0.05


def a_week(directory: Path, *options: str) -> Run:
    """Build a run of a week with a tenth of July 2021's rain, in ticks of two minutes.

    Its pumps have a twentieth of the flow: with all of it on/off would overshoot by 14 mm.
    """
    run = paper_run(
        *options, "--site", str(site_file(directory, tau=120.0)),
        "--weather", str(DATA / "en_climate_hourly_07-2021.csv"), "--start", "2021-07-01T00:00",
        "--hours", "168", "--evapotranspiration", "fao56",
    )
    return rain_scaled(run, 0.1)


@pytest.mark.parametrize(("controller", "strength", "kind"), [
    ("anticipating_onoff", "--fraction", "always rain"),
    ("lookahead", "--max-command", "always rain"), ("lookahead", "--max-command", TOGETHER),
])
def test_an_adversary_costs_at_most_the_budget(
    controller: str, strength: str, kind: str, tmp_path: Path
) -> None:
    """On/off plus its share, plus the budget, plus at most the loss until the pumps may start."""
    plain = deviation_of(a_week(tmp_path, "--controller", "onoff", "--fraction", "0.05"))
    run = a_week(tmp_path, "--controller", controller, strength, "0.05", "--horizon", "48")
    false = with_forecasts(run, kind, 48)

    def reached(budget: float) -> float:
        parameters = {**run.parameters, "waiting_budget": budget, "waiting_share": SHARE}
        return deviation_of(false, run.controller.make(run.site, parameters))

    limit = (1 + SHARE) * plain + BUDGET_H * EMPTY_HOUR
    assert reached(BUDGET_H) <= limit + 0.1 * EMPTY_HOUR
    if controller == "anticipating_onoff":
        assert reached(1e6) > 1.5 * limit


def test_waiting_ends_with_the_budget(caplog: pytest.LogCaptureFixture) -> None:
    """Forecast rain never comes: in the end it acts as on/off, and says so once."""
    rain = [3e-6 if 7200 <= begin < 14_400 else 0.0 for begin in growing_steps(12)[:-1]]
    for budget, pumps in ((72.0, False), (0.01, True)):
        controller = lookahead(waiting_budget=budget, waiting_share=0.0)
        inputs = 2.3, 0.04, [rain], [0.0] * STEPS
        commands = [controller.command(*inputs) for _ in range(600)]
        assert any(commands) is pumps
    assert ["more than plain on/off" in message for message in caplog.messages] == [True]


def test_a_low_outlet_limits_the_waiting_by_hand() -> None:
    """On/off pumps 0.00828 m3/s from 40 m3: after 151 s more than the 1.25 m3 that stay.

    A week of the excess costs the limit of 11 319 m3 s when it is 0.0187 m3, 3 s later.
    """
    site = replace(PAPER_SITE, low_outlet_level=0.8, low_outlet_radius=0.06)
    loss = RegretBudget(site, 1.0, 0.0)
    seconds = 0
    while not loss.judge(40.0, 1.0, 1.0):
        loss.move(40.0, 1.0, 1.0, 1.0, 0.0)
        seconds += 1
    assert seconds == pytest.approx(153, abs=1)


def test_ticks_in_frost_count() -> None:
    """Nothing may be pumped in them, but the roof that waited before is worse off in each."""
    loss = RegretBudget(PAPER_SITE, 1.0, 0.0)
    loss.judge(50.0, 2.0, 1.0)
    loss.move(50.0, 2.0, 2.0, 1.0, 0.0)  # on/off pumps for a tick
    more = loss._more
    assert more == pytest.approx(maximum_pump_flow(PAPER_SITE, 50.0))
    for _ in range(999):
        loss.skip()
    loss.judge(50.0, 2.0, 1.0)
    assert loss.loss == pytest.approx(1000 * more, rel=1e-6)


def test_the_count_on_a_measured_roof_is_what_onoff_has() -> None:
    """Beside a plant that on/off waters; a roof that was never watered lacks everything.

    Rain falls on two roofs; on the wetter one more of it percolates, so the difference is right
    only if that is followed. While the roof waits, its cistern overflows more. In ticks of ten
    seconds at a tenth of the full flow.
    """
    site = replace(read_site(CONFIG / "site_neubrandenburg.yaml"), tau=10.0)
    watered, dry = Plant(site, 80.0, 1.0), Plant(site, 80.0, 1.0)
    budget, rain, potential, lacks = RegretBudget(site, 1e6, 0.0), 1e-6, 2e-6, []
    for _ in range(3600):
        lacks.append(watered.x2 - dry.x2)
        assert budget._more == pytest.approx(lacks[-1], abs=1e-9)
        assert budget._stored == pytest.approx(watered.x1 - dry.x1, abs=1e-9)
        x1, x2 = dry.x1, dry.x2
        watered.step(rain, watered.flows(rain, potential, watered.pump_flow(0.1)))
        dry.step(rain, dry.flows(rain, potential, 0.0))
        budget.move(x1, x2, dry.x2, 0.1, 0.0, rain, potential)
    assert max(lacks) > 0.7
    assert lacks[-1] < 0.7 * max(lacks)


def test_trust_comes_back() -> None:
    """When the roof is filled, and a tenth of on/off's cost has made up for the excess.

    That is 100 m3 s: on/off is 0.1 m3 off its target for 10,000 s.
    """
    budget = RegretBudget(PAPER_SITE, 0.01, 0.1)
    ticks = 0
    while not budget.judge(50.0, 2.0, 1.0):
        budget.move(50.0, 2.0, 2.0, 1.0, 0.0)
        ticks += 1
        assert ticks < 1000
    budget.loss = 0.01 * EMPTY_HOUR + 0.1 * budget.onoff_cost
    assert budget.judge(50.0, 2.0, 1.0)  # it is not filled
    budget._more = 0.0
    budget.loss += 100.0
    seconds = 0
    while budget.judge(50.0, PAPER_SITE.x2_star - 0.1, 1.0):
        seconds += 1
    assert seconds == pytest.approx(10_000, rel=0.01)


def test_a_gain_pays_for_a_loss() -> None:
    """An hour with 1 m3 too much only on the roof of on/off, then the budget and 3600 m3 s."""
    budget = RegretBudget(PAPER_SITE, 0.01, 0.0)
    budget._more = 1.0
    for _ in range(3600):
        assert not budget.judge(50.0, PAPER_SITE.x2_star, 1.0)
    assert budget.loss == pytest.approx(-3600)
    assert budget.onoff_cost == pytest.approx(3600)
    seconds = 0
    while not budget.judge(50.0, PAPER_SITE.x2_star - 1.0, 1.0):
        seconds += 1
    # On/off is at the target, and filling the roof takes half a m3 for that long.
    flow = maximum_pump_flow(PAPER_SITE, 50.0)
    assert seconds == pytest.approx(3600 + 0.01 * EMPTY_HOUR - 0.5 / flow, abs=2)
