"""The campaign of seeded faults, ``make faults``: each case is a parameter of pytest.

Each node and program is killed, ended and stopped; every topic and every Modbus exchange is off,
stuck, garbage, wrong, slow, delayed and intermittent; and so are sensors, drives, weather, and
intruders. A rig (a live site, or a pump node alone) serves the cases of a pytest-xdist group until
one ends or breaks it. Results are lines of JSON. Cases that have a good result are skipped, except
a case that is run alone.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from faults.cases import Case, all_cases
from faults.live import Outcome, run_case
from faults.rig import RIGS, BrokenError, Rig
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
    """Does one case after the other; consecutive cases use the same rig, unless it broke."""

    def __init__(self) -> None:
        RESULTS.mkdir(parents=True, exist_ok=True)
        self._place = Path(tempfile.mkdtemp(prefix="rigs-", dir=RESULTS))
        self._stack = ExitStack()
        self._rig: Rig | None = None
        self._of, self._served, self._failed = "", 0, False

    def do(self, case: Case) -> Outcome:
        """Do a case, and write its outcome."""
        began, outcome = time.monotonic(), Outcome()
        if case.rig != self._of or self._served == _SHARE:
            outcome.fail(self.end_rig())
        try:
            if self._rig is None:
                self._rig = self._new_rig(case)
            self._served += 1
            run_case(self._rig, case, random.Random(f"{SEED} {case.id}"), outcome)
        except BrokenError as error:
            outcome.fail(f"rig: {error}")
        except Exception as error:  # for any error, the next case needs a new rig
            outcome.fail(f"{type(error).__name__}: {error}")
        ends = case.expected.recovery in ("ends", "stays") or case.fault == "full disk"
        if outcome.wrong or ends:
            outcome.fail(self.end_rig())
        self._failed |= bool(outcome.wrong)
        with (RESULTS / "results.jsonl").open("a") as stream:
            stream.write(json.dumps({
                "id": case.id, "fault": case.fault, "target": case.target, "seed": SEED,
                **vars(outcome), "wall_s": round(time.monotonic() - began, 1),
            }) + "\n")
        return outcome

    def _new_rig(self, case: Case) -> Rig:
        self._of, self._served = case.rig, 0
        domain = self._stack.enter_context(reserved_domain())
        kind, _, drive = case.rig.partition(":")
        place = self._place / str(sum(1 for _ in self._place.iterdir()))
        return self._stack.enter_context(RIGS[kind](place, domain, drive))

    def end_rig(self) -> str:
        """End the rig, and return what is wrong with how it ended."""
        rig, self._rig = self._rig, None
        wrong = []
        try:
            self._stack.close()
        except Exception as error:
            wrong.append(f"{type(error).__name__}: {error}")
        wrong += [] if rig is None else rig.ended_badly
        return "; ".join(f"at the end of a rig: {what}" for what in wrong)

    def end(self) -> None:
        """End what is left; fail if the last rig ended badly."""
        wrong = self.end_rig()
        Process.end_all()
        if not self._failed:
            shutil.rmtree(self._place, ignore_errors=True)
        assert not wrong, wrong


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.end()


@pytest.mark.parametrize("case", [
    pytest.param(case, id=case.id, marks=pytest.mark.xdist_group(f"{case.rig} {number // _SHARE}"))
    for number, case in enumerate(in_order(all_cases()))
])
def test_case(bench: Bench, case: Case, request: pytest.FixtureRequest) -> None:
    done = DONE.get(case.id)
    if done is not None and not done["wrong"] and len(request.session.items) > 1:
        pytest.skip("done before")
    wrong = bench.do(case).wrong
    if wrong:
        pytest.fail(wrong, pytrace=False)
