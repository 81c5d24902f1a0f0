"""The known publishers of a topic, and a check of their quality of service."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from rclpy.node import Node

from greenroof_ros.interface.topics import Qos, Topic
from greenroof_ros.ros.messages import describe_qos, find_lacking

# A node's name and its other endpoints may be discovered this long after its publisher (s).
DISCOVERY_S = 1.0
# The name that ROS reports for a node whose name has not been discovered yet.
_UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
# Maximum number of nodes named in a sentence: a client may join again and again under new names.
_NAMED = 5


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
        self._names: list[str] = []
        self._incompatible_since = math.inf

    @property
    def count(self) -> int:
        """The number of publishers."""
        return self._node.count_publishers(self.full_name)

    @property
    def compatible(self) -> int:
        """The number of publishers that have a compatible quality of service."""
        return len(self._endpoints()) - len(self._incompatible())

    def names(self, wait_s: float = 0.0) -> list[str]:
        """Return the names of the publishers' nodes, or the last known names if all are gone.

        Args:
            wait_s: maximum wait for names that have not been discovered yet (s); after the first
                messages, discovery may take :data:`DISCOVERY_S`.
        """
        until = time.monotonic() + wait_s
        known = {info.node_name for info in self._endpoints()}
        while _UNKNOWN_NAME in known and time.monotonic() < until:
            time.sleep(0.01)
            known = {info.node_name for info in self._endpoints()}
        self._names = sorted(map(display_name, known)) or self._names
        return self._names

    def describe_second(self, wait_s: float = 0.0) -> str:
        """Return a predicate that reports a second publisher, or "" if there is none.

        Args:
            wait_s: maximum wait for names (s), as in :meth:`names`.
        """
        count = self.count
        if count < 2 or len(self._endpoints()) < 2:
            return ""
        names = list_nodes(self.names(wait_s))
        return (
            f"has {count} publishers ({names}), but must have only one: stop the other publisher, "
            "or use another ROS_DOMAIN_ID or --namespace"
        )

    def describe_incompatible(self) -> str:
        """Return a predicate that reports incompatible publishers, or "" if there are none.

        DDS does not connect a publisher to a subscription that requests more than the publisher
        offers, and reports only one of the mismatched policies. The profiles of both sides are
        known, so this method lists all mismatched policies.
        """
        incompatible = self._incompatible()
        if not incompatible:
            return ""
        names = sorted({display_name(info.node_name) for info in incompatible})
        offered = [find_lacking(info.qos_profile, self.required) for info in incompatible]
        why = dict.fromkeys(word for words in offered for word in words)
        # Of every publisher, though a live node asks for no earlier messages.
        needed = replace(self.required, durability=self.topic.qos.durability)
        return (
            f"has a publisher with an incompatible QoS ({list_nodes(names)}): it "
            f"{' and '.join(why)}, but must be {describe_qos(needed)}; change its QoS, or stop it"
        )

    def warning(self, now: float) -> str:
        """Return a sentence about publishers still incompatible after the discovery time, or "".

        Args:
            now: time on the steady clock (s).
        """
        problem = self.describe_incompatible()
        self._incompatible_since = min(self._incompatible_since, now) if problem else math.inf
        lasts = now - self._incompatible_since >= DISCOVERY_S
        return f"{self.full_name} {problem}" if lasts else ""

    def _endpoints(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self.topic.graph_name))

    def _incompatible(self) -> list[Any]:
        return [info for info in self._endpoints() if find_lacking(info.qos_profile, self.required)]


def display_name(name: str) -> str:
    """Return the name of a node for use in a message.

    A node that joins the graph just before another node is killed may discover the topics of the
    killed node, but never its name.
    """
    if name == _UNKNOWN_NAME:
        return "a node whose name is unknown, perhaps because it was killed"
    return name


def list_nodes(names: Sequence[str]) -> str:
    """Return the names of the first five nodes, and the number of the others, for a sentence."""
    more = [f"and {len(names) - _NAMED} more"] if len(names) > _NAMED else []
    return ", ".join([*names[:_NAMED], *more])
