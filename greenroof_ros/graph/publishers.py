"""Exactly one live publisher for each topic that a node subscribes to."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.qos import qos_profile

# What ROS calls a publisher whose node has not yet said its name.
UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
# How long a second publisher is in doubt (s). A killed one lives until its lease of 1 s is over;
# ROS repeats the names of nodes every 3 s, and a publisher that is not of ROS never has one.
_LEASE_S = 2.0
_NAMING_S = 5.0
# How long the news of a second publisher may come behind its first message (s).
_NEWS_S = 1.0


class PublisherWatch:
    """How many publishers a topic has; a second one is in doubt, then taken or refused.

    A second publisher is either a node that was started again, and the first is dead; or there are
    two, and the run has to end. As long as that is open the topic is in doubt, and a node does not
    act on what it says. A doubt ends well in two ways:

    - Where the interface gives the topic a liveliness lease, those that live are counted, and the
      lease of one of them runs out. (A killed process stays matched for 20 s.)
    - Without a lease all publishers have one node's name: it, and what it was before its restart.
      That they do not both live is seen on the one topic of each node that has a lease.

    A second message in one tick is a doubt as well, since the news of a second publisher may come
    behind its first message: without that news it is refused.

    A topic with a lease is told of publishers by that alone, not by the event that they match, too:
    taking a matched event locks the reader behind a lock that its liveliness needs, and a node that
    takes one while the other comes stands still for ever (rmw_fastrtps, pull request 890).

    Otherwise the second is refused: two live longer than a lease, they have two names, or one of
    them left in good order, so that it lived, and what was said meanwhile may be its.

    Attributes:
        topic: what the interface says of it.
        name: of the topic on the wire, with its namespace.
        count: of its publishers.
        doubtful: whether it has two, of which one may be dead.
    """

    def __init__(
        self, node: Node, topic: Topic, refuse: Callable[[str], None],
        on_doubt: Callable[[PublisherWatch], None], on_second: Callable[..., None],
        *, recorded: bool,
    ) -> None:
        """Prepare for a subscription.

        Args:
            node: subscribes to it.
            topic: the interface's.
            refuse: called with a message that names them, when there are two.
            on_doubt: called when a doubt begins, and when it ends.
            on_second: called when a publisher comes beside another; ``answered`` says whether it
                has answered the present tick already.
            recorded: the node only keeps what is published. Each message of a topic with a lease
                sets a timer again in its reader; only where a node acts on it is that worth it.
        """
        self.topic = topic
        self.name = node.resolve_topic_name(topic.graph_name)
        self.count = 0
        self.doubtful = False
        self._twice = False
        self._node = node
        self._refuse = refuse
        self._on_doubt = on_doubt
        self._on_second = on_second
        self._lease = math.isfinite(topic.qos.lease_s) and not recorded
        self._known = 0  # those that match; where there is a lease, alive or not
        self._since = 0.0

    def profile(self) -> QoSProfile:
        """Return the profile of the subscription."""
        return qos_profile(self.topic.qos, lease=self._lease)

    def events(self) -> SubscriptionEventCallbacks:
        """Return the callbacks of the subscription, which count."""
        if self._lease:
            return SubscriptionEventCallbacks(liveliness=self._on_liveliness)
        return SubscriptionEventCallbacks(matched=self._on_matched)

    def names(self) -> list[str]:
        """Return the names of the publishers' nodes, as far as they are known."""
        return sorted(self._names() - {UNKNOWN_NAME})

    def settle(self, now: float) -> None:
        """Look whether a doubt is over, and refuse a second publisher that stays.

        Args:
            now: of the steady clock (s).
        """
        passed = now - self._since
        if self._twice:
            if passed > _NEWS_S:
                self._refuse(self._said_twice())
            return
        names = self._names()
        if UNKNOWN_NAME in names and passed < _NAMING_S:
            return
        if self._lease:
            if self.count > 1 and passed > _LEASE_S:
                self._refuse_second(self.count)
            elif self.count <= 1 and passed > _NEWS_S:
                self._doubt(False)  # the first one's lease ran out before the second came
        elif len(names) > 1:
            self._refuse_second(self.count)
        else:
            self._doubt(False)

    def came_twice(self) -> None:
        """Note that two messages came in one tick; a third is one too many whoever sends it."""
        if self._twice:
            self._refuse(self._said_twice())
        self._twice = True
        self._since = time.monotonic()
        self._doubt(True)

    def _on_liveliness(self, event: Any) -> None:
        self._on_count(event.alive_count, event.alive_count + event.not_alive_count)

    def _on_matched(self, event: Any) -> None:
        self._on_count(event.current_count, event.current_count)

    def _on_count(self, count: int, known: int) -> None:
        """Note how many there are: those that live, and all that are known."""
        left = known < self._known  # in good order
        came = known > self._known > 0
        self._known = known
        if came:
            self._on_second(answered=self._twice)
            self._twice = False
        before, self.count = self.count, count
        if count > max(before, 1):
            self._since = time.monotonic()
            self._doubt(True)
        elif self.doubtful and count < before:
            if left:
                self._refuse_second(before, "one that has left")
            elif count == 1 and not self._twice:
                self._doubt(False)

    def _doubt(self, doubtful: bool) -> None:
        self.doubtful = doubtful
        self._on_doubt(self)

    def _said_twice(self) -> str:
        return (
            f"{self.name} came twice in one tick ({self.said_names()}); another publisher, or "
            "nodes of an earlier run, are in this graph"
        )

    def said_names(self, *others: str) -> str:
        """Return the names of the publishers' nodes, and of some others, for a message."""
        unnamed = [call_node(UNKNOWN_NAME)] if UNKNOWN_NAME in self._names() else []
        return ", ".join([*self.names(), *unnamed, *others])

    def _refuse_second(self, count: int, *others: str) -> None:
        self._refuse(
            f"{self.name} has {count} publishers ({self.said_names(*others)}); a graph must have "
            "exactly one: end the other, or take another ROS_DOMAIN_ID or --namespace"
        )

    def _names(self) -> set[str]:
        return names_of_publishers(self._node, self.topic.graph_name)


def call_node(name: str) -> str:
    """Return what to call a node in a message, by its name in the graph.

    Who joined just before another was killed may know that one's topics, and never its name.
    """
    if name == UNKNOWN_NAME:
        return "a node whose name is not known, such as one that was killed"
    return name


def names_of_publishers(node: Node, graph_name: str) -> set[str]:
    """Return the names of the nodes that publish a topic, as far as ROS knows them.

    Args:
        node: asks.
        graph_name: the topic in the node's code.
    """
    return {info.node_name for info in node.get_publishers_info_by_topic(graph_name)}
