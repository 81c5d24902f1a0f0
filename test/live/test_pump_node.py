"""The pump node against a simulated drive: after any fault the motor stops soon.

The motor's state is read at the simulator's workbench, not from the node. What follows from faults
of the node, bringup and the drive, and from hostile messages, is shown by the fault campaign.
"""

from __future__ import annotations

import math
import re
import signal
import subprocess
from typing import Any

import pytest
from brokers import mosquitto, needs_mosquitto
from graphs import Process, free_ports
from live_rig import PumpRig, state_in
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_rig import ERROR, LATE, Observer
from simulators import Simulator
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import DriveExchange, read_endpoint


@pytest.fixture
def rig(observer: Observer) -> PumpRig:
    return PumpRig(observer)


@pytest.mark.parametrize(("make", "at", "seconds", "stops_locally", "guards"), [
    ("abb_acs880", "gateway", 3.0, False, True), ("abb_acs880", "gateway", 10.5, False, False),
    ("abb_acs880", "tcp", None, False, False), ("grundfos_cim500", "tcp", 3.0, False, False),
    ("grundfos_cim500", "tcp", 3.0, True, True),
])
def test_a_timeout_that_does_not_guard(
    make: str, at: str, seconds: float | None, stops_locally: bool, guards: bool
) -> None:
    """Of more than 10 s, or off; a CIM's settings at the pump must stop it, too."""
    endpoint = read_endpoint(find_drive_file(make), f"{at}://127.0.0.1", "address")
    exchange = DriveExchange(endpoint, stops_locally=stops_locally)
    problem = exchange.judge_timeout(seconds, "" if seconds else "it is off")
    assert (problem is None) == guards


def test_it_connects_by_itself_and_runs_no_drive_without_its_own_timeout(rig: PumpRig) -> None:
    """Not connected yet, then it runs; refused with the reason."""
    (port,) = free_ports(1)
    rig.start(f"gateway://127.0.0.1:{port}")
    rig.command(0.5, lambda: rig.code("drive") == "drive_lost", "a lost drive")
    drive = rig.simulate(port)
    rig.run()
    drive.inject("timeout_off")
    drive.inject("dropped")
    rig.command(0.5, lambda: rig.code("drive") == "drive_lost", "a lost drive")
    drive.inject("none")
    drive.inject("timeout_off")
    rig.command(0.5, lambda: rig.code("pump") == "drive_timeout", "the reason")
    rig.stays_off("off")
    assert drive.speed() == 0.0


def test_a_publisher_of_the_command_that_does_not_fit_stops_the_pump(rig: PumpRig) -> None:
    """As by ros2 topic pub: it may send 0. One that fits is in the fault campaign."""
    rig.start()
    rig.run()
    node = Node("volatile", context=rig.watcher.context, start_parameter_services=False)
    node.create_publisher(Float64, "/pump/command", 10)
    rig.until_at_rest()
    rig.until(rig.shows("/pump: command", ERROR, "incompatible QoS (volatile)"), LATE, "why")
    node.destroy_node()
    rig.run()


def test_a_stop_stays_over_a_restart_until_it_is_lifted(rig: PumpRig) -> None:
    """A stop that fails at the end is an error that reports what can still stop the drive.

    If the middleware is slow to end, as on a busy machine, the kernel ends the node.
    """
    node = rig.start()
    rig.run()
    late = rig.watcher.collect("/pump/state", state_in)  # as by ros2 topic echo --once
    rig.watcher.until(lambda: late, LATE, "a state")
    assert rig.call(SetBool, "/pump/stop", data=True).success
    rig.until_at_rest()
    node.terminate()
    assert node.wait(120) == 0
    node = rig.start(popen={"stderr": subprocess.PIPE, "text": True})
    rig.stays_off("held: a hold by the operator")
    assert rig.call(SetBool, "/pump/stop", data=False).success
    rig.run()
    rig.drive.inject("stuck_running")
    node.terminate()
    _, errors = node.communicate(timeout=120)
    assert node.returncode in (1, -signal.SIGALRM)
    assert "error: " in errors and "only a person at its panel or its own timeout" in errors


def command(rig: PumpRig, name: str, *options: str) -> tuple[int, str]:
    return rig.finish(Process(rig.watcher.domain, name, *options, cwd=rig.cwd))


