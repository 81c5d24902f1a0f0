"""Publication of the states of a node and its parts on /diagnostics."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.time import Time

from greenroof_ros.base.times import iso
from greenroof_ros.interface.conditions import Diagnosis, identity_of
from greenroof_ros.interface.states import STARTING
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.messages import qos_profile

# The levels of a diagnosis, as ROS tools know them.
OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE
# How often the state is published while it does not change (s).
_PUBLISH_S = 1.0


@dataclass(frozen=True)
class Status:
    """The state of a node, or of a part of it.

    Attributes:
        level: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
        message: the state, as a word or a sentence.
        values: the code of the condition, and the values in the sentence.
        since: time at which the current code appeared, on the system clock (s since 1970).
        began: time at which the current code appeared, on the steady clock (s).
    """

    level: bytes
    message: str
    values: dict[str, Any]
    since: float
    began: float

    def list_texts(self) -> dict[str, str]:
        """Return the values for programs, with the age of the code (s) and without empty values."""
        texts = {
            key: f"{value:.6g}" if isinstance(value, (float, int)) else str(value)
            for key, value in self.values.items()
        }
        if self.values["code"]:
            texts |= {"since": iso(self.since), "age_s": f"{time.monotonic() - self.began:.1f}"}
        return {key: text for key, text in texts.items() if text}


class NodeDiagnostics:
    """Publisher of the states of a node and its parts.

    As usual in ROS, all nodes of a domain share the topic /diagnostics. The name of a status is the
    node's fully qualified name, for a part followed by the part's name: ``/mpc: inputs``. The
    values of a node are JSON, those of a part are texts. The name and the hardware ID of a status
    stay the same after a restart, since tools identify the status by them. A status that is not OK,
    or that comes from a waiting node, includes a code from
    :mod:`greenroof_ros.interface.conditions`: programs should evaluate the code and the values,
    never the sentence.

    Attributes:
        state: the node's state.
        parts: states of the node's parts, by their names; that of the node itself has no name.
        values: the values last reported.
        machine: the name of this machine.
        hardware: device to which the parts belong; empty if they belong to the computer itself.
        urgent: whether a diagnosis has changed since the last report.
    """

    def __init__(self, node: Any, role: str) -> None:
        """Open the topic.

        Args:
            node: the node.
            role: the node's role in the interface.
        """
        self.state = STARTING
        self.machine = socket.gethostname()
        self.hardware = ""
        self.values: Mapping[str, Any] = {}
        self.parts = {"": _follow(None, OK, STARTING, {"code": ""})}
        self.urgent = False
        self._node = node
        self._role = role
        self._process = f"{self.machine} {os.getpid()}"  # it changes at a restart
        self._began = time.monotonic()
        self._published: object = None
        self._published_at = 0.0
        topic = read_topics()["/diagnostics"]
        profile = qos_profile(topic.qos)
        self._publisher = node.create_publisher(DiagnosticArray, topic.graph_name, profile)

    def diagnose(
        self, part: str, diagnosis: Diagnosis | None, well: str = "", level: bytes = ERROR,
        cause: str = "", *, log: bool = True,
    ) -> None:
        """Set the diagnosis of a part; a change is logged, and reported shortly afterward.

        Args:
            part: name of the part.
            diagnosis: diagnosis of the part; None if nothing is wrong.
            well: sentence to report if nothing is wrong.
            level: ``WARN``, ``ERROR`` or ``STALE``, or ``OK`` if the condition is intended.
            cause: code of the cause; empty if unknown.
            log: whether to log a change; false for a message that changes too often.
        """
        if diagnosis is None:
            diagnosis, level = Diagnosis("", well), OK
        before = self.parts.get(part)
        values = {**diagnosis.values, "code": diagnosis.code, "cause": cause}
        status = self.parts[part] = _follow(before, level, diagnosis.sentence, values)
        if not log or status == before:
            return
        self.urgent = True
        if level != OK:
            self._node.get_logger().warning(status.message)
        elif before is not None:
            self._node.get_logger().info(status.message)

    def publish(self, values: Mapping[str, Any]) -> None:
        """Publish the node's state with the given values, and the states of its parts.

        A report is published if a state, a level or a diagnosis has changed, and otherwise once a
        second. The level is ERROR if the values include a failure. The level of a node that waits
        for its peers is OK, with the code ``peers_awaited``.
        """
        self.urgent, self.values = False, values
        level, code = OK, "peers_awaited" if self.state == STARTING else ""
        if "failure" in values:
            level, code = ERROR, "node_failed"
        own = self.parts[""] = _follow(self.parts[""], level, self.state, {"code": code})
        shown = self.state, [
            (part, status.level, identity_of(status.values)) for part, status in self.parts.items()
        ]
        now = time.monotonic()
        if shown == self._published and now - self._published_at < _PUBLISH_S:
            return
        self._published, self._published_at = shown, now
        own_texts = {key: json.dumps(value) for key, value in {
            "role": self._role, "process": self._process, "up_s": round(now - self._began, 1),
            **({"code": code, "since": iso(own.since)} if code else {}), **values,
        }.items()}
        name, array = self._node.get_fully_qualified_name(), DiagnosticArray()
        for part, status in self.parts.items():
            texts = status.list_texts() if part else own_texts
            array.status.append(DiagnosticStatus(
                level=status.level, name=f"{name}: {part}" if part else name,
                message=status.message, hardware_id=(part and self.hardware) or self.machine,
                values=[KeyValue(key=key, value=text) for key, text in texts.items()],
            ))
        # Before simulated time begins, the system's, since 0 is no time to tools.
        array.header.stamp = Time(nanoseconds=self._node.time_ns or time.time_ns()).to_msg()
        self._publisher.publish(array)


def _follow(before: Status | None, level: bytes, message: str, values: dict[str, Any]) -> Status:
    """Return a new status, which began when its code and fault appeared."""
    if before is not None and identity_of(before.values) == identity_of(values):
        return replace(before, level=level, message=message, values=values)
    return Status(level, message, values, time.time(), time.monotonic())
