"""The alarms node by itself: from reports on /diagnostics to /alarms, its record and its lines."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.executors import SingleThreadedExecutor
from ros_rig import LATE, Observer

from greenroof_ros.interface.alarm import Alarm
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.ros.alarm_status import read_status

if TYPE_CHECKING:
    from greenroof_ros.base.standard_error import Lines


class Reporter:
    """A pump node that reports, as the test says, and the alarms that follow."""

    def __init__(self, observer: Observer) -> None:
        self._observer, self._began = observer, time.monotonic()
        self._publisher = observer.publisher("/diagnostics")
        self.parts: dict[str, tuple[int, str]] = {}
        self.arrays = observer.collect("/alarms", lambda message: message)

    def report(self) -> None:
        up = 100 + round(time.monotonic() - self._began, 1)
        own = {"role": "pump", "process": "host 1", "up_s": up}
        self._publisher.publish(DiagnosticArray(status=[
            DiagnosticStatus(level=b"\0", name="/pump", message="ready", values=[
                KeyValue(key=key, value=json.dumps(value)) for key, value in own.items()
            ]),
            *(DiagnosticStatus(level=bytes([level]), name=f"/pump: {part}", message=f"it is {code}",
                               values=[KeyValue(key="code", value=code)])
              for part, (level, code) in self.parts.items()),
        ]))

    @property
    def alarms(self) -> dict[str, Alarm]:
        """The alarms in the latest message, by name."""
        statuses = self.arrays[-1].status if self.arrays else []
        return {status.name: read_status(
            status.name, status.level[0], status.message,
            {pair.key: pair.value for pair in status.values},
        ) for status in statuses}

    def until(self, condition: Any, event: str) -> None:
        """Report four times a second until a condition holds."""
        due = 0.0

        def holds() -> bool:
            nonlocal due
            self.executor.spin_once(timeout_sec=0.0)
            self.node.check(time.monotonic())
            if time.monotonic() > due:
                due = time.monotonic() + 0.25
                self.report()
            return bool(condition())

        self._observer.until(holds, LATE, event)

    @contextmanager
    def running(self) -> Iterator[list[str]]:
        """Run the node beside the observer, and yield the lines that it prints."""
        lines: list[str] = []
        words = ["--ros-args", "-p", f"directory:={self._observer.cwd}"]
        rclpy.init(args=words, domain_id=self._observer.domain)
        printer = SimpleNamespace(print_line=lines.append, wait=lambda _: None)
        self.node = AlarmsNode(cast("Lines", printer))
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        try:
            yield lines
        finally:
            self.node.on_stop()
            self.node.destroy_node()
            rclpy.shutdown()


def test_from_reports_to_alarms(observer: Observer) -> None:
    """At once, once a second, and to whoever comes later; numbers go on after a restart."""
    reporter = Reporter(observer)
    with reporter.running() as lines:
        reporter.until(lambda: reporter.arrays, "a first message without alarms")
        assert not reporter.alarms
        reporter.parts = {"drive": (2, "drive_lost")}
        reporter.until(lambda: reporter.alarms, "the alarm")
        alarm = reporter.alarms["/pump: drive"]
        assert (alarm.number, alarm.level, alarm.code) == (1, "error", "drive_lost")
        assert alarm.sentence == "the drive is not responding"
        assert abs(alarm.since - time.time()) < 60
        observer.publisher("/diagnostics").publish(b"\0\1\0\0abc")  # whatever anyone publishes
        before = len(reporter.arrays)
        reporter.until(lambda: len(reporter.arrays) > before + 1, "one a second")
        late = observer.collect("/alarms", lambda message: len(message.status))
        reporter.until(lambda: late, "the latest message, for a late subscriber")
        assert late[0] == 1
        reporter.parts = {"drive": (0, "")}
        reporter.until(lambda: reporter.alarms["/pump: drive"].ended, "its end")
        assert "alarm 1: Pump: the drive is not responding" in lines
        assert lines[-1].startswith("alarm 1 is over, after ")
    reporter.parts = {"drive": (2, "drive_fault")}
    with reporter.running():
        reporter.until(lambda: "drive_fault" in {a.code for a in reporter.alarms.values()}, "more")
    assert [(alarm.number, alarm.code) for alarm in read_alarms(observer.cwd)] == [
        (1, "drive_lost"), (2, "drive_fault"),
    ]
