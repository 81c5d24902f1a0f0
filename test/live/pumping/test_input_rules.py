"""Whether a live input may be used: cases by hand, and random values."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper import PAPER_SITE
from places import CHECKOUT

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.input_rules import (
    InputRules,
    LevelBounds,
    LevelRule,
    Movement,
    Wetting,
    cistern_bounds,
    expected_movement,
    roof_bounds,
)
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

# A tank with water that rises by at most 1 mm/s and falls by at most 2 mm/s.
TANK = LevelBounds(lambda level: 0.001, lambda level: 0.002, math.inf)


def level_rule(frozen: float = 0.01, tolerance: float = 0.02) -> LevelRule:
    return LevelRule(TANK, frozen, tolerance)


def rule(problem: Diagnosis | None) -> str:
    """Return the rule that is broken, for codes without their common prefix; empty if none is."""
    return "" if problem is None else problem.code.removeprefix("input_")


def rules_of(values: dict[float, float], rules: InputRules) -> list[str]:
    """Return the rule that each value breaks, by the time at which it comes."""
    return [rule(rules.receive(now, value)) for now, value in values.items()]


def test_a_level_in_another_unit_is_refused() -> None:
    """81 cm is not accepted as 81 m, nor 457 mm on the roof; plausible values continue."""
    cistern = InputRules(
        0.0, 5.0, 0.0, topic="/cistern/level",
        level=LevelRule(cistern_bounds(PAPER_SITE), 0.01, 0.02),
    )
    assert rules_of({0.0: 81.0, 1.0: 0.81, 2.0: 81.0, 3.0: 0.81}, cistern) == [
        "refused", "", "refused", "",
    ]
    problem = cistern.receive(4.0, 81.0)
    assert problem is not None and problem.sentence == (
        "/cistern/level is 81 m, but no level at this site can be above 9 m: is its unit wrong?"
    )
    roof = LevelRule(roof_bounds(PAPER_SITE), 0.01, 0.02)
    assert rule(roof.check(0.0, 45.7)) == "refused"
    assert roof.check(1.0, 0.0457) is None
    assert roof.displacement == 0.0


NAN = Diagnosis.of("input_refused", "refused", why="nan")
# What happens at each time (s), and the rule that is then broken, for an input with a limit of 5 s
# and a recovery of 3 s. None: nothing comes, and the input is only checked.
COURSES: dict[str, list[tuple[float, str, str]]] = {
    "waited for, then good after the time to recover": [
        (1.0, "", "waiting"), (10.5, "", "silent"), (11.0, "a value", "recovering"),
        (13.9, "a value", "recovering"), (14.1, "a value", ""),
    ],
    "silent beyond its maximum age": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (8.0, "", ""), (8.1, "", "silent"),
    ],
    "one bad value, then a silence that no one looked at": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (3.1, "nan", "refused"),
        (3.2, "a value", "recovering"), (6.1, "a value", "recovering"), (6.3, "a value", ""),
        (11.4, "a value", "recovering"), (14.3, "a value", "recovering"), (14.5, "a value", ""),
    ],
    "two publishers, with any values": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (3.5, "2 publishers", "publishers"),
        (4.0, "2 publishers", "publishers"), (4.5, "", "recovering"), (7.5, "", ""),
        (8.0, "unusable", "refused"),
    ],
    "a pause of the node, after which all is old": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (4.0, "pause", "paused"),
        (20.0, "", "paused"), (20.5, "a value", "recovering"), (23.5, "a value", ""),
    ],
    "a pause before anything came": [(2.0, "pause", "waiting")],
}


@pytest.mark.parametrize("name", COURSES)
def test_courses_of_an_input(name: str) -> None:
    rules = InputRules(0.0, limit=5.0, recovery=3.0, limit_name="level_limit")
    for now, event, broken in COURSES[name]:
        if event == "pause":
            rules.clear(7.0)
        if event in ("a value", "nan"):
            problem = rules.receive(now, 1.0, NAN if event == "nan" else None)
        elif event == "unusable":
            problem = rules.refuse(now, "it is too short")
        else:
            problem = rules.check(now, "has 2 publishers" if event == "2 publishers" else "")
        assert rule(problem) == broken, now


def test_frozen() -> None:
    """Frozen: the pump must have lowered it by more than 1 cm, but it has not changed at all.

    If inflow and outflow are equal, the net of rain and pump moves nothing.
    """
    level = level_rule(frozen=0.01)
    rules = InputRules(0.0, limit=5.0, recovery=0.0, level=level)
    for second in range(5):
        assert rules.receive(float(second), 1.5) is None
        level.expect(Movement(0.0, 0.0), 1.0)
        level.expect(Movement(-0.003, -0.002), 1.0)
    assert rules.receive(5.0, 1.5) is None  # 1 cm is not more than 1 cm
    level.expect(Movement(-0.0002, -0.0001), 1.0)
    problem = rules.receive(6.0, 1.5)
    assert problem is not None
    assert (rule(problem), problem.values["movement"]) == ("frozen", 0.01)
    assert rule(rules.receive(7.0, 1.5)) == "frozen"  # the pump now stands, and so does the level
    assert rules.receive(8.0, 1.4999) is None


HOUR_S, DAY_S = 3600.0, 86400.0
MM_PER_HOUR = 1e-3 / HOUR_S
Rate: TypeAlias = Callable[[float], float]


def frozen_after(
    hours: float, flow: Rate, rain: Rate, site: Site = PAPER_SITE, cistern: float = 2.0,
    roof: float = 0.03,
) -> list[float | None]:
    """Return after how many hours each unchanged level is frozen; None if it never is.

    Args:
        hours: how long.
        flow: m3/s, by time (s).
        rain: mm/h, likewise.
        site: the site.
        cistern: its level (m).
        roof: likewise.
    """
    levels, wetting, step = [level_rule(), level_rule()], Wetting(), 10.0
    found: list[float | None] = [None, None]
    for level, value in zip(levels, (cistern, roof), strict=True):
        level.check(0.0, value)
    for number in range(round(hours * HOUR_S / step)):
        now = number * step
        fallen = rain(now) * MM_PER_HOUR
        movements = expected_movement(
            site, flow(now), fallen, wetting.excess(fallen, step), cistern, roof, 0.01
        )
        for tank, (level, movement) in enumerate(zip(levels, movements, strict=True)):
            level.expect(movement, step)
            if found[tank] is None and level.check_frozen() is not None:
                found[tank] = (now + step) / HOUR_S
    return found


def nothing(_: float) -> float:
    return 0.0


def every(period: float, lasting: float, value: float) -> Rate:
    """Return a function of time that has a value for a time (s) in every period (s)."""
    return lambda now: value if now % period < lasting else 0.0


COLLECTING = replace(PAPER_SITE, a_in=270.0)
# At field capacity its soil holds 0.108 m * 0.63 = 68.04 mm.
NEUBRANDENBURG = read_site(CHECKOUT / "config" / "site_neubrandenburg.yaml")
# 0.24 mm on the roof in one pulse of 10 s; 5 mm/day are a pulse every 4147 s.
PULSE = 0.24e-3 * PAPER_SITE.a2 / 10.0
# What is well though a level does not change: how long (h), flow, rain, and further arguments.
WELL: dict[str, tuple[float, Rate, Rate, dict[str, Any]]] = {
    "drizzle that evaporates from an empty roof": (48, nothing, lambda _: 0.2, {"roof": 0.0}),
    "a shower each day that evaporates": (48, nothing, every(DAY_S, HOUR_S, 3.0), {"roof": 0.0}),
    "rain that wets the catchment": (48, nothing, every(9e9, HOUR_S, 0.93), {"site": COLLECTING}),
    "the mains are shut": (
        48, nothing, nothing, {"site": replace(PAPER_SITE, mains_level=2.5, mains_flow=1e-3)},
    ),
    "a full soil is read 5 mm too low": (
        48, nothing, lambda _: 10.0, {"cistern": 3.0, "roof": 0.495},
    ),
    # On a dry catchment with a first-flush diverter.
    "a shower of 4 mm every second day": (
        120, nothing, every(2 * DAY_S, HOUR_S, 4.0), {"site": COLLECTING},
    ),
    "the pump replaces evapotranspiration in pulses": (
        120, every(4147.0, 10.0, PULSE), nothing,
        {"site": replace(PAPER_SITE, mains_level=2.5, mains_flow=1e-3)},
    ),
    "the mains refill what the pump takes": (
        48, lambda _: 5e-4, nothing,
        {"site": replace(PAPER_SITE, mains_level=2.5, mains_flow=1e-3), "roof": 0.5},
    ),
    # A sensor that shows whole steps of 5 mm, rounded down.
    "the mains keep a level that is read 3 mm too high": (
        48, lambda _: 5e-4, nothing,
        {"site": replace(PAPER_SITE, mains_level=2.0, mains_flow=1e-3), "cistern": 2.003,
         "roof": 0.5},
    ),
    "a cistern that spills is read 5 mm too low": (
        48, nothing, lambda _: 10.0, {"site": COLLECTING, "cistern": 2.995, "roof": 0.5},
    ),
    "a cistern at its low outlet is read 5 mm too low": (
        48, nothing, lambda _: 4.0,
        {"site": replace(COLLECTING, low_outlet_level=1.5, low_outlet_radius=0.05),
         "cistern": 1.497, "roof": 0.5},
    ),
    "a roof with a field-capacity soil at field capacity is read 5 mm too low": (
        48, nothing, lambda _: 10.0,
        {"site": NEUBRANDENBURG, "cistern": 3.0, "roof": 0.06304},
    ),
}


@pytest.mark.parametrize("name", WELL)
def test_an_unchanged_level_that_is_not_frozen(name: str) -> None:
    """What may evaporate, wet surfaces or be replaced moves no level surely."""
    hours, flow, rain, further = WELL[name]
    assert frozen_after(hours, flow, rain, **further) == [None, None]


# A frozen sensor: the same, and after how many hours cistern and roof are found.
FROZEN: dict[str, tuple[float, Rate, Rate, dict[str, Any], tuple[float, float]]] = {
    # 0.005 m3/s: more than 10 mm on 25 m2 after 50 s, on 68.8 m2 after 138 s; a step is 10 s.
    "a pump": (1, lambda _: 0.005, nothing, {}, (60 / 3600, 140 / 3600)),
    # 5 mm wet the surfaces, at 9 mm/h net; then 10 mm of the roof at 9 mm/h, and of the cistern
    # 10 mm/h on 243 m2 over 25 m2 (0.9 of 270 m2 run off), for 10 mm: 6.2 minutes.
    "a storm": (
        4, nothing, lambda _: 10.0, {"site": replace(COLLECTING, runoff_coefficient=0.9)},
        (5 / 9 + 10 / (9 * 243 / 25), 5 / 9 + 10 / 8),
    ),
    # 5 mm/day of the roof are 13.76 mm/day of the cistern; 5 mm/day may be drift: 10 mm in
    # 27.4 h. It must be found before the pump runs dry.
    "a cistern that is emptied slowly": (
        48, every(4147.0, 10.0, PULSE), nothing, {}, (240 / 8.76, math.inf),
    ),
}


@pytest.mark.parametrize("name", FROZEN)
def test_a_frozen_level_is_found(name: str) -> None:
    """After the time in which the movement that must have happened exceeds 1 cm."""
    hours, flow, rain, further, due = FROZEN[name]
    for found, expected in zip(frozen_after(hours, flow, rain, **further), due, strict=True):
        assert (math.inf if found is None else found) == pytest.approx(expected, rel=0.05)


def test_jump() -> None:
    """It rises by at most 1 mm/s: in 10 s from 1.5 m to 1.51 m, plus a tolerance of 2 cm.

    1 mm every 10 ms is 10 cm/s; each step alone is within the tolerance: 2 cm and 0.2 s of water.
    """
    rules = InputRules(0.0, 60.0, 0.0, level=level_rule())
    assert rules_of({0.0: 1.5, 10.0: 1.531, 11.0: 1.531}, rules) == ["", "jump", ""]
    rules = InputRules(0.0, 60.0, 0.0, level=level_rule())
    rules_hit = rules_of({step * 0.01: 1.0 + step * 0.001 for step in range(40)}, rules)
    assert rules_hit.index("jump") <= 23
    level = level_rule()
    level.check(0.0, 0.5)
    assert rule(level.check(10.0, 0.459)) == "jump"  # water can be at 0.47 m, give or take 0.01 m


def test_what_jumps_have_moved_the_readings_by() -> None:
    """A spike that comes back displaces nothing; what stays counts, however it got there."""
    for values, moved in (
        ({0.0: 1.5, 1.0: 2.0, 2.0: 1.495}, 0.0),
        ({0.0: 1.5, 1.0: 2.0, 2.0: 1.4}, -0.1),
        ({0.0: 1.5, 1.0: 2.0, 2.0: 2.5}, 1.0),
        ({0.0: 1.5, 1.0: 2.0, 2.0: 1.5, 3.0: 2.0}, 0.5),
        # After five minutes any level is possible: what comes back is water.
        ({0.0: 1.5, 1.0: 2.0, 301.0: 1.3}, -0.2),
    ):
        level = level_rule()
        for now, value in values.items():
            level.check(now, value)
        assert level.displacement == pytest.approx(moved), values


@given(
    start=st.floats(0.1, 3.0),
    steps=st.lists(
        st.tuples(st.floats(0.01, 30.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), max_size=40
    ),
)
def test_true_water_with_noise_never_jumps(
    start: float, steps: list[tuple[float, float, float]]
) -> None:
    """Any water within its speeds, read with an error of less than half the tolerance."""
    rules = InputRules(0.0, 1e9, 0.0, level=level_rule(frozen=1e9))
    now, level = 0.0, start
    assert rules.receive(now, level) is None
    for passed, share, error in steps:
        now += passed
        level += passed * (0.001 if share > 0 else 0.002) * share
        assert rules.receive(now, level + 0.0099 * error) is None


def test_speeds_of_the_paper_s_site() -> None:
    """1.5 times what Eqs. (2)-(4) and the world's maximum rain allow, by hand.

    At 3 m in the cistern, the outlet's edge, c_hat - d + 3 = 42.2 m of head; friction and minor
    loss (3.56 * 18.4 / 0.2 + 0.6) / (2 * 9.81 * 0.0314159^2) = 16,945 s2/m5 in addition to the
    curve's 578,000: sqrt(42.2 / 594,945) = 0.008422 m3/s. Over 25 m2 0.3369 mm/s, over 68.8 m2
    0.1224 mm/s. 500 mm/h are 0.13889 mm/s.
    """
    cistern, roof = cistern_bounds(PAPER_SITE), roof_bounds(PAPER_SITE)
    assert cistern.fall(3.0) == pytest.approx(1.5 * 0.3369e-3, rel=1e-3)
    assert cistern.rise(1.0) == pytest.approx(1.5 * 0.13889e-3 * 0.29225 / 25, rel=1e-3)
    assert roof.rise(0.0) == pytest.approx(1.5 * (0.13889e-3 + 0.1224e-3), rel=1e-3)
    # 50 mm/day are 0.5787 um/s; from 0.1 m 7.83e-8 * 0.6 / 0.5 m/s drain.
    assert roof.fall(0.1) == pytest.approx(1.5 * (0.5787e-6 + 0.09396e-6), rel=1e-3)


# 1 mm/h, and 5 mm/day.
LOSS, DRIFT = 1e-3 / 3600, 5e-3 / 86400


def test_expected_movement() -> None:
    """0.005 m3/s is 0.2 mm/s of the cistern and 0.0727 mm/s of the roof; rain adds to both."""
    cistern, roof = expected_movement(PAPER_SITE, 0.005, 0.0, 0.0, 2.0, 0.03)
    assert cistern == pytest.approx((-0.2e-3 - DRIFT, -0.2e-3 + DRIFT))
    assert roof == (pytest.approx(0.0726744e-3 - LOSS), math.inf)
    # Half of the rain still wets surfaces; all of the 0.29225 m2 catchment may run off.
    cistern, roof = expected_movement(PAPER_SITE, 0.0, 1e-5, 5e-6, 2.0, 0.03)
    assert cistern.min == pytest.approx(5e-6 * PAPER_SITE.effective_catchment / 25 - DRIFT)
    assert cistern.max == pytest.approx(1e-5 * PAPER_SITE.a_in / 25 + DRIFT)
    assert roof.min == pytest.approx(5e-6 - LOSS)
    # Water that spills moves no level: the cistern at its outlet (3 m), the roof at 0.5 m of soil.
    cistern, roof = expected_movement(PAPER_SITE, 0.005, 1e-5, 1e-5, 3.0, 0.5)
    assert (cistern, roof.min) == ((-DRIFT, DRIFT), -LOSS)


def test_wetting() -> None:
    """7 mm in an hour: 1 mm may evaporate, 5 mm wet the surfaces. After a night 4 mm wet them."""
    wetting = Wetting()
    for rain, hours, ran_off in (
        (7.0, 1.0, 1.0), (7.0, 1.0, 6.0), (0.0, 4.0, 0.0), (6.0, 1.0, 1.0),
    ):
        beyond = wetting.excess(rain * MM_PER_HOUR, hours * HOUR_S)
        assert beyond * hours == pytest.approx(ran_off * MM_PER_HOUR), (rain, hours)


def test_a_field_capacity_soil_rises_by_what_it_keeps() -> None:
    """At half of its available water it keeps 3/4; water above field capacity falls in a tick.

    Of 0.1 m of soil, wilting is at 0.02 m and field capacity at 0.06 m: half is 0.04 m.
    """
    site = replace(
        PAPER_SITE, z_soil=0.1, z_cap=68.8 * 0.06,
        field_capacity=0.6, wilting_point=0.2, depletion_fraction=0.5,
    )
    _, roof = expected_movement(site, 0.005, 1e-5, 1e-5, 2.0, 0.04)
    assert roof.min == pytest.approx(0.75 * (0.0726744e-3 + 1e-5) - LOSS, rel=1e-5)
    assert expected_movement(site, 0.005, 1e-5, 1e-5, 2.0, 0.06)[1].min == -LOSS
    fall = roof_bounds(site).fall
    assert fall(0.05) == pytest.approx(1.5 * 0.5787e-6, rel=1e-3)
    assert fall(0.07) == pytest.approx(1.5 * (0.5787e-6 + 0.01), rel=1e-3)


def test_mains_may_raise_the_cistern() -> None:
    """0.001 m3/s over 25 m2 is 0.04 mm/s, only below the valve's level; they can be shut."""
    site = replace(PAPER_SITE, mains_level=1.5, mains_flow=0.001)
    for level, most in ((1.4, 0.04e-3), (1.5, 0.0)):
        cistern, _ = expected_movement(site, 0.0, 0.0, 0.0, level, 0.03)
        assert cistern == pytest.approx((-DRIFT, most + DRIFT))
    without = cistern_bounds(PAPER_SITE).rise(1.4)
    assert cistern_bounds(site).rise(1.4) - without == pytest.approx(1.5 * 0.04e-3, rel=1e-9)


