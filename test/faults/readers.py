"""Four foreign readers of /roof/level stopped for 6.5 s and continued, in all three ways at once.

Over shared memory this froze nodes that had nothing to do with them: no run may end, no pump stop,
and not one byte of the simulation's bag may change.
"""

from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from cases import Case
from graphs import Process, bag_file, environment, own_domain
from live import Outcome
from rig import BrokenError, LoopRig, Rig, SiteRig
from simulated import digest

from greenroof_ros.recording.bag_reader import count_ticks

READERS, STOPPED_S = 4, 6.5
_PAUSE_S = (0.3, 1.2)
# Simulated per wall time, so that the run lasts for all stops.
_SPEED = 20.0
_LEAST_SPEED = 0.05


class _Readers:
    def __init__(self, domain: int, directory: Path) -> None:
        environ = environment(domain)
        self._processes = [
            subprocess.Popen(
                [sys.executable, str(Path(__file__).with_name("reader.py"))], env=environ,
                cwd=directory, start_new_session=True,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
            for _ in range(READERS)
        ]

    def signal(self, number: signal.Signals) -> None:
        for process in self._processes:
            process.send_signal(number)

    def end(self) -> None:
        self.signal(signal.SIGCONT)
        self.signal(signal.SIGTERM)
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(5)
            process.kill()
            process.wait()


def run_cases(cases: list[Case], directory: Path, seed: int) -> Iterator[tuple[Case, Outcome]]:
    """Do all stops of a batch with the same three graphs, and yield what came of each."""
    directory.mkdir(parents=True, exist_ok=True)
    rounds = sorted({case.number for case in cases})
    rng = random.Random(f"{seed} {cases[0].id}")
    outcomes = {case: Outcome(recovery="ran on") for case in cases}
    hours = (len(rounds) + 4) * (STOPPED_S + _PAUSE_S[1]) * _SPEED / 3600
    with contextlib.ExitStack() as stack:
        domains = [stack.enter_context(own_domain()) for _ in range(3)]
        place = directory / "simulated"
        place.mkdir()
        simulation = Process(
            domains[0], "bringup", "--controller", "onoff", "--hours", f"{hours:.2f}", "--speed",
            f"{_SPEED:g}", "--output", "run", cwd=place,
        )
        rigs: dict[str, Rig] = {
            "loop": LoopRig(directory / "loop", domains[1], "danfoss_fc202"),
            "live": SiteRig(directory / "live", domains[2], "danfoss_fc202"),
        }
        readers = [
            _Readers(domain, where)
            for domain, where in zip(
                domains, (place, directory / "loop", directory / "live"), strict=True
            )
        ]
        try:
            for rig in rigs.values():
                rig.until_running(steady_s=6.0)
            simulation.wait_for_ticks(1000)
            for number in rounds:
                began = time.monotonic()
                time.sleep(rng.uniform(*_PAUSE_S))
                for each in readers:
                    each.signal(signal.SIGSTOP)
                time.sleep(STOPPED_S)
                for each in readers:
                    each.signal(signal.SIGCONT)
                for case, outcome in outcomes.items():
                    if case.number == number:
                        _look(case, outcome, rigs, simulation, began)
        except BrokenError as error:
            for outcome in outcomes.values():
                outcome.fail(f"rig: {error}")
        finally:
            for each in readers:
                each.end()
            for rig in rigs.values():
                rig.__exit__()
        _compare(simulation, domains[0], directory, hours, outcomes)
    for case, outcome in outcomes.items():
        for what in (rigs[case.target].ended_badly if case.target in rigs else []):
            outcome.fail(f"at the end of the rig: {what}")
        yield case, outcome


def _look(
    case: Case, outcome: Outcome, rigs: dict[str, Rig], simulation: Process, began: float
) -> None:
    if case.target == "simulated":
        if simulation.process.poll() is not None:
            outcome.fail(f"the run ended: {simulation.stderr()[:400]}")
        return
    rig = rigs[case.target]
    if rig.main.process.poll() is not None:
        outcome.fail(f"the run ended: {rig.main.stderr()[-400:]}")
    elif rig.truth.least(began, time.monotonic()) < _LEAST_SPEED:
        said = [text for at, _, text in rig.watcher.said if at >= began]
        outcome.fail(f"the pump stopped: {said[:8]}")
        rig.until_running(steady_s=6.0)


def _compare(
    simulation: Process, domain: int, directory: Path, hours: float,
    outcomes: dict[Case, Outcome],
) -> None:
    """Compare the bag of the simulation with that of an undisturbed run as fast as it goes."""
    place = directory / "undisturbed"
    place.mkdir()
    wrong = ""
    code = simulation.process.wait(600)
    if code != 0:
        wrong = f"the run ended with exit code {code}: {simulation.stderr()[:400]}"
    else:
        run = Process(
            domain, "bringup", "--controller", "onoff", "--hours", f"{hours:.2f}", "--output",
            "run", cwd=place,
        )
        if run.process.wait(300) != 0:
            wrong = f"the undisturbed run failed: {run.stderr()[:300]}"
        elif digest(bag_file(place / "run")) != digest(bag_file(directory / "simulated" / "run")):
            wrong = "the bag is not that of an undisturbed run"
    for case, outcome in outcomes.items():
        if case.target == "simulated":
            outcome.lost = 0.0
            outcome.recovery = "ran on, every byte as undisturbed"
            if wrong:
                outcome.fail(wrong)
        elif case.target == "loop" and not count_ticks(directory / "loop" / "run" / "bag"):
            outcome.fail("the bag holds no ticks")

