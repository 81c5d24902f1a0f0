"""The pump node against a simulated drive: after any fault the motor stops soon.

The motor's state is read at the simulator's workbench, not from the node. What happens if the node,
bringup or the drive fails is in the sample of the campaign, test_faults.py.
"""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from disks import disk_that_hangs
from graphs import Process, free_ports, wait_for
from pump_node_rig import PumpRig, state_in
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_rig import ERROR, LATE, OK, SUSPENDED, Observer
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.base.times import to_people
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import DriveExchange, read_endpoint


@pytest.fixture
def rig(observer: Observer) -> PumpRig:
    return PumpRig(observer)


def test_it_connects_by_itself_and_its_report_shows_the_state(rig: PumpRig) -> None:
    """Not connected yet, ready, stopped, at fault, and ready again."""
    (port,) = free_ports(1)
    rig.start(f"gateway://127.0.0.1:{port}")
    rig.join()
    rig.tick_until(0.5, lambda: rig.drive_state == "connecting", LATE, "its state")
    rig.until_reported("drive", ERROR, f"127.0.0.1:{port}")
    assert rig.code("drive") == "drive_lost"
    assert [rig.tick(0.5) for _ in range(5)] == [0.0] * 5
    rig.simulate(port=port)
    rig.run()
    assert rig.observer.diagnoses["/pump: drive"].hardware_id.startswith("ABB ACS880")
    assert rig.drive_state == "ready"
    assert rig.call(SetBool, "stop", data=True).success
    rig.tick_until(0.5, lambda: rig.drive_state == "stopped", LATE, "its state")
    rig.drive.inject("drive_fault", 0x2310)
    rig.tick_until(0.5, lambda: rig.drive_state == "fault", LATE, "its state")
    rig.drive.inject("none")
    assert rig.call(Trigger, "reset").success
    assert rig.call(SetBool, "stop", data=False).success
    rig.run()
    assert rig.drive_state == "ready"


HEAD = b"\x00\x01\x00\x00"  # of a message, little-endian


@pytest.mark.parametrize(("make", "at", "seconds", "stops_locally", "words"), [
    ("abb_acs880", "gateway", 3.0, False, None),
    ("abb_acs880", "gateway", 10.5, False, "it is 10.5 s, but must be at most 10 s; to set it: "),
    ("abb_acs880", "tcp", None, False, "is not effective: it is off; to set it: not described"),
    ("grundfos_cim500", "tcp", 3.0, False,
     "and confirm this (local_settings_stop_the_pump: true); to set it: "),
    ("grundfos_cim500", "tcp", 3.0, True, None),
])
def test_a_timeout_that_does_not_guard(
    make: str, at: str, seconds: float | None, stops_locally: bool, words: str | None
) -> None:
    endpoint = read_endpoint(find_drive_file(make), f"{at}://127.0.0.1", "address")
    exchange = DriveExchange(endpoint, stops_locally=stops_locally)
    problem = exchange.judge_timeout(seconds, "" if seconds else "it is off")
    assert (problem is None) == (words is None)
    assert problem is None or words in problem.sentence


def test_without_the_drives_own_timeout_it_does_not_run(rig: PumpRig) -> None:
    """Refused with the reason; at the end of the node, someone must look at the pump."""
    rig.simulate().inject("timeout_off")
    node = rig.start(popen={"stderr": subprocess.PIPE, "text": True})
    rig.join()
    rig.until_reported("drive timeout", ERROR, "is not effective", "58.")
    rig.until_code("pump", "drive_timeout")
    assert rig.drive_state == "refused"
    for _ in range(10):
        assert rig.tick(0.5) == 0.0
    assert rig.drive.speed() == 0.0
    words = "was not stopped at the end", "only a person at its panel can stop it"
    ends_in_words(rig, node, "silence", *words)


def test_malformed_messages_stop_the_motor_and_not_the_node(rig: PumpRig) -> None:
    """Each is counted and reported, and acts like a refused value until the next good one.

    On their way between processes they are padded to a multiple of 4 bytes.
    """
    node = rig.start()
    for topic in ("/pump/command", "/cistern/level", "/weather/frost"):
        rig.run()
        rig.send_malformed(topic, HEAD + b"abc", HEAD, b"\x00")
        assert rig.drive.speed() < 0.5

        def is_counted(topic: str = topic) -> bool:
            return bool(rig.observer.values("/pump")["refused"].get(topic) == 3)

        rig.tick_until(0.5, is_counted, LATE, "its count")
    reported = "/pump/command was rejected: 8 bytes are not a valid Float64"
    assert any(reported in it for it in rig.observer.messages)
    assert node.poll() is None


