"""The faults of the cases: how they begin and end."""

from __future__ import annotations

import json
import os
import random
import signal
import threading
import time
import zlib
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import timedelta
from pathlib import Path

from faults.cases import Case
from faults.players import HOSTILE, HUGE, OFF_S, ON_S, Players
from faults.rig import FullDiskRig, MqttRig, RelayRig, Rig, SiteRig, pump_node, wait
from faults.truth import AT_REST
from faults.watcher import Watcher
from graphs import Process, own_domain
from ros_rig import write_forecast

from greenroof_ros.common.command_line import EXIT_OCCUPIED
from greenroof_ros.common.interface import read_topics

_SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM}
# Shorter than every limit (s).
_SHORT_S = (0.2, 0.6)


def signal_process(pid: int, fault: str, rng: random.Random, undo: ExitStack) -> None:
    """Kill, end or stop a process; a short stop is over when this returns."""
    if fault in _SIGNALS:
        os.kill(pid, _SIGNALS[fault])
        return
    os.kill(pid, signal.SIGSTOP)
    if fault == "stop short":
        time.sleep(rng.uniform(*_SHORT_S))
        os.kill(pid, signal.SIGCONT)
        return
    undo.enter_context(suppress(ProcessLookupError))  # it may rightly have been killed meanwhile
    undo.callback(os.kill, pid, signal.SIGCONT)


def intrude(watcher: Watcher, topic: str, fault: str, rng: random.Random) -> None:
    """Publish nonsense on a topic on which other nodes publish too."""
    kind = read_topics()[topic].type

    def value() -> object:
        if kind.endswith("MultiArray"):
            return [rng.choice(HOSTILE + HUGE) for _ in range(10)]
        if kind.endswith("Float64"):
            return rng.choice((*HOSTILE, *HUGE, 0.5, 1.0))
        if kind.endswith("String"):
            return "running: as an intruder likes it"
        return None

    watcher.open(topic)
    time.sleep(0.3)
    for number in range(10_000 if fault == "10000 hostile" else 20):
        watcher.publish_any(topic, value())
        if number % 500 == 499:
            time.sleep(rng.uniform(0.0, 0.05))


def refuse_second_graph(domain: int, place: Path) -> None:
    """Check that a second bringup refuses to start."""
    second = Process(domain, "bringup", "--hours", "1", cwd=place)
    code = second.wait(30)
    assert code == EXIT_OCCUPIED, f"a second graph ended with exit code {code}: {second.stderr()}"


def begin(rig: Rig, case: Case, rng: random.Random, undo: ExitStack) -> None:
    """Begin the fault of a case, and add its end to a stack."""
    truth, players = rig.truth, rig.players
    match case.fault:
        case "kill" | "term" | "stop short" | "stop long":
            _process(rig, case, rng, undo)
        case "kill both":
            for name in ("pump", "bringup"):
                os.kill(rig.pids()[name], signal.SIGKILL)
        case "power cycle, then kill":
            truth.inject_drive("power_cycle")
            rig.drive.powered_at = time.monotonic()
            wait(lambda: truth.speed <= AT_REST, 10, "a drive that loses power")
            wait(rig.runs, 90, "a pump that runs again")
            rig.main.process.kill()
        case "drive":
            _drive(rig, case, undo)
        case "broker":
            assert isinstance(rig, MqttRig | RelayRig)
            _broker(rig, case.target, rng, undo)
        case "unstoppable":
            _unstoppable(rig, case, undo)
        case "sensor line":
            tank, _, fault = case.target.partition("_")
            _on_wire(rig.lines[tank].inject, fault, undo)
        case "full disk":
            assert isinstance(rig, FullDiskRig)
            rig.fill()
            undo.callback(rig.free)
        case "stuck for ever":
            pass  # the command is the same from the start
        case "sensor" | "site":
            truth.inject_site(case.target, case.parameter)
            undo.callback(truth.inject_site, "none")
        case "forecast file":
            _forecast(rig, case, undo)
        case "state file":
            _state_file(rig, case.target)
        case "dry":
            assert isinstance(rig, SiteRig)
            wait(lambda: rig.levels()[0] <= rig.dry_level, 90, "an empty cistern")
        case "second graph":
            refuse_second_graph(rig.domain, rig.directory)
        case "second pump node" | "second controller":
            _second(rig, case, undo)
        case "10000 hostile" if isinstance(players, Players) and case.target in players.topics:
            players.burst(case.target, 10_000, rng)
        case "intruder" | "10000 hostile":
            intrude(rig.watcher, case.target, case.fault, rng)
            undo.callback(rig.watcher.withdraw, case.target)
        case mode:
            assert players is not None
            players.set(case.target, mode, rng)
            undo.callback(players.set, case.target, "ok", rng)


def _process(rig: Rig, case: Case, rng: random.Random, undo: ExitStack) -> None:
    if not case.target.endswith("_simulator"):
        name = case.target if case.target in rig.pids() else "controller"
        wait(lambda: name in rig.pids(), 15, f"no {case.target}")
        signal_process(rig.pids()[name], case.fault, rng, undo)
        return
    simulator = rig.drive if case.target == "drive_simulator" else rig.site_simulator
    assert simulator is not None
    if case.fault == "kill":
        water = isinstance(rig, SiteRig) and case.target == "site_simulator"
        undo.callback(lambda: simulator.start(*(rig.water() if water else ())))
        undo.callback(simulator.process.process.wait)
    signal_process(simulator.process.process.pid, case.fault, rng, undo)


