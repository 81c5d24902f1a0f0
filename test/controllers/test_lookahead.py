"""The controller that looks ahead: its recursion against exhaustive search, and its behaviour."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from paper import PAPER_SITE, advance, lookahead, paper_run, site_with, virtual_site
from places import CONFIG, refusal
from scipy.integrate import quad

from greenroof_ros.controllers.lookahead import Lookahead
from greenroof_ros.controllers.order_up_to import OrderUpTo, halve_by_rain
from greenroof_ros.site.file import read_site
from greenroof_ros.site.horizon import growing_steps
from greenroof_ros.site.site import Site

# --- the recursion, on whole numbers of a unit ----------------------------------------------------

UNIT = 0.05  # m3
TARGET = 40  # units
MOST = 240  # units on the roof
HOUR = 3600.0


@dataclass(frozen=True)
class Tiny:
    """A problem of a few hours in whole units; each list has an entry for each hour."""

    roof: int
    water: int
    rain: tuple[tuple[int, ...], ...]
    """of each member"""
    evaporated: tuple[int, ...]
    pumps: tuple[int, ...]

    @property
    def site(self) -> Site:
        """The paper's site with a target of 40 units, and practically no rain into its cistern."""
        return site_with(z_veg=TARGET * UNIT / PAPER_SITE.a2, a_in=1e-9)

    def solved(self, groups: NDArray[np.intp]) -> float:
        """Return the minimum by the recursion (m3)."""
        site, hours = self.site, len(self.pumps)
        rain = np.array(self.rain) * UNIT / HOUR / site.a2
        return OrderUpTo(site).solve(
            HOUR * np.arange(hours + 1),
            site.cistern_volume(site.suction_level) + self.water * UNIT, self.roof * UNIT, rain,
            np.array(self.evaporated) * UNIT / HOUR, np.array(self.pumps) * UNIT / HOUR, groups,
        )


def straight(before: float, after: float) -> float:
    """Return the mean of |x - x*| from one volume to another (units), by its integral."""
    first, last = before - TARGET, after - TARGET
    if first == last:
        return abs(first)
    return (last * abs(last) - first * abs(first)) / 2 / (last - first)


def exhaustive(tiny: Tiny, groups: Sequence[Sequence[int]]) -> float:
    """Return the minimum mean deviation (m3), trying each volume, each water and each level.

    The decision in a state is the same for all members of a group.
    """

    def ended(hour: int, member: int, roof: int, water: int) -> tuple[float, int, int]:
        """Leave the roof alone during an hour: return cost, roof and water after it."""
        alone = min(max(roof + tiny.rain[member][hour] - tiny.evaporated[hour], 0), MOST)
        return straight(roof, alone), alone, water

    def holding(hour: int, member: int, roof: int, water: int) -> tuple[float, int, int]:
        _, alone, _ = ended(hour, member, roof, water)
        goal = min(roof, roof + tiny.pumps[hour] - tiny.evaporated[hour])
        after = max(alone, min(goal, alone + water))
        return straight(roof, after), after, water - max(after - alone, 0)

    @cache
    def decided(hour: int, group: int, roof: int, water: int) -> int | None:
        """Return the level to fill to; None to leave the roof alone."""
        members = [member for member, label in enumerate(groups[hour]) if label == group]
        best = None
        minimum = np.mean([cost(hour, member, roof, water, None) for member in members])
        for level in range(roof, TARGET + 1):
            reached = roof + tiny.pumps[hour] - tiny.evaporated[hour]
            if level > roof and (level > reached or level - roof > water):
                break
            costs = np.mean([cost(hour, member, roof, water, level) for member in members])
            if costs < minimum - 1e-9:
                best, minimum = level, costs
        return best

    def cost(hour: int, member: int, roof: int, water: int, level: int | None) -> float:
        if level is None:
            here_cost, after, remaining = ended(hour, member, roof, water)
        else:
            filled = level - roof
            here_cost, after, remaining = holding(hour, member, level, water - filled)
            if filled:
                here_cost += filled * filled / (2 * tiny.pumps[hour])
        return here_cost + value(hour + 1, member, after, remaining)

    @cache
    def value(hour: int, member: int, roof: int, water: int) -> float:
        if hour == len(tiny.pumps):
            return 0.0
        level = decided(hour, groups[hour][member], roof, water)
        return cost(hour, member, roof, water, level)

    members = range(len(tiny.rain))
    total = np.mean([value(0, member, tiny.roof, tiny.water) for member in members])
    return float(total) * UNIT / len(tiny.pumps)


