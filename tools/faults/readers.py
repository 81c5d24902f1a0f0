"""Four foreign readers of /roof/level stopped for 6.5 s and continued, in all three ways at once.

With shared memory this froze unrelated nodes. No run may end, no pump may stop, and the
simulation's bag must not change in a single byte.
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

from faults.cases import ROUNDS, Case
from faults.live import Outcome
from faults.rig import BrokenError, LoopRig, Rig, SiteRig
from faults.simulated import digest, reference
from graphs import Process, bag_file, environment, reserved_domain

from greenroof_ros.common.processes import child_environment
from greenroof_ros.recording.bag_reader import count_ticks

READERS, STOPPED_S = 4, 6.5
# Pause before the readers are stopped again, and the longest time between their stops (s).
_PAUSE_S, _APART_S = (0.1, 0.5), 0.4
# Simulated per wall time, so that the run lasts for all stops.
_SPEED = 20.0
_MIN_SPEED = 0.05
# Like ``ros2 topic echo``: it uses only this package's rule for when to end, and the middleware's
# own settings, including shared memory.
_READER = """
import rclpy
from std_msgs.msg import Float64
from greenroof_ros.common.processes import end_with_parent
end_with_parent()
rclpy.init()
node = rclpy.create_node("reader", start_parameter_services=False)
node.create_subscription(Float64, "/roof/level", lambda message: None, 10)
rclpy.spin(node)
"""


class _Readers:
    """Four readers in each domain."""

    def __init__(self, domains: list[int], directory: Path) -> None:
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-c", _READER],
                env={**child_environment(), **environment(domain)}, cwd=directory,
                start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
            for domain in domains for _ in range(READERS)
        ]

    def stop_and_continue(self, rng: random.Random) -> None:
        """Stop each for `STOPPED_S`, at its own random time; for most of it all are stopped."""
        began = time.monotonic()
        moments = []
        for process in self._processes:
            at = began + rng.uniform(0.0, _APART_S)
            moments += [(at, process, signal.SIGSTOP), (at + STOPPED_S, process, signal.SIGCONT)]
        for at, process, number in sorted(moments, key=lambda moment: moment[0]):
            time.sleep(max(0.0, at - time.monotonic()))
            process.send_signal(number)
            if process.poll() is not None:
                raise BrokenError(f"a reader ended on its own: exit code {process.returncode}")

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
    """Do the three cases of a block, each in its own graph, and yield the outcome of each."""
    directory.mkdir(parents=True, exist_ok=True)
    rng = random.Random(f"{seed} {cases[0].number}")
    outcomes = {case: Outcome(recovery="ran on") for case in cases}
    round_s = STOPPED_S + _PAUSE_S[1] + _APART_S
    hours = f"{(ROUNDS * round_s + 30.0) * _SPEED / 3600:.2f}"
    with contextlib.ExitStack() as stack:
        domains = [stack.enter_context(reserved_domain()) for _ in range(3)]
        place = directory / "simulated"
        place.mkdir()
        rigs: dict[str, Rig] = {
            "loop": LoopRig(directory / "loop", domains[1], "danfoss_fc202"),
            "live": SiteRig(directory / "live", domains[2], "danfoss_fc202"),
        }
        readers = _Readers(domains, directory)
        simulation: Process | None = None
        try:
            for rig in rigs.values():
                rig.until_running(steady_s=6.0)
            simulation = Process(
                domains[0], "bringup", "--controller", "onoff", "--hours", hours,
                "--speed", f"{_SPEED:g}", "--output", "run", cwd=place,
            )
            simulation.wait_for_ticks(1000)
            for number in range(ROUNDS):
                began = time.monotonic()
                time.sleep(rng.uniform(*_PAUSE_S))
                readers.stop_and_continue(rng)
                for case, outcome in outcomes.items():
                    _check_round(case, outcome, rigs, simulation, began, number)
        except BrokenError as error:
            for outcome in outcomes.values():
                outcome.fail(f"rig: {error}")
        finally:
            readers.end()
            for rig in rigs.values():
                rig.__exit__()
        if simulation is not None:
            _compare(simulation, domains[0], directory, hours, outcomes)
    for case, outcome in outcomes.items():
        for what in (rigs[case.target].ended_badly if case.target in rigs else []):
            outcome.fail(f"at the end of the rig: {what}")
        yield case, outcome


def _check_round(
    case: Case, outcome: Outcome, rigs: dict[str, Rig], simulation: Process, began: float,
    number: int,
) -> None:
    """Check after a round that it had no effect."""
    if case.target == "simulated":
        if simulation.process.poll() is not None and not outcome.wrong:
            outcome.fail(f"the run ended in round {number}: {simulation.stderr()[:400]}")
        return
    rig = rigs[case.target]
    if rig.main.process.poll() is not None:
        raise BrokenError(f"{case.target} ended in round {number}: {rig.main.stderr()[-400:]}")
    if rig.truth.minimum(began, time.monotonic()) < _MIN_SPEED:
        texts = [text for at, _, text in rig.watcher.texts if at >= began]
        outcome.fail(f"the pump stopped in round {number}: {texts[:8]}")
        rig.until_running(steady_s=6.0)


def _compare(
    simulation: Process, domain: int, directory: Path, hours: str,
    outcomes: dict[Case, Outcome],
) -> None:
    """Compare the simulation's bag with the bag of an undisturbed run at full speed."""
    wrong = ""
    code = simulation.process.wait(600)
    if code != 0:
        wrong = f"the run ended with exit code {code}: {simulation.stderr()[:400]}"
    elif digest(bag_file(directory / "simulated" / "run")) != digest(
        bag_file(reference(directory, domain, hours))
    ):
        wrong = "the bag differs from an undisturbed run's"
    for case, outcome in outcomes.items():
        if case.target == "simulated":
            outcome.lost = 0.0
            outcome.recovery += ", every byte as undisturbed"
            if wrong:
                outcome.fail(wrong)
        elif case.target == "loop" and not count_ticks(directory / "loop" / "run" / "bag"):
            outcome.fail("the bag holds no ticks")

