"""The guard of a user's own pump driver, with the example as a process of its own.

That the pump stops if the driver dies, hangs or is held is shown by the fault campaign.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from graphs import start_node
from places import CHECKOUT, CONFIG
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_rig import ERROR, LATE, Observer, Site
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.interface.states import ActuatorState

DRIVER = CHECKOUT / "examples" / "live_pump_driver.py"
GOOD = {"/cistern/level": 2.5, "/roof/level": 0.01, "/weather/frost": 0.0, "/pump/command": 0.5}


class Rig(Site):
    """The guard, and a test that acts as sensors and controller."""

    def __init__(self, observer: Observer) -> None:
        super().__init__(observer)
        self.site = observer.cwd / "site.yaml"
        self.site.write_text(f"extends: {CONFIG / 'site.yaml'}\ntau: 0.2\n")
        self.flows: list[float] = observer.collect("/pump/flow")
        self.holds: list[float] = observer.collect("/pump/hold")
        self.states: list[ActuatorState] = observer.collect(
            "/pump/state", lambda message: ActuatorState.read(message.data)
        )
        # Another node, since this one also reads /pump/hold.
        self.node = Node("peers", context=observer.context, start_parameter_services=False)
        self.values = dict(GOOD)

    def start(self, **parameters: object) -> subprocess.Popen[Any]:
        return self.watcher.start("live.external_pump", **{
            "site_file": self.site, "state_file": self.cwd / "pump.json",
            "recovery_time": 0.3, **parameters,
        })

    def drive(self, text: str = DRIVER.read_text()) -> subprocess.Popen[Any]:
        process = start_node(self.watcher.domain, self.cwd, "driver", text)
        self.watcher.started.append(process)
        return process

    def play_until(self, condition: Callable[[], Any], event: str, seconds: float = LATE) -> None:
        self.until(condition, seconds, f"{event} ({self.states[-3:]})")

    def runs(self) -> bool:
        return bool(
            self.states and self.states[-1].state == "running" and self.flows
            and self.flows[-1] > 0.0035 and self.holds[-1] == 0.0
        )


@pytest.fixture
def rig(observer: Observer) -> Iterator[Rig]:
    rig = Rig(observer)
    yield rig
    rig.node.destroy_node()


def test_a_hold_outlives_the_guard_and_its_end_reaches_another_driver(rig: Rig) -> None:
    """By the driver's ~/stop, whatever the controller commands; two publishers of a flow hold, too.

    A hold that ends while the guard is down has ended when it is back.
    """
    node, first = rig.start(), rig.drive()
    rig.play_until(rig.runs, "running")
    second = rig.watcher.publisher("/pump/flow")
    rig.play_until(lambda: rig.holds[-1] == 1.0, "a hold")
    rig.play_until(rig.watcher.shows("/pump_guard: driver", ERROR, "2 publishers"), "its alarm")
    rig.watcher.node.destroy_publisher(second)
    rig.play_until(rig.runs, "running again")
    until = time.time() + 60
    fields = {"owner": "me", "until": until}.items()
    assert rig.call(SetParametersAtomically, "/pump_guard/hold", parameters=[
        Parameter(name, value=value).to_parameter_msg() for name, value in fields
    ]).result.successful
    rig.play_until(lambda: rig.flows[-1] == 0.0, "a stop")
    for kept in (True, False):
        node.kill()
        node.wait()
        if not kept:
            first.kill()
            rig.play_until(lambda: time.time() > until, "its end", 80)
            rig.drive(DRIVER.read_text().replace('"my_pump"', '"another_pump"'))
        node = rig.start()
        if kept:
            rig.states.clear()
            rig.play_until(lambda: rig.states and rig.states[-1].codes == ("hold",), "the hold")
            assert rig.holds[-1] == 1.0 and rig.flows[-1] == 0.0
    rig.play_until(rig.runs, "running again")


def test_a_driver_that_does_not_stop_is_a_fault(rig: Rig) -> None:
    """That a person must reset; who holds it is told that it cannot be reached."""
    rig.start(follow_time=2.0)
    rig.drive(DRIVER.read_text().replace("min(command, 1.0)", "0.5").replace(
        "self.create_service(", "(lambda *_: None)("
    ))
    rig.play_until(rig.runs, "running")
    answer = rig.call(SetBool, "/pump_guard/stop", data=True)
    assert not answer.success and "stop the pump yourself" in answer.message
    assert rig.call(Trigger, "/pump_guard/release").success
    rig.values["/pump/command"] = 0.0
    rig.play_until(lambda: rig.states[-1].state == "fault", "a fault")
    assert rig.states[-1].codes == ("runs_on",)
    assert rig.holds[-1] == 1.0
    assert not rig.call(Trigger, "/pump_guard/clear").success
    assert rig.call(Trigger, "/pump_guard/reset").success


def test_the_controller_commands_0_during_a_hold_and_without_news_of_it(site: Site) -> None:
    """It reads /pump/hold only where the pump is external; until it comes, the command is 0."""
    commands = site.be_dry()
    good = site.values
    with site.live(
        "controller --controller onoff", external_pump=True, recovery_time=0.3, hold_limit=1.0
    ):
        for hold, command in ((None, 0.0), (0.0, 1.0), (1.0, 0.0), (0.0, 1.0), (None, 0.0)):
            site.values = good if hold is None else {**good, "/pump/hold": hold}
            commands.clear()
            site.until(
                lambda command=command: len(commands) > 10
                and {value for _, value in commands[-5:]} == {command},
                LATE, f"{command} at a hold of {hold}",
            )
