"""Whether a live input may be used: cases by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeAlias

import pytest
from paper import PAPER_SITE

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.input_rules import (
    InputRules,
    LevelBounds,
    LevelRule,
    cistern_bounds,
    expected_movements,
    roof_bounds,
)
from greenroof_ros.site.site import Site

# A tank with water that rises by at most 1 mm/s and falls by at most 2 mm/s.
TANK = LevelBounds(0.001, lambda level: 0.002, math.inf)
# At half of its available water its soil keeps 3/4 of what arrives; it is full at 0.06 m.
FIELD_CAPACITY = replace(
    PAPER_SITE, z_soil=0.1, z_cap=68.8 * 0.06,
    field_capacity=0.6, wilting_point=0.2, depletion_fraction=0.5,
)


def rule(problem: Diagnosis | None) -> str:
    """Return the rule that is broken, for codes without their common prefix; empty if none is."""
    assert problem is None or problem.sentence
    return "" if problem is None else problem.code.removeprefix("input_")


def rules_broken(values: dict[float, float], level: LevelRule) -> list[str]:
    """Return the rule that each value breaks, by the time at which it comes."""
    rules, broken = InputRules(0.0, 60.0, 0.0, level=level), []
    for now, value in values.items():
        rules.receive(now, value)
        broken.append(rule(rules.check(now)))
    return broken


def test_a_level_in_another_unit_is_refused() -> None:
    """81 cm is not accepted as 81 m, nor 457 mm on the roof; plausible values continue."""
    for bounds, wrong, right in (
        (cistern_bounds(PAPER_SITE), 81.0, 0.81), (roof_bounds(PAPER_SITE), 45.7, 0.0457),
    ):
        level = LevelRule(bounds, 0.01, 0.02)
        assert rules_broken({0.0: wrong, 1.0: right, 2.0: wrong, 3.0: right}, level) == [
            "refused", "", "refused", "",
        ]
        assert level.displacement == 0.0


REFUSED = {
    "a value": None, "nan": Diagnosis.of("input_refused", "refused", why="nan"),
    "pause": Diagnosis.of("input_paused", time=7.0),
}
# What happens at each time (s), and the rule that is then broken, for an input with a limit of 5 s
# and a recovery of 3 s. Empty: nothing comes, and the input is only checked.
COURSES: dict[str, list[tuple[float, str, str]]] = {
    "waited for, then good after the time to recover": [
        (1.0, "", "waiting"), (5.5, "", "silent"), (6.0, "a value", "recovering"),
        (8.9, "a value", "recovering"), (9.1, "a value", ""),
    ],
    "silent beyond its maximum age": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (8.0, "", ""), (8.1, "", "silent"),
    ],
    "one bad value, then a silence that no one looked at": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (3.1, "nan", "refused"),
        (3.2, "a value", "recovering"), (6.3, "a value", ""), (11.4, "a value", "recovering"),
    ],
    "two publishers, with any values": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (3.5, "2 publishers", "publishers"),
        (4.0, "2 publishers", "publishers"), (4.5, "", "recovering"), (7.5, "", ""),
    ],
    "a pause of the node, after which all is old": [
        (0.0, "a value", "recovering"), (3.0, "a value", ""), (4.0, "pause", "paused"),
        (20.0, "", "silent"), (20.5, "a value", "recovering"), (23.5, "a value", ""),
    ],
}


@pytest.mark.parametrize("name", COURSES)
def test_courses_of_an_input(name: str) -> None:
    rules = InputRules(0.0, limit=5.0, recovery=3.0, limit_name="level_limit")
    for now, event, broken in COURSES[name]:
        if event in REFUSED:
            rules.receive(now, 1.0, REFUSED[event])
        problem = rules.check(now, "has 2 publishers" if event == "2 publishers" else "")
        assert rule(problem) == broken, now


Rate: TypeAlias = Callable[[float], float]


def in_pulses(now: float) -> float:
    """Return the flow (m3/s) of 0.24 mm on the roof every 4147 s, which are 5 mm/day."""
    return 0.24e-3 * PAPER_SITE.a2 / 10.0 if now % 4147.0 < 10.0 else 0.0


MAINS = replace(PAPER_SITE, mains_level=2.5, mains_flow=1e-3)


@pytest.mark.parametrize(("hours", "flow", "further", "due"), [
    # 0.005 m3/s: more than 10 mm on 25 m2 after 50 s, on 68.8 m2 after 138 s; a step is 10 s.
    (1, lambda _: 0.005, {}, (60 / 3600, 140 / 3600)),
    # 5 mm/day of the roof are 13.76 mm/day of the cistern; 5 mm/day may be drift: 10 mm in
    # 27.4 h. It must be found before the pump runs dry.
    (48, in_pulses, {}, (240 / 8.76, math.inf)),
    # A soil at field capacity is read 5 mm too low, and keeps no more.
    (1, lambda _: 0.005, {"site": FIELD_CAPACITY, "roof": 0.055}, (60 / 3600, math.inf)),
])
def test_a_frozen_level_is_found_if_the_pump_must_move_it(
    hours: float, flow: Rate, further: dict[str, Any], due: tuple[float, float]
) -> None:
    """After the hours in which the movement that must have happened exceeds 1 cm, for each tank."""
    given: dict[str, Any] = {"site": PAPER_SITE, "cistern": 2.0, "roof": 0.03} | further
    site: Site = given["site"]
    levels, step, found = [LevelRule(TANK, 0.01, 0.02) for _ in range(2)], 10.0, [math.inf] * 2
    for number in range(round(hours * 3600 / step)):
        movements = expected_movements(
            site, flow(number * step), given["cistern"], given["roof"], 0.005
        )
        for tank, (level, movement) in enumerate(zip(levels, movements, strict=True)):
            level.expect(movement * step)
            if found[tank] == math.inf and level.check_frozen() is not None:
                found[tank] = (number + 1) * step / 3600
    assert found == pytest.approx(due, rel=0.05)


@pytest.mark.parametrize(("values", "broken", "moved"), [
    # It rises by at most 1 mm/s: in 10 s from 1.5 m to 1.51 m, plus a tolerance of 2 cm.
    ({0.0: 1.5, 10.0: 1.531, 11.0: 1.531}, ["", "jump", ""], 0.031),
    ({0.0: 0.5, 10.0: 0.459}, ["", "jump"], -0.041),  # water can be at 0.47 m, give or take 0.01 m
    # A spike that comes back displaces the readings by next to nothing; what stays counts.
    ({0.0: 1.5, 1.0: 2.0, 2.0: 1.495}, ["", "jump", "jump"], -0.005),
    ({0.0: 1.5, 1.0: 2.0, 2.0: 2.5}, ["", "jump", "jump"], 1.0),
    # 1 mm every 10 ms is 10 cm/s; each step alone is within the tolerance.
    ({step * 0.01: 1.0 + step * 0.001 for step in range(25)},
     [*[""] * 21, "jump", "", "", ""], 0.001),
])
def test_jump(values: dict[float, float], broken: list[str], moved: float) -> None:
    level = LevelRule(TANK, 0.01, 0.02)
    assert rules_broken(values, level) == broken
    assert level.displacement == pytest.approx(moved)


def test_speeds_by_hand() -> None:
    """1.5 times what Eqs. (2)-(4) and the world's maximum rain allow, by hand.

    At 3 m in the cistern, the outlet's edge, c_hat - d + 3 = 42.2 m of head; friction and minor
    loss (3.56 * 18.4 / 0.2 + 0.6) / (2 * 9.81 * 0.0314159^2) = 16,945 s2/m5 in addition to the
    curve's 578,000: sqrt(42.2 / 594,945) = 0.008422 m3/s. Over 25 m2 0.3369 mm/s, over 68.8 m2
    0.1224 mm/s. 500 mm/h are 0.13889 mm/s. At 1 m of head, a low outlet takes
    0.61 pi 0.025^2 sqrt(2 9.81) = 0.00530529 m3/s.
    """
    cistern, roof = cistern_bounds(PAPER_SITE), roof_bounds(PAPER_SITE)
    assert cistern.fall(3.0) == pytest.approx(1.5 * 0.3369e-3, rel=1e-3)
    assert cistern.rise == pytest.approx(1.5 * 0.13889e-3 * 0.29225 / 25, rel=1e-3)
    assert roof.rise == pytest.approx(1.5 * (0.13889e-3 + 0.1224e-3), rel=1e-3)
    # 50 mm/day are 0.5787 um/s; a field-capacity soil loses what is above it within a tick of 1 s.
    assert roof.fall(0.1) == pytest.approx(1.5 * 0.5787e-6, rel=1e-3)
    assert roof_bounds(FIELD_CAPACITY).fall(0.07) == pytest.approx(1.5 * (0.5787e-6 + 0.01))
    assert cistern_bounds(MAINS).rise - cistern.rise == pytest.approx(1.5 * 1e-3 / 25)
    drained = cistern_bounds(replace(PAPER_SITE, low_outlet_level=1.0, low_outlet_radius=0.025))
    assert drained.fall(2.0) - cistern.fall(2.0) == pytest.approx(1.5 * 0.00530529 / 25)
