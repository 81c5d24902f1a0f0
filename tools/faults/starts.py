"""Start a live site, and kill one or all of its processes at a random moment.

``python -m pytest tools/faults/starts.py -n 4`` makes a hundred starts with a pump, or as many as
``STARTS`` says, each with a kill at a random moment of the start. The pump must stand within the
documented time after the kill, as in the fault campaign (`faults.bounds`), unless the killed
process came back in time. As many kills are of an open valve, which must be closed within the time
of its relay's auto-off.
"""

from __future__ import annotations

import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest
from faults.bounds import bounds
from faults.cases import DRIVES
from faults.rig import RIGS
from faults.valve import ValveRig
from graphs import Process, environment, reserved_domain

STARTS = int(os.environ.get("STARTS", "100"))
# A start takes about this long until the pump runs (s).
_START_S = 15.0
# How many kills of an open valve share a rig, and how long they wait at most (s).
_KILLS, _WAIT_S = 10, 6.0
# The bound of each process's end.
_BOUNDS = {"pump": "drive", "bringup": "drive", "controller": "command", "station": "level"}

os.environ |= environment(0)


@pytest.mark.parametrize("seed", range(STARTS))
def test_a_start(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    kind = rng.choice(["site", "relay"])
    drive = rng.choice(DRIVES) if kind == "site" else rng.choice(["tasmota", "shelly_gen2"])
    with reserved_domain() as domain, RIGS[kind](tmp_path, domain, drive) as rig:
        time.sleep(rng.uniform(0.0, _START_S))
        pids = rig.pids()
        names = [*pids] if rng.random() < 0.2 else [rng.choice([*pids])]
        ran, killed_at = rig.truth.runs(), time.monotonic()
        for name in names:
            with suppress(ProcessLookupError):
                os.kill(pids[name], signal.SIGKILL)
        bound = min(bounds(rig.site)[_BOUNDS[name]] for name in names)
        time.sleep(bound)
        stopped_at, back = rig.truth.stopped_at(killed_at), rig.pids()
        stopped_s = bound if stopped_at is None else stopped_at - killed_at
        print(f"{kind}:{drive}, {' and '.join(names)}, ran: {ran}, stood after {stopped_s:.1f} s")
        if "bringup" in names:
            since = time.monotonic()
            time.sleep(2.0)
            assert rig.truth.max_speed(since, time.monotonic()) == 0.0
        assert stopped_at is not None or back.get(names[0], pids[names[0]]) != pids[names[0]]
    Process.end_all()


@pytest.mark.parametrize("seed", range(STARTS // _KILLS))
def test_kills_of_an_open_valve(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    make = rng.choice(["tasmota", "shelly_gen2"])
    with reserved_domain() as domain, ValveRig(tmp_path, domain, make) as rig:
        for _ in range(_KILLS):
            rig.until_running()
            time.sleep(rng.uniform(0.0, _WAIT_S))
            pids, killed_at = rig.pids(), time.monotonic()
            names = [*pids] if rng.random() < 0.3 else ["valve"]
            for name in names:
                with suppress(ProcessLookupError):
                    os.kill(pids[name], signal.SIGKILL)
            bound = rig.bounds()["relay"]
            time.sleep(bound)
            closed_at = rig.truth.stopped_at(killed_at)
            closed_s = bound if closed_at is None else closed_at - killed_at
            which = "all processes" if len(names) > 1 else "the valve node"
            print(f"KILL {make}, {which}: closed after {closed_s:.2f} of {bound:.1f} s")
            assert closed_at is not None and closed_s <= bound
            if len(names) > 1:
                rig.main.process.wait(20)
                rig.main = rig.bring_up()
        rig.watcher.stop(False)
    Process.end_all()
