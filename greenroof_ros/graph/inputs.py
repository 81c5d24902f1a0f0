"""The topics that a node subscribes to: their newest values, and who publishes them."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from greenroof_ros.common.interface import Topic, read_topics
from greenroof_ros.common.times import boot_time
from greenroof_ros.graph.messages import decoder, lacks, qos_profile, requirements
from greenroof_ros.graph.supervision import ROLES
from greenroof_ros.pumping.input_rules import InputRules, Verdict

# The name of a node and its other ends are known a moment after its publisher (s).
DISCOVERY_S = 1.0
# What ROS calls a publisher whose node has not yet said its name.
_UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
# How many messages of a topic wait for a live recorder that is busy, or that the machine is for it.
_RECORDED_DEPTH = 1000
_GOOD = Verdict()


class Publishers:
    """The publishers of a topic: one is believed; a second one, and one that is not heard, is said.

    In lockstep all that ROS knows count, and they are asked for: an event of the middleware can
    lock up rclpy's fast executor while the liveliness of a peer changes (rmw_fastrtps, pull
    request 890). ROS knows of a publisher before its first message arrives.

    In a live graph a node that was killed is started again, and ROS knows the dead one until its
    process's lease ends (``config/fastdds.xml``). Where the interface gives the topic a liveliness
    lease, those that live count there, by events.

    Attributes:
        topic: the interface's.
        full_name: of the topic on the wire, with its namespace.
        required: what a publisher must offer to be heard.
    """

    def __init__(self, node: Node, topic: Topic, *, live: bool, recorded: bool = False) -> None:
        """Prepare for a subscription.

        Args:
            node: subscribes to it.
            topic: the interface's.
            live: whether its graph is live.
            recorded: the node only keeps what is published, and all of it.
        """
        self.topic = topic
        self.full_name: str = node.resolve_topic_name(topic.graph_name)
        self.required = replace(
            topic.qos,
            durability="volatile" if live else topic.qos.durability,
            # Each message of a topic with a lease sets a timer again in each of its readers.
            lease_s=topic.qos.lease_s if live and not recorded else math.inf,
        )
        self._node = node
        self._by_lease = math.isfinite(self.required.lease_s)
        self._depth = topic.qos.depth if not live else _RECORDED_DEPTH if recorded else 1
        self._alive = 0  # by lease
        self._unfit_since = -math.inf  # when the middleware last said that one is not heard
        self._unheard_since = math.inf
        self._names: list[str] = []

    def profile(self) -> QoSProfile:
        """Return the profile of the subscription; in a live graph the past is not asked for."""
        profile = qos_profile(self.required)
        profile.depth = self._depth
        return profile

    def events(self) -> SubscriptionEventCallbacks:
        """Return the callbacks of the subscription, which count those that live."""
        if not self._by_lease:
            return SubscriptionEventCallbacks(use_default_callbacks=False)
        return SubscriptionEventCallbacks(
            liveliness=self._on_liveliness, incompatible_qos=self._on_unfit
        )

    def _on_liveliness(self, event: Any) -> None:
        self._alive = event.alive_count

    def _on_unfit(self, event: Any) -> None:
        self._unfit_since = time.monotonic()

    @property
    def count(self) -> int:
        """How many there are."""
        return self._alive if self._by_lease else self._node.count_publishers(self.full_name)

    @property
    def heard(self) -> int:
        """How many there are whose messages arrive: their quality of service fits."""
        return self._alive if self._by_lease else len(self._known()) - len(self._unheard())

    def names(self) -> list[str]:
        """Return what to call the publishers' nodes; where all have gone, what they were called."""
        self._names = sorted({call_node(info.node_name) for info in self._known()}) or self._names
        return self._names

    def problem(self, now: float) -> str:
        """Say that there are two, if there are, or by lease that one is not heard.

        What a second one says may be meant to stop the pump, heard or not. A count of two where one
        is known is the middleware's mistake, after a lease that ran out on a busy machine.

        Args:
            now: of the steady clock (s).
        """
        count = self.count
        if self._unfit_since > -math.inf or (count > 1 and not self._by_lease):
            unheard = self._unheard_problem()
            if unheard:
                return unheard
            if now - self._unfit_since > DISCOVERY_S:
                self._unfit_since = -math.inf  # it went
        if count < 2 or len(self._known()) < 2:
            return ""
        return (
            f"has {count} publishers ({', '.join(self.names())}), but must have one: end the "
            "other, or use another ROS_DOMAIN_ID or --namespace"
        )

    def sentence(self, now: float) -> str:
        """Return the same with the name of the topic, as a sentence; empty where all is well."""
        problem = self.problem(now)
        return f"{self.full_name} {problem}" if problem else ""

    def warning(self, now: float) -> str:
        """Return a sentence on what cannot be heard, once all of it has been discovered.

        Args:
            now: of the steady clock (s).
        """
        problem = self._unheard_problem()
        self._unheard_since = min(self._unheard_since, now) if problem else math.inf
        return f"{self.full_name} {problem}" if now - self._unheard_since >= DISCOVERY_S else ""

    def _unheard_problem(self) -> str:
        """Say who cannot be heard, and why; empty where everybody can.

        DDS connects no publisher to a subscription that asks for more than it offers, and says so
        of one of the policies that differ. What each end has is known, and so all are said at once.
        """
        unheard = self._unheard()
        if not unheard:
            return ""
        needed = replace(self.required, lease_s=self.topic.qos.lease_s)
        names = sorted({call_node(info.node_name) for info in unheard})
        why = dict.fromkeys(word for info in unheard for word in lacks(info.qos_profile, needed))
        return (
            f"has a publisher that cannot be heard ({', '.join(names)}): it {' and '.join(why)}, "
            f"but must be {requirements(self.topic.qos)} (doc/real-pump.md); change it, or end it"
        )

    def _known(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self.topic.graph_name))

    def _unheard(self) -> list[Any]:
        return [info for info in self._known() if lacks(info.qos_profile, self.required)]


