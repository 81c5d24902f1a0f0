"""A batch of cases of one kind of rig, each with its line in the results."""

from __future__ import annotations

import contextlib
import json
import random
import time
from collections.abc import Iterator
from pathlib import Path

import readers
import simulated
from cases import Case, all_cases
from graphs import own_domain
from live import Outcome, run_case
from rig import RIGS, BrokenError, Rig, SkippedError


def work(ids: Path, directory: Path, results: Path, seed: int) -> None:
    """Do the cases that a file lists, in a directory of their own.

    Args:
        ids: a JSON list of the cases' ids, all of one rig.
        directory: for what they leave.
        results: file of lines of JSON, to which each result is added.
        seed: of all that is random.
    """
    known = {case.id: case for case in all_cases()}
    cases = [known[one] for one in json.loads(ids.read_text())]
    kind, _, drive = cases[0].rig.partition(":")
    if kind == "simulated":
        done = _simulations(cases, directory, seed)
    elif kind == "readers":
        done = readers.run_cases(cases, directory, seed)
    else:
        done = _live(cases, directory, kind, drive, seed)
    began = time.monotonic()
    for case, outcome in done:
        line = {
            "id": case.id, "way": case.way, "fault": case.fault, "target": case.target,
            "seed": seed, "to_safe": outcome.to_safe, "bound": outcome.bound,
            "lost": outcome.lost, "alarm": outcome.alarm, "recovery": outcome.recovery,
            "wrong": outcome.wrong, "wall_s": round(time.monotonic() - began, 1),
        }
        began = time.monotonic()
        with results.open("a") as stream:
            stream.write(json.dumps(line) + "\n")
        print(f"{'FAILED' if outcome.wrong else 'held':6} {case.id}"
              + (f": {outcome.wrong}" if outcome.wrong else ""), flush=True)


def _random(seed: int, case: Case) -> random.Random:
    return random.Random(f"{seed} {case.id}")


def _simulations(cases: list[Case], directory: Path, seed: int) -> Iterator[tuple[Case, Outcome]]:
    """Yield what came of each, which is a run of its own."""
    for number, case in enumerate(cases):
        with own_domain() as domain:
            yield case, simulated.run_case(
                case, directory / str(number), domain, _random(seed, case)
            )


def _live(
    cases: list[Case], directory: Path, kind: str, drive: str, seed: int
) -> Iterator[tuple[Case, Outcome]]:
    """Yield what came of each; a rig serves until a case ends it or breaks it."""
    rig: Rig | None = None
    with contextlib.ExitStack() as stack:
        for number, case in enumerate(cases):
            outcome = Outcome()
            try:
                if rig is None:
                    domain = stack.enter_context(own_domain())
                    rig = stack.enter_context(RIGS[kind](directory / str(number), domain, drive))
                run_case(rig, case, _random(seed, case), outcome)
            except BrokenError as error:
                outcome.fail(f"rig: {error}")
            except SkippedError as error:
                outcome.recovery = str(error)
            except Exception as error:  # whatever it is, the next case needs a new rig
                outcome.fail(f"{type(error).__name__}: {error}")
            last = case.expected.recovery in ("ends", "stays") or number == len(cases) - 1
            last |= case.fault == "full disk"
            if outcome.wrong or last:
                try:
                    stack.close()
                except Exception as error:
                    outcome.fail(f"at the end of the rig: {type(error).__name__}: {error}")
                for what in [] if rig is None else rig.ended_badly:
                    outcome.fail(f"at the end of the rig: {what}")
                rig = None
            yield case, outcome
