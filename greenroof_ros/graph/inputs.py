"""The topics that a node subscribes to: their newest values and their publishers."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
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

# A node's name and its other endpoints are discovered up to this long after its publisher (s).
DISCOVERY_S = 1.0
# The name that ROS reports for a node whose name has not been discovered yet.
_UNKNOWN_NAME = "_NODE_NAME_UNKNOWN_"
# How many messages of a topic can wait for a live recorder if it or the machine is busy.
_RECORDED_DEPTH = 1000
# The most nodes that a sentence names: a client may join again and again under new names.
_NAMED = 5
_GOOD = Verdict()


class Publishers:
    """The publishers of a topic; reports a second one, and one whose messages cannot arrive.

    In lockstep, all publishers that ROS knows count. ROS is polled for them, since a middleware
    event can lock up rclpy's fast executor while a peer's liveliness changes (rmw_fastrtps, pull
    request 890). ROS knows of a publisher before its first message arrives.

    In a live graph, a killed node is restarted, while ROS knows the dead one until the lease of its
    process ends (``config/fastdds.xml``). If the interface gives the topic a liveliness lease, only
    publishers that are alive count there; events report them.

    Attributes:
        topic: the topic in the interface.
        full_name: the topic's full name in ROS, with its namespace.
        required: the quality of service that a publisher must offer to be heard.
    """

    def __init__(self, node: Node, topic: Topic, *, live: bool, recorded: bool = False) -> None:
        """Prepare for a subscription.

        Args:
            node: the subscribing node.
            topic: the topic in the interface.
            live: whether the graph is live.
            recorded: whether the node only records, and must record every message.
        """
        self.topic = topic
        self.full_name: str = node.resolve_topic_name(topic.graph_name)
        self.required = replace(
            topic.qos,
            durability="volatile" if live else topic.qos.durability,
            # Each message of a topic with a lease restarts a timer in each of its readers.
            lease_s=topic.qos.lease_s if live and not recorded else math.inf,
        )
        self._node = node
        self._by_lease = math.isfinite(self.required.lease_s)
        self._depth = topic.qos.depth if not live else _RECORDED_DEPTH if recorded else 1
        self._alive = 0  # counted if there is a lease
        self._unfit_since = -math.inf  # when the middleware last reported an incompatible one
        self._unheard_since = math.inf
        self._names: list[str] = []

    def profile(self) -> QoSProfile:
        """Return the profile of the subscription; in a live graph it requests no past messages."""
        profile = qos_profile(self.required)
        profile.depth = self._depth
        return profile

    def events(self) -> SubscriptionEventCallbacks:
        """Return the event callbacks of the subscription: with a lease, they count publishers."""
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
        """How many publishers there are."""
        return self._alive if self._by_lease else self._node.count_publishers(self.full_name)

    @property
    def heard(self) -> int:
        """How many publishers can be heard: their quality of service fits."""
        return self._alive if self._by_lease else len(self._known()) - len(self._unheard())

    def names(self) -> list[str]:
        """Return the names of the publishers' nodes; if all have gone, the last known names."""
        self._names = sorted({call_node(info.node_name) for info in self._known()}) or self._names
        return self._names

    def problem(self, now: float) -> str:
        """Return what is wrong, as a clause: a second publisher, or with a lease an unheard one.

        A second publisher may be trying to stop the pump, even if its messages do not arrive. If
        only one of two is known, the middleware miscounted after a lease ran out on a busy machine.

        Args:
            now: time on the steady clock (s).
        """
        count = self.count
        if self._unfit_since > -math.inf or (count > 1 and not self._by_lease):
            unheard = self._unheard_problem()
            if unheard:
                return unheard
            if now - self._unfit_since > DISCOVERY_S:
                self._unfit_since = -math.inf  # it has gone
        if count < 2 or len(self._known()) < 2:
            return ""
        return (
            f"has {count} publishers ({list_nodes(self.names())}), but must have one: end the "
            "other, or use another ROS_DOMAIN_ID or --namespace"
        )

    def sentence(self, now: float) -> str:
        """Return :meth:`problem` as a sentence with the topic's name; empty if there is none."""
        problem = self.problem(now)
        return f"{self.full_name} {problem}" if problem else ""

    def warning(self, now: float) -> str:
        """Return a sentence on publishers that have been unheard for the discovery time, or "".

        Args:
            now: time on the steady clock (s).
        """
        problem = self._unheard_problem()
        self._unheard_since = min(self._unheard_since, now) if problem else math.inf
        return f"{self.full_name} {problem}" if now - self._unheard_since >= DISCOVERY_S else ""

    def _unheard_problem(self) -> str:
        """Return which publishers cannot be heard, and why; empty if all can.

        DDS does not connect a publisher to a subscription that requests more than it offers, and
        reports only one of the mismatched policies. The profiles of both are known: list them all.
        """
        unheard = self._unheard()
        if not unheard:
            return ""
        needed = replace(self.required, lease_s=self.topic.qos.lease_s)
        names = sorted({call_node(info.node_name) for info in unheard})
        why = dict.fromkeys(word for info in unheard for word in lacks(info.qos_profile, needed))
        return (
            f"has a publisher that cannot be heard ({list_nodes(names)}): it {' and '.join(why)}, "
            f"but must be {requirements(self.topic.qos)}; change it, or end it"
        )

    def _known(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self.topic.graph_name))

    def _unheard(self) -> list[Any]:
        return [info for info in self._known() if lacks(info.qos_profile, self.required)]


