"""Publishers that a graph cannot hear: each is named, with all that a publisher must be.

DDS connects no publisher to a subscription that asks for more than it offers, and says so of one of
the policies that differ. What each end has is known, and so all can be said at once.
"""

from __future__ import annotations

import math
from dataclasses import replace

from rclpy.node import Node

from greenroof_ros.common.interface import Topic, read_topics
from greenroof_ros.graph.publishers import DISCOVERY_S, UNKNOWN_NAME, Publishers, call_node
from greenroof_ros.graph.qos import lacks, requirements


class UnfitPublishers:
    """Warns of publishers whose quality of service does not fit a topic of the interface.

    Attributes:
        watched: the publishers of each topic that the node subscribes to.
        warnings: one sentence for each publisher.
    """

    def __init__(self, node: Node) -> None:
        """Begin without any.

        Args:
            node: subscribes to the topics, and logs the warnings.
        """
        self.watched: list[Publishers] = []
        self.warnings: list[str] = []
        self._node = node
        self._looked = 0.0
        self._seen: set[tuple[Topic, str]] = set()  # at the last look

    def look(self, now: float) -> None:
        """Warn of those that are there for two looks, a second apart: their names are known then.

        Args:
            now: of the steady clock (s).
        """
        if now - self._looked < DISCOVERY_S:
            return
        self._looked = now
        before, self._seen = self._seen, set()
        for publishers in self.watched:
            topic = publishers.topic
            for one in publishers.unheard():
                seen = (topic, one.node_name)
                self._seen.add(seen)
                if seen in before:
                    lacking = lacks(one.qos_profile, publishers.required)
                    self._warn(topic, one.node_name, " and ".join(lacking))

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
