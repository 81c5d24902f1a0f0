"""The publishers of a topic, as ROS knows them: who they are, and whether their QoS fits."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from rclpy.node import Node

from greenroof_ros.common.interface import Qos, Topic
from greenroof_ros.graph.messages import describe_qos, find_lacking

# A node's name and its other endpoints may be discovered this long after its publisher (s).
DISCOVERY_S = 1.0
# The name that ROS reports for a node whose name has not been discovered yet.
_UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
# Maximum number of nodes named in a sentence: a client may join again and again under new names.
_NAMED = 5


class Publishers:
    """The publishers of a topic; reports a second one, and one whose messages cannot arrive.

    All publishers that ROS knows count. ROS is polled for them, since a middleware event can lock
    up rclpy's fast executor while a peer's liveliness changes (rmw_fastrtps, pull request 890). ROS
    knows about a publisher before its first message arrives.

    Attributes:
        topic: the topic in the interface.
        full_name: the topic's full name in ROS, with its namespace.
        required: the quality of service that a publisher must offer to be compatible.
    """

    def __init__(self, node: Node, topic: Topic, required: Qos) -> None:
        """Prepare for a subscription.

        Args:
            node: the subscribing node.
            topic: the topic in the interface.
            required: the quality of service of the subscription.
        """
        self.topic = topic
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
        """The number of publishers with a compatible quality of service, whose messages arrive."""
        return len(self._endpoints()) - len(self._incompatible())

    def names(self, wait_s: float = 0.0) -> list[str]:
        """Return the names of the publishers' nodes; if all have gone, the last known names.

        Args:
            wait_s: how long to wait for a name that is not discovered yet; after the first
                messages, this may take :data:`DISCOVERY_S`.
        """
        until = time.monotonic() + wait_s
        known = {info.node_name for info in self._endpoints()}
        while _UNKNOWN_NAME in known and time.monotonic() < until:
            time.sleep(0.01)
            known = {info.node_name for info in self._endpoints()}
        self._names = sorted(map(display_name, known)) or self._names
        return self._names

    def describe_second(self, wait_s: float = 0.0) -> str:
        """Return a clause about a second publisher; empty if there is none.

        Args:
            wait_s: as for :meth:`names`.
        """
        count = self.count
        if count < 2 or len(self._endpoints()) < 2:
            return ""
        names = list_nodes(self.names(wait_s))
        return (
            f"has {count} publishers ({names}), but must have only one: end the "
            "other, or use another ROS_DOMAIN_ID or --namespace"
        )

    def describe_incompatible(self) -> str:
        """Return a clause on which publishers are incompatible, and why; empty if none is.

        DDS does not connect a publisher to a subscription that requests more than it offers, and
        reports only one of the mismatched policies. The profiles of both are known, so all are
        listed.
        """
        incompatible = self._incompatible()
        if not incompatible:
            return ""
        names = sorted({display_name(info.node_name) for info in incompatible})
        offered = [find_lacking(info.qos_profile, self.required) for info in incompatible]
        why = dict.fromkeys(word for words in offered for word in words)
        return (
            f"has a publisher with an incompatible QoS ({list_nodes(names)}): it "
            f"{' and '.join(why)}, but must be {describe_qos(self.required)}; change it, or end it"
        )

    def warning(self, now: float) -> str:
        """Return a sentence on publishers that stay incompatible for the discovery time, or "".

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
    """Return the name of a node for a message.

    A node that joined just before another one was killed may discover its topics but never its
    name.
    """
    if name == _UNKNOWN_NAME:
        return "a node of unknown name, perhaps because it was killed"
    return name


def list_nodes(names: Sequence[str]) -> str:
    """Return the names of nodes for a sentence: the first five, and how many more there are."""
    more = [f"and {len(names) - _NAMED} more"] if len(names) > _NAMED else []
    return ", ".join([*names[:_NAMED], *more])
