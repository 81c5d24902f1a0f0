"""Start a live site, and kill one or all of its processes at a random moment of the start.

``python -m pytest tools/faults/starts.py -n 4`` makes a hundred starts, or as many as
``STARTS`` says. The pump must stand within the documented time after the kill, as in
the fault campaign (`faults.bounds`), unless the killed process came back in time.
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
from graphs import Process, environment, reserved_domain

STARTS = int(os.environ.get("STARTS", "100"))
# A start takes about this long until the pump runs (s).
_START_S = 15.0
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
