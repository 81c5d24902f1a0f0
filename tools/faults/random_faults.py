"""Random faults against the pump's control: whatever happens, it never runs when it must not.

``python -m pytest tools/faults/random_faults.py`` tries 2,000 seeds, or as many as
``FAULTS_SEEDS`` says, in one process and on a clock of its own.
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
from greenroof_ros.physics.pump import STANDSTILL

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
    assert on > 10 * len(seeds)