def call_node(name: str) -> str:
    """Return what to call a node in a message, by its name in the graph.

    A node that joined just before another was killed may know its topics, and never its name.
    """
    if name == _UNKNOWN_NAME:
        return "a node of unknown name, perhaps because it was killed"
    return name


class Input:
    """One topic that a node subscribes to, with its newest value.

    A value that is not finite, or outside the interface's range, is refused: 0 stands in its place
    until the next one comes. The first of them is logged, further ones are only counted.

    Attributes:
        topic: what the interface says of it.
        name: of the topic on the wire, with its namespace.
        publishers: who publishes it.
        value: the newest; nanoseconds of a clock, otherwise a number or a row of numbers.
        verdict: on the newest; in a live graph by all rules.
        refused: how many were.
        heard: live: whether anything ever came.
        optional: live: whether the node acts without it.
        tolerates_second: lockstep: whether the node itself looks for a second publisher, which
            ends nothing.
        rules: live: that its values must keep.
    """

    rules: InputRules

    def __init__(
        self, publishers: Publishers, logger: Any, *,
        optional: bool = False, tolerates_second: bool = False,
    ) -> None:
        """Start with the value 0.

        Args:
            publishers: who publishes it.
            logger: of the node.
            optional: live: whether the node acts without it.
            tolerates_second: whether a second publisher ends nothing in lockstep, either.
        """
        self.publishers = publishers
        self.topic = publishers.topic
        self.name = publishers.full_name
        self.value: Any = 0.0
        self.verdict = _GOOD
        self.refused = 0
        self.heard = False
        self.optional, self.tolerates_second = optional, tolerates_second
        self._logger = logger
        self._decode = decoder(self.topic.type)
        self._low, self._high = self.topic.low, self.topic.high

    @property
    def good(self) -> bool:
        """Whether the newest value may be acted on."""
        return not self.verdict.code

    @property
    def problem(self) -> str:
        """Why it may not, as a sentence."""
        return f"{self.name} {self.verdict.why}"

    def receive(self, message: bytes) -> None:
        """Read a message's value and keep it, or 0 where it must be refused."""
        value = self._decode(message)
        low, high = self._low, self._high
        if isinstance(value, (float, int)):
            if low <= value <= high:  # a NaN is neither
                self.value, self.verdict = value, _GOOD
            else:
                self._refuse(value, 0.0)
            return
        if isinstance(value, np.ndarray):
            wrong: Any = value[~((low <= value) & (value <= high))]
        else:  # ten numbers: numpy would take longer
            wrong = [number for number in value if not low <= number <= high]
        if len(wrong):
            self._refuse(float(wrong[0]), np.zeros(np.shape(value)))
        else:
            self.value, self.verdict = value, _GOOD

    def judge(self) -> None:
        """Judge the newest value by the rules of a live graph, as it is now."""
        self.verdict = self.rules.judge(boot_time(), self.publishers.problem(time.monotonic()))

    def refuse(self, why: str) -> None:
        """Refuse the newest value in a live graph: who acts on it cannot.

        Args:
            why: a clause.
        """
        self.refused += 1
        self.rules.refuse(boot_time(), f"was refused: {why}")
        self.judge()

    def hand_on_to(self, callback: Callable[[Any], None]) -> Callable[[bytes], None]:
        """Return what receives its messages and hands each value on."""

        def on_message(message: bytes) -> None:
            self.receive(message)
            callback(self.value)

        return on_message

    def _refuse(self, value: float, instead: Any) -> None:
        unit = "" if self.topic.unit == "1" else f" {self.topic.unit}"
        limits = f"must be finite and at least {self.topic.low:g}{unit}"
        if self.topic.high < sys.float_info.max:
            limits = f"must be from {self.topic.low:g} to {self.topic.high:g}{unit}"
        if not self.refused:
            self._logger.error(
                f"refused {value!r} on {self.name}: it {limits}; it acts as 0, and further ones "
                "are only counted"
            )
        self.refused += 1
        self.verdict = Verdict("input_refused", f"was refused: {value!r}; it {limits}")
        self.value = instead


