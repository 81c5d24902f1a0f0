"""Random faults against the control of pump and valve: it never acts when it must not.

``python -m pytest tools/faults/random_faults.py`` tries 2,000 seeds of the pump and 500 of the
valve, or as many as ``FAULTS_SEEDS`` says, in one process and on a clock of its own.
"""

from __future__ import annotations

import math
import os
import random
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from paper import PAPER_SITE
from places import CONFIG
from pump_rig import LOST, NOT_READY, OVERLOAD, Rig, settings_for

from greenroof_ros.base.processes import IN_MEMORY
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.input_rules import (
    InputRules,
    LevelRule,
    cistern_bounds,
    roof_bounds,
)
from greenroof_ros.live.pumping.pump_control import PumpControl
from greenroof_ros.live.pumping.state_file import StateFile
from greenroof_ros.live.pumping.valve_control import (
    ValveControl,
    ValveObservation,
    ValveSettings,
    valve_parameters,
)
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.pump import STANDSTILL
from greenroof_ros.physics.tick import step
from greenroof_ros.site.file import read_site

SITE = replace(PAPER_SITE, max_dose=0.5, starts_per_hour=3600.0)
SETTINGS = settings_for(SITE, min_off=1.0)
MAX_AGE = {"command": 3.0, "cistern_level": 5.0, "roof_level": 5.0, "frost": 10.0}
REFUSED = Diagnosis.of("input_refused", "refused", why="it is not a number")
INPUT = ("", "", "silent", "late", "nan", "jump", "two publishers")
"""faults of an input; late messages come every 7 s"""
OUT_OF_ORDER: list[dict[str, Any]] = [
    {"reasons": [LOST], "speed": None}, {"reasons": [NOT_READY]}, {"reasons": [OVERLOAD]},
    {"speed": None},
]
WRONG: list[dict[str, Any]] = [
    {"speed": 2.0}, {"speed": -0.5}, {"flow": 1e3}, {"flow": 0.0}, {}, {}, {},
]


def run(seed: int, file: Path) -> int:
    """Run for some minutes; return for how many seconds the pump was on."""
    rng = random.Random(seed)
    rig = Rig(x1=rng.uniform(18.0, 75.0), x2=rng.uniform(0.0, 3.0), site=SITE, settings=SETTINGS,
              file=file)
    levels = {"cistern_level": LevelRule(cistern_bounds(SITE), 0.01, 0.02),
              "roof_level": LevelRule(roof_bounds(SITE), 0.01, 0.02)}
    rules = {name: InputRules(rig.now, age, 2.0, level=levels.get(name))
             for name, age in MAX_AGE.items()}
    came_at = dict.fromkeys(rules, -math.inf)
    faults, drive, held, latched, on = dict[str, str](), dict[str, Any](), False, "", 0
    for _ in range(150):
        match rng.randrange(25):
            case 0 | 1 | 2:
                faults[rng.choice([*rules])] = rng.choice(INPUT)
            case 3 | 4:
                faults.clear()
            case 5 | 6:
                drive = rng.choice(OUT_OF_ORDER + WRONG)
            case 7:
                rig.state_file.hold("the page")
                held = True
            case 8 | 9:
                rig.state_file.release()
                held = False
            case 10 | 11:
                rig.clear()
                latched, drive = "", {}
            case 12:
                rig.control.doses.request(time.time(), 0.2, time.time())
            case 13:
                assert rig.suspend(rng.choice((2.0, 60.0))).request is None
            case 14:  # a restart
                assert rig.state_file.close() == ""
                rig.state_file = StateFile(file)
                rig.control = PumpControl(SITE, SETTINGS, rig.state_file, 15.0)
        true = dict(zip(levels, rig.levels(), strict=True)) | {
            "command": rng.random(), "frost": float(rng.random() < 0.01),
        }
        rig.change = {"displacements": tuple(each.displacement for each in levels.values())}
        must_not = ["held"] * held + [latched] * bool(latched) + ["drive"] * (drive in OUT_OF_ORDER)
        for name, rule in rules.items():
            fault, value = faults.get(name, ""), true[name]
            if fault == "jump" and name in levels:
                value += rng.choice((-0.3, 0.3, 60.0))
            if fault != "silent" and (fault != "late" or rig.now % 7 == 0):
                rule.receive(rig.now, value, REFUSED if fault == "nan" else None)
                came_at[name] = rig.now
            bad = rule.check(rig.now, "has 2 publishers" if fault == "two publishers" else "")
            rig.change[name] = None if bad else value
            spoilt = fault in ("nan", "two publishers") or abs(value - true[name]) > 1.0
            if spoilt or rig.now - came_at[name] > MAX_AGE[name]:
                must_not.append(name)
        rig.change |= drive
        turns = rig.speed > STANDSTILL and drive.get("speed") is None
        decision = rig.step(None)
        assert not (turns and decision.at_rest), "it counts as standing"
        assert decision.request is None or not must_not, must_not
        assert decision.request is None or SETTINGS.min_speed <= decision.request <= 1
        assert ("hold" in decision.active) == held
        assert decision.state == "fault" or not latched
        latched = rig.state_file.state.fault_code
        on += decision.request is not None
    assert rig.state_file.close() == ""
    return on


