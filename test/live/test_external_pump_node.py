"""The guard of a user's own pump driver, with the example as a process of its own.

That the pump stops if the driver dies, hangs or is held is shown by the fault campaign.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from checked_nodes import start_node
from graphs import Process
from places import CHECKOUT, CONFIG
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_rig import ERROR, LATE, OK, Observer
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.interface.states import ActuatorState

DRIVER = CHECKOUT / "examples" / "live_pump_driver.py"
GOOD = {"/cistern/level": 2.5, "/roof/level": 0.01, "/weather/frost": 0.0, "/pump/command": 0.5}


class Rig:
    """The guard, and a test that acts as sensors and controller."""

    def __init__(self, observer: Observer) -> None:
        self.observer = observer
        self.site = observer.cwd / "site.yaml"
        self.site.write_text(f"extends: {CONFIG / 'site.yaml'}\ntau: 0.2\n")
        self.command = 0.5
        self.flows: list[float] = observer.collect("/pump/flow")
        self.holds: list[float] = observer.collect("/pump/hold")
        self.states: list[ActuatorState] = observer.collect(
            "/pump/state", lambda message: ActuatorState.read(message.data)
        )
        # Another node, since this one also reads /pump/hold.
        self.peers = Node("peers", context=observer.context, start_parameter_services=False)
        self.publishers = {topic: observer.publisher(topic, self.peers) for topic in GOOD}
        self._sent_at = 0.0

    def start(self, **parameters: object) -> subprocess.Popen[Any]:
        return self.observer.start("live.external_pump", **{
            "site_file": self.site, "state_file": self.observer.cwd / "pump.json",
            "recovery_time": 0.3, **parameters,
        })

    def drive(self, text: str = DRIVER.read_text()) -> subprocess.Popen[Any]:
        process = start_node(self.observer.domain, self.observer.cwd, "driver", text)
        self.observer.started.append(process)
        return process

    def play(self, until: Callable[[], Any], event: str, seconds: float = LATE) -> float:
        """Publish the inputs ten times a second until a condition holds; return how long (s)."""
        began = time.monotonic()

        def played() -> Any:
            if time.monotonic() - self._sent_at > 0.1:
                self._sent_at = time.monotonic()
                for topic, publisher in self.publishers.items():
                    value = self.command if topic == "/pump/command" else GOOD[topic]
                    publisher.publish(Float64(data=value))
            return until()

        self.observer.until(played, seconds, f"{event} ({self.states[-3:]})")
        return time.monotonic() - began

    def call(self, kind: Any, name: str, **fields: object) -> Any:
        client = self.observer.node.create_client(kind, f"/pump_guard/{name}")
        self.play(client.service_is_ready, name)
        future = client.call_async(kind.Request(**fields))
        self.play(future.done, name)
        return future.result()

    def runs(self) -> bool:
        return bool(
            self.states and self.states[-1].state == "running" and self.flows
            and self.flows[-1] > 0.0035 and self.holds[-1] == 0.0
        )


@pytest.fixture
def rig(observer: Observer) -> Iterator[Rig]:
    rig = Rig(observer)
    yield rig
    rig.peers.destroy_node()


def test_a_hold_outlives_the_guard_and_its_end_reaches_another_driver(rig: Rig) -> None:
    """By the driver's ~/stop, whatever the controller commands; two publishers of a flow hold, too.

    A hold that ends while the guard is down has ended when it is back.
    """
    node, first = rig.start(), rig.drive()
    rig.play(rig.runs, "running")
    second = rig.observer.publisher("/pump/flow")
    rig.play(lambda: rig.holds[-1] == 1.0, "a hold")
    rig.play(rig.observer.shows("/pump_guard: driver", ERROR, "2 publishers"), "its alarm")
    rig.observer.node.destroy_publisher(second)
    rig.play(rig.runs, "running again")
    until = time.time() + 60
    fields = {"owner": "me", "until": until}.items()
    assert rig.call(SetParametersAtomically, "hold", parameters=[
        Parameter(name, value=value).to_parameter_msg() for name, value in fields
    ]).result.successful
    rig.play(lambda: rig.flows[-1] == 0.0, "a stop")
    for kept in (True, False):
        node.kill()
        node.wait()
        if not kept:
            first.kill()
            rig.play(lambda: time.time() > until, "its end", 80)
            rig.drive(DRIVER.read_text().replace('"my_pump"', '"another_pump"'))
        node = rig.start()
        if kept:
            rig.states.clear()
            rig.play(lambda: rig.states and rig.states[-1].codes == ("hold",), "the hold")
            assert rig.holds[-1] == 1.0 and rig.flows[-1] == 0.0
    rig.play(rig.runs, "running again")


def test_a_driver_that_pumps_nothing_is_reported(rig: Rig) -> None:
    """And held off by nothing, since it may have its own reason."""
    rig.start(follow_time=0.1)
    rig.drive(DRIVER.read_text().replace("* MAX_FLOW, 0.1", "* 0.09 * MAX_FLOW, 0.1"))
    idle = rig.observer.shows("/pump_guard: driver", ERROR, "hardly any flow for 12 s")
    assert rig.play(idle, "a report") > 12
    assert (rig.holds[-1], rig.states[-1].codes) == (0.0, ())
    rig.command = 0.1  # the driver may deliver this in pulses
    rig.play(rig.observer.shows("/pump_guard: driver", OK), "its end")


def test_a_driver_that_does_not_stop_is_a_fault(rig: Rig) -> None:
    """That a person must reset; who holds it is told that it cannot be reached."""
    rig.start(follow_time=2.0)
    rig.drive(DRIVER.read_text().replace("min(command, 1.0)", "0.5").replace(
        "self.create_service(", "(lambda *_: None)("
    ))
    rig.play(rig.runs, "running")
    answer = rig.call(SetBool, "stop", data=True)
    assert not answer.success and "stop the pump yourself" in answer.message
    assert rig.call(Trigger, "release").success
    rig.command = 0.0
    rig.play(lambda: rig.states[-1].state == "fault", "a fault")
    assert rig.states[-1].codes == ("runs_on",)
    assert rig.holds[-1] == 1.0
    assert not rig.call(Trigger, "clear").success
    assert rig.call(Trigger, "reset").success


def test_check_pump_passes_the_example(rig: Rig) -> None:
    for publisher in rig.publishers.values():
        rig.peers.destroy_publisher(publisher)
    rig.drive()
    check = Process(
        rig.observer.domain, "check_pump", "--node", "my_pump", "--live", "--period", "0.2",
        "--site", str(rig.site), cwd=rig.observer.cwd,
    )
    assert check.wait(400) == 0, check.stdout() + check.stderr()
    assert check.stdout().startswith("THE PUMP WILL RUN. The check takes ")


def test_the_controller_commands_0_during_a_hold_and_without_news_of_it(observer: Observer) -> None:
    """It reads /pump/hold only where the pump is external; until it comes, the command is 0."""
    site = observer.cwd / "site.yaml"
    site.write_text(f"extends: {CONFIG / 'site.yaml'}\ntau: 0.2\n")
    commands: list[float] = observer.collect("/pump/command")
    inputs = {topic: value for topic, value in GOOD.items() if topic != "/pump/command"}
    publishers = {topic: observer.publisher(topic) for topic in (*inputs, "/pump/hold")}

    def play(until: Callable[[], Any], event: str, hold: float | None) -> None:
        values = inputs if hold is None else {**inputs, "/pump/hold": hold}

        def played() -> Any:
            for topic, value in values.items():
                publishers[topic].publish(Float64(data=value))
            time.sleep(0.05)
            return until()

        commands.clear()
        observer.until(played, LATE, event)

    def newest(value: float) -> Callable[[], bool]:
        return lambda: len(commands) > 10 and {*commands[-5:]} == {value}

    observer.start(
        "live.controller --controller onoff", site_file=site, external_pump=True,
        recovery_time=0.3, hold_limit=1.0,
    )
    for hold, command in ((None, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, 1.0), (None, 0.0)):
        play(newest(command), f"{command} at a hold of {hold}", hold)