def test_a_hold_by_the_command_and_what_is_none(rig: PumpRig) -> None:
    """Its times are those of the site's clock. A request that does not shorten it says so.

    The pump runs on after each that is none; nor does a parameter of an unknown type end the node.
    """
    rig.start()
    rig.run()
    requests: tuple[dict[str, Any], ...] = (
        {}, {"owner": ""}, {"owner": 7.0}, {"reason": "no owner"}, {"owner": "me", "because": "x"},
        {"owner": "me", "until": 1.0}, {"owner": "me", "until": "tomorrow"},
        {"owner": "me", "until": math.nan}, {"owner": "me", "until": 1e300},
    )
    unknown = [ParameterMessage(name="owner", value=ParameterValue(type=42))]
    for service, parameters in (("hold", unknown), ("dose", unknown), *(("hold", [
        Parameter(name, value=value).to_parameter_msg() for name, value in request.items()
    ]) for request in requests)):
        result = rig.call(SetParametersAtomically, f"/pump/{service}", parameters=parameters).result
        assert not result.successful and result.reason, parameters
        assert rig.state.startswith("running"), parameters
    code, output = command(rig, "hold", "--for", "1h", "--reason", "painting")
    times = r"since (\d\d \w{3} )?\d\d:\d\d until (\d\d \w{3} )?\d\d:\d\d"
    held = f"held: a hold by the command line {times}: painting"
    assert code == 0 and re.fullmatch(rf"{held}(; the pump is still .*)?\n", output), output
    rig.stays_off(held)
    code, output = command(rig, "hold", "--for", "0.5")
    assert (code, "the earlier hold lasts longer and was not shortened" in output) == (0, True)
    assert command(rig, "release")[0] == 0
    rig.run()


def test_a_broken_state_needs_a_reset_that_is_confirmed(rig: PumpRig) -> None:
    """Neither a release nor the page clears it."""
    file = rig.cwd / "pump.json"
    file.write_bytes(b"torn")
    rig.start(state_file=file)
    assert rig.call(SetBool, "/pump/stop", data=False).success
    assert not rig.call(Trigger, "/pump/clear").success
    code, output = command(rig, "reset")
    assert code == 1 and "not cleared: the request was not confirmed" in output
    rig.stays_off("fault: .*pump.json cannot be read")
    assert command(rig, "reset", "--yes")[0] == 0
    rig.run()


def test_a_dose_by_the_command(rig: PumpRig) -> None:
    """Delivered in full at the controller's 0; exit code 1 if it is refused or ended by a stop."""
    rig.start(site_file=rig.site("max_dose: 0.5"))
    rig.run()
    rig.until_at_rest(0.0)
    before = rig.pumped()
    code, output = command(rig, "dose", "--litres", "50")
    assert (code, output.splitlines()[-1]) == (0, "the dose of 50 litres was delivered")
    rig.until_at_rest(0.0)
    assert rig.pumped() - before == pytest.approx(0.05, rel=0.1)
    assert command(rig, "dose", "--litres", "600")[0] == 1
    process = Process(rig.watcher.domain, "dose", "--litres", "500", cwd=rig.cwd)
    rig.command(0.0, lambda: "a dose of 500 litres" in rig.state, "a dose")
    assert rig.call(SetBool, "/pump/stop", data=True).success
    code, output = rig.finish(process)
    assert (code, "error: the dose ended early, after " in output) == (1, True)


@needs_mosquitto
def test_check_pump_finds_a_relay_right(rig: PumpRig) -> None:
    """At command 1, at which a relay stays on; the check acts as all peers, so no one publishes."""
    with mosquitto(rig.cwd) as broker, Simulator(
        "drive_simulator", "--drive", "tasmota", "--at", f"{broker.address}/roof", "--timeout", "3"
    ) as relay:
        node = rig.start(f"{broker.address}/roof", drive="tasmota")
        check = Process(
            rig.watcher.domain, "check_pump", "--node", "pump", "--live", "--period", "0.1",
            "--command", "1", "--site", str(rig.cwd / "site.yaml"), cwd=rig.cwd,
        )
        assert check.wait(300) == 0, check.stdout() + check.stderr()
        assert relay.speed() == 0.0
        node.terminate()
        node.wait(120)
