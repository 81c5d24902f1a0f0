"""The campaign of seeded faults, ``make faults``: each case is a parameter of pytest.

It has more than a thousand cases: each node and program killed, ended and stopped; every topic and
every Modbus exchange off, stuck, garbage, wrong, slow, delayed and intermittent; sensors, drives,
weather, intruders. A rig (a live site, a pump node alone, hardware in the loop, a simulation)
serves the cases of a pytest-xdist group until one ends or breaks it. Results are lines of JSON.
Cases that have a good result are skipped, except a case that is run alone.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from faults import readers, service, simulated
from faults.cases import Case, all_cases
from faults.live import Outcome, Rigs, run_case
from faults.table import read_results
from graphs import Process, environment, reserved_domain

# Seed of everything random; then the directory of the results and of the rigs' files.
SEED = int(os.environ.get("FAULTS_SEED", "1"))
RESULTS = Path(os.environ.get("FAULTS_RESULTS", "runs/faults")).resolve()
# Most cases that share a rig, because it accumulates state.
_SHARE = 40

os.environ |= environment(0)
DONE = read_results(RESULTS)


def in_order(cases: list[Case]) -> list[Case]:
    """Return the cases in the order in which they are done.

    They are shuffled, because a node that is soon killed again waits longer for its next start.
    Cases that stop the pump follow those that do not, which need a pump that has run for a while.
    Cases that end a rig come last, so that the others share one.
    """
    random.Random(SEED).shuffle(cases)
    return sorted(cases, key=lambda case: (
        case.rig, case.expected.recovery == "ends", case.expected.stops is not False
    ))


class Bench:
    """Does one case after the other; consecutive cases use the same rig."""

    def __init__(self) -> None:
        RESULTS.mkdir(parents=True, exist_ok=True)
        self._place = Path(tempfile.mkdtemp(prefix="rigs-", dir=RESULTS))
        self._rigs = Rigs(self._place)
        self._of, self._served = "", 0
        self._read: dict[Case, Outcome] = {}
        self._last: dict[str, Any] = {}
        self._failed = False
        self._ended_badly: list[str] = []

    def do(self, case: Case) -> Outcome:
        """Do a case, and write its outcome."""
        if case.rig != self._of or self._served == _SHARE:
            self.end_rig()
            self._of, self._served = case.rig, 0
        self._served += 1
        began, rng = time.monotonic(), random.Random(f"{SEED} {case.id}")
        place = self._place / str(sum(1 for _ in self._place.iterdir()))
        outcome = Outcome()
        if case.rig == "simulated":
            with reserved_domain() as domain:
                outcome = simulated.run_case(case, place, domain, rng)
        elif case.rig == "readers":
            if case not in self._read:
                block = [other for other in all_cases()
                         if (other.rig, other.number) == (case.rig, case.number)]
                self._read |= dict(readers.run_cases(block, place, SEED))
            outcome = self._read[case]
        elif case.rig == "service":
            service.run_case(case, place, outcome)
        else:
            self._rigs.do(case, outcome, lambda rig: run_case(rig, case, rng, outcome))
        self._last = {
            "id": case.id, "way": case.way, "fault": case.fault, "target": case.target,
            "seed": SEED, **vars(outcome), "wall_s": round(time.monotonic() - began, 1),
        }
        self._write()
        return outcome

    def _write(self) -> None:
        self._failed |= bool(self._last["wrong"])
        with (RESULTS / "results.jsonl").open("a") as stream:
            stream.write(json.dumps(self._last) + "\n")

    def end_rig(self) -> None:
        """End the rig; anything wrong with that is added to its last case."""
        wrong = self._rigs.end()
        if wrong:
            self._last["wrong"] = "; ".join(filter(None, (self._last["wrong"], wrong)))
            self._write()
            self._ended_badly.append(f"{self._last['id']}: {wrong}")

    def end(self) -> None:
        """End what is left; fail if a rig ended badly after its last case."""
        self.end_rig()
        Process.end_all()
        if not self._failed:
            shutil.rmtree(self._place, ignore_errors=True)
        assert not self._ended_badly, self._ended_badly


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.end()


@pytest.mark.parametrize("case", [
    # Simulations and foreign readers keep the processors busy, so they form one group.
    pytest.param(case, id=case.id, marks=pytest.mark.xdist_group(
        case.rig if ":" in case.rig else "busy"))
    for case in in_order(all_cases())
])
def test_case(bench: Bench, case: Case, request: pytest.FixtureRequest) -> None:
    done = DONE.get(case.id)
    if done is not None and not done["wrong"] and len(request.session.items) > 1:
        pytest.skip("done before")
    wrong = bench.do(case).wrong
    if wrong:
        pytest.fail(wrong, pytrace=False)
