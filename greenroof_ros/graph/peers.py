"""The other nodes of a graph, as their reports tell: who is here, who went, and who waits."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from rclpy.impl.rcutils_logger import RcutilsLogger

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.reports import Report
from greenroof_ros.graph.states import ENDED, FINISHED, READY, ROLES, STARTING

# Nodes report four times a second. One that is silent for so long (s) does not answer; one that is
# for longer than the other limit, the plant's own for its peers, will not.
_SILENT_S = 3.0
_GONE_S = 5.0
# For so long (s) ROS knows a process that was killed; and a silence (s) after which a process of
# the same node may be another.
_KNOWN_S, _PERHAPS_DEAD_S = 25.0, 1.0
# A pause of this process itself (s): what it did not hear is not the others' silence.
_PAUSE_S = 1.0
# How long somebody must be missing before it is said, and how often it is said again (s).
_PATIENCE_S = 2.0
_AGAIN_S = 5.0


def root_causes(roles: Collection[str], topics: Iterable[Topic]) -> set[str]:
    """Return which of some silent roles do not themselves wait for another of them, or else all.

    Args:
        roles: from which nothing comes.
        topics: of the interface, which says who waits for whom.
    """
    waiting = {
        role
        for topic in topics
        for role in roles
        if topic.per_tick and role in topic.subscribers
        and any(other in roles and other != role for other in topic.publishers)
    }
    return set(roles) - waiting or set(roles)


def by_publisher(
    absent: Collection[str], topics: Mapping[str, Topic], own: str
) -> dict[str, list[str]]:
    """Return topics on which there is nothing, by the role of who should publish them.

    Where the interface names two, the plant or a pump driver, it is the first of whom nothing else
    is here.

    Args:
        absent: names of those topics.
        topics: all that a node subscribes to, by name.
        own: role of that node.
    """
    here = {own} | {topic.publishers[0] for name, topic in topics.items() if name not in absent}
    roles: dict[str, list[str]] = {}
    for name in absent:
        candidates = topics[name].publishers
        role = next((role for role in candidates if role not in here), candidates[-1])
        roles.setdefault(role, []).append(name)
    return roles


class Peers:
    """Who is in the graph beside a node. It says who is missing, and when a peer goes or comes.

    Attributes:
        names: what to call a node that has not reported, by its role.
    """

    def __init__(self, logger: RcutilsLogger) -> None:
        """Know nobody yet.

        Args:
            logger: of the node.
        """
        self.names = dict(ROLES)
        self._logger = logger
        self._reports: dict[str, Report] = {}
        self._processes: dict[str, set[str]] = {}  # that have had a name
        self._doubled: dict[str, float] = {}
        self._replaced: dict[str, float] = {}
        self._heard: dict[str, float] = {}
        self._silent: set[str] = set()
        self._looked = time.monotonic()
        self._missing: list[str] = []
        self._missing_since = self._looked
        self._said: list[str] = []
        self._said_at = 0.0

    def hear(self, report: Report) -> None:
        """Take a report, and say if the node has ended, or is here again."""
        name = report.name
        before = self._reports.get(name)
        known = self._processes.setdefault(name, set())
        now = time.monotonic()
        alive = (
            before is not None and before.state != ENDED and now - self._heard[name] < _SILENT_S
        )
        if before is not None and alive and report.process in known - {before.process}:
            if name not in self._doubled:
                self._logger.warning(f"there are two nodes named {name}")
            self._doubled[name] = now
            return
        known.add(report.process)
        self._reports[name] = report
        self._heard[name] = now
        if before is None:
            return
        again = before.process != report.process
        if again:
            self._replaced[name] = now
        if report.state == ENDED:
            # The end of the plant is that of the run, which says so itself.
            if before.state in (STARTING, READY) and report.role != "plant":
                why = f": {report.values['failure']}" if "failure" in report.values else ""
                self._logger.warning(f"{name} has ended{why}")
        elif name in self._silent or (again and before.state != FINISHED):
            self._logger.info(f"{name} {'was started' if again else 'answers'} again")
        self._silent.discard(name)

    def may_be_one(self, name: str, now: float) -> bool:
        """Whether of two processes of a node's name one may be what it was before its restart.

        Not where the node never reported, where two report, and where it lived all the time.

        Args:
            name: of the node.
            now: of the steady clock (s).
        """
        if name not in self._reports or now - self._doubled.get(name, -math.inf) < _SILENT_S:
            return False
        started_again = now - self._replaced.get(name, -math.inf) < _KNOWN_S
        return started_again or now - self._heard[name] > _PERHAPS_DEAD_S

    def look(self, now: float) -> None:
        """Say who has fallen silent; called all the time.

        Args:
            now: of the steady clock (s).
        """
        if now - self._looked > _PAUSE_S:
            self._heard = dict.fromkeys(self._heard, now)
        self._looked = now
        for name, heard in self._heard.items():
            if now - heard > _SILENT_S and name not in self._silent:
                self._silent.add(name)
                if self._reports[name].state in (STARTING, READY):
                    self._logger.warning(f"{name} does not answer")

    def say_missing(self, roles: Collection[str], now: float) -> None:
        """Say who is missing before the run: after 2 s, when it changes, and every 5 s.

        Args:
            roles: of those that are.
            now: of the steady clock (s).
        """
        missing = sorted(self.call(role) for role in roles)
        if missing != self._missing:
            self._missing, self._missing_since = missing, now
        if now - self._missing_since < _PATIENCE_S:
            return
        if missing != self._said or (missing and now - self._said_at > _AGAIN_S):
            self._logger.info(
                f"waiting for {', '.join(missing)}" if missing else "all nodes are here"
            )
            self._said, self._said_at = missing, now

    def waited_for(self, role: str) -> set[str]:
        """Return for whom the others wait, but for one's own role."""
        return {
            missing
            for name, report in self._reports.items()
            if report.state == STARTING and name not in self._silent
            for missing in report.values.get("waiting", [])
        } - {role}

    def call(self, role: str, publishers: Sequence[str] = ()) -> str:
        """Return the name of the node that has a role, or what to call it.

        Args:
            role: of the interface.
            publishers: the nodes that publish its topics: drivers do not report.
        """
        names = [name for name, report in self._reports.items() if report.role == role]
        if names:
            return max(names, key=self._heard.__getitem__)
        return publishers[0] if publishers else self.names.get(role, role)

    def said_by(self, role: str) -> dict[str, Any]:
        """Return the values of the newest report of a role's node."""
        names = [name for name, report in self._reports.items() if report.role == role]
        return self._reports[max(names, key=self._heard.__getitem__)].values if names else {}

    def running(self, now: float, *, just_finished: bool) -> bool:
        """Whether a node is here for which the run is not over.

        Args:
            now: of the steady clock (s).
            just_finished: so that one which has not joined may be of this run, and not of the next.
        """
        states = (STARTING, READY) if just_finished else (READY,)
        return any(
            report.state in states and now - self._heard[name] < _GONE_S
            for name, report in self._reports.items()
        )

    def end_of(self, role: str, now: float) -> str | None:
        """Return how the node of a role went, or None if it has not."""
        for name, report in self._reports.items():
            if report.role == role:
                if report.state == ENDED:
                    return f"{name} has ended"
                if now - self._heard[name] > _GONE_S:
                    return f"{name} has not answered for {_GONE_S:g} s"
        return None
