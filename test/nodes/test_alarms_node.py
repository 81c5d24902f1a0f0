"""The alarms node by itself: from reports on /diagnostics to /alarms, its record and its lines."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import SingleThreadedExecutor
from ros_rig import ERROR, LATE, OK, Observer

from greenroof_ros.interface.alarm import Alarm
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.ros.alarm_status import read_status


class Rig:
    """A pump node that reports the state of its drive, and the alarms that follow."""

    def __init__(self, observer: Observer) -> None:
        self.observer = observer
        self.publisher = observer.publisher("/diagnostics")
        self.drive = OK, ""
        self.arrays = observer.collect("/alarms", lambda message: message.status)

    def report(self) -> None:
        level, code = self.drive
        own = {"role": "pump", "process": "host 1", "up_s": 100.0}
        values = [KeyValue(key=key, value=json.dumps(value)) for key, value in own.items()]
        self.publisher.publish(DiagnosticArray(status=[
            DiagnosticStatus(level=OK, name="/pump", message="ready", values=values),
            DiagnosticStatus(level=level, name="/pump: drive", message="it is so",
                             values=[KeyValue(key="code", value=code)]),
        ]))

    def alarm(self) -> Alarm | None:
        """Return the last alarm in the latest message; None if there is none."""
        statuses = self.arrays[-1] if self.arrays else []
        return read_status(
            statuses[-1].name, statuses[-1].level[0], statuses[-1].message,
            {pair.key: pair.value for pair in statuses[-1].values},
        ) if statuses else None

    @contextmanager
    def running(self) -> Iterator[list[str]]:
        """Run the node beside the observer, and yield the lines that it prints."""
        lines: list[str] = []
        words = ["--ros-args", "-p", f"directory:={self.observer.cwd}"]
        rclpy.init(args=words, domain_id=self.observer.domain)
        printer: Any = SimpleNamespace(print_line=lines.append, wait=lambda _: None)
        self.node, self.executor = AlarmsNode(printer), SingleThreadedExecutor()
        self.executor.add_node(self.node)
        try:
            yield lines
        finally:
            self.node.on_stop()
            self.node.destroy_node()
            rclpy.shutdown()

    def until(self, condition: Any, event: str) -> Any:
        """Report, and let the node judge, until a condition holds."""

        def holds() -> Any:
            self.report()
            self.executor.spin_once(timeout_sec=0.05)
            self.node.check(time.monotonic())
            return condition()

        return self.observer.until(holds, LATE, event)


def test_from_reports_to_alarms(observer: Observer) -> None:
    """At once, once a second, and to whoever comes later; numbers go on after a restart."""
    rig = Rig(observer)
    with rig.running() as lines:
        rig.until(lambda: rig.arrays, "a first message without alarms")
        assert rig.alarm() is None
        rig.drive = ERROR, "drive_lost"
        alarm = rig.until(rig.alarm, "the alarm")
        assert (alarm.name, alarm.number, alarm.level) == ("/pump: drive", 1, "error")
        assert alarm.sentence == "the drive is not responding"
        assert abs(alarm.since - time.time()) < 60
        rig.publisher.publish(b"\0\1\0\0abc")  # whatever anyone publishes
        before = len(rig.arrays)
        rig.until(lambda: len(rig.arrays) > before + 1, "one a second")
        late = observer.collect("/alarms", lambda message: len(message.status))
        rig.until(lambda: late, "the latest message, for a late subscriber")
        assert late[0] == 1
        rig.drive = OK, ""
        rig.until(lambda: rig.alarm().ended, "its end")
        assert "alarm 1: Pump: the drive is not responding" in lines
        assert lines[-1].startswith("alarm 1 is over, after ")
    rig.drive = ERROR, "drive_fault"
    with rig.running():
        rig.until(lambda: len(read_alarms(observer.cwd)) > 1, "another alarm")
    assert [(alarm.number, alarm.code) for alarm in read_alarms(observer.cwd)] == [
        (1, "drive_lost"), (2, "drive_fault"),
    ]