def ends_in_words(rig: PumpRig, node: subprocess.Popen[str], fault: str, *words: str) -> None:
    """If the stop at the end fails, exit code 1 and an error that reports what can still stop it.

    If the middleware is slow to end, as on a busy machine, the kernel ends the node.
    """
    rig.drive.inject(fault)
    node.terminate()
    _, errors = node.communicate(timeout=120)
    assert node.returncode in (1, -signal.SIGALRM)
    assert all(word in errors for word in ("error: ", *words)), errors


STOPPED = "held: a hold by the operator"


def test_a_disk_that_hangs_undoes_no_stop(rig: PumpRig) -> None:
    """The stop is answered in time, and written when the disk is back.

    Meanwhile the node keeps reporting.
    """
    with disk_that_hangs(rig.cwd / "disk") as hang:
        file = rig.cwd / "disk" / "state.json"
        node = rig.start(state_file=file)
        rig.run()
        hang(True)
        answer = rig.call(SetBool, "stop", data=True)
        assert not answer.success and answer.message.startswith(STOPPED)
        assert answer.message.endswith((
            f"but {file} is not yet on the disk; writing continues",
            f"but {file} could not be written within 2 s",  # on a busy machine
        ))
        rig.until_at_rest()
        rig.until_reported("state file", ERROR, "within 2 s")
        assert rig.state.startswith(STOPPED)
        hang(False)
        wait_for(lambda: rig.call(SetBool, "stop", data=True).success, LATE, "the disk")
        assert b'"hold_owner":"the operator"' in file.read_bytes()
        node.kill()
        node.wait()


def test_commands_that_must_not_pump(rig: PumpRig) -> None:
    """Negative, not finite, of two publishers, of a silent one: off, and it recovers."""
    rig.start()
    rig.run()
    for command in (math.nan, math.inf, -1.0):
        rig.until_at_rest(command)
        rig.run()
    rig.until_reported("command", ERROR, "rejected", command=-1.0)
    rig.until_code("pump", "command_unknown", -1.0)
    assert rig.code("command") == "input_refused"
    rig.run()
    # The second has the same name as the first: endpoints count, not names.
    name = rig.node.get_name()
    twin = Node(name, context=rig.observer.context, start_parameter_services=False)
    rig.observer.publisher("/pump/command", twin)
    rig.until_at_rest()
    rig.until_reported("command", ERROR, f"/pump/command has 2 publishers ({name})")
    rig.until_code("command", "input_publishers")
    rig.until_code("pump", "command_unknown")
    twin.destroy_node()
    rig.run()
    # An incompatible publisher, such as ros2 topic pub, may be sending 0 to stop it.
    volatile = Node("volatile", context=rig.observer.context)
    volatile.create_publisher(Float64, "/pump/command", 10)
    rig.until_at_rest()
    rig.until_reported(
        "command", ERROR, "incompatible QoS (volatile): it must have a liveliness lease of at "
        "most 1 s",
    )
    volatile.destroy_node()
    rig.run()
    assert rig.shows("command", OK)
    rig.until_code("pump", "")


def test_a_fault_stays_until_it_is_reset_and_a_stop_until_it_is_lifted(rig: PumpRig) -> None:
    """Also over restarts of the node; a stop that fails at the end is reported."""

    def stays_off(state: str) -> None:
        rig.join()
        assert [rig.tick(0.5) for _ in range(10)] == [0.0] * 10
        assert rig.state.startswith(state)

    node = rig.start()
    rig.run()
    rig.drive.inject("drive_fault", 0x2310)
    rig.until_state("fault: the drive reports")
    rig.until_reported("pump", ERROR, "the drive reports")
    rig.until_at_rest()
    rig.drive.inject("none")
    node.kill()
    node.wait()
    node = rig.start()
    stays_off("fault: the drive reports")
    answer = rig.call(Trigger, "reset")
    assert answer.success and "the drive reports" in answer.message
    rig.run()
    late = rig.observer.collect("/pump/state", state_in)  # as by ros2 topic echo --once
    rig.observer.until(lambda: late, LATE, "a state")
    assert late == [rig.state]

    assert rig.call(SetBool, "stop", data=True).success
    rig.until_at_rest()
    assert rig.state.startswith(STOPPED)
    node.terminate()
    assert node.wait(120) == 0
    node = rig.start(popen={"stderr": subprocess.PIPE, "text": True})
    stays_off(STOPPED)
    assert rig.call(SetBool, "stop", data=False).success
    rig.run()
    words = "was not stopped at the end", "its own timeout (1.5 s)"
    ends_in_words(rig, node, "stuck_running", *words)


