"""The alarms node, which judges the reports of all nodes and publishes the alarms on /alarms.

The node receives /diagnostics, and takes no part in the lockstep of a simulated graph. The alarms
are published at every change, and once a second. In a live site, the node also records every change
in ``alarms.jsonl``, and prints the changes, and at the start a list of what keeps the pump off.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Container, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.time import Time

from greenroof_ros.base.disk import DiskThread
from greenroof_ros.base.files import replace_text
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.standard_error import Lines
from greenroof_ros.interface.alarm import (
    ALARMS,
    ERROR,
    Alarm,
    advise,
    read_alarms,
    to_record,
    to_status,
)
from greenroof_ros.interface.states import DriveState
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.alarms import RESTARTED, ROLE, Diagnoses, Judge, describe_alarm
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.messages import qos_profile
from greenroof_ros.ros.parameters import declare
from greenroof_ros.ros.reports import PAUSE_S, Reports, StatusDiagnosis, read_statuses

# Size beyond which alarms.jsonl is written anew, with this many of the newest alarms (bytes).
_FULL, _KEPT = 1_000_000, 1000
# How long the start waits for the file to be read (s).
_RESUMED_S = 5.0
_NOT_SHOWN = "; alarms from before this start will not be shown"
# Its own disk thread, since the recorder's may be full of messages; a node that is made again reads
# the file after the node before it has written.
_DISK = DiskThread()


class AlarmLog:
    """Log that prints every alarm that begins or ends, and stores every change immediately.

    A line is added to the file for every change. If that fails, or if the file is too large, all
    alarms are written anew.

    Attributes:
        last_number: number of the last alarm in the file.
    """

    def __init__(self, tell: Callable[[str], object], file: Path | None) -> None:
        """Continue the file from earlier starts, and end the alarms that are still active in it.

        Args:
            tell: function that prints a line of text.
            file: file to which the disk thread writes every change; None to write nothing.
        """
        self._tell, self._file = tell, file
        self._alarms: dict[int, Alarm] = {}
        self._problem = ""  # why all alarms must be written anew; empty if a line may be added
        self._write_all = partial(self._write, None)  # the same object, so that it is queued once
        if file is not None and not (_DISK.do(self._resume) and _DISK.wait(_RESUMED_S)):
            tell(f"warning: {file}: the disk does not respond{_NOT_SHOWN}")
        self.last_number = max(self._alarms, default=0)

    def _resume(self) -> None:
        """Read the file (in the disk thread), and write it anew, since its last line may be cut."""
        file, began = self._file, time.time()
        if file is None or not file.is_file():
            return
        try:
            read = {
                alarm.number: replace(alarm, ended=began if alarm.ended is None else alarm.ended)
                for alarm in read_alarms(file.parent)
            }
        except (OSError, ValueError) as error:
            self._tell(f"warning: {error}{_NOT_SHOWN}")
        else:
            self._alarms = read | self._alarms  # if it came late, there are new ones
            self._write_all()

    def add(self, changed: Iterable[Alarm], stopped: Container[str] = ()) -> None:
        """Print and store alarms; a new level or cause is stored but not printed.

        Args:
            changed: the alarms.
            stopped: names of the nodes that have stopped, with which their alarms end.
        """
        for alarm in changed:
            title, text = _name(alarm), describe_alarm(alarm)
            if alarm.ended is not None:
                how = "was present when its node stopped" if alarm.node in stopped else "is over"
                self._tell(f"{title} {how}, after {alarm.seconds:.1f} s: {text}")
            elif alarm.number not in self._alarms:
                roots = "".join(
                    f" (follows from {_name(each)})" for each in self._alarms.values()
                    if each.name == alarm.follows and each.ended is None
                )
                self._tell(f"{title}: {text}{roots}")
            self._alarms[alarm.number] = alarm
            _DISK.do(partial(self._write, alarm))
        for number in [*self._alarms][:-_KEPT]:
            if self._alarms[number].ended is not None:
                del self._alarms[number]

    def write(self) -> None:
        """Try again if the last write failed; call this once a second."""
        if self._problem:
            _DISK.do(self._write_all)

    def _write(self, added: Alarm | None) -> None:
        """Add an alarm to the file, or write all of them anew (in the disk thread)."""
        file = self._file
        if file is None or (added is not None and self._problem):
            return  # all will be written anew
        alarms = [added] if added is not None else [*self._alarms.values()]
        lines = "".join(f"{json.dumps(to_record(alarm))}\n" for alarm in alarms)
        try:
            if added is None:
                replace_text(file, lines)
            else:
                with file.open("a", encoding="utf-8") as stream:
                    stream.write(lines)
            self._problem = "it is full" if file.stat().st_size > _FULL else ""
        except OSError as error:
            problem = error.strerror or str(error)
            if problem != self._problem:
                self._tell(f"warning: {file}: {problem}; another attempt is made every second")
            self._problem = problem

    def wait(self, seconds: float) -> None:
        """Wait for a limited time (s) until everything is written."""
        _DISK.wait(seconds)


def _name(alarm: Alarm) -> str:
    return f"{'alarm' if alarm.is_serious else 'warning'} {alarm.number}"


# Interval at which the alarms are judged, and at which they are published without a change (s).
_JUDGE_S, _PUBLISH_S = 0.25, 1.0
# How long the end waits for the disk and for the reader of standard output (s).
_WRITTEN_S = 2.0
# For how long a condition must have lasted before it is listed at the start, at least (s).
_SETTLED_S = 1.0
# States of the pump node in which it cannot run its drive yet.
_NOT_READY = {DriveState.CONNECTING.value, DriveState.REFUSED.value}
# Messages that may wait: all nodes share the topic. Other devices publish with any QoS profile.
_DEPTH = 64


def parameters(site: object = None) -> list[Parameter]:
    """Return the node's parameters, which are the same at every site."""
    return [
        Parameter(
            "directory", "", meaning="directory of a live site, in which the alarms are recorded; "
            "empty for no record",
        ),
        Parameter("expected", "", meaning="names of the nodes that must report, with blanks"),
    ]


