"""The alarms of a live site, derived from the reports of its nodes to the supervisor."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from greenroof_ros.interface.alarm import ALARMS
from greenroof_ros.interface.states import STARTING
from greenroof_ros.live.alarm_log import AlarmLog
from greenroof_ros.live.live_topics import read_live_topics
from greenroof_ros.live.supervisor import ProcessStart
from greenroof_ros.ros.alarms import Judge, NodeReport, is_starting

# A longer gap between two updates means that this process was paused (s), so what it has not read
# yet does not mean that the nodes were silent.
_PAUSE_S = 1.0


class SiteAlarms:
    """Alarms from the reports of a site's nodes, which are printed and recorded.

    In these alarms, a node counts as lost as soon as its process has ended. For an observer of
    /diagnostics, the node counts as lost when it has been silent for a while or has returned. Both
    losses raise the same alarm, which dates from the node's last report on /diagnostics.

    Attributes:
        log: log of the alarms that are printed and recorded.
        judge: object that evaluates the current conditions.
    """

    def __init__(
        self, state: Path, namespace: str, processes: Iterable[ProcessStart],
        print_line: Callable[[str], None],
    ) -> None:
        """Continue the alarm record in the directory of a site.

        Args:
            state: directory of the site.
            namespace: namespace of the nodes, such as ``/site1``; empty for none.
            processes: processes of the site.
            print_line: function that prints a line for human readers.
        """
        self.log = AlarmLog(print_line, state / ALARMS)
        self.judge = Judge(self.log.last_number)
        self._namespace = namespace
        self._processes = {process.name: process.nodes for process in processes}
        self._print_line = print_line
        self._nodes: dict[str, NodeReport] = {}
        self._newest: dict[str, Mapping[str, Any]] = {}
        self._updated_at = time.monotonic()

    def fail(self, process: str, text: str) -> None:
        """Print a message about a failed process; the next update turns it into an alarm."""
        self._print_line(f"{process}: {text}")
        now = time.monotonic()
        for name in self._processes[process]:
            known = self._nodes.setdefault(name, NodeReport(
                f"{self._namespace}/{name}", _role_of(name), "", STARTING, {}, now, time.time(),
            ))
            known.ended = text

    def update(self, reports: Mapping[str, Mapping[str, Any]]) -> None:
        """Evaluate the last report of each node; after a pause of this process, await new ones.

        Args:
            reports: reports, keyed by the names of the nodes. A report from an earlier call is not
                received again.
        """
        wall, now = time.monotonic(), time.time()
        for name, report in reports.items():
            if self._newest.get(name) is not report:
                self._newest[name] = report
                self._receive(name, report, wall, now)
        paused, self._updated_at = wall - self._updated_at > _PAUSE_S, wall
        if paused:
            return
        nodes = list(self._nodes.values())
        diagnoses = {name: it for node in nodes for name, it in node.diagnoses(wall)}
        self.log.add(self.judge.update(wall, now, diagnoses, starting=is_starting(nodes, wall)))

    def _receive(self, name: str, report: Mapping[str, Any], wall: float, now: float) -> None:
        process, node = report.get("process", ""), self._nodes.get(name)
        if node is None or node.process != process:
            node = self._nodes[name] = NodeReport(
                f"{self._namespace}/{name}", report.get("role", ""), process, report["state"],
                report, wall,
            )
        node.receive(wall, now, report["state"], report)
        node.heard -= wall - report.get("published_at", wall)
        for part, status in report.get("diagnoses", {}).items():
            node.receive_part(part, wall, status["level"], status["message"], status["values"])


def _role_of(name: str) -> str:
    """Return the role of a node that has never reported."""
    roles = {role for topic in read_live_topics().values() for role in topic.publishers}
    return name if name in roles else "controller"