@st.composite
def tiny_problems(
    draw: st.DrawFn, members: int = 1, water: int = 1000, pumps: tuple[int, ...] = (1000,),
) -> Tiny:
    """Draw a problem of five hours, in which storms come and go."""
    hours = 5
    rain = st.sampled_from([0, 0, 0, 4, 8, 16, 28])
    return Tiny(
        draw(st.integers(0, TARGET + 12)), water,
        tuple(tuple(draw(rain) for _ in range(hours)) for _ in range(members)),
        tuple(draw(st.sampled_from([0, 2, 4, 6])) for _ in range(hours)),
        tuple(draw(st.sampled_from(pumps)) for _ in range(hours)),
    )


def cost_difference(tiny: Tiny, groups: Sequence[Sequence[int]] = ((0,),) * 5) -> float:
    """Return the difference of the recursion's cost from the minimum of all plans (units)."""
    cost = tiny.solved(np.array(groups).T)
    return abs(cost - exhaustive(tiny, groups)) / UNIT


@settings(max_examples=30)
@given(tiny_problems(pumps=(0, 2, 4, 10, 20, 1000)))
def test_one_forecast(tiny: Tiny) -> None:
    """Strong pumps, pumps that hardly keep up with evaporation, and hours in which none may run."""
    assert cost_difference(tiny) < 0.5


@settings(max_examples=8)
@given(tiny_problems(members=4))
def test_an_ensemble_that_parts(tiny: Tiny) -> None:
    """One level for all, then one for each half, by the mean over them."""
    groups = [[0, 0, 0, 0]] * 2 + [[0, 0, 1, 1]] * 2 + [[0, 1, 2, 3]]
    assert cost_difference(tiny, groups) < 0.2


@settings(max_examples=20)
@given(tiny_problems(), st.integers(0, 16))
def test_a_cistern_that_runs_empty(tiny: Tiny, water: int) -> None:
    """Its water is pumped once, when it is worth most.

    The nodes of water are 9 units apart, so half of that may be lost, and what a single forecast
    loses with water to spare.
    """
    assert cost_difference(replace(tiny, water=water)) < 4.5 + 0.1


# --- members that can be distinguished -----------------------------------------------------------


def test_the_drier_half_parts_from_the_wetter() -> None:
    """Five members, hours of rain (mm), a halving every two hours: worked out by hand.

    After two hours 0, 1, 1, 2 and 3 mm have fallen: the two driest separate. The second 1 mm is
    wetter than the first because more follows in the next hour. After four hours each is alone
    except the two wettest, and after six hours these are, too.
    """
    fallen = [[2, 0, 0, 5, 0, 0, 0, 0], [0, 1, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 9, 0, 0, 0],
              [3, 0, 0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 0, 0, 0, 0]]
    groups = halve_by_rain(np.array(fallen, dtype=float), np.arange(9) * 3600.0, 7200.0)
    assert groups.T.tolist() == (
        [[0, 0, 0, 0, 0]] * 2 + [[0, 0, 1, 0, 1]] * 2 + [[0, 1, 2, 0, 3]] * 2
        + [[0, 1, 2, 3, 4]] * 2
    )