class AlarmsNode(GraphNode):
    """Node that publishes the alarms of its namespace."""

    def __init__(self, lines: Lines | None = None) -> None:
        """Open the topics, and continue the record of the site's directory.

        Args:
            lines: writer of the lines for the person at the terminal; None to print nothing.
        """
        super().__init__(ROLE, ROLE, read_topics())
        values = declare(self, parameters())
        self._lines = lines
        self._tell: Callable[[str], object] = str if lines is None else lines.print_line
        directory: str = values["directory"]
        self._log = AlarmLog(self._tell, Path(directory) / ALARMS if directory else None)
        self._judge = Judge(self._log.last_number)
        self._reports = Reports(self.get_namespace(), values["expected"].split())
        self._starting = bool(directory)
        self._missing: list[tuple[str, str]] = []  # names and codes in the list that was printed
        self._checked, self._published = time.monotonic(), -math.inf
        self.open_outputs("/alarms")
        reports = self.interface["/diagnostics"]
        self.open_subscription(reports, self._receive, qos_profile(replace(
            reports.qos, reliability="best_effort", durability="volatile", depth=_DEPTH
        )))

    def _receive(self, message: bytes) -> None:
        stamp_ns, statuses = read_statuses(message)
        self._reports.receive(time.monotonic(), statuses, stamp_ns)

    @property
    def _now(self) -> float:
        """The graph's time (s since 1970): in a simulation, the time of the plant's last report."""
        return self._reports.time_ns / 1e9 or time.time()

    # --- running, beside other nodes ------------------------------------------------------------

    wait_s = _JUDGE_S

    def report_state(self, **values: object) -> None:
        """Report nothing: /alarms itself shows that the node runs."""

    def check(self, now: float) -> None:
        """Judge what has been received, if it is time to do so.

        Args:
            now: time on the steady clock (s).
        """
        if self.failure is not None:
            raise self.failure
        passed = now - self._checked
        if passed < _JUDGE_S:
            return
        self._checked = now
        if passed > PAUSE_S:  # this process was paused: what it did not receive was no silence
            self._reports.excuse_silence(passed)
            return
        diagnoses = self._reports.diagnoses(now)
        if why := os.environ.pop(RESTARTED, ""):  # only this process can report that, and once
            name = self.get_fully_qualified_name()
            diagnoses[f"{name}: station"] = StatusDiagnosis.of(
                name, "station", ROLE, "station_restarted", ERROR, now, why=why
            )
        starting = self._reports.is_starting(now)
        changed = self._judge.update(now, self._now, diagnoses, starting=starting)
        nodes = self._reports.nodes.values()
        self._log.add(changed, [node.name for node in nodes if node.has_ended])
        if self._starting:
            self._list_missing(now, diagnoses)
        if changed or now - self._published >= _PUBLISH_S:
            self._published = now
            self._publish_alarms()
            self._log.write()

    def _list_missing(self, now: float, diagnoses: Diagnoses) -> None:
        """Print what keeps a starting site from pumping, with remedies, or that the start is over.

        The list covers everything that is missing or wrong, except warnings and mere consequences.
        It is printed again when its codes change, not when its sentences change, since these
        contain numbers. The start is over when nothing keeps the pump off; later losses raise
        alarms.
        """
        wrong = {
            name: diagnosis for name, diagnosis in diagnoses.items()
            if diagnosis.is_serious and diagnosis.role != ROLE
        }
        faulty = {each.role for each in wrong.values() if each.stops_pump}
        lines = {
            (name, each.code):
                f"  {name}: {each.sentence}. {advise(each.code, each.role, each.node)}"
            for name, each in wrong.items()
            if now - each.began >= max(_SETTLED_S, each.condition.lasts)
            and not _is_consequence(each, faulty - {each.role})
        }
        if lines and [*lines] != self._missing:
            self._missing = [*lines]
            self._tell("\n".join(["missing:", *lines.values()]))
        cistern, roof = map(self._reports.value, ("cistern_level", "roof_level"))
        known = isinstance(cistern, (int, float)) and isinstance(roof, (int, float))
        kept_off = any(each.stops_pump for each in wrong.values())
        if known and not kept_off and self._reports.value("drive_state") not in _NOT_READY:
            self._starting = False
            self._tell(f"running: cistern {cistern:.3f} m, roof {roof:.4f} m")

    def _publish_alarms(self) -> None:
        array = DiagnosticArray()
        array.header.stamp = Time(nanoseconds=round(self._now * 1e9)).to_msg()
        for alarm in self._judge.shown:
            level, values = to_status(alarm)
            array.status.append(DiagnosticStatus(
                level=bytes([level]), name=alarm.name, message=alarm.sentence,
                hardware_id=self.reports.machine,
                values=[KeyValue(key=key, value=value) for key, value in values.items()],
            ))
        self.publish("/alarms", array)

    def on_stop(self) -> None:
        """Wait for a limited time until everything is recorded and printed."""
        self._log.wait(_WRITTEN_S)
        if self._lines is not None:
            self._lines.wait(_WRITTEN_S)


def _is_consequence(diagnosis: StatusDiagnosis, faulty: set[str]) -> bool:
    """Return whether all topics that a node lacks come from nodes with faults of their own."""
    senders = [topic.senders for name, topic in read_topics().items() if name in diagnosis.about]
    return bool(senders) and all(map(faulty.intersection, senders))
