"""The faults of the cases: how they begin and end."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import datetime, timedelta, timezone
from pathlib import Path

from faults.bounds import DRIVE_TIMEOUT_S
from faults.cases import (
    CHANGES,
    DISK_SIGNS,
    GAUGES,
    LEVELS,
    ROUNDS,
    VALVE,
    VALVE_ALARM,
    Case,
)
from faults.players import HOSTILE, HUGE, OFF_S, ON_S
from faults.rig import (
    FailingDiskRig,
    FullDiskRig,
    MqttRig,
    OwnDriverRig,
    RelayRig,
    Rig,
    SiteRig,
    pump_node,
    wait,
)
from faults.truth import AT_REST
from faults.valve import ValveRig, begin_valve
from faults.watcher import Watcher
from graphs import Process, environment, reserved_domain
from ros_rig import FORECAST_HEADER, write_forecast

from greenroof_ros.base.command_line import EXIT_OCCUPIED
from greenroof_ros.base.processes import child_environment
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.devices.drive_file import read_drive_file
from greenroof_ros.live.devices.modbus_line import ModbusLine, encode, parse_address
from greenroof_ros.live.pumping.state_file import GUARD

_SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM}
# Shorter than every limit (s).
_SHORT_S = (0.2, 0.6)
# A timeout as another client may write it, or as a flipped bit shows it (s); and the exception with
# which a gateway answers for a drive that it does not reach.
_LONG_TIMEOUT_S, _GATEWAY = 1643.4, 11
_MEMBERS, _HOURS = 30, 168
# Which values of an ensemble (member, hour) are missing, by case.
_MISSING: dict[str, Callable[[int, int], bool]] = {
    "a null": lambda member, hour: (member, hour) == (2, 5),
    "an empty member": lambda member, hour: member == 3,
    "a short control run": lambda member, hour: member == 0 and hour >= 120,
}
# Time for which foreign readers are stopped, and the longest time between their stops (s).
_READERS_S, _APART_S = 6.5, 0.4
# Like ``ros2 topic echo``: it uses only this package's rule for when to end, and the middleware's
# own settings, including shared memory.
_READER = """
import rclpy
from std_msgs.msg import Float64
from greenroof_ros.base.processes import end_with_parent
end_with_parent()
rclpy.init()
node = rclpy.create_node("reader", start_parameter_services=False)
node.create_subscription(Float64, "/roof/level", lambda message: None, 10)
rclpy.spin(node)
"""
# Where cleaners of temporary files remove them, and the end of a login session.
_CLEANED = ("/tmp/", "/run/lock/", "/var/lock/", "/dev/shm/")


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


def change_parameter(watcher: Watcher, node: str, name: str) -> None:
    """Set a parameter to 4000 values next to 1, and last to 1."""
    for first in range(0, 4000, 50):  # a node answers no other request meanwhile
        values = [1.0 - 1e-12 * (3999 - first - number) for number in range(50)]
        accepted = watcher.set_parameter(node, name, values)
        assert accepted == [True] * 50, f"{node} accepted {sum(accepted)} of 50 changes"


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
        case "failing disk":
            _failing_disk(rig, case.target.partition(",")[0])
        case fault if fault in (VALVE, VALVE_ALARM):
            begin_valve(rig, case.target, undo)
        case "broker of the valve":
            assert isinstance(rig, ValveRig)
            _broker(rig, case.target, rng, undo)
        case "stuck for ever":
            pass  # the command is the same from the start
        case "from the start":
            assert isinstance(rig, SiteRig)
            undo.callback(write_forecast, rig.forecast, hours=48)
        case "timeout rewritten":
            _rewrite_timeout(rig, case, undo)
        case "use_sim_time":
            rig.watcher.set_parameter(case.target, case.fault, [True])  # it changes nothing
        case fault if fault == CHANGES:
            change_parameter(rig.watcher, case.target, "level")
        case "readers":
            _stop_readers(rig, rng, undo)
        case "coarse in rain":
            assert players is not None
            for topic, mode in ((LEVELS[0], "coarse"), (GAUGES[0], "wrong")):
                players.set(topic, mode, rng)
                undo.callback(players.set, topic, "ok", rng)
        case "sensor" | "site":
            truth.inject_site(case.target, case.parameter)
            undo.callback(truth.inject_site, "none")
        case "forecast file":
            _forecast(rig, case, undo)
        case "held":
            assert rig.watcher.stop(True, node=GUARD)
            undo.callback(rig.watcher.stop, False, node=GUARD)
        case "state file":
            _state_file(rig, case.target)
        case "dry":
            assert isinstance(rig, SiteRig)
            wait(lambda: rig.levels()[0] <= rig.dry_level, 90, "an empty cistern")
        case "second graph":
            if "removed" in case.target:
                _remove_files(rig)
            refuse_second_graph(rig.domain, rig.directory)
        case "second pump node" | "second controller":
            _second(rig, case, undo)
        case "10000 hostile" if players is not None and case.target in players.topics:
            players.burst(case.target, 10_000, rng)
        case "intruder" | "10000 hostile":
            intrude(rig.watcher, case.target, case.fault, rng)
            undo.callback(rig.watcher.withdraw, case.target)
        case mode:
            assert players is not None
            players.set(case.target, mode, rng)
            undo.callback(players.set, case.target, "ok", rng)


def _process(rig: Rig, case: Case, rng: random.Random, undo: ExitStack) -> None:
    if isinstance(rig, OwnDriverRig) and case.fault == "kill":
        undo.callback(rig.start_driver)
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
    rig: MqttRig | RelayRig | ValveRig, fault: str, rng: random.Random, undo: ExitStack
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
            undo.callback(broker.resume)
        case "half_open":
            rig.cable.cut = True
            undo.callback(setattr, rig.cable, "cut", False)
        case "hostile" if isinstance(rig, MqttRig):
            rig.publish_nonsense(10_000, rng)
        case "retained" if isinstance(rig, MqttRig):
            # The sensor dies, and a client that reconnects gets its last message.
            rig.publish_retained()
            rig.truth.inject_site("cistern_silent")
            undo.callback(rig.truth.inject_site, "none")
            broker.end()
            broker.start()


def _drive(rig: Rig, case: Case, undo: ExitStack) -> None:
    truth = rig.truth
    if case.target == "local":
        truth.take_over(True)
        undo.callback(truth.take_over, False)
    elif case.target.startswith(("runs_on", "says_stopped")):
        truth.inject_drive(case.target.partition(",")[0], case.parameter)
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


def _rewrite_timeout(rig: Rig, case: Case, undo: ExitStack) -> None:
    """Write a long timeout as another client, and refuse what a new pump node writes.

    It reads that timeout, and cannot write *stop*: it leaves the drive in silence, and the motor
    runs. Then the drive can be reached again.
    """
    file, address = read_drive_file(Path(rig.drive_file)), parse_address(rig.drive_at)
    timeout = file.timeout.get(address.interface)
    assert timeout is not None
    register = file.registers[timeout.register]

    def write(seconds: float) -> None:
        line = ModbusLine(address, file.serial, 1.0)
        line.connect()
        words = encode(seconds / register.scale, register.type, register.word_order)
        for number, word in enumerate(words):
            line.write(register.address + number, word)
        line.close()

    write(min(register.high, _LONG_TIMEOUT_S))
    undo.callback(write, DRIVE_TIMEOUT_S)
    rig.truth.inject_drive("refused_writes", _GATEWAY)
    undo.callback(rig.truth.inject_drive, "none")
    os.kill(rig.pids()["pump"], signal.SIGKILL)
    wait(lambda: "nothing is sent" in rig.watcher.last.get("pump: drive", ""), 40, "a silence")
    assert rig.truth.runs(), "the motor stopped on its own"
    rig.truth.inject_drive("none")
    if case.target == "stop requested":
        rig.watcher.stop(True)
        undo.callback(rig.watcher.stop, False)


def _stop_readers(rig: Rig, rng: random.Random, undo: ExitStack) -> None:
    """Stop and continue four foreign readers, again and again.

    With shared memory this froze unrelated nodes.
    """
    readers = [
        subprocess.Popen(
            [sys.executable, "-c", _READER], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            env={**child_environment(), **environment(rig.domain)}, start_new_session=True,
        ) for _ in range(4)
    ]
    for reader in readers:
        undo.callback(reader.wait)
        undo.callback(reader.kill)
    time.sleep(3.0)
    for _ in range(ROUNDS):
        for number in (signal.SIGSTOP, signal.SIGCONT):
            for reader in readers:
                reader.send_signal(number)
                time.sleep(rng.uniform(0.0, _APART_S / 4))
            if number == signal.SIGSTOP:
                time.sleep(_READERS_S)
    assert all(reader.poll() is None for reader in readers), "a reader ended on its own"


def _remove_files(rig: Rig) -> None:
    """Remove the temporary files that the processes hold open, such as a lock, as cleaners do."""
    for pid in rig.pids().values():
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                file = entry.readlink()
                if str(file).startswith(_CLEANED) and rig.directory not in file.parents:
                    file.unlink()


def _forecast(rig: Rig, case: Case, undo: ExitStack) -> None:
    assert isinstance(rig, SiteRig)
    match case.target:
        case "broken":
            rig.forecast.write_text("issued,time,precipitation [mm/h]\nnonsense,1,2\n")
        case "missing":
            rig.forecast.unlink()
        case "old":
            write_forecast(rig.forecast, timedelta(days=30), hours=48)
        case "short":
            write_forecast(rig.forecast, hours=6)
        case "large":
            _write_ensembles(rig.forecast, issues=130)
        case "an issue too large":
            _write_ensembles(rig.forecast, hours=130 * _HOURS)
        case spoilt:
            _write_ensembles(rig.forecast, missing=_MISSING[spoilt])
    undo.callback(write_forecast, rig.forecast, hours=rig.forecast_h)


def _write_ensembles(
    path: Path, issues: int = 1, hours: int = _HOURS,
    missing: Callable[[int, int], bool] = lambda member, hour: False,
) -> None:
    """Write hourly issues of an ensemble, up to now, in one step."""
    draft, now = path.with_suffix(".new"), datetime.now(timezone.utc)
    with draft.open("w") as stream:
        stream.write(FORECAST_HEADER.replace("time,", "time,member,") + "\n")
        for ago in reversed(range(issues)):
            issued = now.replace(minute=0, second=0, microsecond=0) - timedelta(hours=ago)
            times = [(issued + timedelta(hours=hour)).isoformat() for hour in range(hours)]
            stream.writelines(
                f"{times[0]},{at},{member},{'' if missing(member, hour) else 0.0},2.0,15.0\n"
                for member in range(_MEMBERS) for hour, at in enumerate(times)
            )
    draft.replace(path)


def _state_file(rig: Rig, fault: str) -> None:
    """Kill the pump node, and lose or break its state file before the supervisor restarts it."""
    os.kill(rig.pids()["pump"], signal.SIGKILL)
    file = rig.output / "pump.json"
    match fault:
        case "moved away":
            file.rename(file.with_name("pump.json.broken"))
        case "torn":
            file.write_bytes(file.read_bytes()[:5000])


def _failing_disk(rig: Rig, how: str) -> None:
    """Let the disk of the state fail: the pump runs on, until its node is killed."""
    assert isinstance(rig, FailingDiskRig)
    rig.fail_disk(how)
    failed = time.monotonic()
    wait(lambda: rig.signs(failed) >= set(DISK_SIGNS), 30, "the signs of a failing disk")
    assert rig.truth.runs(), "the pump stopped because of a disk"
    os.kill(rig.pids()["pump"], signal.SIGKILL)


def _second(rig: Rig, case: Case, undo: ExitStack) -> None:
    elsewhere = case.target.startswith("in another domain")
    if "removed" in case.target:
        _remove_files(rig)
    domain = undo.enter_context(reserved_domain()) if elsewhere else rig.domain
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
