"""What commands the outlet's valve: by hand, and against all ways on a fine grid."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from paper import run_in, site_with, weather_of

import greenroof_ros as gr
from greenroof_ros.controllers import outlet
from greenroof_ros.controllers.outlet import Policy
from greenroof_ros.controllers.outlet_plan import find_hourly, solve
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.storm_water import find_wet
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.site.site import Site

# 10 m3 below the upper outlet at 2 m; a valve at 0.1 m that takes 4.7 m3/h at a head of 1 m.
SITE = site_with(
    a1=5.0, z_o=2.0, a_in=270.0, z_pump=0.0, z_H=0.05, low_outlet_level=0.1,
    low_outlet_radius=0.0125, low_outlet_valve=True, tau=60.0,
)
HOUR = 3600.0
ENDS = HOUR * np.arange(9.0)


# So little evaporates (m3/s) that the roof needs nothing now, and 8.6 m3 within the reach (days).
EVAPORATED, REACH = 1e-9, 1e5


def policy(site: Site = SITE, without_rain: float = math.inf, **given: Any) -> Policy:
    """Make a policy; its reserve is 2 m3, and water is worth a tenth of discharge."""
    return Policy(site, ENDS, without_rain, **{
        "outlet": "plan", "outlet_reserve": 2.0, "outlet_price": 0.1, "outlet_reach": 2 * REACH,
        **given,
    })


def command(
    of: Policy, x1: float, rain: Any, roof: float = 0.0457, evaporated: float = EVAPORATED
) -> float:
    """Return the command with so much in the cistern (m3); rain in mm/h, hour by hour."""
    rates = np.atleast_2d(rain) / 1000 / HOUR
    return of.command(x1 / 5.0, roof, rates, np.full(rates.shape[1], evaporated))


def minutes_closed(of: Policy, *rain: float) -> int:
    """Let some minutes of rain (mm/h) pass, and then dry ones until the valve opens."""
    for rate in rain:
        command(of, 9.0, [rate] + [0.0] * 7)
    return next(count for count in range(200) if command(of, 9.0, [0.0] * 8))


@pytest.mark.parametrize("name", ["drain", "plan"])
@pytest.mark.parametrize(("rain", "closed"), [
    ((), 0), ((0.09,) * 60, 0), ((0.11,), 120),
    # Drizzle within an hour after rain is rain, and so is drizzle within an hour after that.
    ((5.0, *[0.05] * 100), 120), ((5.0, *[0.0] * 59, 0.05), 120), ((5.0, *[0.0] * 60, 0.05), 59),
    # A sensor that reports nothing may be one in the rain.
    ((math.nan,), 120), ((math.nan, 0.05), 120),
])
def test_closed_until_two_hours_after_rain(
    name: str, rain: tuple[float, ...], closed: int
) -> None:
    """A run begins in dry weather."""
    assert minutes_closed(policy(outlet=name, outlet_reach=1.0), *rain) == closed


def test_rain_before_the_first_tick_counts() -> None:
    assert minutes_closed(policy(outlet="drain", without_rain=1800.0)) == 90
    assert minutes_closed(policy(outlet="drain", without_rain=1800.0), 0.05) == 120


def test_drain_ends_at_its_reserve() -> None:
    """2 m3 and a thousandth: 2.001 m3 is a head of 0.3002 m, which takes 42.9 l in a minute."""
    drain = policy(outlet="drain")
    minute = 60 * 0.61 * math.pi * 0.0125**2 * math.sqrt(19.62 * 0.3002)
    assert command(drain, 2.001, [0.0] * 8) == pytest.approx(0.001 / minute)
    assert command(drain, 2.0, [0.0] * 8) == command(drain, 0.3, [0.0] * 8) == 0.0


def test_plan_keeps_what_fits() -> None:
    """8 m3 and 7 mm x 270 m2 are 9.89 m3: no need to open. One mm more is 10.16 m3.

    An hour's drain before the storm is enough, so the valve opens with the plan of that hour.
    """
    assert command(policy(), 8.0, [0.0, 7, 0, 0, 0, 0, 0, 0]) == 0.0
    plan = policy()
    commands = [command(plan, 8.0, [0.0, 0, 0, 8, 0, 0, 0, 0]) for _ in range(60)]
    commands += [command(plan, 8.0, [0.0, 8, 0, 0, 0, 0, 0, 0]) for _ in range(60)]
    assert commands == [0.0] * 60 + [1.0] * 60


FULL = SITE.roof_level(SITE.x2_star) + 0.15
KEPT = replace(SITE, drainage_to_cistern=1.0)
SEVEN, FIVE, NONE = ([0.0, depth, *[0.0] * 6] for depth in (7.0, 5.0, 0.0))


@pytest.mark.parametrize(("site", "reach", "inputs", "opens"), [
    # 8 m3 and 7 mm are 9.89 m3; the full roof drains 7 mm x 68.75 m2 = 0.48 m3 more.
    (SITE, 2 * REACH, (8.0, SEVEN, FULL), 0), (KEPT, 2 * REACH, (8.0, SEVEN, FULL), 1),
    # A dry roof takes 1 m3 from the cistern, so that 9.5 m3 and 5 mm fit.
    (SITE, 2 * REACH, (9.5, FIVE), 1), (SITE, 2 * REACH, (9.5, FIVE, 0.0457 - 1.0 / SITE.a2), 0),
    # 1e-9 m3/s for 5e4 days are 4.32 m3, above the 0.25 m3 that the pumps cannot take.
    (SITE, 5e4, (4.5, NONE), 0), (SITE, 5e4, (5.0, NONE), 1),
    # In winter nothing evaporates, and the reserve stays.
    (SITE, 5e4, (1.9, NONE, 0.0457, 0.0), 0), (SITE, 5e4, (2.5, NONE, 0.0457, 0.0), 1),
])
def test_plan_keeps_what_fits_and_what_the_roof_needs(
    site: Site, reach: float, inputs: Any, opens: int
) -> None:
    assert command(policy(site, outlet_reach=reach), *inputs) == opens


def test_plan_is_drain_if_the_forecast_is_short() -> None:
    """In 10 min a valve of 4.7 m3/h drains the cistern from 2.6 m3 to its reserve of 2 m3.

    The root of the head falls by 600 s x c_low / (2 a1) = 600 x 0.0013263 / 10 = 0.07958 from
    sqrt(0.3) + 0.07958 = 0.62730, that of a level of 0.1 + 0.39351 m, or 2.4675 m3.
    """
    plan = Policy(SITE, 60.0 * np.arange(11), math.inf, "plan", 2.0, 0.1, REACH)
    assert command(plan, 2.46, [0.0] * 10) == 0.0
    assert 0 < command(plan, 2.48, [0.0] * 10) < 1
    assert command(plan, 9.0, [0.0] * 10) == 1.0


def test_plan_without_a_forecast_is_drain() -> None:
    """The last plan is followed until the next one is due; only the present rain is needed."""
    plan, lost = policy(), np.array([0.0, *[math.nan] * 7])
    assert command(plan, 9.0, [0.0] * 8) == 0.0
    assert [command(plan, 9.0, lost) for _ in range(60)] == [0.0] * 59 + [1.0]
    assert command(plan, 2.0, lost) == 0.0


@pytest.mark.parametrize("name", ["drain", "plan"])
@pytest.mark.parametrize("forecast", [[], np.empty((1, 0)), np.full((2, 8), math.nan)])
def test_unknown_rain_is_wet(name: str, forecast: Any) -> None:
    """Without a forecast and without a gauge."""
    valve = policy(outlet=name, outlet_reach=1.0)
    assert command(valve, 9.0, [0.0] * 8) == 1.0
    assert {valve.command(9.0 / 5, 0.0457, forecast, []) for _ in range(300)} == {0.0}
    assert minutes_closed(valve) == 120


def test_an_hour_with_a_tenth_of_a_millimetre_is_wet() -> None:
    """Sums of rates are rounded; of all multiples of 0.1 mm before it, it remains 0.1 mm."""
    for tenths in range(200):
        rates = np.array([tenths / 10, 0.0, 0.1]) / 1000 / HOUR
        hourly = find_hourly(rates, HOUR * np.arange(4.0), 3)
        wet, _ = find_wet(hourly / HOUR, HOUR, 0.0, math.inf)
        assert wet.tolist() == [tenths > 0, False, True]


def test_plan_depends_on_all_members() -> None:
    """A storm that one of three members forecasts is prepared for if it outweighs the mains.

    It does not if water is dear: 2/3 x 0.6 is more than 1/3.
    """
    members = np.zeros((3, 8))
    members[2, 1] = 30.0
    assert command(policy(), 9.0, members) == 1.0
    assert command(policy(), 9.0, members[:2]) == 0.0
    assert command(policy(outlet_price=0.6), 8.0, members) == 0.0


def test_the_hours_of_steps_that_are_none() -> None:
    """Rates over steps of 20 min, 70 min and 6 h, as totals of hours."""
    ends = np.array([0.0, 1200, 5400, 27_000])
    hourly = find_hourly(np.array([3.0, 6.0, 1.0]) / HOUR, ends, 8)
    assert hourly == pytest.approx([1 + 4, 3 + 0.5, 1, 1, 1, 1, 1, 0.5])


def find_costs(
    site: Site, x2: float, rain: np.ndarray, evaporated: float, price: float, needed: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return volumes, and the cost from the end of the first hour's drain on, by all ways.

    A dynamic program on a fine grid that tries each volume which the valve can reach; it relies on
    no level. Rain in mm of each hour, for each member.
    """
    floor, full = 5.0 * 0.05, 5.0 * site.z_o
    grid = np.linspace(floor, full, 401)
    low = site.a1 * (site.low_outlet_level or 0.0)
    root = np.sqrt(np.maximum(grid - low, 0) / site.a1) - site.c_low * HOUR / (2 * site.a1)
    lowest = np.where(grid > low, low + site.a1 * np.maximum(root, 0) ** 2, grid)
    reachable = (grid[None] >= lowest[:, None] - 1e-9) & (grid[None] <= grid[:, None] + 1e-9)
    total = np.zeros_like(grid)
    for member in rain:
        above, flows = x2 - site.x2_star, []
        for depth in member:
            above += depth / 1000 * site.a2 - evaporated
            flows.append(depth / 1000 * site.effective_catchment - max(0.0, -above))
            above = min(max(above, 0.0), 0.15 * site.a2)
        cost = -price * np.minimum(grid - floor, needed)
        for hour in reversed(range(len(member))):
            wet = bool((member[max(0, hour - 2) : hour + 1] > 0.0999).any())
            held = grid + flows[hour]
            cost = (
                np.interp(held, grid, cost) + wet * np.maximum(held - full, 0)
                + price * np.maximum(floor - held, 0)
            )
            if hour == 0:
                break
            let_out = np.where(reachable, cost[None] + wet * (grid[:, None] - grid[None]), np.inf)
            cost = np.minimum(let_out.min(axis=1), cost if wet else np.interp(lowest, grid, cost))
        total += cost
    return grid, total / len(rain)


