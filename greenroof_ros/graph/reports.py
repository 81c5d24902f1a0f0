"""A node's state, on /diagnostics and to the process that started it, and those of its peers."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.qos import qos_profile
from greenroof_ros.graph.states import FINISHED, REPORT_PIPE, STARTING


class Reports:
    """Says a node's state, and hears those of the other nodes of its namespace.

    /diagnostics is one topic for all nodes of a domain, as everywhere in ROS; a status has the
    node's fully qualified name, and its values are written as JSON.

    Attributes:
        state: of the node: starting, ready or finished.
        publisher: of the reports.
        final: the values of the reports of nodes that have finished, by node.
    """

    def __init__(self, node: Node, on_finished: Callable[[str], None]) -> None:
        """Open the topic and, where a parent process wants reports, the pipe to it.

        Args:
            node: whose state it is.
            on_finished: called with the name of a node that has finished, at each of its reports.
        """
        self.state = STARTING
        self.final: dict[str, dict[str, Any]] = {}
        self._node = node
        self._on_finished = on_finished
        self._pipe: int | None = None
        if REPORT_PIPE in os.environ:
            self._pipe = int(os.environ[REPORT_PIPE])
            os.set_blocking(self._pipe, False)
        topic = read_topics()["/diagnostics"]
        profile = qos_profile(topic.qos)
        self.publisher = node.create_publisher(DiagnosticArray, topic.graph_name, profile)
        node.create_subscription(DiagnosticArray, topic.graph_name, self._on_reports, profile)

    def say(self, values: dict[str, Any]) -> None:
        """Publish the node's state with these values."""
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK,
            name=self._node.get_fully_qualified_name(),
            message=self.state,
            values=[KeyValue(key=key, value=json.dumps(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self.publisher.publish(array)
        if self._pipe is not None:
            # A reader that is stopped must not stop the node: what does not fit is dropped, and
            # said again a moment later.
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                line = json.dumps({"state": self.state, **values})
                os.write(self._pipe, f"{line}\n".encode())

    def _on_reports(self, array: DiagnosticArray) -> None:
        for status in array.status:
            namespace, _, name = status.name.rpartition("/")
            if status.message != FINISHED or (namespace or "/") != self._node.get_namespace():
                continue
            with contextlib.suppress(json.JSONDecodeError):  # another's status of that name
                self.final[name] = {entry.key: json.loads(entry.value) for entry in status.values}
                self._on_finished(name)