def test_it_waits_for_what_will_be_known_in_time() -> None:
    """One member of eight has rain in six hours that fills the roof for a day.

    If it separates from most others after an hour, an hour's wait is worth it. If it does not
    separate before the rain, the roof is filled: seven of eight lack water.
    """
    edges = growing_steps(12)
    storm = np.where((edges[:-1] >= 21_600) & (edges[:-1] < 32_400), 3e-6, 0.0)
    rain = np.stack([*[0 * storm] * 7, storm])
    commands = [
        lookahead(recourse=hours, days_after=1).command(2.3, 0.04, rain, [0.0] * len(storm))
        for hours in (1.0, 240.0)
    ]
    assert commands[0] == 0.0
    assert commands[1] > 0.9


# --- what follows from the recursion --------------------------------------------------------------

STEPS = len(growing_steps(12.0)) - 1
DRY = [0.0] * STEPS
FIELD_CAPACITY = read_site(CONFIG / "site_neubrandenburg.yaml")
Array = NDArray[np.float64]


def rain_in(hours: tuple[float, float], depth: float) -> list[float]:
    """Return a forecast of 12 h: a depth (m) between two hours, in whole steps."""
    edges = growing_steps(12.0)
    falls = (edges[:-1] >= 3600 * hours[0]) & (edges[1:] <= 3600 * hours[1])
    rate = depth / (np.diff(edges) * falls).sum()
    return (rate * falls).tolist()


def planned_volumes(controller: Lookahead) -> Array:
    """Return what its plan pumps in each step (m3)."""
    ends, flows, _, _ = controller.plan.T
    return np.asarray(flows * np.diff(ends, prepend=0.0))


def test_what_is_above_the_outlet_is_not_counted_on() -> None:
    """A cistern at 3.9 m, with 1.1 m that will be gone in minutes, for a roof of 91 m3."""
    site = site_with(a2=2000.0, a_in=1e-9)
    controller = lookahead(site)
    assert controller.command(3.9, 0.0, DRY, DRY) > 0.9
    lifted = site.a1 * (site.z_o - site.suction_level)
    assert planned_volumes(controller).sum() == pytest.approx(lifted)


@pytest.mark.parametrize("exponent", [1.0, 3.0])
def test_it_fills_its_own_soil(exponent: float) -> None:
    """To its target in a minute, with TAW times the integral of dS / (1 - S^beta)."""
    site = replace(FIELD_CAPACITY, tau=60.0, percolation_exponent=exponent)
    begin, end = (
        (share * site.x2_star - site.wilting_volume) / site.available_volume for share in (0.999, 1)
    )
    needed, _ = quad(lambda filled: site.available_volume / (1 - filled**exponent), begin, end)
    command = lookahead(site).command(2.0, 0.999 * site.z_veg, DRY, DRY)
    pumped = 60 * command * site.b * math.sqrt(2.0 + site.c_hat - site.d)
    assert pumped == pytest.approx(needed, abs=3e-6)


def test_water_that_fades_is_pumped_once() -> None:
    """The cistern has 0.5 m3 for ten dry days: all is pumped at once, and no more."""
    site = replace(FIELD_CAPACITY, a_in=1e-9, mains_level=None, mains_flow=None)
    controller = lookahead(site, horizon=240.0)
    dry = [0.0] * (len(growing_steps(240.0)) - 1)
    level = site.suction_level + 0.5 / site.a1
    evaporates = [3e-3 / 86_400 * site.a2] * len(dry)
    assert controller.command(level, site.z_veg / 2, dry, evaporates) > 0.9
    volumes = planned_volumes(controller)
    assert volumes.sum() == pytest.approx(0.5)
    assert volumes[controller.plan[:, 0] <= 600].sum() == pytest.approx(0.5)


def test_what_a_low_outlet_would_take_is_on_the_roof_before_it_is_gone() -> None:
    """One forecast of three has rain for 0.9 of the lack: it waits, if it can fill later.

    If a low outlet empties the cistern in an hour, it fills most of the lack at once.
    """
    missing = PAPER_SITE.z_veg / 2
    forecasts = [rain_in((8, 10), 0.9 * missing), DRY, DRY]
    levels = []
    for low in ({}, {"low_outlet_level": 0.76, "low_outlet_radius": 0.03}):
        controller = lookahead(site_with(a_in=1e-9, **low))
        controller.command(1.0, PAPER_SITE.z_veg - missing, forecasts, DRY)
        levels.append(controller.fill_to)
    assert levels[0] == pytest.approx(PAPER_SITE.z_veg - 0.9 * missing, abs=1e-3)
    assert levels[1] > PAPER_SITE.z_veg - 0.5 * missing


