"""Report a node's state on /diagnostics."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.node import Node

from greenroof_ros.common.conditions import Problem, Value
from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.messages import qos_profile
from greenroof_ros.graph.states import STARTING

# The levels of a diagnosis, as ROS tools know them.
OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE
# The longest value on /diagnostics (characters): observers read no value above 20,000, such as the
# weeks of a run of decades.
_LONGEST = 16_000
LEVELS = {OK: "OK", WARN: "WARN", ERROR: "ERROR", STALE: "STALE"}


@dataclass(frozen=True)
class Diagnosis:
    """The state of a node or of a part of it.

    Attributes:
        level: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
        message: a sentence; for the node itself, its state.
        code: for programs; empty if all is well.
        cause: the code of the cause; empty if unknown.
        since: when the present code began, by the system clock (s since 1970).
        values: what the sentence is made of.
    """

    level: bytes
    message: str
    code: str
    cause: str
    since: float
    values: Mapping[str, Value] = field(default_factory=dict)

    def for_programs(self) -> dict[str, str]:
        """Return its code, the start of that code (ISO 8601), and its cause; each can be empty."""
        since = datetime.fromtimestamp(self.since, timezone.utc).isoformat(timespec="seconds")
        return {"code": self.code, "since": since if self.code else "", "cause": self.cause}


class Reports:
    """Reports a node's state.

    As usual in ROS, /diagnostics is one topic for all nodes of a domain. The name of a status is
    the node's fully qualified name; its values are JSON. The status of a part adds the part's name:
    ``/mpc: inputs``. Name and hardware of a status stay the same after a restart, since tools use
    them as its identity. A status that is not OK, or comes from a waiting node, has a code of
    :mod:`greenroof_ros.common.conditions`: programs use code and values, never the sentence.

    Attributes:
        state: the node's state.
        diagnoses: diagnoses of the node's parts, by name.
        numbers: measured or counted values of the node's parts, by name; None if unknown.
        hardware: the device that the parts belong to; empty for the machine.
        urgent: whether a diagnosis has changed since the last report.
        publisher: publishes the reports.
    """

    def __init__(self, node: Node, role: str) -> None:
        """Open the topic.

        Args:
            node: the node.
            role: its role in the interface.
        """
        self.state = STARTING
        self.diagnoses: dict[str, Diagnosis] = {}
        self.numbers: dict[str, Mapping[str, float | None]] = {}
        self.hardware = ""
        self.urgent = False
        self._current: Diagnosis | None = None  # the node's own
        self._node = node
        self._role = role
        self._machine = socket.gethostname()
        self._process = f"{self._machine} {os.getpid()}"  # changes at a restart
        self._began = time.monotonic()
        topic = read_topics()["/diagnostics"]
        profile = qos_profile(topic.qos)
        self.publisher = node.create_publisher(DiagnosticArray, topic.graph_name, profile)

    def diagnose(
        self, part: str, problem: Problem | None, well: str = "", level: bytes = ERROR,
        cause: str = "", *, log: bool = True,
    ) -> None:
        """Set the diagnosis of a part; a change is logged, and reported soon.

        Args:
            part: the part's name.
            problem: what is wrong; None if nothing is.
            well: the sentence to report if nothing is.
            level: of the problem: ``WARN``, ``ERROR`` or ``STALE``; or ``OK`` if it is as intended.
            cause: the code of its cause; empty if unknown.
            log: false for a message that changes too often to be logged.
        """
        before = self.diagnoses.get(part)
        if problem is None:
            problem, level = Problem("", well), OK
        diagnosis = self.diagnoses[part] = _dated(before, level, problem, cause)
        if not log or diagnosis == before:
            return
        self.urgent = True
        logger = self._node.get_logger()
        if level == WARN:
            logger.warning(diagnosis.message)
        elif level != OK:
            logger.error(diagnosis.message)
        elif before is not None:
            logger.info(diagnosis.message)

    def publish(self, values: dict[str, Any]) -> dict[str, Any]:
        """Publish the node's state with these values; return all, with the parts' diagnoses.

        The level is ERROR if they have a failure, and WARN if they have warnings. A node that waits
        for its peers is OK, with a code that says so. The stamp is the node's time, or the system's
        until simulated time begins: tools take 0 for a missing stamp.
        """
        self.urgent = False
        level, code = OK, ""
        if "failure" in values:
            level, code = ERROR, "node_failed"
        elif values["warnings"]:
            level, code = WARN, "input_publishers"
        elif self.state == STARTING:
            code = "peers_awaited"
        self._current = diagnosis = _dated(self._current, level, Problem(code, self.state))
        of_code = {key: text for key, text in diagnosis.for_programs().items() if text}
        values = {
            "role": self._role, "process": self._process,
            "up_s": round(time.monotonic() - self._began, 1), **of_code, **values,
        }
        name = self._node.get_fully_qualified_name()
        status = DiagnosticStatus(
            level=level, name=name, message=self.state, hardware_id=self._machine,
            values=[
                KeyValue(key=key, value=text) for key, value in values.items()
                if len(text := json.dumps(value)) <= _LONGEST
            ],
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
        return {"state": self.state, **values, "diagnoses": diagnoses}


def _dated(
    before: Diagnosis | None, level: bytes, problem: Problem, cause: str = ""
) -> Diagnosis:
    """Return a diagnosis; it keeps the start of the previous one if that has the same code."""
    since = time.time() if before is None or before.code != problem.code else before.since
    return Diagnosis(level, problem.sentence, problem.code, cause, since, problem.values)


def _values(diagnosis: Diagnosis, numbers: Mapping[str, float | None]) -> list[KeyValue]:
    """Return the values in the status of a part: its numbers, code, start and cause."""
    values = {
        key: f"{value:.6g}" if isinstance(value, (float, int)) else str(value)
        for key, value in {**diagnosis.values, **numbers}.items() if value is not None
    }
    values |= diagnosis.for_programs()
    return [KeyValue(key=key, value=value) for key, value in values.items() if value]