@pytest.mark.parametrize("seed", range(40))
def test_level_against_all_ways(seed: int) -> None:
    """The plan's level costs at most 0.5 % of the cistern more than the best of all volumes."""
    random = np.random.default_rng(seed)
    site = replace(
        SITE, low_outlet_level=random.choice([0.1, random.uniform(0.1, 1.8)]),
        low_outlet_radius=10 ** random.uniform(-2.7, -1.5),
    )
    hours, members = int(random.integers(3, 13)), int(random.choice([1, 3]))
    fallen = np.where(
        random.random((members, hours)) < 0.3, random.exponential(6, (members, hours)).round(1), 0
    )
    fallen[:, 0] = 0
    evaporated, price = random.choice([0, 0.005, 0.02]), 10 ** random.uniform(-1.5, 0.3)
    x1, x2 = random.uniform(0.3, 10), site.x2_star * random.uniform(0.7, 1.1)
    needed = random.choice([0.0, 3.0, 20.0])
    level = solve(
        plant_parameters(site), 5.0 * 0.05, price, needed, x1, x2, fallen / 1000,
        np.full(hours, evaporated),
    )
    grid, costs = find_costs(site, x2, fallen, evaporated, price, needed)
    low = 5.0 * (site.low_outlet_level or 0.0)
    root = max(0.0, math.sqrt(max(0, x1 - low) / 5.0) - site.c_low * HOUR / 10.0)
    lowest = low + 5.0 * root**2 if x1 > low else x1
    found = np.interp(min(max(level, lowest), x1), grid, costs)
    assert found <= np.interp(np.linspace(lowest, x1, 200), grid, costs).min() + 0.05


