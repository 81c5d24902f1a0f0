"""The other nodes of a live graph, as their reports show: which process has which name."""

from __future__ import annotations

import math
import time

from greenroof_ros.graph.reports import Report
from greenroof_ros.graph.states import ENDED

# Nodes report four times a second. For so long (s) ROS knows a process that was killed; a silence
# (s) after which a process of the same node may be another; and one after which it is.
_KNOWN_S, _PERHAPS_DEAD_S, _DEAD_S = 25.0, 1.0, 3.0


class Peers:
    """Tells a node that was killed and started again from two nodes of one name."""

    def __init__(self) -> None:
        """Know nobody yet."""
        self._reports: dict[str, Report] = {}
        self._processes: dict[str, set[str]] = {}  # that have had a name
        self._doubled: dict[str, float] = {}
        self._replaced: dict[str, float] = {}
        self._heard: dict[str, float] = {}

    def hear(self, report: Report) -> None:
        """Take a report."""
        name = report.name
        before = self._reports.get(name)
        known = self._processes.setdefault(name, set())
        now = time.monotonic()
        alive = (
            before is not None and before.state != ENDED and now - self._heard[name] < _DEAD_S
        )
        if before is not None and alive and report.process in known - {before.process}:
            self._doubled[name] = now
            return
        known.add(report.process)
        self._reports[name] = report
        self._heard[name] = now
        if before is not None and before.process != report.process:
            self._replaced[name] = now

    def may_be_one(self, name: str, now: float) -> bool:
        """Whether of two processes of a node's name one may be what it was before its restart.

        Not where the node never reported, where two report, and where it lived all the time.

        Args:
            name: of the node.
            now: of the steady clock (s).
        """
        if name not in self._reports or now - self._doubled.get(name, -math.inf) < _DEAD_S:
            return False
        started_again = now - self._replaced.get(name, -math.inf) < _KNOWN_S
        return started_again or now - self._heard[name] > _PERHAPS_DEAD_S
