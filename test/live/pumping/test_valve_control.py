"""The control of the outlet valve on a clock of its own: interlocks, moves, switches, balance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from places import CONFIG

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.interlocks import Decision
from greenroof_ros.live.pumping.state_file import StateFile
from greenroof_ros.live.pumping.valve_control import (
    ValveControl,
    ValveObservation,
    ValveSettings,
    valve_parameters,
)
from greenroof_ros.site.file import read_site

SITE = read_site(CONFIG / "site_valve.yaml")
TRAVEL, WET_S = 30.0, 7200.0  # as the site file and the manual of the package state them
RAIN = 2.0 / 3.6e6  # 2 mm/h
MOST = 0.6 * math.pi * 0.0085**2 * math.sqrt(2 * 9.81)  # m3/s at 1 m of head, Eq. (2) of the paper


class Rig:
    """A valve that takes 10 s to move, and a cistern that it drains."""

    def __init__(self, file: Path | None = None, **settings: Any) -> None:
        self.site = replace(SITE, **{
            key: settings.pop(key) for key in ("valve_moves_per_hour", "low_outlet_radius")
            if key in settings
        })
        defaults: list[Parameter] = [*valve_parameters(self.site)]
        values = {each.name: each.default for each in defaults} | settings
        self.settings = ValveSettings(**values)
        self.state_file = StateFile(file)
        self.control = ValveControl(self.site, self.settings, self.state_file, 10.0)
        self.level, self.position, self.leak, self.jammed = 1.1, 0.0, 0.0, False
        self.change: dict[str, Any] = {}
        self.decision = Decision({})

    def step(self, command: float | None = 1.0, dt: float = 1.0) -> Decision:
        on = self.decision.request is not None
        if not self.jammed:
            self.position += max(-dt / 10, min(dt / 10, float(on) - self.position))
        head = max(0.0, self.level - 0.1)
        most = MOST * (self.site.low_outlet_radius / 0.0085) ** 2
        self.level -= (self.position * most * math.sqrt(head) + self.leak) * dt / self.site.a1
        self.decision = self.control.step(dt, ValveObservation(**{
            "command": command, "cistern_level": self.level, "frost": 0.0, "rain": 0.0,
            "pumped": 0.0, "on": on, "opened": float(self.position > 0.99),
            "closed": float(self.position < 0.01), **self.change,
        }))
        return self.decision

    def run(self, seconds: float, command: float | None = 1.0, **change: Any) -> Decision:
        self.change = change
        for _ in range(round(seconds)):
            self.step(command)
        return self.decision

    def until(self, reached: Callable[[Decision], bool], within: float, **change: Any) -> float:
        self.change = change
        for second in range(round(within)):
            if reached(self.step()):
                return second + 1.0
        raise AssertionError(self.decision)

    @property
    def is_open(self) -> bool:
        return self.decision.request is not None


def opened(**settings: Any) -> Rig:
    """Return a rig whose valve has opened, in dry weather."""
    rig = Rig(**settings)
    rig.state_file.change(without_rain=1e6)
    rig.until(lambda decision: decision.state == "open", 120)
    return rig


LOST = Diagnosis.of("drive_lost", problem="no reply")


@pytest.mark.parametrize(("change", "code"), [
    ({"frost": 1.0}, "frost"), ({"frost": None}, "frost_unknown"),
    ({"cistern_level": None}, "cistern_level_unknown"), ({"rain": None}, "rain_unknown"),
    ({"rain": RAIN}, "wet_weather"), ({"command": None}, "command_unknown"),
    ({"reasons": [LOST]}, "drive_lost"), ({"opened": None}, "position_unknown"),
])
def test_an_interlock_closes_it_at_once(change: dict[str, Any], code: str) -> None:
    """And it opens again by itself, after rain not before the sewer has drained."""
    rig = opened(has_switches=True, valve_moves_per_hour=3600.0)
    decision = rig.run(1, **change)
    assert (list(decision.active)[:1], decision.request) == ([code], None)
    if code != "position_unknown":
        assert rig.until(lambda decision: decision.at_rest, 30, **change) < TRAVEL
    again = rig.until(lambda _: rig.is_open, 8000)
    assert again >= WET_S - 1 if change.get("rain") else again < 60


def test_it_makes_at_most_so_many_moves_an_hour() -> None:
    """Whole openings, of which one of 4 moves an hour begins every 30 min; it closes at once."""
    rig, states = opened(), list[bool]()
    for second in range(3 * 3600):
        rig.step(1.0 if second % 60 < 30 else 0.49)
        states.append(rig.is_open)
        rig.level = 1.1
    moves = [second for second, (a, b) in enumerate(pairwise(states)) if a != b]
    assert all(sum(at <= each < at + 3600 for each in moves) <= 4 for at in moves)
    assert len(moves) >= 10 and moves[1] - moves[0] >= 1800


@pytest.mark.parametrize(("dry", "wet_for"), [(300.0, WET_S - 300.0), (WET_S + 10.0, 0.0)])
@pytest.mark.parametrize("unseen", [0.0, 400.0])
def test_it_remembers_the_rain_over_a_short_restart_alone(
    tmp_path: Path, dry: float, wet_for: float, unseen: float
) -> None:
    """Otherwise, what was not seen counts as rain, as does unknown rain."""
    rig = Rig(tmp_path / "valve.json")
    rig.run(dry, 0.0)
    assert rig.state_file.close() == ""
    state_file = StateFile(tmp_path / "valve.json")
    state_file.unseen_s += unseen
    rig.control = ValveControl(rig.site, rig.settings, state_file, 10.0)
    rig.run(60, 1.0, rain=None)  # the gauge is not known at once
    rest = WET_S if unseen else wet_for
    assert rest <= rig.until(lambda _: rig.is_open, 8000) <= rest + 2 * TRAVEL
    state_file.close()


def test_a_person_opens_it_for_a_time_under_the_same_interlocks() -> None:
    rig = opened()
    rig.run(100, 0.0)
    rig.run(1800, 0.0)
    rig.control.opened_by, rig.control.open_for = "the owner", 600.0
    rig.run(500, None)
    assert rig.is_open and rig.decision.why == "opened by the owner"
    assert [*rig.run(101, None).active] == ["command_unknown"]
    rig.run(2000, 0.0)
    rig.control.open_for = 7200.0
    assert rig.run(60, None).request and not rig.run(1, None, frost=1.0).request
    assert [*rig.run(2000, None).active] == ["command_unknown"]  # it does not open again


@pytest.mark.parametrize(("fault", "has_switches", "code", "within"), [
    ("stuck_open", True, "valve_stuck_open", TRAVEL), ("leak", True, "valve_leaks", 86_400),
    ("wrong_switch", True, "switches_disagree", TRAVEL),
    ("stuck_closed", True, "valve_stuck_closed", 86_400),
    # The same as a leak, to someone who sees only the level.
    ("stuck_open", False, "valve_leaks", 86_400), ("leak", False, "valve_leaks", 86_400),
    ("stuck_closed", False, "valve_stuck_closed", 86_400),
])
def test_what_is_wrong_is_found_within_a_day(
    fault: str, has_switches: bool, code: str, within: float
) -> None:
    """By the switches after the travel time, by the balance of the cistern after hours."""
    rig = opened(has_switches=has_switches)
    rig.jammed = fault == "stuck_open"
    if fault == "stuck_closed":
        rig.run(100, 0.0)
        rig.jammed = True
    command = 1.0 if fault == "stuck_closed" else 0.0
    rig.change = {"opened": 1.0, "closed": 1.0} if fault == "wrong_switch" else {}
    rig.run(60, command, **rig.change)
    rig.leak = 2e-3 / 60 if fault == "leak" else 0.0  # 2 L/min

    def found(decision: Decision) -> bool:
        stuck = rig.control.stuck
        return code in decision.active or (stuck is not None and stuck.code == code)

    assert any(found(rig.step(command)) for _ in range(round(within)))
    latched = code != "valve_stuck_closed"
    assert (rig.state_file.state.fault_code == code) == latched
    rig.jammed, rig.leak, rig.change = False, 0.0, {}
    rig.run(60, 0.0)
    assert bool(rig.decision.active) == latched
    rig.state_file.change(fault="", fault_code="")
    rig.control.discard_evidence()
    rig.level = 1.1
    rig.until(lambda _: rig.is_open, 4000)


def test_nothing_is_found_at_a_sound_valve() -> None:
    """Nor a wide outlet that opens; in a week of openings, with noise and an inexact pump."""
    rig = opened(has_switches=False, low_outlet_radius=0.03)
    assert all(rig.step() and rig.control.stuck is None for _ in range(900))
    rig = opened(has_switches=False)
    for second in range(0, 7 * 86_400, 10):
        pumped = 3e-5 if second % 7200 < 3600 else 0.0
        rig.level += 0.001 * math.sin(second) - 1.1 * pumped * 10 / rig.site.a1
        rig.level = max(rig.level, 0.15) if second % 20_000 else 1.1
        rig.change = {"pumped": pumped}
        rig.step(1.0 if second % 40_000 < 4000 else 0.0, dt=10.0)
        rig.level -= 0.001 * math.sin(second)
        assert not {*rig.decision.active} & {"valve_leaks"} and rig.control.stuck is None, second


def test_a_silent_relay_counts_as_closed_only_after_its_timer_and_travel() -> None:
    rig = opened()
    lost = {"on": None, "reasons": [LOST]}
    assert rig.run(1, **lost).state == "unknown"
    closed = rig.until(lambda decision: decision.at_rest, 60, **lost)
    assert closed == pytest.approx(10 + TRAVEL, abs=2)
