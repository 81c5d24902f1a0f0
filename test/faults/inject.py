"""What is done in a case: begun, and ended again."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime, timedelta, timezone

from cases import Case
from graphs import Process, environment
from players import HOSTILE, HUGE
from rig import PlayedRig, PumpRig, Rig, Simulator, SiteRig, wait, write_forecast

from greenroof_ros.common.interface import read_topics
from greenroof_ros.drives.faults import DEFAULT

Undo = Callable[[], None]
_SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM}
# Shorter than every limit, and longer than every one.
SHORT_S, LONG_S = (0.2, 0.6), 8.0


def nothing() -> None:
    """Undo nothing."""


def signal_process(pid: int, fault: str, rng: random.Random) -> Undo:
    """Kill, end or stop a process; a short stop is over when this returns."""
    if fault in _SIGNALS:
        os.kill(pid, _SIGNALS[fault])
        return nothing
    os.kill(pid, signal.SIGSTOP)
    if fault == "stop short":
        time.sleep(rng.uniform(*SHORT_S))
        os.kill(pid, signal.SIGCONT)
        return nothing

    def go_on() -> None:
        try:
            os.kill(pid, signal.SIGCONT)
        except ProcessLookupError:
            return  # it was killed meanwhile, as it should be

    return go_on


def begin(rig: Rig, case: Case, rng: random.Random) -> Undo:
    """Begin the fault of a case, and return what ends it."""
    if case.fault in ("kill", "term", "stop short", "stop long"):
        return _process(rig, case, rng)
    if case.fault == "drive":
        return _drive(rig, case)
    if case.fault in ("sensor", "site"):
        rig.truth.inject_site(case.target, DEFAULT if case.parameter is None else case.parameter)
        return lambda: rig.truth.inject_site("none")
    if case.fault == "forecast file":
        return _forecast(rig, case)
    if case.fault == "dry":
        assert isinstance(rig, SiteRig)
        wait(lambda: rig.cistern_level() < rig.site.suction_level, 90, "an empty cistern")
        return nothing
    if case.fault in ("intruder", "10000 hostile") and case.target not in _played(rig):
        return _intruder(rig, case, rng)
    if case.fault == "10000 hostile":
        assert isinstance(rig, (PlayedRig, PumpRig))
        rig.players.burst(case.target, 10_000, rng)
        return nothing
    if case.fault.startswith("second"):
        return _second(rig, case)
    assert isinstance(rig, (PlayedRig, PumpRig))
    rig.players.set(case.target, case.fault, rng)
    return lambda: rig.players.set(case.target, "ok", rng)


def _played(rig: Rig) -> set[str]:
    return rig.players.topics if isinstance(rig, (PlayedRig, PumpRig)) else set()


def _process(rig: Rig, case: Case, rng: random.Random) -> Undo:
    if case.target.endswith("_simulator"):
        simulator = getattr(rig, case.target.replace("drive_simulator", "drive"))
        assert isinstance(simulator, Simulator)
        undo = signal_process(simulator.process.process.pid, case.fault, rng)
        if case.fault != "kill":
            return undo

        def again() -> None:
            simulator.process.process.wait()
            simulator.start()

        return again
    pids = rig.pids()
    name = case.target if case.target in pids else "controller"
    wait(lambda: name in rig.pids(), 15, f"no {case.target}")
    return signal_process(rig.pids()[name], case.fault, rng)


def _drive(rig: Rig, case: Case) -> Undo:
    if case.target == "local":
        rig.truth.take_over(True)
        return lambda: rig.truth.take_over(False)
    if case.target == "timeout_off":
        # It is read with each new connection.
        rig.truth.inject_drive("timeout_off")
        rig.truth.inject_drive("dropped")
        time.sleep(1.0)
        rig.truth.inject_drive("none")

        def replace() -> None:
            rig.drive.end()
            rig.drive.start()

        return replace
    rig.truth.inject_drive(case.target)
    return lambda: rig.truth.inject_drive("none")


def _forecast(rig: Rig, case: Case) -> Undo:
    assert isinstance(rig, SiteRig)
    if case.target == "broken":
        write_forecast(rig.forecast, text="issued,time,precipitation [mm/h]\nnonsense,1,2\n")
    elif case.target == "missing":
        rig.forecast.unlink()
    else:
        write_forecast(rig.forecast, issued=datetime.now(timezone.utc) - timedelta(days=30))
    return lambda: write_forecast(rig.forecast)


def _intruder(rig: Rig, case: Case, rng: random.Random) -> Undo:
    topic = case.target
    kind = read_topics()[topic].type

    def value() -> object:
        if kind.endswith("MultiArray"):
            return [rng.choice(HOSTILE + HUGE) for _ in range(10)]
        if kind.endswith("Float64"):
            return rng.choice((*HOSTILE, *HUGE, 0.5, 1.0))
        if kind.endswith("String"):
            return "running: as an intruder likes it"
        return None

    count = 10_000 if case.fault == "10000 hostile" else 20
    rig.watcher.open(topic)
    time.sleep(0.3)
    for number in range(count):
        rig.watcher.publish_any(topic, value())
        if number % 500 == 499:
            time.sleep(rng.uniform(0.0, 0.05))
    return lambda: rig.watcher.withdraw(topic)


def _second(rig: Rig, case: Case) -> Undo:
    if case.fault == "second graph":
        second = Process(rig.domain, "bringup", "--hours", "1", cwd=rig.directory)
        code = second.wait(30)
        text = second.stderr()
        if code != 3 or "already" not in text:
            raise AssertionError(f"a second graph ended with exit code {code}: {text}")
        return nothing
    if case.fault == "second controller":
        command = ["-m", "greenroof_ros.nodes.controller", "--controller", "mpc", "--ros-args",
                   "-p", "live:=true"]
    else:
        command = ["-m", "greenroof_ros.nodes.pump", "--ros-args", "-p", "live:=true", "-p",
                   f"drive:={rig.drive_name}", "-p", f"address:={rig.drive_at}", "-p",
                   "autostart:=true", "-p", f"state_file:={rig.directory / 'second.json'}"]
    second_node = subprocess.Popen(
        [sys.executable, *command], cwd=rig.directory, env=environment(rig.domain),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    time.sleep(3.0)

    def end() -> None:
        second_node.terminate()
        second_node.wait(10)

    return end