def _on_wire(inject: Callable[[str], None], fault: str, undo: ExitStack) -> None:
    """Start a fault of a line; an intermittent fault is silence that comes and goes."""
    undo.callback(inject, "none")
    if fault != "intermittent":
        inject(fault)
        return
    ended = threading.Event()

    def work() -> None:
        while not ended.wait(ON_S):
            inject("silence")
            ended.wait(OFF_S)
            inject("none")

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    undo.callback(thread.join)
    undo.callback(ended.set)


def _broker(
    rig: MqttRig | RelayRig, fault: str, rng: random.Random, undo: ExitStack
) -> None:
    """Do something to the broker of sensors or relay, or to the cable."""
    broker = rig.broker
    match fault:
        case "killed":
            broker.kill()
            undo.callback(broker.start)
        case "restarted":
            broker.kill()
            broker.start()
            time.sleep(6.0)  # its clients wait for up to 5 s; their reports belong to this case
        case "paused":
            broker.pause()
            undo.callback(broker.go_on)
        case "half_open":
            rig.cable.cut = True
            undo.callback(setattr, rig.cable, "cut", False)
        case "hostile" if isinstance(rig, MqttRig):
            rig.say_nonsense(10_000, rng)
        case "retained" if isinstance(rig, MqttRig):
            # The sensor dies, and a client that reconnects gets its last message.
            rig.say_retained()
            rig.truth.inject_site("cistern_silent")
            undo.callback(rig.truth.inject_site, "none")
            broker.end()
            broker.start()


def _drive(rig: Rig, case: Case, undo: ExitStack) -> None:
    truth = rig.truth
    if case.target == "local":
        truth.take_over(True)
        undo.callback(truth.take_over, False)
    elif case.target.startswith("runs_on"):
        truth.inject_drive("runs_on", case.parameter)
        rig.watcher.stop(True)
        undo.callback(rig.watcher.stop, False)
        undo.callback(truth.inject_drive, "none")
    elif case.target == "timeout_off":
        # The timeout is read with each new connection.
        truth.inject_drive("timeout_off")
        truth.inject_drive("dropped")
        time.sleep(1.0)
        truth.inject_drive("none")
        undo.callback(rig.drive.start)
        undo.callback(rig.drive.end)
    else:
        if case.target == "power_cycle":
            rig.drive.powered_at = time.monotonic()
        _on_wire(truth.inject_drive, case.target, undo)


def _unstoppable(rig: Rig, case: Case, undo: ExitStack) -> None:
    """Let the motor ignore orders, or run again after it stood; at the end it can be stopped."""
    undo.callback(rig.watcher.stop, False)
    undo.callback(wait, lambda: rig.truth.speed <= AT_REST, 8, "a pump that can be stopped stands")
    undo.callback(rig.truth.inject_drive, "none")
    if case.target != "contactor":
        rig.truth.inject_drive(case.target)
    rig.watcher.stop(True)
    if case.target == "contactor":
        wait(lambda: rig.truth.speed <= AT_REST, 10, "a pump that is stopped stands")
        rig.truth.inject_drive("stuck_running", 8000)


def _forecast(rig: Rig, case: Case, undo: ExitStack) -> None:
    assert isinstance(rig, SiteRig)
    if case.target == "broken":
        rig.forecast.write_text("issued,time,precipitation [mm/h]\nnonsense,1,2\n")
    elif case.target == "missing":
        rig.forecast.unlink()
    else:
        write_forecast(rig.forecast, timedelta(days=30), hours=48)
    undo.callback(write_forecast, rig.forecast, hours=48)


def _state_file(rig: Rig, fault: str) -> None:
    """Kill the pump node, and lose or break its state file before the supervisor restarts it."""
    os.kill(rig.pids()["pump"], signal.SIGKILL)
    file = rig.kept / "pump.json"
    match fault:
        case "moved away":
            file.rename(file.with_name("pump.json.broken"))
        case "unfinished":
            file.rename(file.with_name("pump.json.new"))
        case "torn":
            file.write_bytes(file.read_bytes()[:5000])
        case "without starts":
            lines = b""
            for line in file.read_bytes().splitlines():
                content = json.loads(line.split(maxsplit=1)[1])
                del content["starts"]
                text = json.dumps(content).encode()
                lines += (b"%08x " % zlib.crc32(text) + text).ljust(len(line)) + b"\n"
            file.write_bytes(lines)


def _second(rig: Rig, case: Case, undo: ExitStack) -> None:
    elsewhere = case.target == "in another domain"
    domain = undo.enter_context(own_domain()) if elsewhere else rig.domain
    if case.fault == "second controller":
        topic = "/pump/command"
        node = Process(
            domain, "live.controller", "--controller", "mpc", cwd=rig.directory,
        )
    else:
        topic = "/pump/flow"
        node = pump_node(rig, domain=domain)
    undo.callback(node.process.wait, 15)
    undo.callback(node.process.terminate)
    if elsewhere:
        rig.watchers.append(Watcher(domain))
        undo.callback(rig.watchers[1].close)
    wait(
        lambda: rig.watcher.publishers(topic) > 1 or node.process.poll() is not None
        or (elsewhere and rig.watchers[1].last), 30, "no second node",
    )
