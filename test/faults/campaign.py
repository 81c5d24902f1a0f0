"""Each case of the campaign as a parameter of pytest; ``python test/faults`` says which.

A rig serves for the cases of a group of pytest-xdist, until one ends or breaks it. Simulations and
foreign readers keep the processors busy: each kind is one group.
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
from typing import Any

import pytest
import readers
import simulated
from cases import Case, all_cases
from graphs import Process, own_domain
from live import Outcome, run_case
from rig import RIGS, BrokenError, Rig, SkippedError

PLAN = json.loads(Path(os.environ["GREENROOF_ROS_FAULTS"]).read_text())
SEED, RESULTS = PLAN["seed"], Path(PLAN["results"])
KNOWN = {case.id: case for case in all_cases()}
# So many cases share a rig: what it gathers ends with it.
_GROUP = 40


def groups() -> dict[str, list[Case]]:
    """Return the cases of each group in the order in which they are done."""
    by_rig: dict[str, list[Case]] = {}
    for name in PLAN["cases"]:
        by_rig.setdefault(KNOWN[name].rig, []).append(KNOWN[name])
    found = {kind: by_rig.pop(kind) for kind in ("readers", "simulated") if kind in by_rig}
    for rig, those in by_rig.items():
        # A node that is killed again soon waits longer for its next start.
        random.Random(SEED).shuffle(those)
        for at in range(0, len(those), _GROUP):
            # What stops nothing begins when the pump has run for a while, so the next can follow at
            # once; what ends a rig comes last, so that the others share one.
            found[f"{rig} {at // _GROUP}"] = sorted(those[at:at + _GROUP], key=lambda case: (
                case.expected.recovery == "ends", case.expected.stops is not False
            ))
    return found


class Bench:
    """Does the cases of a group, one after the other."""

    def __init__(self) -> None:
        self.place = Path(tempfile.mkdtemp(prefix="group-", dir=RESULTS))
        self._stack = ExitStack()
        self._rig: Rig | None = None
        self._read: dict[Case, Outcome] = {}
        self._last: dict[str, Any] = {}
        self._failed = False

    def do(self, case: Case) -> Outcome:
        """Do a case, and write down what came of it."""
        began, rng = time.monotonic(), random.Random(f"{SEED} {case.id}")
        place = self.place / str(sum(1 for _ in self.place.iterdir()))
        if case.rig == "simulated":
            with own_domain() as domain:
                outcome = simulated.run_case(case, place, domain, rng)
        elif case.rig == "readers":
            if case not in self._read:
                block = [one for one in KNOWN.values()
                         if (one.rig, one.number) == ("readers", case.number)]
                self._read |= dict(readers.run_cases(block, place, SEED))
            outcome = self._read[case]
        else:
            outcome = Outcome()
            self._do_to_a_rig(case, place, rng, outcome)
        self._last = {
            "id": case.id, "way": case.way, "fault": case.fault, "target": case.target,
            "seed": SEED, "to_safe": outcome.to_safe, "bound": outcome.bound,
            "lost": outcome.lost, "alarm": outcome.alarm, "recovery": outcome.recovery,
            "wrong": outcome.wrong, "wall_s": round(time.monotonic() - began, 1),
        }
        self._write()
        return outcome

    def _do_to_a_rig(
        self, case: Case, place: Path, rng: random.Random, outcome: Outcome
    ) -> None:
        try:
            if self._rig is None:
                domain = self._stack.enter_context(own_domain())
                kind, _, drive = case.rig.partition(":")
                self._rig = self._stack.enter_context(RIGS[kind](place, domain, drive))
            run_case(self._rig, case, rng, outcome)
        except BrokenError as error:
            outcome.fail(f"rig: {error}")
        except SkippedError as error:
            outcome.recovery = str(error)
        except Exception as error:  # whatever it is, the next case needs a new rig
            outcome.fail(f"{type(error).__name__}: {error}")
        ends = case.expected.recovery in ("ends", "stays") or case.fault == "full disk"
        if outcome.wrong or ends:
            outcome.fail(self._close())

    def _close(self) -> str:
        """End the rig, and return what is wrong with how it ended."""
        wrong = []
        try:
            self._stack.close()
        except Exception as error:
            wrong.append(f"{type(error).__name__}: {error}")
        wrong += [] if self._rig is None else self._rig.ended_badly
        self._rig = None
        return "; ".join(f"at the end of the rig: {one}" for one in wrong)

    def _write(self) -> None:
        self._failed |= bool(self._last["wrong"])
        with (RESULTS / "results.jsonl").open("a") as stream:
            stream.write(json.dumps(self._last) + "\n")

    def end(self) -> None:
        """End what is left; what is wrong with that stands beside the last case."""
        wrong = self._close()
        if wrong:
            self._last["wrong"] = "; ".join(filter(None, (self._last["wrong"], wrong)))
            self._write()
        Process.end_all()
        if not self._failed:
            shutil.rmtree(self.place, ignore_errors=True)


@pytest.fixture
def nothing_left() -> None:
    """A rig outlives its cases: the same fixture of all other tests would end it."""


class Benches:
    """The bench of the group whose turn it is; a fixture with a parameter would end after each."""

    def __init__(self) -> None:
        self._group = ""
        self._bench: Bench | None = None

    def of(self, group: str) -> Bench:
        """Return the bench of a group, and end the one before."""
        if self._bench is None or group != self._group:
            self.end()
            self._group, self._bench = group, Bench()
        return self._bench

    def end(self) -> None:
        """End the bench; what is wrong with that is written down beside its last case."""
        if self._bench is not None:
            self._bench.end()


@pytest.fixture(scope="session")
def benches() -> Iterator[Benches]:
    benches = Benches()
    yield benches
    benches.end()


@pytest.mark.parametrize(("group", "case"), [
    pytest.param(group, case, id=case.id, marks=pytest.mark.xdist_group(group))
    for group, those in groups().items() for case in those
])
def test_case(benches: Benches, group: str, case: Case) -> None:
    outcome = benches.of(group).do(case)
    if outcome.wrong:
        pytest.fail(outcome.wrong, pytrace=False)
