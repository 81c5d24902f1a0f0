"""Publishers that a graph cannot hear: each is named, with all that a publisher must be.

DDS connects no publisher to a subscription that asks for more than it offers, and tells only one of
the policies that differ. What each end has is known, and so all can be said at once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.duration import Duration, Infinite
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from greenroof_ros.common.interface import Qos, Topic, read_topics
from greenroof_ros.graph.publishers import UNKNOWN_NAME, call_node

# The name of a node and its other ends are known a moment after its publisher (s).
DISCOVERY_S = 1.0


class UnfitPublishers:
    """Warns of publishers whose quality of service does not fit a topic of the interface.

    Attributes:
        warnings: one sentence for each.
    """

    def __init__(self, node: Node) -> None:
        """Begin without any.

        Args:
            node: subscribes to the topics, and logs the warnings.
        """
        self.warnings: list[str] = []
        self._node = node
        self._due: dict[Topic, float] = {}  # to look at, each with since when

    def on_event(
        self, topic: Topic, also: Callable[[Any], None] | None
    ) -> Callable[[Any], None]:
        """Return what a subscription to a topic calls when a publisher does not fit it.

        Args:
            topic: the interface's.
            also: what is called then, too.
        """

        def note(event: Any) -> None:
            self._due.setdefault(topic, time.monotonic())
            if also is not None:
                also(event)

        return note

    def look(self) -> None:
        """Warn of those that came a second ago."""
        if not self._due:
            return
        now = time.monotonic()
        for topic in [one for one, since in self._due.items() if now - since > DISCOVERY_S]:
            del self._due[topic]
            for publisher in self._node.get_publishers_info_by_topic(topic.graph_name):
                lacking = lacks(publisher.qos_profile, topic.qos)
                if lacking:
                    self._warn(topic, publisher.node_name, " and ".join(lacking))

    def _warn(self, topic: Topic, node_name: str, lacking: str) -> None:
        who = call_node(node_name) if node_name == UNKNOWN_NAME else f"node {node_name}"
        sentence = (
            f"{self._node.resolve_topic_name(topic.graph_name)}: what {who} publishes "
            f"does not arrive: it {lacking}, and must be {requirements(topic.qos)} "
            "(doc/real-pump.md)"
        )
        lossy = self._lossy_subscriptions(node_name)
        if lossy:
            sentence += f"; so must its subscription to {', '.join(lossy)}, or it misses messages"
        sentence += f"; a graph has exactly one publisher of it, {' or '.join(topic.publishers)}"
        if sentence not in self.warnings:
            self.warnings.append(sentence)
            self._node.get_logger().warning(sentence)

    def _lossy_subscriptions(self, node_name: str) -> list[str]:
        """Return the topics of a tick of which a node may miss messages, by their full names."""
        return [
            self._node.resolve_topic_name(topic.graph_name)
            for topic in read_topics().values()
            if topic.per_tick
            for one in self._node.get_subscriptions_info_by_topic(topic.graph_name)
            if one.node_name == node_name
            and lacks(one.qos_profile, replace(topic.qos, lease_s=math.inf))
        ]


def lacks(offered: QoSProfile, required: Qos) -> list[str]:
    """Return what an end of a topic has less than is required, each as a verb and its object."""
    found = []
    if required.reliability == "reliable" and offered.reliability != ReliabilityPolicy.RELIABLE:
        found.append("is best effort")
    if (
        required.durability == "transient_local"
        and offered.durability != DurabilityPolicy.TRANSIENT_LOCAL
    ):
        found.append("is volatile")
    lease = offered.liveliness_lease_duration
    if math.isfinite(required.lease_s) and lease > Duration(seconds=required.lease_s):
        found.append(
            "has no liveliness lease" if lease == Infinite
            else f"has a liveliness lease of {lease.nanoseconds / 1e9:g} s"
        )
    return found


def requirements(qos: Qos) -> str:
    """Return a profile in words."""
    words = f"{qos.reliability.replace('_', ' ')}, {qos.durability.replace('_', ' ')}, "
    words += f"keep last {qos.depth}"
    if math.isfinite(qos.lease_s):
        words += f", with a liveliness lease of {qos.lease_s:g} s"
    return words