@pytest.mark.parametrize(("max_command", "x1"), [(1.0, 57.0), (1e-3, 57.0), (1.0, 18.85)])
def test_what_it_plans_is_what_happens(max_command: float, x1: float) -> None:
    """The plan's flows lead the plant through its levels: strong, weak pumps, 0.1 m3 of water."""
    rain = rain_in((5, 7), 0.01)
    controller = lookahead(max_command=max_command)
    plant, levels = virtual_site(x1, 2.0), []
    controller.command(*plant.levels(), [rain], [3e-6] * STEPS)
    plan = controller.plan
    for falls, (flow, seconds) in zip(
        rain, zip(plan[:, 1], np.diff(growing_steps(12.0)), strict=True), strict=True
    ):
        for _ in range(int(seconds)):
            advance(plant, falls, 3e-6, 0.0, flow)
        levels.append(plant.levels()[1])
    assert plan[:, 2] == pytest.approx(levels, abs=1e-6)
    assert plan[:, 1].max() > 0


def test_what_it_plans_if_no_rain_comes() -> None:
    """Rain in one step that fills the roof: until its end the roof is left alone, then filled."""
    ends, wet = growing_steps(12.0)[1:], 25
    rain = [0.0] * STEPS
    rain[wet] = 0.03 / (ends[wet] - ends[wet - 1])
    controller = lookahead()
    assert controller.command(2.3, 0.03, [rain], DRY) == 0.0
    fill_to = controller.plan[:, 3]
    assert not fill_to[: wet + 1].any()
    assert fill_to[wet + 1] == pytest.approx(PAPER_SITE.z_veg)
    assert not fill_to[wet + 2 :].any()  # nothing dries: it holds that without pumping
    assert controller.plan[wet:, 2] == pytest.approx(0.06)  # as full as this with the rain


# --- the controller -------------------------------------------------------------------------------


def test_without_a_forecast_it_counts_on_the_rain_of_the_gauge() -> None:
    """At the level it pumps what evaporates, as on the past day, less what the gauge measures."""
    evaporates, plant, controller = 6e-6, virtual_site(57.0, 0.9 * PAPER_SITE.x2_star), lookahead()
    controller.command(*plant.levels(), [DRY], [evaporates] * STEPS)
    assert controller.command(*plant.levels(), [], []) == 1.0  # it fills to the target
    for _ in range(300):
        advance(plant, 0.0, evaporates, controller.command(*plant.levels(), [], []))
    assert plant.state.roof == pytest.approx(PAPER_SITE.x2_star, abs=2e-5)
    for rain in (0.0, evaporates / 2, evaporates / 3):
        controller.gauge_rain = rain / PAPER_SITE.a2
        for _ in range(10):
            command = controller.command(*plant.levels(), [], [])
            flows = advance(plant, controller.gauge_rain, evaporates, command)
        assert flows.pump == pytest.approx(evaporates - rain, rel=1e-6)


@pytest.mark.parametrize("gap", [None, (0, -1), (1, 0)])
def test_a_forecast_that_is_missing_for_a_while_ends_no_wait_for_rain(
    gap: tuple[int, int] | None
) -> None:
    """A plan for 12 h is followed for a quarter of an hour; only then is the roof filled.

    A forecast with a gap, in the rain or in evapotranspiration, is treated as missing.
    """
    wet = rain_in((3, 6), 0.03), DRY
    missing: tuple[list[float], list[float]] = [], []
    if gap is not None:
        missing = rain_in((3, 6), 0.03), DRY.copy()
        missing[gap[0]][gap[1]] = math.nan
    controller = lookahead(observer_time_constant=300.0)
    assert controller.command(2.3, 0.03, *wet) == 0.0
    waited = [controller.command(2.3, 0.03, *missing) for _ in range(899)]
    assert not any(waited)
    assert controller.command(2.3, 0.03, *missing) > 0
    assert controller.fill_to == pytest.approx(PAPER_SITE.z_veg) and controller.solves == 1
    assert controller.command(2.3, 0.03, *wet) == 0.0


