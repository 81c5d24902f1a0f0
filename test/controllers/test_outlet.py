"""What commands the outlet's valve: by hand, and against an exhaustive search."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from paper import site_with

from greenroof_ros.controllers import outlet
from greenroof_ros.controllers.outlet import OutletPolicy, make_outlet
from greenroof_ros.model.plant import low_outlet_flow
from greenroof_ros.model.site import Site

# 10 m3 below the upper outlet at 2 m; a valve at 0.1 m that takes 4.7 m3/h at a head of 1 m.
SITE = site_with(
    a1=5.0, z_o=2.0, a_in=270.0, z_pump=0.0, z_H=0.05, low_outlet_level=0.1,
    low_outlet_radius=0.0125, low_outlet_valve=True, tau=60.0,
)
HOUR = 3600.0
ENDS = HOUR * np.arange(9.0)


def policy(site: Site = SITE, **given: Any) -> OutletPolicy:
    """Make a policy; its reserve is 2 m3, and water for ten days is worth a tenth of discharge."""
    return make_outlet(site, ENDS, **{
        "outlet": "plan", "outlet_reserve": 2.0, "outlet_price": 0.1, "outlet_reach": 10.0, **given,
    })


def command(of: OutletPolicy, x1: float, rain: Any, roof: float = 0.0457) -> float:
    """Return the command with so much in the cistern (m3); rain in mm/h, hour by hour."""
    rates = np.atleast_2d(rain) / 1000 / HOUR
    return of.command(x1 / 5.0, roof, rates, np.zeros(rates.shape[1]))


def let_pass(of: OutletPolicy, minutes: int, rain: float = 0.0) -> None:
    """Let ticks of a minute pass."""
    for _ in range(minutes):
        command(of, 0.0, [rain] * 8)


@pytest.mark.parametrize(("name", "share"), [("closed", 0.0), ("open", 1.0)])
def test_what_is_fixed(name: str, share: float) -> None:
    assert command(policy(outlet=name), 9.0, [20.0] * 8) == share


def test_drain_opens_two_hours_after_rain() -> None:
    """Rain below 0.1 mm/h is none; the run begins as if it had just rained."""
    drain = policy(outlet="drain")
    let_pass(drain, 60, 5.0)
    let_pass(drain, 120, 0.09)
    assert command(drain, 9.0, [0.0] * 8) == 1.0
    let_pass(drain, 1, 0.11)
    let_pass(drain, 119)
    assert command(drain, 9.0, [0.0] * 8) == 0.0
    assert command(drain, 9.0, [0.0] * 8) == 1.0


def test_drain_ends_at_its_reserve() -> None:
    """2 m3 and a thousandth: 2.001 m3 is a head of 0.3002 m, which takes 42.9 l in a minute."""
    drain = policy(outlet="drain")
    let_pass(drain, 121)
    minute = 60 * low_outlet_flow(SITE, 2.001)
    assert minute == pytest.approx(0.61 * math.pi * 0.0125**2 * math.sqrt(19.62 * 0.3002) * 60)
    assert command(drain, 2.001, [0.0] * 8) == pytest.approx(0.001 / minute)
    assert command(drain, 2.0, [0.0] * 8) == command(drain, 0.3, [0.0] * 8) == 0.0


def test_plan_keeps_what_fits() -> None:
    """8 m3 and 7 mm x 270 m2 are 9.89 m3: no need to open. One mm more is 10.16 m3."""
    plan = policy()
    let_pass(plan, 180)
    assert command(plan, 8.0, [0.0, 0, 0, 7, 0, 0, 0, 0]) == 0.0
    let_pass(plan, 60)
    assert command(plan, 8.0, [0.0, 0, 0, 8, 0, 0, 0, 0]) == 0.0  # an hour before is enough
    let_pass(plan, 60)
    assert command(plan, 8.0, [0.0, 8, 0, 0, 0, 0, 0, 0]) == 1.0


def test_plan_without_a_forecast_is_drain() -> None:
    plan, drain = policy(), policy(outlet="drain")
    for one in (plan, drain):
        let_pass(one, 200)
    lost = np.full((1, 8), math.nan)
    assert command(plan, 9.0, lost) == command(drain, 9.0, [0.0] * 8) == 1.0
    assert plan.command(9.0 / 5, 0.04, [], []) == 1.0


def test_plan_depends_on_all_members() -> None:
    """A storm that one of three members forecasts is prepared for if it outweighs the mains."""
    members = np.zeros((3, 8))
    members[2, 1] = 30.0
    plan, alone = policy(), policy()
    for one in (plan, alone):
        let_pass(one, 180)
    assert command(plan, 9.0, members) == 1.0
    assert command(alone, 9.0, members[:2]) == 0.0


def exhaustive(site: Site, x1: float, rain: np.ndarray, wet: np.ndarray, price: float) -> float:
    """Return the minimum cost, of all ways to let out whole shares of an hour in each hour."""
    best = math.inf
    for shares in itertools.product((0.0, 0.25, 0.5, 0.75, 1.0), repeat=len(rain)):
        v, cost = x1, 0.0
        for hour, share in enumerate(shares):
            v += rain[hour] / 1000 * site.effective_catchment
            over = max(0.0, v - 10.0)
            v -= over
            root = math.sqrt(max(0.0, v - 0.5) / 5.0)
            lowest = 0.5 + 5.0 * max(0.0, root - site.c_low * HOUR / 10.0) ** 2 if v > 0.5 else v
            out = share * (v - lowest)
            v -= out
            cost += wet[hour] * (out + over)
        best = min(best, cost - price * (v - 0.25))
    return best


@pytest.mark.parametrize("rain", [
    [0.0, 0, 0, 20, 0], [0.0, 0, 30, 0, 0], [0.0, 12, 0, 0, 25], [0.0, 0, 0, 0, 0],
])
def test_cost_of_the_plan_against_all_ways(rain: list[float]) -> None:
    """The dynamic program's cost is at most that of the best of 3,125 ways, and hardly less.

    It may let out any share, so it can be better by what a quarter of an hour lets out.
    """
    plan = make_outlet(SITE, HOUR * np.arange(6.0), "plan", 2.0, 0.1, 3650.0)
    assert isinstance(plan, outlet.Plan)
    let_pass(plan, 180)
    depth = np.array([rain]) / 1000
    wet = plan._find_wet(depth)
    nodes = plan._nodes
    value = -0.1 * (nodes - nodes[0])[None]
    flows = depth * SITE.effective_catchment
    for hour in reversed(range(5)):
        value = plan._before(value, nodes, flows[:, hour, None], wet[:, hour, None])
    found = float(np.interp(9.0, nodes, value[0]))
    best = exhaustive(SITE, 9.0, np.array(rain), wet[0], 0.1)
    assert best - 1.3 < found < best + 0.05


def test_needs_of_the_roof_come_first() -> None:
    """A dry roof takes 1 m3 from the cistern, so that 9.5 m3 and 5 mm fit."""
    full, dry = policy(), policy()
    for one in (full, dry):
        let_pass(one, 180)
    rain = [0.0, 5, 0, 0, 0, 0, 0, 0]
    assert command(full, 9.5, rain) == 1.0
    assert command(dry, 9.5, rain, 0.0457 - 1.0 / SITE.a2) == 0.0


def test_a_controllers_own_share() -> None:
    class Own:
        outlet = 0.25

    own = outlet.OfController(Own())
    assert own.command() == 0.25
    for wrong in (math.nan, -0.1, 1.5, "open", None):
        Own.outlet = wrong  # type: ignore[assignment]
        with pytest.raises(Exception, match="the attribute outlet of Own"):
            own.command()


def test_reserve_by_default() -> None:
    """40 mm on the roof's 68.75 m2, or half of the cistern's 10 m3."""
    by_name = {each.name: each.default for each in outlet.parameters_on(SITE, "plan")}
    assert by_name["outlet"] == "plan"
    assert by_name["outlet_reserve"] == pytest.approx(0.04 * SITE.a2)
    small = replace(SITE, a1=1.0)
    assert outlet.parameters_on(small, "drain")[1].default == 1.0
