"""The inputs of a live node: their values, limits and publishers, and the rules they violate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.topics import Topic, read_topics
from greenroof_ros.live.pumping.input_rules import (
    AWAITED,
    InputRules,
    LevelRule,
    cistern_bounds,
    expected_movements,
    roof_bounds,
)
from greenroof_ros.ros.graph_node import Publishers
from greenroof_ros.ros.messages import Input
from greenroof_ros.site.site import Site

# A node's name and its other endpoints may be discovered this long after its publisher (s).
_DISCOVERY_S = 1.0
_UNKNOWN = "unknown"


class LivePublishers(Publishers):
    """The publishers of a topic in a live graph, in which a killed node is restarted.

    ROS continues to list the killed node until the lease of its process expires
    (``config/fastdds.xml``). If the interface specifies a liveliness lease for the topic, only live
    publishers count; they are known from events.
    """

    def __init__(self, node: Node, topic: Topic, *, optional: bool = False) -> None:
        """Prepare for a subscription.

        Args:
            node: the subscribing node.
            topic: topic in the interface.
            optional: whether the node acts without the topic.
        """
        required = replace(topic.qos, durability="volatile", depth=1)
        super().__init__(node, topic, required)
        self.optional = optional
        self._by_lease = math.isfinite(self.required.lease_s)
        self._alive = 0  # counted only if there is a lease
        self._incompatible_at = -math.inf  # when the middleware last reported an incompatible one

    def events(self) -> SubscriptionEventCallbacks | None:
        """Return the subscription's event callbacks, which count publishers if there is a lease."""
        if not self._by_lease:
            return None
        return SubscriptionEventCallbacks(
            liveliness=self._on_liveliness, incompatible_qos=self._on_incompatible
        )

    def _on_liveliness(self, event: Any) -> None:
        self._alive = event.alive_count

    def _on_incompatible(self, event: Any) -> None:
        self._incompatible_at = time.monotonic()

    @property
    def count(self) -> int:
        """Number of publishers."""
        return self._alive if self._by_lease else super().count

    @property
    def compatible(self) -> int:
        """Number of publishers with a compatible quality of service, whose messages arrive."""
        return self._alive if self._by_lease else super().compatible

    def describe_conflict(self) -> str:
        """Return a message if there is a second or, with a lease, an incompatible publisher.

        If only one of two publishers is known, the middleware has miscounted after a lease expired
        on a busy computer.
        """
        if self._incompatible_at == -math.inf and self.count < 2:
            return ""
        conflict = super().describe_conflict()
        if not conflict and time.monotonic() - self._incompatible_at > _DISCOVERY_S:
            self._incompatible_at = -math.inf  # it has gone
        return conflict


class LiveInput(Input):
    """An input with the rules that its values must satisfy.

    Attributes:
        publishers: publishers of the topic.
        rules: rules of the input.
        diagnosis: diagnosis of the violated rule; None if the latest value may be used.
        received: whether any message has been received.
    """

    diagnosis: Diagnosis | None

    def __init__(self, publishers: LivePublishers, rules: InputRules) -> None:
        """Initialize without a value.

        Args:
            publishers: publishers of the topic.
            rules: rules of the input.
        """
        super().__init__(publishers.topic, publishers.full_name)
        self.publishers = publishers
        self.rules = rules
        self.received = False
        self.check()

    @property
    def good(self) -> bool:
        """Whether the latest value may be used."""
        return self.diagnosis is None

    def receive(self, message: bytes) -> None:
        """Receive the value of a message, or 0 if the value must be rejected, and check it."""
        self.received = True
        super().receive(message)
        refused = None
        if self.refusal:
            case = "unknown" if self.refusal == _UNKNOWN else "refused"
            refused = Diagnosis.of("input_refused", case, why=self.refusal)
        self.rules.receive(boot_time(), self.value, refused)
        self.check()

    def check(self) -> None:
        """Check the latest value at the current time."""
        self.diagnosis = self.rules.check(boot_time(), self.publishers.describe_conflict())

    def refuse(self, why: Diagnosis) -> None:
        """Reject the latest value because the node cannot use it."""
        self.rules.receive(boot_time(), None, why)
        self.check()

    def _refuse(self, value: float, why: str) -> None:
        super()._refuse(value, why)
        if self.topic.may_be_unknown and math.isnan(value):
            self.refused -= 1  # its publisher does not know it, which is no fault
            self.refusal = _UNKNOWN


