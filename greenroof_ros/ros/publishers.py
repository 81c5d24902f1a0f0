"""The known publishers of a topic, and a check of their quality of service."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

from greenroof_ros.interface.topics import Qos, Topic
from greenroof_ros.ros.messages import find_lacking


class Publishers:
    """The publishers of a topic, including superfluous and incompatible ones.

    All publishers that ROS knows of are counted. ROS is polled for the publishers, because a
    middleware event can lock up rclpy's fast executor when the liveliness of a peer changes
    (rmw_fastrtps, pull request 890). ROS knows about a publisher before its first message arrives.

    Attributes:
        topic: the topic in the interface.
        full_name: the topic's full name in ROS, with its namespace.
        required: the quality of service that a publisher must offer to be compatible.
        optional: whether the subscribing node acts without the topic.
    """

    def __init__(
        self, node: Node, topic: Topic, required: Qos, *, optional: bool = False
    ) -> None:
        """Create an object for the publishers that a subscription receives messages from.

        Args:
            node: the subscribing node.
            topic: the topic in the interface.
            required: the quality of service of the subscription.
            optional: whether the subscribing node acts without the topic.
        """
        self.topic, self.optional = topic, optional
        self.full_name: str = node.resolve_topic_name(topic.graph_name)
        self.required = required
        self._node = node

    @property
    def count(self) -> int:
        """The number of publishers."""
        return self._node.count_publishers(self.full_name)

    @property
    def compatible(self) -> int:
        """The number of publishers that have a compatible quality of service."""
        return len(self._endpoints()) - len(self._incompatible())

    def names(self) -> list[str]:
        """Return the names of the publishers' nodes."""
        return sorted({name_owner(info) for info in self._endpoints()})

    def describe_conflict(self) -> str:
        """Return a predicate that reports an incompatible or a second publisher, or ""."""
        if incompatible := self._incompatible():
            info, lacking = incompatible[0]
            return (
                f"has a publisher with an incompatible QoS ({name_owner(info)}): it must have "
                f"{lacking}; change its QoS, or stop it"
            )
        count = self.count
        if count < 2 or len(self._endpoints()) < 2:
            return ""
        return (
            f"has {count} publishers ({', '.join(self.names())}), but must have only one: stop the "
            "other publisher, or use another ROS_DOMAIN_ID or --namespace"
        )

    def _endpoints(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self.topic.graph_name))

    def _incompatible(self) -> list[tuple[Any, str]]:
        """Return the publishers that ROS does not connect to the subscription, and why."""
        return [
            (info, lacking) for info in self._endpoints()
            if (lacking := find_lacking(info.qos_profile, self.required))
        ]


def name_owner(info: Any) -> str:
    """Return the name of an endpoint's node.

    A node that joins the graph just before another node is killed may discover the topics of the
    killed node, but never its name.
    """
    return str(info.node_name).replace("_NODE_NAME_UNKNOWN_", "a node whose name is unknown")