def test_a_low_outlet_lets_the_cistern_fall_and_stand() -> None:
    """At 1 m of head it takes 0.61 pi 0.025^2 sqrt(2 9.81) = 0.00530529 m3/s.

    4e-4 m/s on 50 m2, 0.8 arriving, are 0.016 m3/s: possibly only 0.00804 stays, because the
    outlet can take 1.5 times as much. All of it may arrive, 0.02 m3/s, and the outlet alone must
    lower nothing: it can be clogged.
    """
    site = replace(
        PAPER_SITE, a_in=50.0, runoff_coefficient=0.8,
        low_outlet_level=1.0, low_outlet_radius=0.025,
    )
    outflow = 0.61 * math.pi * 0.025**2 * math.sqrt(2 * 9.81)
    for flow, rain, level, minimum, most in (
        (0.0, 4e-4, 1.0, 0.016, 0.02), (0.0, 4e-4, 2.0, 0.016 - 1.5 * outflow, 0.02),
        (0.005, 0.0, 2.0, -0.005 - 1.5 * outflow, -0.005),
    ):
        computed = expected_movement(site, flow, rain, rain, level, 0.03)[0]
        due = (minimum / 25 - DRIFT, most / 25 + DRIFT)
        assert computed == pytest.approx(due, rel=1e-12), (flow, rain, level)
    without = cistern_bounds(PAPER_SITE).fall(2.0)
    assert cistern_bounds(site).fall(2.0) - without == pytest.approx(1.5 * outflow / 25, rel=1e-9)
    # A cloudburst runs off completely: 500 mm/h on 50 m2.
    assert cistern_bounds(site).rise(2.0) == pytest.approx(1.5 * 0.5 / 3600 * 50 / 25, rel=1e-9)