def bad_inputs(inputs: Iterable[LiveInput]) -> Diagnosis | None:
    """Return a joint diagnosis of the invalid inputs, with the code and values of the worst.

    The worst input is the first that violates a rule or, if none does, the first that is awaited.
    """
    diagnoses = [diagnosis for entry in inputs if (diagnosis := entry.diagnosis) is not None]
    if not diagnoses:
        return None
    worst = min(diagnoses, key=lambda each: each.code in AWAITED)
    topics = " ".join(dict.fromkeys(str(each.values["topic"]) for each in diagnoses))
    text = "; ".join(each.sentence for each in diagnoses)
    return replace(worst, text=text, values={**worst.values, "topics": topics})


RECOVERY = Parameter(
    "recovery_time", 10.0, "s", 0.0, 86400.0,
        "time for which a rejected input must satisfy all rules before it is used again",
)
_FROZEN_MOVEMENT = Parameter(
    "frozen_movement", 0.01, "", 1e-6, 10.0,
        "change that the pump should have caused before an unchanged level counts as frozen (m); "
        "must exceed the sensor's resolution",
)
_JUMP_TOLERANCE = Parameter(
    "jump_tolerance", 0.02, "", 1e-6, 10.0,
        "maximum difference between two values of a level beyond what water can cause (m); at "
        "least 10 times the standard deviation of the noise",
)


# The maximum age of every topic on which nodes act in a live graph.
LIMITS = {
    topic.name: Parameter(
        age.parameter, age.default, "s", 0.1, age.max, f"maximum age of {age.quantity}"
    )
    for topic in read_topics().values() if (age := topic.max_age) is not None
}


def live_parameters(topics: Iterable[str]) -> list[Parameter]:
    """Return the parameters of a live node that acts on the given topics."""
    limits = dict.fromkeys(LIMITS[topic] for topic in topics)
    of_levels = [_FROZEN_MOVEMENT, _JUMP_TOLERANCE] if LIMITS["/roof/level"] in limits else []
    return [*limits, RECOVERY, *of_levels]


class Levels:
    """Levels of the cistern and the roof as inputs, with checks for physically possible changes.

    Attributes:
        cistern: the cistern's level.
        roof: the roof's level.
    """

    def __init__(
        self, site: Site, values: Mapping[str, Any], subscribe: Callable[..., LiveInput], *,
        needs_roof: bool = True,
    ) -> None:
        """Open both inputs.

        Args:
            site: site to which the tanks belong.
            values: values of the node's :func:`live_parameters`.
            subscribe: function that opens an input:
                :meth:`greenroof_ros.live.node.LiveNode.subscribe`.
            needs_roof: whether the node does not act without the level of the roof.
        """
        self._site, self._frozen_movement = site, values[_FROZEN_MOVEMENT.name]
        self._rules = [
            LevelRule(bounds, self._frozen_movement, values[_JUMP_TOLERANCE.name])
            for bounds in (cistern_bounds(site), roof_bounds(site))
        ]
        self.cistern = subscribe("/cistern/level", level=self._rules[0])
        self.roof = subscribe(
            "/roof/level", optional=not needs_roof, level=self._rules[1]
        )

    @property
    def displacements(self) -> tuple[float, float]:
        """Total displacements of both levels' readings by impossible jumps so far (m)."""
        cistern, roof = self._rules
        return cistern.displacement, roof.displacement

    def expect(self, flow: float) -> None:
        """Set the level changes that the pump's flow (m3/s) must cause in a tick.

        A coarse sensor may be off by half of the movement beyond which a level is frozen.
        """
        movements = expected_movements(
            self._site, flow, self.cistern.value, self.roof.value, self._frozen_movement / 2
        )
        for rule, movement in zip(self._rules, movements, strict=True):
            rule.expect(movement * self._site.tau)
