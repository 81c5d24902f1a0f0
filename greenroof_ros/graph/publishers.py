"""The publishers of a topic that a node subscribes to: exactly one is believed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from greenroof_ros.common.interface import Qos, Topic
from greenroof_ros.graph.peers import Peers
from greenroof_ros.graph.qos import lacks, qos_profile, requirements

# What ROS calls a publisher whose node has not yet said its name.
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
# The name of a node and its other ends are known a moment after its publisher (s).
DISCOVERY_S = 1.0
# How many messages of a topic wait for a live recorder that is busy, or that the machine is for it.
_RECORDED_DEPTH = 1000


class Publishers:
    """How many publishers a topic has; a second one is always refused.

    In lockstep all that ROS knows count, and they are asked for: an event of the middleware can
    lock up rclpy's fast executor while the liveliness of a peer changes (rmw_fastrtps, pull
    request 890). ROS knows of a publisher before its first message arrives.

    In a live graph a node that was killed is started again, and ROS knows the dead one for 20 s.
    So events count there: where the interface gives the topic a liveliness lease those that live,
    otherwise all that match.

    Attributes:
        topic: the interface's.
        full_name: of the topic on the wire, with its namespace.
        on_change: live: called when the count changes.
    """

    def __init__(
        self, node: Node, topic: Topic, peers: Peers | None = None, *, recorded: bool = False
    ) -> None:
        """Prepare for a subscription.

        Args:
            node: subscribes to it.
            topic: the interface's.
            peers: of the node, which report; None in lockstep.
            recorded: live: the node only keeps what is published, and all of it.
        """
        self.on_change: Callable[[], None] = lambda: None
        self._node = node
        self.topic = topic
        self.full_name = node.resolve_topic_name(topic.graph_name)
        self._peers = peers
        self._recorded = recorded
        self._lease = math.isfinite(topic.qos.lease_s) and not recorded
        self._counted = 0  # live: by events
        self._unfit_since = -math.inf  # live: when the middleware last said that one is not heard
        self._names: list[str] = []

    def profile(self) -> QoSProfile:
        """Return the profile of the subscription; in a live graph the past is not asked for."""
        profile = qos_profile(self.topic.qos, lease=self._lease)
        if self._peers is not None:
            profile.durability = DurabilityPolicy.VOLATILE
            profile.depth = _RECORDED_DEPTH if self._recorded else 1
        return profile

    def events(self) -> SubscriptionEventCallbacks:
        """Return the callbacks of the subscription, which count; in lockstep there are none."""
        if self._peers is None:
            return SubscriptionEventCallbacks(use_default_callbacks=False)
        if self._lease:
            return SubscriptionEventCallbacks(
                liveliness=self._on_liveliness, incompatible_qos=self._on_unfit
            )
        return SubscriptionEventCallbacks(
            matched=self._on_matched, incompatible_qos=self._on_unfit
        )

    @property
    def count(self) -> int:
        """How many there are."""
        if self._peers is None:
            return self._node.count_publishers(self.full_name)
        return self._counted

    @property
    def heard(self) -> int:
        """How many there are whose messages arrive: their quality of service fits."""
        if self._peers is not None:
            return self._counted
        return sum(not lacks(one.qos_profile, self.required) for one in self._known())

    @property
    def required(self) -> Qos:
        """What a publisher must offer to be heard."""
        lease = self.topic.qos.lease_s if self._lease else math.inf
        durability = self.topic.qos.durability if self._peers is None else "volatile"
        return replace(self.topic.qos, lease_s=lease, durability=durability)

    def unheard(self) -> list[Any]:
        """Return what ROS knows of those that offer less."""
        return [one for one in self._known() if lacks(one.qos_profile, self.required)]

    def names(self) -> list[str]:
        """Return what to call the publishers' nodes; where all have gone, what they were called."""
        self._names = sorted({call_node(one.node_name) for one in self._known()}) or self._names
        return self._names

    def problem(self, now: float) -> str:
        """Say that there are two, if there are, or live that one is not heard.

        What a second one says may be meant to stop the pump, heard or not.

        Live, one that was killed is known for 20 s more where the topic has no lease. It does not
        count if its node was started again since, and alone reports: another process of that name,
        beside a node that lived all the time, is a second one. A count of two where one is known is
        the middleware's mistake, after a lease that ran out on a busy machine.

        Args:
            now: of the steady clock (s).
        """
        count = self.count
        if self._unfit_since > -math.inf or (self._peers is None and count > 1):
            unheard = self.unheard()
            if not unheard and now - self._unfit_since > DISCOVERY_S:
                self._unfit_since = -math.inf  # it went
            if unheard:
                who = ", ".join(sorted({call_node(one.node_name) for one in unheard}))
                return (
                    f"has a publisher that cannot be heard ({who}): end it, or make it "
                    f"{requirements(self.required)}"
                )
        if count < 2 or len(self._known()) < 2:
            return ""
        names = self.names()
        if self._peers is not None and not self._lease and len(names) == 1 and (
            self._peers.may_be_one(names[0], now)
        ):
            return ""
        return (
            f"has {count} publishers ({', '.join(names)}), and must have one: end the other, "
            "or take another ROS_DOMAIN_ID or --namespace"
        )

    def _known(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self.topic.graph_name))

    def _on_liveliness(self, event: Any) -> None:
        self._counted = event.alive_count
        self.on_change()

    def _on_matched(self, event: Any) -> None:
        self._counted = event.current_count
        self.on_change()

    def _on_unfit(self, event: Any) -> None:
        self._unfit_since = time.monotonic()
        self.on_change()


def call_node(name: str) -> str:
    """Return what to call a node in a message, by its name in the graph.

    Who joined just before another was killed may know that one's topics, and never its name.
    """
    if name == UNKNOWN_NAME:
        return "a node whose name is not known, such as one that was killed"
    return name
