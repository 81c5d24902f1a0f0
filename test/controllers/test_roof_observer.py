"""How far the controllers that look ahead trust the level sensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from paper import PAPER_SITE, lookahead, paper_run
from places import CONFIG

from greenroof_ros.controllers.anticipating_onoff import AnticipatingOnOff
from greenroof_ros.controllers.regret_budget import RegretBudget
from greenroof_ros.controllers.roof_observer import RoofObserver
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.horizon import growing_steps

STEPS = len(growing_steps(12)) - 1
FIELD_CAPACITY = ("--site", str(CONFIG / "site_neubrandenburg.yaml"))


@pytest.mark.parametrize("options", [(), ("--cistern", "60", "--roof", "35"), FIELD_CAPACITY])
def test_estimate_is_the_truth_where_model_and_sensor_are_exact(options: tuple[str, ...]) -> None:
    """With rain, running pumps, a soil that drains, and one that percolates and dries."""
    run = paper_run(
        "--controller", "onoff", "--start", "2021-07-08T05:00", "--hours", "2", *options
    )
    estimate, budget = RoofObserver(run.site, 300.0), RegretBudget(run.site, 1.0, 0.0)
    for tick in Simulation(run).ticks():
        x2 = estimate.correct(tick.roof_level)
        assert x2 == pytest.approx(tick.x2, abs=1e-9)
        now = tick.precipitation, tick.evapotranspiration
        estimate.predicted = budget.move(tick.x1, x2, 1.0, tick.command, *now).roof


def test_it_begins_with_the_mean() -> None:
    """Each of the first n readings is equally good, so their mean is the best estimate."""
    estimate = RoofObserver(PAPER_SITE, 300.0)
    readings = 0.04 + 0.0005 * np.random.default_rng(2).standard_normal(300)
    for number, reading in enumerate(readings, start=1):
        estimate.predicted = x2 = estimate.correct(float(reading))
        assert PAPER_SITE.roof_level(x2) == pytest.approx(readings[:number].mean(), abs=1e-12)


@pytest.mark.parametrize("tau", [1.0, 10.0])
def test_noise_of_any_size_is_noise(tau: float) -> None:
    """It is averaged over 300 s: the error is only the average's, without jumps."""
    site, noise = replace(PAPER_SITE, tau=tau), 0.005
    estimate = RoofObserver(site, 300.0)
    errors = []
    for deviate in np.random.default_rng(3).standard_normal(43_200 // int(tau)):
        estimate.predicted = x2 = estimate.correct(0.06 + noise * float(deviate))
        errors.append(site.roof_level(x2) - 0.06)
    gain = tau / 300
    expected = noise * math.sqrt(gain / (2 - gain))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(expected, rel=0.25)


CONTROLLERS = {
    "anticipating_onoff": lambda: AnticipatingOnOff(
        PAPER_SITE, 1.0, horizon=12, days_after=10, observer_time_constant=300.0,
        waiting_budget=math.inf, waiting_share=0.0,
    ),
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
    inflow during the fifteen seconds until the sensor is trusted is too much.
    """
    controller = kind()
    level, steps = 0.035, [0.0] * STEPS
    full = maximum_pump_flow(PAPER_SITE, PAPER_SITE.cistern_volume(2.3)) / PAPER_SITE.a2
    for _ in range(3600):
        level += controller.command(2.3, level, steps, steps) * strength * full
    slack = 0.001 + 15 * max(0.0, strength - 1) * full
    assert PAPER_SITE.z_veg - 5e-4 < level < PAPER_SITE.z_veg + slack