class Inputs:
    """The inputs of a node, by the names of their topics in the interface.

    Attributes:
        by_name: all of them.
        names: what to call a node that has not been seen, by its role.
    """

    def __init__(self, role: str) -> None:
        """Begin without any.

        Args:
            role: of the node.
        """
        self.by_name: dict[str, Input] = {}
        self.names = dict(ROLES)
        self._role = role

    def absent(self) -> dict[str, list[str]]:
        """Return the topics that nobody is heard on, by the role of who should publish them."""
        return self.by_role([
            name for name, entry in self.by_name.items()
            if not entry.optional and not entry.publishers.heard
        ])

    def by_role(self, names: Collection[str]) -> dict[str, list[str]]:
        """Return some of the topics, by the role of who should publish them.

        Where the interface names two, the plant or a pump driver, it is the first that publishes
        nothing else here.
        """
        present = {self._role} | {
            entry.topic.publishers[0] for name, entry in self.by_name.items() if name not in names
        }
        roles: dict[str, list[str]] = {}
        for name in names:
            candidates = self.by_name[name].topic.publishers
            role = next((role for role in candidates if role not in present), candidates[-1])
            roles.setdefault(role, []).append(name)
        return roles

    def say(self, silent: Mapping[str, Collection[str]]) -> str:
        """Name topics, and the nodes that should publish them."""
        return "; ".join(
            f"{', '.join(self.by_name[name].name for name in names)} from {self.call(role)}"
            for role, names in silent.items()
        )

    def causes(self, awaited: Collection[str]) -> str:
        """Name topics that are awaited, and the nodes that should publish them.

        Topics of a node that waits itself for another of these topics are left out.
        """
        silent = self.by_role([name for name in self.by_name if name in awaited])
        causes = root_causes(silent, read_topics().values())
        return self.say({role: silent[role] for role in silent if role in causes})

    def call(self, role: str) -> str:
        """Return what to call the node of a role: its name, where it publishes one of the topics.

        Args:
            role: of the interface.
        """
        nodes = [
            node for entry in self.by_name.values() if role in entry.topic.publishers
            for node in entry.publishers.names()
        ]
        return nodes[0] if nodes else self.names.get(role, role)


def root_causes(roles: Collection[str], topics: Iterable[Topic]) -> set[str]:
    """Return which of some silent roles do not themselves wait for another of them, or else all.

    Args:
        roles: from which nothing comes.
        topics: of the interface, which says who waits for whom.
    """
    waiting = {
        role
        for topic in topics
        for role in roles
        if topic.per_tick and role in topic.subscribers
        and any(publisher in roles and publisher != role for publisher in topic.publishers)
    }
    return set(roles) - waiting or set(roles)