def command(rig: PumpRig, name: str, *options: str) -> tuple[int, str]:
    """Run a command while the graph ticks; return its exit code and its output."""
    process = Process(rig.domain, name, *options, cwd=rig.cwd)
    rig.tick_until(0.0, lambda: process.process.poll() is not None, LATE, name)
    return process.wait(1), process.stdout() + process.stderr()


def test_a_hold_is_kept_over_restarts_and_ends_automatically(rig: PumpRig) -> None:
    """By the command, with its end and its reason; who releases it need not be its owner.

    Its times are those of the site's clock. A request that does not shorten it says so.
    """
    node = rig.start()
    rig.run()
    until = datetime.now().astimezone() + timedelta(hours=1)
    code, output = command(
        rig, "hold", "--until", f"{until:%Y-%m-%dT%H:%M:%S}", "--reason", "painting",
    )
    at_site = until.replace(microsecond=0).astimezone(timezone(timedelta(hours=-5)))
    held = re.compile(
        r"held: a hold by the command line since [-\d]+ [:\d]+-05:00 until "
        f"{re.escape(to_people(at_site))}: painting"
    )
    assert (code, bool(held.match(output))) == (0, True), output
    rig.until_at_rest()

    def reported() -> Any:
        return rig.observer.values("/pump").get("hold")

    rig.tick_until(0.5, lambda: reported() and held.fullmatch(rig.state), LATE, "its report")
    report = reported()
    assert (report["owner"], report["reason"]) == ("the command line", "painting")
    assert report["until"] == int(until.timestamp())
    node.kill()
    node.wait()
    rig.start()
    rig.join()
    assert [rig.tick(0.5) for _ in range(10)] == [0.0] * 10
    assert held.fullmatch(rig.state)
    assert rig.call(SetBool, "stop", data=False).success
    rig.run()
    rig.tick_until(0.5, lambda: reported() is None, LATE, "a report without it")
    soon = time.time() + 15
    assert command(rig, "hold", "--for", f"{15 / 3600:g}")[0] == 0
    rig.until_at_rest()
    rig.run()
    assert time.time() >= soon - 1
    assert command(rig, "hold")[0] == 0
    rig.until_at_rest()
    code, output = command(rig, "hold", "--for", "1")
    assert (code, "the earlier hold lasts longer and was not shortened" in output) == (0, True)
    code, output = command(rig, "release")
    assert (code, "hold" in output) == (0, False), output
    rig.run()


def test_what_is_no_hold_is_refused(rig: PumpRig) -> None:
    """The pump runs on after each."""
    rig.start()
    requests: tuple[dict[str, Any], ...] = (
        {}, {"owner": ""}, {"owner": 7.0}, {"reason": "no owner"}, {"owner": "me", "because": "x"},
        {"owner": "me", "until": 1.0}, {"owner": "me", "until": "tomorrow"},
        {"owner": "me", "until": math.nan}, {"owner": "me", "until": 1e300},
    )
    for request in requests:
        rig.run()
        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in request.items()
        ]
        result = rig.call(SetParametersAtomically, "hold", parameters=parameters).result
        assert not result.successful, request
        assert re.search("must have (an )?owner|owner = |until = ", result.reason), request
        assert [rig.tick(0.5) > 0 for _ in range(3)] == [True] * 3, request
    unknown = ParameterMessage(name="owner", value=ParameterValue(type=42))
    for service in ("hold", "dose"):
        result = rig.call(SetParametersAtomically, service, parameters=[unknown]).result
        assert not result.successful and result.reason
        assert rig.tick(0.5) > 0


def test_a_broken_state_needs_a_reset(rig: PumpRig) -> None:
    """Neither a release nor the page clears it, and it is kept over a restart."""
    file = rig.cwd / "pump.json"
    file.write_bytes(b"torn")
    for _ in range(2):
        node = rig.start(state_file=file)
        rig.join()
        rig.until_code("pump", "state_unknown")
        assert rig.call(SetBool, "stop", data=False).success
        assert not rig.call(Trigger, "clear").success
        assert [rig.tick(0.5) for _ in range(10)] == [0.0] * 10
        assert "pump.json cannot be read" in rig.state
        node.kill()
        node.wait()
    rig.start(state_file=file)
    rig.join()
    code, output = command(rig, "reset")
    assert code == 1 and "not cleared: the request was not confirmed" in output
    assert re.search("The fault: .*pump.json cannot be read", output)
    assert [rig.tick(0.5) for _ in range(5)] == [0.0] * 5
    code, output = command(rig, "reset", "--yes")
    assert code == 0 and "pump.json cannot be read" in output
    rig.run()


