"""Nodes of a simulation that failed, started again in the same run."""

from __future__ import annotations

import sys
import time
from collections import Counter
from typing import Any

from greenroof_ros.common.command_line import EXIT_FAILED
from greenroof_ros.graph.node_processes import NodeFailed
from greenroof_ros.graph.states import FINISHED, READY, RECORDER
from greenroof_ros.graph.supervisor import Supervisor

# How often one node is started again in a run.
MOST = 5
# What a node's process holds and a new one could not have: the state of the plant itself.
_NEVER = "plant"
# Arguments of a new process beside those of the first.
_FURTHER = {RECORDER: ("-p", "go_on:=true")}


class Restarts:
    """Starts weather, controller, pump node and recorder again when they die or hang.

    A node that ended with a sentence of its own is not: it would say the same again.

    Attributes:
        incidents: what happened, for the summary: ``node``; ``tick`` from which the new process
            answers, and ``restarted_after_s`` (s), both None where it ended before; ``how``
            the old one ended; ``lost``: topic and tick of each message that is not in the bag.
        parameter_changes: of processes that ended, and the return to what was configured.
        refused: how many values processes that ended had refused, by topic.
    """

    def __init__(self, supervisor: Supervisor) -> None:
        """Begin without any incident."""
        self.incidents: list[dict[str, Any]] = []
        self.parameter_changes: list[dict[str, Any]] = []
        self.refused: Counter[str] = Counter()
        self._supervisor = supervisor
        self._since: dict[str, float] = {}
        self._open: dict[str, dict[str, Any]] = {}
        self._changed: dict[str, list[dict[str, Any]]] = {}

    def start_again(self, failure: NodeFailed) -> set[str]:
        """Start the nodes of a failure again.

        Returns:
            Those that were started.

        Raises:
            NodeFailed: the failure, where that is no use.
        """
        supervisor = self._supervisor
        started = set()
        for node in failure.nodes:
            last = supervisor.last.get(node, {})
            if last.get("state") == FINISHED:
                supervisor.let_go(node)  # it had said all
                continue
            count = sum(incident["node"] == node for incident in self.incidents)
            if node == _NEVER or "failure" in last or failure.code != EXIT_FAILED or count >= MOST:
                raise failure
            self._note(node, failure.how)
            supervisor.start_again(node, *_FURTHER.get(node, ()))
            started.add(node)
        return started

    def _note(self, node: str, how: str) -> None:
        last = self._supervisor.last.get(node, {})
        incident: dict[str, Any] = {
            "node": node, "tick": None, "how": how, "restarted_after_s": None, "lost": [],
        }
        self.incidents.append(incident)
        self._open[node] = incident
        self._since[node] = time.monotonic()
        self.refused.update(last.get("refused", {}))
        changes = last.get("parameter_changes", [])
        self.parameter_changes += changes
        if changes:
            self._changed[node] = changes
        print(f"warning: node {node} ended ({how}) and is started again", file=sys.stderr)

    def hear(self, node: str, report: dict[str, Any]) -> None:
        """Take a node's report: one that was started again may be in the run by now."""
        for topic, tick in report.get("lost", []):
            # It was lost with the process in the place of which another one went on next.
            incident = min(
                (one for one in self.incidents if one["tick"] is not None and one["tick"] > tick
                 and one["node"] not in (RECORDER, "weather")),
                key=lambda one: int(one["tick"]), default=None,
            )
            if incident is not None and [topic, tick] not in incident["lost"]:
                incident["lost"].append([topic, tick])
        tick = report.get("answers_from")
        if node not in self._open or tick is None or report["state"] not in (READY, FINISHED):
            return
        incident = self._open.pop(node)
        incident["tick"] = tick
        incident["restarted_after_s"] = round(time.monotonic() - self._since[node], 1)
        configured: dict[str, Any] = {}
        present: dict[str, Any] = {}
        for change in self._changed.pop(node, []):
            configured.setdefault(change["parameter"], change["before"])
            present[change["parameter"]] = change["value"]
        self.parameter_changes += [
            {"tick": tick, "parameter": name, "before": present[name], "value": value}
            for name, value in configured.items() if present[name] != value
        ]
        print(
            f"warning: node {node} goes on from tick {tick}, after "
            f"{incident['restarted_after_s']:g} s", file=sys.stderr,
        )
