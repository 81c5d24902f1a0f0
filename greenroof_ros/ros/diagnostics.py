"""Publication of a node's state on /diagnostics."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.duration import Duration
from rclpy.node import Node

from greenroof_ros.base.times import iso
from greenroof_ros.interface.states import STARTING
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.messages import qos_profile

# Maximum length of a value on /diagnostics (characters): observers read no value longer than
# 20,000, such as the rain events of a run of decades.
_MAX_LENGTH = 16_000


class NodeDiagnostics:
    """Publisher of a node's state.

    As usual in ROS, all nodes of a domain share the topic /diagnostics. The name of a status is the
    node's fully qualified name, and its values are JSON. The name and the hardware ID of a status
    stay the same after a restart, since tools identify the status by them. A status that is not OK,
    or that comes from a waiting node, includes a code from
    :mod:`greenroof_ros.interface.conditions`: programs should evaluate the code and the values,
    never the sentence.

    Attributes:
        state: the node's state.
        machine: the name of this machine.
    """

    def __init__(self, node: Node, role: str) -> None:
        """Open the topic.

        Args:
            node: the node.
            role: the node's role in the interface.
        """
        self.state = STARTING
        self.machine = socket.gethostname()
        self._code, self._since = "", 0.0  # the present code, and when it began (s since 1970)
        self._node = node
        self._role = role
        self._process = f"{self.machine} {os.getpid()}"  # it changes at a restart
        self._began = time.monotonic()
        topic = read_topics()["/diagnostics"]
        profile = qos_profile(topic.qos)
        self._publisher = node.create_publisher(DiagnosticArray, topic.graph_name, profile)

    def publish(self, values: dict[str, Any]) -> None:
        """Publish the node's state with the given values; see :meth:`status`."""
        self.send([self.status(values)[0]])

    def status(self, values: dict[str, Any]) -> tuple[DiagnosticStatus, dict[str, Any]]:
        """Return the node's status with the given values, and a dictionary of all values in it.

        The level is ERROR if the values include a failure, and WARN if they include warnings. The
        level of a node that waits for its peers is OK, with the code ``peers_awaited``.
        """
        level, code = DiagnosticStatus.OK, ""
        if "failure" in values:
            level, code = DiagnosticStatus.ERROR, "node_failed"
        elif values["warnings"]:
            refused = values.get("refused")
            level, code = DiagnosticStatus.WARN, (
                "values_refused" if refused else "input_publishers"
            )
        elif self.state == STARTING:
            code = "peers_awaited"
        if code != self._code:
            self._code, self._since = code, time.time()
        of_code = {"code": code, "since": iso(self._since)} if code else {}
        values = {
            "role": self._role, "process": self._process,
            "up_s": round(time.monotonic() - self._began, 1), **of_code, **values,
        }
        return DiagnosticStatus(
            level=level, name=self._node.get_fully_qualified_name(), message=self.state,
            hardware_id=self.machine,
            values=[
                KeyValue(key=key, value=text) for key, value in values.items()
                if len(text := json.dumps(value)) <= _MAX_LENGTH
            ],
        ), values

    def send(self, statuses: Sequence[DiagnosticStatus]) -> None:
        """Publish statuses of the node.

        The time stamp is the node's time, or the system's time until simulated time begins, because
        tools treat 0 as a missing time stamp.
        """
        array = DiagnosticArray(status=statuses)
        now = self._node.get_clock().now()
        array.header.stamp = (now if now.nanoseconds else Clock().now()).to_msg()
        self._publisher.publish(array)

    def flush(self, seconds: float) -> None:
        """Wait up to the given time (s) until all readers have received all reports."""
        self._publisher.wait_for_all_acked(Duration(seconds=seconds))
