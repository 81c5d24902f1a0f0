"""Trust that is learned from shadow roofs: where it ends, and what it costs on the way."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from paper import lookahead, site_with
from places import CONFIG

from greenroof_ros.controllers.lookahead import Lookahead
from greenroof_ros.controllers.order_up_to import leave
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.controllers.trust import SHARES
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.site import read_site

Array = NDArray[np.float64]

HOUR_S, DAY_S = 3600.0, 86_400.0
HORIZON = 24.0
ENDS = growing_steps(HORIZON)
EVAPORATES = 4e-3 / DAY_S  # m/s
STORM = 0.008 / (2 * HOUR_S)  # m/s, for two hours every third day
# Ticks of an hour, and a cistern that does not run empty for weeks.
SITES = {
    "paper": site_with(tau=HOUR_S, M=1, mains_level=0.85, mains_flow=5e-4),
    "measured": replace(
        read_site(CONFIG / "site_catchment.yaml"), tau=HOUR_S, M=1, z_veg=0.0457,
        x2_star=68.8 * 0.0457,
    ),
}


def fallen(time: Array) -> Array:
    """Return the rain until a time (m)."""
    periods, since = np.divmod(time, 3 * DAY_S)
    rained = np.clip(since - 2 * DAY_S, 0.0, 2 * HOUR_S)
    return np.asarray(STORM * (2 * HOUR_S * periods + rained))


def truth(time: float) -> Array:
    """Return what will fall in each step (m/s)."""
    return np.asarray(np.diff(fallen(time + ENDS)) / np.diff(ENDS))


def dry(time: float) -> Array:
    """Return no rain."""
    return np.zeros(len(ENDS) - 1)


def always(time: float) -> Array:
    """Return 10 mm that are always six to twelve hours ahead."""
    ahead = (ENDS[:-1] >= 6 * HOUR_S) & (ENDS[1:] <= 12 * HOUR_S)
    return ahead * 0.01 / (6 * HOUR_S)


@functools.cache
def season(
    site: str, forecast: Callable[[float], Array], days: float = 6.0, *, memory: float = 30.0,
    falls: Callable[[Array], Array] = fallen,
) -> tuple[Lookahead, Array, Array]:
    """Run some days with a forecast that is sure to be right only for the present tick.

    Returns the controller and, for each tick, the deviation (in days of an empty roof) and the
    trust.
    """
    of = SITES[site]
    choice = find_controller("lookahead")
    changes = {"horizon": HORIZON, "trust_memory": memory}
    controller = choice.make(of, {**choice.defaults(of), **changes})
    assert isinstance(controller, Lookahead)
    plant, off, trust = Plant(of, 57.0, of.x2_star), [], []
    losses = np.full(len(ENDS) - 1, EVAPORATES * of.a2)
    for tick in range(round(days * DAY_S / of.tau)):
        time = tick * of.tau
        coming = forecast(time)
        coming[0] = rain = float(np.diff(falls(np.array([time, time + of.tau])))[0]) / of.tau
        command = controller.command(*plant.levels(), [coming], losses)
        off.append(abs(plant.x2 / of.x2_star - 1) * of.tau / DAY_S)
        trust.append(controller.trust)
        plant.step(rain, plant.flows(rain, losses[0], plant.pump_flow(command)))
    return controller, np.array(off), np.array(trust)


def three_days(time: float) -> Array:
    """Return :func:`always` on three of every four days, otherwise no rain."""
    return always(time) * (time % (4 * DAY_S) < 3 * DAY_S)


def test_a_worthless_forecast_is_given_up() -> None:
    """Rain that never comes costs one wait of three days, not one in every four days."""
    _, trusting, alike = season("paper", three_days, 8.0, memory=0.0, falls=np.zeros_like)
    _, learned, trust = season("paper", three_days, 8.0, falls=np.zeros_like)
    assert alike.tolist() == [1.0] * len(alike)
    four_days = len(trust) // 2
    assert trust[: four_days // 2].tolist() == [1.0] * (four_days // 2)
    assert trust[four_days:].tolist() == [0.0] * four_days
    assert trusting.sum() == pytest.approx(2 * learned.sum(), rel=0.02)


def test_a_good_forecast_is_trusted_to_the_last_bit() -> None:
    """And there is a gain."""
    _, plain, _ = season("paper", dry, memory=0.0)
    _, trusting, _ = season("paper", truth, memory=0.0)
    _, learned, trust = season("paper", truth)
    assert trust.tolist() == [1.0] * len(trust)
    assert learned.tolist() == trusting.tolist()
    assert learned.sum() < plain.sum()


def test_trust_comes_back() -> None:
    """For a service that forecasts rain during a drought, and is right as it ends."""
    dry_for = 4 * DAY_S

    def falls(time: Array) -> Array:
        return np.asarray(fallen(np.maximum(time - dry_for, 0.0)))

    def forecast(time: float) -> Array:
        if time < dry_for:
            return three_days(time)
        return np.asarray(np.diff(falls(time + ENDS)) / np.diff(ENDS))

    _, _, trust = season("paper", forecast, 21.0, falls=falls)
    assert trust.min() == 0.0
    assert trust[-1] > 0.0


@pytest.mark.parametrize("site", SITES)
def test_the_shadows_are_the_roofs_that_would_be(site: str) -> None:
    """The shadow without trust is a roof without a forecast; with full trust, one with it."""
    controller, _, _ = season(site, always)
    for shadow, forecast in ((0, dry), (-1, always)):
        _, off, _ = season(site, forecast, memory=0.0)
        weights = np.exp(-np.arange(len(off))[::-1] * HOUR_S / DAY_S / 30)
        assert controller._trust.losses[shadow] == pytest.approx((off * weights).sum(), rel=0.1)


@pytest.mark.parametrize("site", SITES)
def test_without_a_forecast_the_shadows_have_the_rain_of_the_gauge(site: str) -> None:
    """They dry as on the day before: for two days they equal the roof, hour by hour."""
    of, choice = SITES[site], find_controller("lookahead")
    controller = choice.make(of, {**choice.defaults(of), "horizon": HORIZON})
    assert isinstance(controller, Lookahead)
    plant, evaporates = Plant(of, 57.0, of.x2_star), EVAPORATES * of.a2
    forecast = [dry(0.0)], np.full(len(ENDS) - 1, evaporates)
    fullest = 0.0
    for hour in range(48):
        controller.gauge_rain = 2e-3 / HOUR_S if 1 <= hour < 7 else 0.0
        command = controller.command(*plant.levels(), *(([], []) if hour else forecast))
        flows = plant.flows(controller.gauge_rain, evaporates, plant.pump_flow(command))
        plant.step(controller.gauge_rain, flows)
        assert controller._trust.roofs == pytest.approx(plant.x2, abs=3e-4 * of.a2)  # 0.3 mm
        fullest = max(fullest, of.roof_level(plant.x2))
    assert fullest > of.z_veg + 0.002


def test_one_that_is_made_again_goes_on_with_what_was_learned() -> None:
    """Both trust and budget; either all of it, or nothing."""
    controller, _, trust = season("paper", three_days, 8.0, falls=np.zeros_like)
    site, choice = SITES["paper"], find_controller("lookahead")
    again = choice.make(site, {**choice.defaults(site), "horizon": HORIZON})
    assert isinstance(again, Lookahead)
    assert (again.trust, trust[-1]) == (1.0, 0.0)
    again.learned = controller.learned
    assert again.learned == controller.learned
    assert again.trust == 0.0
    assert again.learned["waiting_loss_m3_s"] != 0
    with pytest.raises(KeyError):
        again.learned = {"waiting_loss_m3_s": 0.0, "onoff_cost_m3_s": 0.0, "trust": 1.0}
    assert again.learned == controller.learned


def test_what_is_left_for_rain() -> None:
    """All, none and half of the room; where a plan leaves the roof alone, as for an empty roof."""
    assert leave(SHARES, 1.0, 0.5, 4.0).tolist() == [4.0, 3.0, 2.0, 1.0]
    assert leave(0.5, -1.0, 1.0, 4.0) == 2.5
    assert leave(np.array([0.5, 1.0]), -1.0, -1.0, 4.0).tolist() == [2.0, -1.0]


@pytest.mark.parametrize("potential", [3e-6, 0.0])
@pytest.mark.parametrize("share", SHARES[:-1])
def test_the_plan_leaves_the_room_that_the_command_leaves(share: float, potential: float) -> None:
    """The level is held until the next step can raise it, also at night, when nothing dries."""
    controller, steps = lookahead(horizon=HORIZON), len(ENDS) - 1
    controller.learned = {**controller.learned, "trust": share}
    controller.command(2.3, 0.04, [always(-6 * HOUR_S)], [potential] * steps)
    ends, _, levels, _ = controller.plan.T
    assert levels[ends == 120] == pytest.approx(controller.fill_to, abs=1e-5)
