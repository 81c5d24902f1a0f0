"""A node's state, on /diagnostics and to the process that started it."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.node import Node

from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.messages import qos_profile
from greenroof_ros.graph.supervision import STARTING, SupervisorSocket

# How a part of a node is, as tools know it.
OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE
LEVELS = {OK: "OK", WARN: "WARN", ERROR: "ERROR", STALE: "STALE"}


@dataclass(frozen=True)
class Diagnosis:
    """How a part of a node is.

    Attributes:
        level: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
        message: a sentence.
        code: for programs; empty where all is well.
        cause: the code that it follows from; empty where that is not known.
        since: when it began to have this code, by the system's clock (s since 1970).
    """

    level: bytes
    message: str
    code: str
    cause: str
    since: float

    def for_programs(self) -> dict[str, str]:
        """Return its code, since when it has it (ISO 8601), and its cause; each may be empty."""
        since = datetime.fromtimestamp(self.since, timezone.utc).isoformat(timespec="seconds")
        return {"code": self.code, "since": since if self.code else "", "cause": self.cause}


class Reports:
    """Says a node's state.

    /diagnostics is one topic for all nodes of a domain, as everywhere in ROS; a status has the
    node's fully qualified name, and its values are written as JSON. The status of a part has the
    part's name behind it: ``/mpc: inputs``. Name and hardware of a status are the same after a
    restart: tools take them for the identity of what they show. A status that is not OK, and one of
    a node that waits, has a code of :mod:`greenroof_ros.common.interface`: programs
    go by that, and none by a sentence.

    Attributes:
        state: of the node.
        diagnoses: of its parts, by name.
        numbers: of its parts, by name: what was measured or counted; None is not known.
        hardware: what its parts are about, where that is a device; otherwise the machine.
        publisher: of the reports.
        supervisor: of the node, if it has one.
    """

    def __init__(self, node: Node, role: str) -> None:
        """Open the topic and, where somebody supervises the node, the socket to it.

        Args:
            node: whose state it is.
            role: what the interface calls it.
        """
        self.state = STARTING
        self.diagnoses: dict[str, Diagnosis] = {}
        self.numbers: dict[str, Mapping[str, float | None]] = {}
        self.hardware = ""
        self._own: Diagnosis | None = None  # of the node itself
        self._node = node
        self._role = role
        self._machine = socket.gethostname()
        self._process = f"{self._machine} {os.getpid()}"  # another one after a restart
        self.supervisor = SupervisorSocket()
        topic = read_topics()["/diagnostics"]
        profile = qos_profile(topic.qos)
        self.publisher = node.create_publisher(DiagnosticArray, topic.graph_name, profile)

    def diagnose(self, part: str, level: bytes, message: str, code: str, cause: str) -> bool:
        """Keep how a part is, and return whether that is another diagnosis than before."""
        before = self.diagnoses.get(part)
        self.diagnoses[part] = _dated(before, level, message, code, cause)
        return self.diagnoses[part] != before

    def say(self, values: dict[str, Any]) -> None:
        """Publish the node's state with these values.

        It is an error where they say why the node failed, and a warning where they have warnings.
        One that waits for its peers is well, and says so by its code.
        The stamp is the node's time; until simulated time begins, the system's: tools take 0
        for a stamp that was forgotten.
        """
        level, code = OK, ""
        if "failure" in values:
            level, code = ERROR, "node_failed"
        elif values["warnings"]:
            level, code = WARN, "input_publishers"
        elif self.state == STARTING:
            code = "peers_awaited"
        self._own = diagnosis = _dated(self._own, level, self.state, code)
        of_code = {key: text for key, text in diagnosis.for_programs().items() if text}
        values = {"role": self._role, "process": self._process, **of_code, **values}
        name = self._node.get_fully_qualified_name()
        status = DiagnosticStatus(
            level=level, name=name, message=self.state, hardware_id=self._machine,
            values=[KeyValue(key=key, value=json.dumps(value)) for key, value in values.items()],
        )
        parts = [
            DiagnosticStatus(
                level=diagnosis.level, name=f"{name}: {part}", message=diagnosis.message,
                hardware_id=self.hardware or self._machine,
                values=_values(diagnosis, self.numbers.get(part, {})),
            )
            for part, diagnosis in self.diagnoses.items()
        ]
        array = DiagnosticArray(status=[status, *parts])
        now = self._node.get_clock().now()
        array.header.stamp = (now if now.nanoseconds else Clock().now()).to_msg()
        self.publisher.publish(array)
        diagnoses = {
            part: {
                "level": LEVELS[diagnosis.level], "message": diagnosis.message,
                **diagnosis.for_programs(),
            }
            for part, diagnosis in self.diagnoses.items()
        }
        self.supervisor.report({"state": self.state, **values, "diagnoses": diagnoses})


def _dated(
    before: Diagnosis | None, level: bytes, message: str, code: str, cause: str = ""
) -> Diagnosis:
    """Return a diagnosis that goes on since the one before it began, where its code is the same."""
    since = time.time() if before is None or before.code != code else before.since
    return Diagnosis(level, message, code, cause, since)


def _values(diagnosis: Diagnosis, numbers: Mapping[str, float | None]) -> list[KeyValue]:
    """Return what the status of a part says to programs: its code, and its numbers."""
    values = {key: f"{number:.6g}" for key, number in numbers.items() if number is not None}
    values |= diagnosis.for_programs()
    return [KeyValue(key=key, value=value) for key, value in values.items() if value]