def test_forecasts_of_another_shape_are_refused() -> None:
    """They belong to another horizon."""
    controller = lookahead()
    for rain, evaporated in (([[0.0] * 5], DRY), ([DRY], [0.0] * 5), ([], DRY)):
        refusal(controller.command, 2.3, 0.04, rain, evaporated)


def test_the_order_of_members_does_not_matter() -> None:
    """Bit for bit; nor does their order in memory."""
    storms = [rain_in((5, 7), depth) for depth in (0.0, 0.004, 0.006, 0.01)]
    three = [lookahead() for _ in range(3)]
    for controller, members in zip(
        three, (storms, storms[::-1], np.asfortranarray(storms)), strict=True
    ):
        controller.command(2.3, 0.03, members, [2e-6] * STEPS)
    assert three[0].fill_to == three[1].fill_to == three[2].fill_to > 0.03
    assert three[0].plan.tobytes() == three[1].plan.tobytes() == three[2].plan.tobytes()


def test_it_plans_again_when_something_changed() -> None:
    """In a minute if a forecast has 1 mm more, at once with more members, and periodically.

    With 12 h, a plan is followed for a quarter of an hour. A skipped tick has no plan.
    """
    controller = lookahead()

    def plans(seconds: int, *members: list[float]) -> int:
        before = controller.solves
        for _ in range(seconds):
            controller.command(2.3, 0.05, members, DRY)
        return controller.solves - before

    assert plans(1, DRY) == 1 and controller.plan.shape == (STEPS, 4)
    assert plans(60, rain_in((5, 7), 0.9e-3)) == 0 and controller.plan.shape == (0, 4)
    assert plans(60, rain_in((5, 7), 1.1e-3)) == 1
    assert plans(1, DRY, DRY) == 1
    assert plans(900, DRY, DRY) == 1
    controller.skip()
    assert np.isnan(controller.plan).all() and controller.plan.shape == (1, 4)


def test_from_one_start_to_the_next_it_waits() -> None:
    """Three minutes at twenty starts an hour, regardless of what the sensor reads meanwhile."""
    controller = lookahead()
    started = []
    for second in range(600):
        level = 0.0457 if second % 60 else 0.0450
        if controller.command(2.3, level, [DRY], DRY):
            started.append(second)
    assert started == [0, 180, 360, 540]


def test_filling_lasts_as_long_as_the_pumps_must_be_on() -> None:
    """Two minutes instead of one, at one flow, without a break."""
    controller, commands = lookahead(min_on=120.0), []
    plant = virtual_site(PAPER_SITE.cistern_volume(2.3), PAPER_SITE.roof_volume(0.04))
    for _ in range(400):
        commands.append(controller.command(*plant.levels(), [DRY], DRY))
        advance(plant, 0.0, 0.0, commands[-1])
    on = [command for command in commands if command]
    assert 118 <= len(on) <= 122 and commands[: len(on)] == on
    assert on[:-3] == pytest.approx([on[0]] * (len(on) - 3), rel=0.02)
    assert plant.levels()[1] == pytest.approx(PAPER_SITE.z_veg, abs=1e-5)
    lack = PAPER_SITE.z_veg - 1e-7  # at the minimum command a fill would end sooner
    assert lookahead().command(2.3, lack, [DRY], DRY) > 0
    assert lookahead(min_on=300.0).command(2.3, lack, [DRY], DRY) == 0.0
    run = paper_run("--controller", "lookahead", "--pump-min-on", "60")
    assert run.parameters["min_on"] == 60.0