def test_reserve_by_default() -> None:
    """40 mm on the roof's 68.75 m2, or half of the cistern's 10 m3."""
    defaults = find_controller("lookahead").complete_parameters(SITE, {})
    assert defaults["outlet_reserve"] == pytest.approx(0.04 * SITE.a2)
    small = replace(SITE, a1=1.0)
    of_small = find_controller("onoff").complete_parameters(small, {})
    assert of_small["outlet_reserve"] == 1.0


@pytest.mark.parametrize(("policy", "changes"), [
    ("open", {"low_outlet_valve": False}),
    ("closed", {
        "low_outlet_valve": False, "low_outlet_level": None, "low_outlet_radius": None,
    }),
])
def test_a_valve_that_never_moves_is_none(policy: str, changes: dict[str, Any]) -> None:
    """Open it is an orifice and closed a wall, also to the controller of the pump."""
    with_valve, without = (
        gr.simulate("lookahead", site=site, hours=6, initial=(9.5, 2.9), **options)
        for site, options in ((SITE, {"outlet": policy}), (replace(SITE, **changes), {}))
    )
    assert with_valve.metrics == without.metrics


STORM = {20: 25.0, 21: 12.0}
ATTACKS: dict[str, tuple[dict[int, float], dict[str, float]]] = {
    "storm": (STORM, {}),
    "drizzle before": ({**dict.fromkeys(range(2, 20), 0.1), **STORM}, {}),
    "at once": ({0: 15.0, 5: 20.0}, {}),
    "small valve": (STORM, {"low_outlet_radius": 0.002}),
    "large valve": (STORM, {"low_outlet_radius": 0.1}),
    "drainage kept": (STORM, {"drainage_to_cistern": 1.0, "roof": 1.4}),
    "dry roof": ({2: 0.5, **STORM}, {"roof": 0.6}),
    "begins within an hour": (STORM, {"offset": 1 / 3}),
    "ticks of an hour": (STORM, {"tau": 3600.0}),
    "mains": ({30: 3.0}, {"mains_level": 0.08, "mains_flow": 1e-4, "x1": 0.6, "roof": 0.5}),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_plan_costs_no_more_than_what_needs_no_forecast(attack: str) -> None:
    """Discharge in wet weather, mains water and what is left, over one and the same forecast."""
    depths, changes = ATTACKS[attack]
    given = {"roof": 1.0, "offset": 0.0, "x1": 9.0, "tau": 300.0, **changes}
    roof, offset, x1 = (given.pop(name) for name in ("roof", "offset", "x1"))
    site, price, reach = replace(SITE, M=1, **given), 0.3, 20.0
    weather, costs = weather_of([depths.get(hour, 0.0) for hour in range(100)], 4.0), {}
    for name in outlet.POLICIES:
        results = simulate(run_in(
            weather, site, x1, roof * site.x2_star, after_h=offset, length_h=36, outlet=name,
            outlet_price=price, outlet_reach=reach,
        ))[0]
        lowest = 5.0 * max(site.suction_level, site.mains_level or 0.0)
        # The reach begins with the run, which lasts for 1.5 days.
        left = max(0.0, results["final_cistern_m3"] - lowest)
        left = min(left, (reach - 1.5) * 0.004 * site.a2)
        costs[name] = results["wet_discharge_m3"] + price * (results.get("mains_m3", 0.0) - left)
    assert costs["plan"] <= min(costs.values()) + 0.01
