"""The alarms node by itself: from reports on /diagnostics to /alarms, its record and its lines."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import SingleThreadedExecutor
from ros_rig import ERROR, LATE, OK, Observer

from greenroof_ros.interface.alarm import Alarm
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.ros.alarm_status import read_status


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

    def report(self) -> None:
        level, code = self.drive
        own = {"role": '"pump"', "process": '"host 1"', "up_s": "100.0"}
        part = {"code": code, "fault": "F 7", "topics": "/roof/level /x"}
        self.publisher.publish(DiagnosticArray(status=[
            DiagnosticStatus(level=each, name=name, message="ready", values=[
                KeyValue(key=key, value=value) for key, value in values.items()
            ]) for each, name, values in ((OK, "/pump", own), (level, "/pump: drive", part))
        ]))

    @contextmanager
    def running(self) -> Iterator[Callable[[Callable[[], Any], str], Any]]:
        """Run the node; yield a function that reports until a condition holds."""
        words = ["--ros-args", "-p", f"directory:={self.observer.cwd}"]
        rclpy.init(args=words, domain_id=self.observer.domain)
        printer: Any = SimpleNamespace(print_line=self.lines.append, wait=lambda _: None)
        node, executor = AlarmsNode(printer), SingleThreadedExecutor()
        executor.add_node(node)

        def until(condition: Callable[[], Any], event: str) -> Any:
            def holds() -> Any:
                self.report()
                executor.spin_once(timeout_sec=0.05)
                node.check(time.monotonic())
                return condition()

            return self.observer.until(holds, LATE, event)

        try:
            yield until
        finally:
            node.on_stop()
            node.destroy_node()
            rclpy.shutdown()


def test_from_reports_to_alarms(observer: Observer) -> None:
    """At once, once a second, and to whoever comes later; numbers go on after a restart."""
    rig = Rig(observer)
    with rig.running() as until:
        until(lambda: rig.arrays, "a first message without alarms")
        assert rig.alarm() is None
        rig.drive = ERROR, "drive_lost"
        alarm = until(rig.alarm, "the alarm")
        assert (alarm.name, alarm.number, alarm.level) == ("/pump: drive", 1, "error")
        assert (alarm.fault, alarm.about) == ("F 7", ("/roof/level", "/x"))
        rig.publisher.publish(b"\0\1\0\0abc")  # whatever anyone publishes
        before = len(rig.arrays)
        until(lambda: len(rig.arrays) > before + 1, "one a second")
        late = observer.collect("/alarms", lambda message: len(message.status))
        until(lambda: late, "the latest message, for a late subscriber")
        rig.drive = OK, ""
        over = until(lambda: rig.alarm().ended and rig.alarm(), "its end")
        assert over.seconds > 0 and over.level == "error" and rig.lines
    rig.drive = ERROR, "drive_fault"
    with rig.running() as until:
        until(lambda: len(read_alarms(observer.cwd)) > 1, "another alarm")
    codes = {alarm.number: alarm.code for alarm in read_alarms(observer.cwd)}
    assert codes == {1: "drive_lost", 2: "drive_fault"}


def test_what_another_program_says_of_an_alarm_is_checked() -> None:
    for broken in ({"number": "x"}, {"since": "now"}, {"seconds": "long"}):
        with pytest.raises(ValueError, match=r"x|now|long"):
            read_status("/pump", 2, "", broken)