def test_the_pump_never_runs_when_it_must_not() -> None:
    """Not on an unfit input, held, latched or without its drive, nor beyond its speeds."""
    seeds, failed, on = range(int(os.environ.get("FAULTS_SEEDS", "2000"))), dict[int, str](), 0
    for seed in seeds:
        with TemporaryDirectory(dir=IN_MEMORY, ignore_cleanup_errors=True) as directory:
            try:
                on += run(seed, Path(directory) / "pump.json")
            except Exception as error:
                failed[seed] = f"{type(error).__name__}: {error}"
    assert not failed, f"seeds that failed: {failed}"
    assert on > 5 * len(seeds)


# --- the outlet valve -----------------------------------------------------------------------------

VALVE_SITE = replace(
    read_site(CONFIG / "site_valve.yaml"), tau=1.0, wet_after=0.01, valve_travel_time=5.0,
    valve_moves_per_hour=120.0,
)
# Of the simulated valve, and of its relay (s).
TRAVEL_S, TIMER_S = 3.0, 5.0
PAUSE_S, WET_S = 7200.0 / 120.0, 36.0
MAX_RUN_S, MAX_DAY_M3 = 100.0, 0.15
VALVE_AGE = {"command": 3.0, "cistern_level": 5.0, "frost": 10.0, "rain": 10.0, "opened": 10.0,
             "closed": 10.0}
# Time after which a valve that does not close must have latched its fault (s): the travel time.
NOTICED_S = 5.0 + 3.0


class Valve:
    """A valve on a relay, which drains a cistern, with the faults of both.

    Attributes:
        on: whether the relay is on.
        position: share to which the valve is open.
        lost_for: for how long the relay has not been reached (s); negative if it is reached.
        fault: the fault of the valve; empty for none.
        released: volume released without a fault of the valve (m3).
    """

    def __init__(self, volume: float) -> None:
        self.on, self.position, self.lost_for, self.fault = False, 0.0, -1.0, ""
        self._p, self.state = plant_parameters(VALVE_SITE), State(volume, 0.0, 0.0)
        self.released = 0.0

    def step(self, wanted: bool, rain: float) -> None:
        """Advance by a second; without a renewal the relay switches off."""
        self.on = wanted if self.lost_for < 0 else self.on and self.lost_for < TIMER_S
        self.lost_for += self.lost_for >= 0
        if self.fault != ("stuck_closed" if self.on else "stuck_open"):
            change = (1.0 if self.on else -1.0) / TRAVEL_S
            self.position = min(1.0, max(0.0, self.position + change))
        opening = max(self.position, 0.05 * (self.fault == "leak"))
        self.state, flows = step(self._p, self.state, rain, 0.0, 0.0, opening, 0.0)
        self.released += flows.low_outlet * (not self.fault)

    def readings(self, rain: float, rng: random.Random) -> dict[str, float]:
        """Return the true values of the node's inputs."""
        is_open = self.position > 0.99 or self.fault == "wrong_switch"
        return {
            "command": rng.random() < 0.9, "cistern_level": self.state.cistern / VALVE_SITE.a1,
            "frost": float(rng.random() < 0.003), "rain": rain, "opened": float(is_open),
            "closed": float(self.position < 0.01),
        }


