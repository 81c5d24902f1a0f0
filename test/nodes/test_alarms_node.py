"""The alarms node by itself: from reports on /diagnostics to /alarms, its record and its lines."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import SingleThreadedExecutor
from ros_rig import ERROR, LATE, OK, Observer

from greenroof_ros.interface.alarm import Alarm, read_alarms
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.ros.alarm_status import read_status

FAULT = KeyValue(key="fault", value="F 7")
TOPICS = KeyValue(key="topics", value="/roof/level /x")


class Rig:
    """A pump node that reports the state of its drive, and the alarms node beside it."""

    def __init__(self, observer: Observer) -> None:
        self.observer, self.drive = observer, (OK, "")
        self.publisher = observer.publisher("/diagnostics")
        self.arrays = observer.collect("/alarms", lambda message: message.status)
        self.lines: list[str] = []

    def alarm(self) -> Alarm | None:
        """Return the last alarm in the latest message; None if there is none."""
        for status in reversed(self.arrays[-1] if self.arrays else []):
            values = {pair.key: pair.value for pair in status.values}
            return read_status(status.name, status.level[0], status.message, values)
        return None

    def until(self, condition: Any, event: str) -> Any:
        """Report, and let the node judge, until a condition holds."""
        own = {"role": '"pump"', "process": '"host 1"', "up_s": "100.0"}

        def holds() -> Any:
            level, code = self.drive
            self.publisher.publish(DiagnosticArray(status=[
                DiagnosticStatus(level=OK, name="/pump", message="ready", values=[
                    KeyValue(key=key, value=value) for key, value in own.items()
                ]),
                DiagnosticStatus(level=level, name="/pump: drive", message="it is so",
                                 values=[KeyValue(key="code", value=code), FAULT, TOPICS]),
            ]))
            self.executor.spin_once(timeout_sec=0.05)
            self.node.check(time.monotonic())
            return condition()

        return self.observer.until(holds, LATE, event)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Run the node beside the observer."""
        words = ["--ros-args", "-p", f"directory:={self.observer.cwd}"]
        rclpy.init(args=words, domain_id=self.observer.domain)
        printer: Any = SimpleNamespace(print_line=self.lines.append, wait=lambda _: None)
        self.node, self.executor = AlarmsNode(printer), SingleThreadedExecutor()
        self.executor.add_node(self.node)
        try:
            yield
        finally:
            self.node.on_stop()
            self.node.destroy_node()
            rclpy.shutdown()


def test_from_reports_to_alarms(observer: Observer) -> None:
    """At once, once a second, and to whoever comes later; numbers go on after a restart."""
    rig = Rig(observer)
    with rig.running():
        rig.until(lambda: rig.arrays, "a first message without alarms")
        assert rig.alarm() is None
        rig.drive = ERROR, "drive_lost"
        alarm = rig.until(rig.alarm, "the alarm")
        assert (alarm.name, alarm.number, alarm.level) == ("/pump: drive", 1, "error")
        assert (alarm.fault, alarm.about) == ("F 7", ("/roof/level", "/x"))
        assert abs(alarm.since - time.time()) < 60
        rig.publisher.publish(b"\0\1\0\0abc")  # whatever anyone publishes
        before = len(rig.arrays)
        rig.until(lambda: len(rig.arrays) > before + 1, "one a second")
        late = observer.collect("/alarms", lambda message: len(message.status))
        rig.until(lambda: late, "the latest message, for a late subscriber")
        rig.drive = OK, ""
        over = rig.until(lambda: rig.alarm().ended and rig.alarm(), "its end")
        assert 0 < over.seconds < 60 and over.level == "error"
        for broken in ({"number": "x"}, {"since": "now"}, {"seconds": "long"}):  # of any program
            with pytest.raises(ValueError, match=r"x|now|long"):
                read_status("/pump", 2, "", broken)
        assert "alarm 1: Pump: the drive is not responding" in rig.lines
    rig.drive = ERROR, "drive_fault"
    with rig.running():
        rig.until(lambda: len(read_alarms(observer.cwd)) > 1, "another alarm")
    codes = {alarm.number: alarm.code for alarm in read_alarms(observer.cwd)}
    assert codes == {1: "drive_lost", 2: "drive_fault"}