def call_node(name: str) -> str:
    """Return how to name a node in a message.

    A node that joined just before another was killed may discover its topics but never its name.
    """
    if name == _UNKNOWN_NAME:
        return "a node of unknown name, perhaps because it was killed"
    return name


def list_nodes(names: Sequence[str]) -> str:
    """Return the names of nodes for a sentence: the first five, and how many more there are."""
    more = [f"and {len(names) - _NAMED} more"] if len(names) > _NAMED else []
    return ", ".join([*names[:_NAMED], *more])


class Input:
    """One topic that a node subscribes to, with its newest value.

    A value that is not finite or is outside the interface's range is refused: it acts as 0 until
    the next one comes. The first refused value is logged, further ones are only counted.

    Attributes:
        topic: the topic in the interface.
        name: the topic's full name in ROS, with its namespace.
        publishers: the topic's publishers.
        value: the newest value: nanoseconds for a clock, otherwise a number or an array of numbers.
        verdict: whether the newest value may be acted on; in a live graph, by all rules.
        refused: how many values were refused.
        heard: live: whether any message has come.
        optional: live: whether the node acts without it.
        tolerates_second: lockstep: whether the node handles a second publisher itself, so that it
            does not end the run.
        nan_is_unknown: live: whether NaN is not refused, but says that the value is not known.
        rules: live: the rules that its values must keep.
    """

    rules: InputRules

    def __init__(
        self, publishers: Publishers, logger: Any, *,
        optional: bool = False, tolerates_second: bool = False,
    ) -> None:
        """Start with the value 0.

        Args:
            publishers: the topic's publishers.
            logger: the node's logger.
            optional: live: whether the node acts without it.
            tolerates_second: lockstep: whether a second publisher does not end the run.
        """
        self.publishers = publishers
        self.topic = publishers.topic
        self.name = publishers.full_name
        self.value: Any = 0.0
        self.verdict = _GOOD
        self.refused = 0
        self.heard = False
        self.optional, self.tolerates_second = optional, tolerates_second
        self.nan_is_unknown = False
        self._logger = logger
        self._decode = decoder(self.topic.type)
        self._low, self._high = self.topic.low, self.topic.high

    @property
    def good(self) -> bool:
        """Whether the newest value may be acted on."""
        return not self.verdict.code

    @property
    def problem(self) -> str:
        """Why it must not be acted on, as a sentence."""
        return f"{self.name} {self.verdict.why}"

    def receive(self, message: bytes) -> None:
        """Keep the value of a message, or 0 if the value must be refused."""
        value = self._decode(message)
        low, high = self._low, self._high
        if isinstance(value, (float, int)):
            if low <= value <= high:  # False for NaN
                self.value, self.verdict = value, _GOOD
            else:
                self._refuse(value, 0.0)
            return
        if isinstance(value, np.ndarray):
            wrong: Any = value[~((low <= value) & (value <= high))]
        else:  # about ten numbers: numpy would take longer
            wrong = [number for number in value if not low <= number <= high]
        if len(wrong):
            self._refuse(float(wrong[0]), np.zeros(np.shape(value)))
        else:
            self.value, self.verdict = value, _GOOD

    def judge(self) -> None:
        """Judge the newest value by the rules of a live graph, at the present time."""
        self.verdict = self.rules.judge(boot_time(), self.publishers.problem(time.monotonic()))

    def refuse(self, why: str) -> None:
        """Refuse the newest value in a live graph, because the node cannot act on it.

        Args:
            why: the reason, as a clause.
        """
        self.refused += 1
        self.rules.refuse(boot_time(), f"was refused: {why}")
        self.judge()

    def hand_on_to(self, callback: Callable[[Any], None]) -> Callable[[bytes], None]:
        """Return a function that receives its messages and passes each value to a callback."""

        def on_message(message: bytes) -> None:
            self.receive(message)
            callback(self.value)

        return on_message

    def _refuse(self, value: float, instead: Any) -> None:
        if self.nan_is_unknown and math.isnan(value):
            self.verdict = Verdict("input_refused", "is not known to its publisher")
            self.value = instead
            return
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
        by_name: all inputs.
        names: how to name a node that has not been seen, by its role.
    """

    def __init__(self, role: str) -> None:
        """Begin without inputs.

        Args:
            role: the node's role in the interface.
        """
        self.by_name: dict[str, Input] = {}
        self.names = dict(ROLES)
        self._role = role

    def absent(self) -> dict[str, list[str]]:
        """Return the required topics without a publisher that can be heard, by missing role."""
        return self.by_role([
            name for name, entry in self.by_name.items()
            if not entry.optional and not entry.publishers.heard
        ])

    def by_role(self, names: Collection[str]) -> dict[str, list[str]]:
        """Return some of the topics, by the role that should publish them.

        If the interface names two roles (plant or pump driver), it is the first that publishes none
        of this node's other inputs, or else the last.
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
        """Return a text that names topics and the nodes that should publish them."""
        return "; ".join(
            f"{', '.join(self.by_name[name].name for name in names)} from {self.call(role)}"
            for role, names in silent.items()
        )

    def causes(self, awaited: Collection[str]) -> str:
        """Return a text that names awaited topics and the nodes that should publish them.

        Topics of a node that is itself waiting for another of these nodes are left out.
        """
        silent = self.by_role([name for name in self.by_name if name in awaited])
        causes = root_causes(silent, read_topics().values())
        return self.say({role: silent[role] for role in silent if role in causes})

    def call(self, role: str) -> str:
        """Return how to name the node of a role: by its node name if it publishes an input here.

        Args:
            role: a role of the interface.
        """
        nodes = [
            node for entry in self.by_name.values() if role in entry.topic.publishers
            for node in entry.publishers.names()
        ]
        return nodes[0] if nodes else self.names.get(role, role)


def root_causes(roles: Collection[str], topics: Iterable[Topic]) -> set[str]:
    """Return the silent roles that do not wait for another silent role; if there are none, all.

    Args:
        roles: the roles from which nothing comes.
        topics: the interface's topics, which determine which role waits for which.
    """
    waiting = {
        role
        for topic in topics
        for role in roles
        if topic.per_tick and role in topic.subscribers
        and any(publisher in roles and publisher != role for publisher in topic.publishers)
    }
    return set(roles) - waiting or set(roles)