def run_valve(seed: int, file: Path) -> int:
    """Run for some minutes; return for how many seconds the valve was to be open."""
    rng = random.Random(seed)
    has_switches = rng.random() < 0.7
    settings = ValveSettings(**{
        **{each.name: each.default for each in valve_parameters(VALVE_SITE)},
        "has_switches": has_switches, "max_run": MAX_RUN_S, "max_volume_per_day": MAX_DAY_M3,
    })
    valve, state_file, now = Valve(rng.uniform(4.0, 9.0)), StateFile(file), 1000.0
    control = ValveControl(VALVE_SITE, settings, state_file, TIMER_S)
    names = [name for name in VALVE_AGE if has_switches or name not in ("opened", "closed")]
    level = LevelRule(cistern_bounds(VALVE_SITE), 0.01, 0.02)
    rules = {
        name: InputRules(now, VALVE_AGE[name], 2.0, level=level if "level" in name else None)
        for name in names
    }
    came_at, faults = dict.fromkeys(rules, -math.inf), dict[str, str]()
    held, latched, rain, dry_for, open_for, opened_at = False, "", 0.0, 0.0, 0.0, -math.inf
    on, stuck_for, dt, wrong_at, unseen_for = 0, 0.0, 0.0, -math.inf, 0.0
    for _ in range(600):
        match rng.randrange(60):
            case 0 | 1:
                faults[rng.choice(names)] = rng.choice(INPUT)
            case 2 | 3 | 4:
                faults.clear()
            case 5:
                valve.lost_for = 0.0
            case 6 | 7:
                valve.lost_for = -1.0
            case 8:
                state_file.hold("the page")
                held = True
            case 9 | 10:
                state_file.release()
                held = False
            case 11:
                valve.fault = rng.choice(("stuck_open", "stuck_closed", "leak", "wrong_switch"))
            case 12 | 13 | 14:
                valve.fault = ""
            case 15 | 16 | 17:
                state_file.change(fault="", fault_code="")
                control.discard_evidence()
                latched, stuck_for = "", 0.0
            case 18:
                rain = rng.choice((0.0, 5e-3 / 3600))
            case 19 | 20 | 21:
                rain = 0.0
            case 22:
                control.opened_by = "the page"
                control.open_for = rng.choice((1e4, 0.0))
            case 23:  # a suspend, in which the relay switches off
                for _ in range(60):
                    valve.lost_for = max(valve.lost_for, TIMER_S)
                    valve.step(False, rain)
                now, unseen_for, open_for = now + 60.0, unseen_for + 60.0, 0.0
                assert control.step(60.0, ValveObservation()).request is None
                valve.lost_for = -1.0
            case 24:  # a restart
                assert state_file.close() == ""
                state_file = StateFile(file)
                control = ValveControl(VALVE_SITE, settings, state_file, TIMER_S)
                open_for = unseen_for = 0.0
        true, observed, must_not = valve.readings(rain, rng), dict[str, Any](), list[str]()
        for name, rule in rules.items():
            fault, value = faults.get(name, ""), float(true[name])
            if fault == "jump" and name == "cistern_level":
                value += rng.choice((-0.3, 0.3, 60.0))
            if fault != "silent" and (fault != "late" or now % 7 == 0):
                rule.receive(now, value, REFUSED if fault == "nan" else None)
                came_at[name] = now
            bad = rule.check(now, "has 2 publishers" if fault == "two publishers" else "")
            observed[name] = None if bad else value
            spoilt = fault in ("nan", "two publishers") or abs(value - true[name]) > 1.0
            if (spoilt or now - came_at[name] > VALVE_AGE[name]) and (
                name != "command" or not control.open_for
            ):
                must_not.append(name)
        seen = observed["rain"]
        unseen_for += dt
        if unseen_for > 180.0 or seen is not None:
            dry_for = dry_for + dt if seen == 0 and unseen_for <= 180.0 else 0.0
        unseen_for = unseen_for if seen is None else 0.0
        lost = valve.lost_for >= 2.0
        for name, reason in {
            "held": held, latched: bool(latched), "lost": lost, "frost": observed["frost"],
            "wet": dry_for < WET_S, "too long": open_for > MAX_RUN_S + 1,
            "too much": valve.released > MAX_DAY_M3 + 0.01,
        }.items():
            must_not += [name] * bool(reason)
        fit = {faults.get(name, "") for name in ("opened", "closed")} <= {""}
        wrong_at = now if valve.fault or not fit else wrong_at
        decision = control.step(dt, ValveObservation(
            **observed, pumped=0.0, on=None if lost else valve.on, reasons=[LOST] * lost,
        ))
        opens = decision.request is not None
        assert not opens or not must_not, must_not
        assert not opens or open_for or now - opened_at >= PAUSE_S, "it opens again too soon"
        assert not (has_switches and fit and decision.at_rest and valve.position > 0.01)
        assert ("hold" in decision.active) == held
        assert decision.state == "fault" or not latched
        before, latched = latched, state_file.state.fault_code
        assert before or not latched or now - wrong_at < 60.0, f"{latched} without a reason"
        stands = not opens and fit and valve.position > 0.01 and valve.fault == "stuck_open"
        stuck_for = stuck_for + 1.0 if stands and has_switches and not lost else 0.0
        assert stuck_for < NOTICED_S + 10.0 or latched, "a valve stuck open is not noticed"
        opened_at = now if opens and not open_for else opened_at
        open_for = open_for + 1.0 if opens else 0.0
        on += opens
        valve.step(opens, rain)
        now, dt = now + 1.0, 1.0
    assert state_file.close() == ""
    return on


def test_the_valve_is_never_open_when_it_must_not() -> None:
    """Not on an unfit input, in frost or wet weather, held, latched, too long, or too often."""
    seeds, failed, on = range(int(os.environ.get("FAULTS_SEEDS", "500"))), dict[int, str](), 0
    for seed in seeds:
        with TemporaryDirectory(dir=IN_MEMORY, ignore_cleanup_errors=True) as directory:
            try:
                on += run_valve(seed, Path(directory) / "valve.json")
            except Exception as error:
                failed[seed] = f"{type(error).__name__}: {error}"
    assert not failed, f"seeds that failed: {failed}"
    assert on > 5 * len(seeds)
