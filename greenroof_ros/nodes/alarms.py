"""The alarms node, which judges the reports of all nodes and publishes the alarms on /alarms.

The node receives /diagnostics, and takes no part in the lockstep of a simulated graph. The alarms
are published at every change, and once a second. In a live site, the node also records every change
in ``alarms.jsonl``, and prints the changes, and at the start a list of what keeps the pump off.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.time import Time

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.standard_error import Lines
from greenroof_ros.interface.alarm import ALARMS, ERROR
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.nodes.alarm_log import AlarmLog
from greenroof_ros.nodes.start_list import StartList
from greenroof_ros.ros.alarm_status import to_status
from greenroof_ros.ros.alarms import RESTARTED, ROLE, Judge
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.messages import qos_profile
from greenroof_ros.ros.parameters import declare
from greenroof_ros.ros.reports import PAUSE_S, Reports, StatusDiagnosis, read_statuses
from greenroof_ros.site.site import Site

# Interval at which the alarms are judged, and at which they are published without a change (s).
_JUDGE_S, _PUBLISH_S = 0.25, 1.0
# How long the end waits for the disk and for the reader of standard output (s).
_WRITTEN_S = 2.0
# Messages that may wait: all nodes share the topic. Other devices publish with any QoS profile.
_DEPTH = 64


def parameters(site: Site | None = None) -> list[Parameter]:
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
        tell: Callable[[str], None] = lines.print_line if lines is not None else lambda _: None
        directory: str = values["directory"]
        self._log = AlarmLog(tell, Path(directory) / ALARMS if directory else None)
        self._judge = Judge(self._log.last_number)
        self._reports = Reports(self.get_namespace(), values["expected"].split())
        self._start = StartList(tell) if directory else None
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

    def on_start(self) -> None:
        """Do nothing, as the node needs nothing more."""

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
        self._log.add(changed)
        if self._start is not None and self._start.update(now, diagnoses, self._reports):
            self._start = None
        if changed or now - self._published >= _PUBLISH_S:
            self._published = now
            self._publish_alarms()
            self._log.write()

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
