"""Exactly one live publisher for each topic that a node subscribes to."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from rclpy.duration import Infinite
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.qos import qos_profile

# The name of a node is known a moment after its publisher; how long to wait for it (s).
_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_NAMING_S = 0.5


class PublisherWatch:
    """How many publishers a topic has; a second one is refused.

    Where the interface gives a topic a liveliness lease, those that live are counted, otherwise
    those that are matched: a killed process stays matched for 20 s.

    Attributes:
        topic: what the interface says of it.
        name: of the topic on the wire, with its namespace.
        count: of its publishers.
    """

    def __init__(
        self, node: Node, topic: Topic, refuse: Callable[[str], None], *, recorded: bool
    ) -> None:
        """Prepare for a subscription.

        Args:
            node: subscribes to it.
            topic: the interface's.
            refuse: called with a message that names them, when there are two.
            recorded: the node only keeps what is published. Each message of a topic with a lease
                sets a timer again in its reader; only where a node acts on it is that worth it.
        """
        self.topic = topic
        self.name = node.resolve_topic_name(topic.graph_name)
        self.count = 0
        self._node = node
        self._refuse = refuse
        self._lease = math.isfinite(topic.qos.lease_s) and not recorded

    def profile(self) -> QoSProfile:
        """Return the profile of the subscription."""
        profile = qos_profile(self.topic.qos)
        if not self._lease:
            profile.liveliness_lease_duration = Infinite
        return profile

    def events(self) -> SubscriptionEventCallbacks:
        """Return the callbacks of the subscription, which count."""
        if self._lease:
            return SubscriptionEventCallbacks(liveliness=self._on_liveliness)
        return SubscriptionEventCallbacks(matched=self._on_matched)

    def _on_liveliness(self, event: Any) -> None:
        self._on_count(event.alive_count)

    def _on_matched(self, event: Any) -> None:
        self._on_count(event.current_count)

    def _on_count(self, count: int) -> None:
        """Note how many there are, and refuse a second one.

        Without a lease two publishers of one name, a node and what it was before its restart, are
        let pass. (A third party under that name is met by its first message.)
        """
        self.count = count
        if count <= 1:
            return
        names = self._publisher_names()
        if self._lease or len(names) > 1:
            self._refuse(
                f"{self.name} has {count} publishers ({', '.join(names)}); a graph must have "
                "exactly one: end the other, or take another ROS_DOMAIN_ID or --namespace"
            )

    def _publisher_names(self) -> list[str]:
        until = time.monotonic() + _NAMING_S
        while True:
            found = self._node.get_publishers_info_by_topic(self.topic.graph_name)
            names = sorted({info.node_name for info in found})
            if _UNKNOWN not in names or time.monotonic() > until:
                return names
            time.sleep(0.02)
