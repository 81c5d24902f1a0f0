"""From which tick a node answers that is started, in the run or before it.

Each node says on /diagnostics

- ``nodes``: the processes of the other nodes that it has heard of, by their roles;
- ``taken``: for each of them how many messages it had of its topics when it first heard of it. The
  k-th of a topic belongs to tick k;
- ``answers_from``: the tick that the node itself answers first;
- ``silent_at``: as long as that is not decided, the time (ns of the system clock) at which it had
  published nothing yet: a node that joins late is sent what was said before;
- ``agreed``: the processes whose ``answers_from`` it has heard.

A node that is started asks nothing; it waits until all whom the plant knows have said what they
have taken, decides, waits until all have agreed, and only then publishes its first message. So
nobody has to guess which process a message is of, or which tick; and it does not matter whether the
process before it died before its answer, after it, or having given it to some and not to others.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.reports import Report
from greenroof_ros.graph.states import ENDED, FINISHED

PLANT = "plant"


class Handshake:
    """What the nodes of a run have said of their ticks, and what a node says itself.

    Attributes:
        answers_from: the tick that the node answers first; None as long as it is not decided.
        agreed: whether all have heard that.
        nodes: the newest process of each other role.
        taken: what the node has said that it had, by process and topic.
    """

    def __init__(
        self, role: str, process: str, interface: Mapping[str, Topic], *, repeats: bool
    ) -> None:
        """Begin; the plant begins each run.

        Args:
            role: of the node.
            process: that runs it.
            interface: every topic of the graph, by name.
            repeats: whether the node gives the same answer to a tick whenever it is asked.
        """
        self.nodes: dict[str, str] = {}
        self.taken: dict[str, dict[str, int]] = {}
        self._role = role
        self._process = process
        self._repeats = repeats
        self._readers = {
            reader for topic in interface.values() if topic.per_tick and role in topic.publishers
            for reader in topic.subscribers if reader != role
        } | {PLANT}
        self._known: set[str] = {process}
        self._reports: dict[str, Report] = {}
        self._heard_first: set[str] = set()  # processes whose first tick was heard
        self.begin()

    def begin(self) -> None:
        """Begin anew: with a plant that was started again, another run begins."""
        self.answers_from: int | None = 0 if self._role == PLANT else None
        self.agreed = self._role == PLANT

    def hear(self, report: Report) -> bool:
        """Take a report.

        Returns:
            Whether its process is in the place of another one.
        """
        before = self.nodes.get(report.role)
        if report.process != before:
            if report.process in self._known:
                return False  # a last word of one that is gone
            self._known.add(report.process)
            self.nodes[report.role] = report.process
        self._reports[report.role] = report
        return before not in (None, report.process)

    def said(self) -> dict[str, Any]:
        """Return what the node says."""
        present = set(self.nodes.values())
        silent = {"silent_at": time.time_ns()} if self.answers_from is None else {}
        return {
            "nodes": self.nodes,
            "taken": {one: taken for one, taken in self.taken.items() if one in present},
            "answers_from": self.answers_from,
            "agreed": sorted(self._heard_first & present),
            **silent,
        }

    def first_of(self, role: str) -> int | None:
        """Return from which tick the present process of a role answers, if it has said so."""
        if role == PLANT:
            return 0 if role in self._reports else None
        report = self._reports.get(role)
        first: int | None = None if report is None else report.values.get("answers_from")
        return first

    def is_here(self, role: str) -> bool:
        """Whether a role's node was heard, or the plant has heard it."""
        plant = self._reports.get(PLANT)
        return role in self.nodes or (
            plant is not None and role in plant.values.get("nodes", {})
        )

    def is_foreign(self, role: str) -> bool:
        """Whether a role is that of a node of somebody else's, which says nothing of its ticks."""
        plant = self._reports.get(PLANT)
        return role not in self.nodes and plant is not None and "nodes" in plant.values and (
            role not in plant.values["nodes"]
        )

    def must_be_told(self, role: str) -> bool:
        """Whether the node has not yet said what it has of a role's present process."""
        return role in self.nodes and self.nodes[role] not in self.taken

    def tell(self, role: str, taken: dict[str, int]) -> None:
        """Say what the node has of a role's topics."""
        self.taken[self.nodes[role]] = taken

    def may_agree(self, role: str) -> bool:
        """Whether a role's present process has said its first tick, and it was not yet taken.

        The plant's report is then one that it made after it had heard of that process: what it has
        received by then is what the process before it said last.
        """
        process = self.nodes.get(role)
        plant = self._reports.get(PLANT)
        return (
            process in self.taken and process not in self._heard_first
            and self.first_of(role) is not None
            and (
                PLANT in (role, self._role)
                or (plant is not None and process in plant.values.get("taken", {}))
            )
        )

    def agree(self, role: str) -> None:
        """Say that the node knows from which tick a role's present process answers."""
        self._heard_first.add(self.nodes[role])

    def decide(self, *, supervised: bool) -> bool:
        """Decide from which tick the node answers, or note that all know it.

        Args:
            supervised: whether all nodes were started for one run, so that a plant that has
                finished is that of the node's.

        Returns:
            Whether something changed.

        Raises:
            LockstepError: what came to one reader and not to another cannot be answered again.
        """
        if self.agreed:
            return False
        asked = self._asked(supervised=supervised)
        if asked is None:
            return False
        if self.answers_from is not None:
            self.agreed = all(self._process in one.values["agreed"] for one in asked)
            return self.agreed
        taken = {one.role: one.values["taken"].get(self._process) for one in asked}
        if None in taken.values():
            return False
        if self._repeats:
            self.answers_from = min(n for one in taken.values() for n in one.values())
            return True
        self.answers_from = max(taken[PLANT].values(), default=0)
        # The recorder puts right what it has; see there.
        for role in taken.keys() - {PLANT, "recorder"}:
            for topic, count in taken[role].items():
                if count != self.answers_from:
                    raise LockstepError(
                        f"{topic} of tick {min(count, self.answers_from)} came from a "
                        f"{self._role} that has ended to one of plant and {role} alone: the run "
                        "cannot go on; end all nodes and start it again"
                    )
        return True

    def _asked(self, *, supervised: bool) -> list[Report] | None:
        """Return the newest reports of all who read what the node publishes; None: not all."""
        plant = self._reports.get(PLANT)
        if plant is None or "nodes" not in plant.values or (
            plant.state in (FINISHED, ENDED) and not supervised
        ):
            return None
        asked = {**plant.values["nodes"], PLANT: plant.process}
        asked.pop(self._role, None)
        found = []
        for role in self._readers & asked.keys():
            report = self._reports.get(role)
            if report is None or report.process != asked[role] or "taken" not in report.values:
                return None
            found.append(report)
        return found
