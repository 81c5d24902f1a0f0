"""What is done in a case: begun, and ended again."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import datetime, timedelta, timezone

from cases import Case
from graphs import Process, own_domain
from line import OFF_S, ON_S
from players import HOSTILE, HUGE
from rig import (
    FullDiskRig,
    GaugedRig,
    PlayedRig,
    PumpRig,
    RelayedRig,
    Rig,
    Simulator,
    SiteRig,
    pump_node,
    wait,
    write_forecast,
)
from truth import STANDS

from greenroof_ros.common.interface import read_topics
from greenroof_ros.simulators.faults import DEFAULT

Undo = Callable[[], None]
_SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM}
PLAYED_RIGS = (PlayedRig, PumpRig, GaugedRig)
_PUBLISHED_RIGS = (*PLAYED_RIGS, RelayedRig)
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
    if case.fault == "kill both":
        for name in ("pump", "bringup"):
            os.kill(rig.pids()[name], signal.SIGKILL)
        return nothing
    if case.fault == "power cycle, then kill":
        rig.truth.inject_drive("power_cycle")
        rig.drive.powered_at = time.monotonic()
        wait(lambda: rig.truth.speed <= STANDS, 10, "a drive that loses power")
        wait(rig.runs, 90, "a pump that runs again")
        rig.main.process.kill()
        return nothing
    if case.fault == "drive":
        return _drive(rig, case)
    if case.fault == "sensor line":
        tank, _, fault = case.target.partition("_")
        rig.lines[tank].inject(fault)
        return lambda: rig.lines[tank].inject("none")
    if case.fault == "full disk":
        assert isinstance(rig, FullDiskRig)
        rig.fill()
        return rig.free
    if case.fault == "stuck for ever":
        return nothing  # it says the same from the start on
    if case.fault in ("sensor", "site"):
        rig.truth.inject_site(case.target, DEFAULT if case.parameter is None else case.parameter)
        return lambda: rig.truth.inject_site("none")
    if case.fault == "forecast file":
        return _forecast(rig, case)
    if case.fault == "dry":
        assert isinstance(rig, SiteRig)
        wait(lambda: rig.levels()[0] <= rig.dry_level, 90, "an empty cistern")
        return nothing
    if case.fault in ("intruder", "10000 hostile") and case.target not in _played(rig):
        return _intruder(rig, case, rng)
    if case.fault == "10000 hostile":
        assert isinstance(rig, PLAYED_RIGS)
        rig.players.burst(case.target, 10_000, rng)
        return nothing
    if case.fault.startswith("second"):
        return _second(rig, case)
    assert isinstance(rig, _PUBLISHED_RIGS)
    rig.players.set(case.target, case.fault, rng)
    return lambda: rig.players.set(case.target, "ok", rng)


def _played(rig: Rig) -> set[str]:
    return rig.players.topics if isinstance(rig, PLAYED_RIGS) else set()


def _process(rig: Rig, case: Case, rng: random.Random) -> Undo:
    if case.target.endswith("_simulator"):
        simulator = getattr(rig, case.target.replace("drive_simulator", "drive"))
        assert isinstance(simulator, Simulator)
        undo = signal_process(simulator.process.process.pid, case.fault, rng)
        if case.fault != "kill":
            return undo

        def again() -> None:
            simulator.process.process.wait()
            water = isinstance(rig, SiteRig) and case.target == "site_simulator"
            simulator.start(*(rig.water() if water else ()))

        return again
    pids = rig.pids()
    name = case.target if case.target in pids else "controller"
    wait(lambda: name in rig.pids(), 15, f"no {case.target}")
    return signal_process(rig.pids()[name], case.fault, rng)


def _come_and_go(rig: Rig) -> Undo:
    """Have the drive silent for some time, again and again."""
    ended = threading.Event()

    def work() -> None:
        while not ended.wait(ON_S):
            rig.truth.inject_drive("silence")
            ended.wait(OFF_S)
            rig.truth.inject_drive("none")

    thread = threading.Thread(target=work, daemon=True)
    thread.start()

    def end() -> None:
        ended.set()
        thread.join()

    return end


def _drive(rig: Rig, case: Case) -> Undo:
    if case.target == "intermittent":
        return _come_and_go(rig)
    if case.target == "local":
        rig.truth.take_over(True)
        return lambda: rig.truth.take_over(False)
    if case.target.startswith("runs_on"):
        line = rig.lines["drive"] if case.target == "runs_on, breaks" else None
        rig.truth.inject_drive("runs_on")
        if line is not None:
            line.inject("breaks")
        rig.watcher.hold(True)

        def release() -> None:
            rig.truth.inject_drive("none")
            if line is not None:
                line.inject("none")
            rig.watcher.hold(False)

        return release
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
    if case.target == "power_cycle":
        rig.drive.powered_at = time.monotonic()
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
    with ExitStack() as stack:
        elsewhere = case.target == "in another domain"
        domain = stack.enter_context(own_domain()) if elsewhere else rig.domain
        if case.fault == "second controller":
            topic = "/pump/command"
            second_node = Process(
                domain, "nodes.controller", "--controller", "mpc", "--ros-args", "-p",
                "live:=true", cwd=rig.directory,
            )
        else:
            topic = "/pump/flow"
            second_node = pump_node(rig, domain=domain)
        stack.callback(_end_of(second_node))
        rig.others.append(second_node)
        wait(
            lambda: rig.watcher.publishers(topic) > 1 or second_node.process.poll() is not None
            or (elsewhere and second_node.stderr()), 30, "no second node",
        )
        return stack.pop_all().close


def _end_of(process: Process) -> Undo:
    """Return what ends a process."""

    def end() -> None:
        process.process.terminate()
        process.process.wait(15)

    return end