def test_commands_without_a_graph_say_what_to_do(domain: int, tmp_path: Path) -> None:
    """A time in the past is refused first, since no graph would accept it."""
    dose, reset, past = (
        Process(domain, *words, cwd=tmp_path) for words in (
            ("dose", "--volume", "0.05"), ("reset", "--yes"),
            ("hold", "--until", "2020-01-01T00:00"),
        )
    )
    assert (past.wait(300), "must be in the future" in past.stderr()) == (2, True)
    for process in (dose, reset):
        assert process.wait(300) == 1
        assert process.stderr().startswith("error: There is no pump node to send the request to: ")
        assert (
            "Start the pump node's graph first, with the same ROS_DOMAIN_ID, "
            "ROS_AUTOMATIC_DISCOVERY_RANGE and --namespace"
        ) in process.stderr()


def test_a_dose_by_the_command(rig: PumpRig) -> None:
    """Delivered in full at the controller's 0; exit code 1 if it is refused or ended by a stop."""
    rig.start(site_file=rig.site("max_dose: 0.5"))
    rig.run()
    rig.until_at_rest(0.0)
    volume = [Parameter("volume", value=0.05).to_parameter_msg()]
    by_hand = rig.call(SetParametersAtomically, "dose", parameters=volume).result
    assert not by_hand.successful and "must have volume" in by_hand.reason
    before = rig.pumped()
    code, output = command(rig, "dose", "--volume", "0.05")
    assert (code, output.splitlines()[-1]) == (0, "the dose of 0.05 m3 was delivered")
    assert " of 0.05 m3 was accepted" in output
    rig.until_at_rest(0.0)
    assert rig.pumped() - before == pytest.approx(0.05, rel=0.1)
    assert "running: a dose of 0.05 m3" in rig.states

    code, output = command(rig, "dose", "--volume", "0.6")
    assert (code, "to 0.5 m3 (max_dose)" in output) == (1, True)
    process = Process(rig.domain, "dose", "--volume", "0.5", cwd=rig.cwd)
    rig.tick_until(0.0, lambda: "a dose of 0.5 m3" in rig.state, LATE, "a dose")
    assert rig.call(SetBool, "stop", data=True).success
    rig.tick_until(0.0, lambda: process.process.poll() is not None, LATE, "its end")
    assert process.wait(1) == 1
    assert "error: the dose ended early, after " in process.stderr()
    assert rig.call(SetBool, "stop", data=False).success
    assert [rig.tick(0.0) for _ in range(20)][10:] == [0.0] * 10


def test_a_suspend_lasts_as_long_as_it_does(rig: PumpRig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Old inputs do not count. In an hour a low outlet takes 0.5 m: this is not a fault.

    Then a flow meter counts, and unknown frost stops the pump.
    """
    site = rig.site("tau: 0.2", "low_outlet_level: 1.0", "low_outlet_radius: 0.025")
    (rig.cwd / "sitecustomize.py").write_text(SUSPENDED)
    rig.simulate()  # the drive is not suspended
    monkeypatch.setenv("PYTHONPATH", f"{rig.cwd}:{os.environ.get('PYTHONPATH', '')}")
    rig.start(site_file=site, level_limit=1.0, frost_limit=1.0, command_limit=1.0,
              flow_limit=1.0)
    inputs = {"/cistern/level": 2.5, "/roof/level": 0.01, "/weather/frost": 0.0}

    def play(until: Callable[[], Any], event: str, command: float = 0.5) -> None:
        rig.play({**inputs, "/pump/command": command}, until, event, LATE)

    rig.join()
    play(lambda: rig.drive.speed() > 0.5, "a pump that runs")
    (rig.cwd / "suspended").touch()
    inputs["/cistern/level"] = 2.0
    play(lambda: any("/pump/command is unknown: this node" in said for said in
                     rig.observer.messages), "the reason", 0.0)
    play(lambda: rig.shows("inputs", OK), "what is new", 0.0)
    began = time.monotonic()
    play(lambda: time.monotonic() > began + 3, "three seconds", 0.0)
    assert rig.state == "off: the command is 0"
    assert not any(state.startswith("fault") for state in rig.states)
    play(lambda: rig.drive.speed() > 0.5, "a pump that runs")
    inputs["/pump/meter"] = 0.00321  # counts, not the speed
    play(lambda: rig.flows[-1] == 0.00321, "the measured flow")
    inputs["/weather/frost"] = math.nan
    play(lambda: rig.drive.speed() == 0.0, "a stop")
