"""The alarms node by itself: from reports on /diagnostics to /alarms, its record and its lines."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graphs import environment, wait_for
from ros_rig import LATE, Observer

from greenroof_ros.interface.alarm import Alarm, read_status
from greenroof_ros.results.alarm_file import read_alarms


class Reporter:
    """A pump node that reports, as the test says, and the alarms that follow."""

    def __init__(self, observer: Observer) -> None:
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        self._types = DiagnosticArray, DiagnosticStatus, KeyValue
        self._observer, self._began = observer, time.monotonic()
        self._publisher = observer.publisher("/diagnostics")
        self.parts: dict[str, tuple[int, str]] = {}
        self.values: dict[str, Any] = {}
        self.arrays = observer.collect("/alarms", lambda message: message)

    def report(self) -> None:
        array_type, status_type, pair_type = self._types
        up = time.monotonic() - self._began
        own = {"role": "pump", "process": "host 1", "up_s": round(100 + up, 1), **self.values}
        array = array_type(status=[
            status_type(level=b"\0", name="/pump", message="ready", values=[
                pair_type(key=key, value=json.dumps(value)) for key, value in own.items()
            ]),
            *(status_type(level=bytes([level]), name=f"/pump: {part}", message=f"it is {code}",
                          values=[pair_type(key="code", value=code)])
              for part, (level, code) in self.parts.items()),
        ])
        self._publisher.publish(array)

    @property
    def alarms(self) -> dict[str, Alarm]:
        """The alarms in the latest message, by name."""
        statuses = self.arrays[-1].status if self.arrays else []
        alarms = [
            read_status(status.name, status.level[0], status.message,
                        {pair.key: pair.value for pair in status.values})
            for status in statuses
        ]
        return {alarm.name: alarm for alarm in alarms}

    def until(self, condition: Any, event: str) -> None:
        """Report four times a second until a condition holds."""
        due = 0.0

        def holds() -> bool:
            nonlocal due
            if time.monotonic() > due:
                due = time.monotonic() + 0.25
                self.report()
            return bool(condition())

        self._observer.until(holds, LATE, event)


@contextmanager
def running(observer: Observer, out: Path) -> Iterator[subprocess.Popen[Any]]:
    with out.open("w") as stream:
        process = observer.start("nodes.alarms", directory="run", popen={
            "env": environment(observer.domain), "stdout": stream,
        })
        yield process
        process.terminate()
        assert process.wait(60) == 0


def test_from_reports_to_alarms(observer: Observer) -> None:
    """At once, once a second, and to whoever comes later; numbers go on after a restart."""
    (observer.cwd / "run").mkdir()
    reporter, out = Reporter(observer), observer.cwd / "out"
    with running(observer, out):
        reporter.until(lambda: reporter.arrays, "a first message without alarms")
        assert not reporter.alarms
        reporter.parts = {"drive": (2, "drive_lost")}
        reporter.until(lambda: reporter.alarms, "the alarm")
        alarm = reporter.alarms["/pump: drive"]
        assert (alarm.number, alarm.level, alarm.code) == (1, "error", "drive_lost")
        assert alarm.sentence == "the drive is not responding"
        assert abs(alarm.since - time.time()) < 60
        reporter.values = {"warnings": ["/roof/level has a publisher with an incompatible QoS"]}
        # Whatever anyone publishes there.
        observer.publisher("/diagnostics").publish(b"\0\1\0\0abc")
        before = len(reporter.arrays)
        until = time.monotonic() + 4
        reporter.until(lambda: time.monotonic() > until, "some seconds")
        assert 2 <= len(reporter.arrays) - before <= 6
        late = observer.collect("/alarms", lambda message: len(message.status))
        reporter.until(lambda: late, "the latest message, for a late subscriber")
        assert late[0] == 1
        reporter.parts = {"drive": (0, "")}
        reporter.until(lambda: reporter.alarms["/pump: drive"].ended, "its end")
    reporter.parts = {"drive": (2, "drive_fault")}
    with running(observer, observer.cwd / "out2"):
        reporter.until(lambda: "drive_fault" in {a.code for a in reporter.alarms.values()}, "more")
    recorded = read_alarms(observer.cwd / "run")
    assert [(alarm.number, alarm.code) for alarm in recorded] == [
        (1, "drive_lost"), (2, "drive_fault"),
    ]
    first, *_, last = out.read_text().splitlines()
    wait_for(lambda: "alarm 1: Pump: the drive is not responding" in out.read_text(), 10, "a line")
    assert out.read_text().count("warning: /pump: /roof/level has a publisher with an inc") == 1
    assert last.startswith("alarm 1 is over, after ") and last.endswith(" s: Pump"), first
