"""A live graph: a node acts every tick of the steady clock, on the newest value of each input.

There is no plant and no clock topic. What is missing, late or wrong is not waited for: the node is
told which of its inputs are not good, by the rules of
:mod:`greenroof_ros.pumping.input_rules`, and acts accordingly.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, Protocol

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from greenroof_ros.common.clock import boot_time
from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.inputs import Inputs
from greenroof_ros.graph.parameters import NodeParameter
from greenroof_ros.graph.peers import Peers
from greenroof_ros.graph.publishers import call_node
from greenroof_ros.graph.qos import qos_profile
from greenroof_ros.graph.reports import ERROR, OK, WARN, Report
from greenroof_ros.graph.unfit_publishers import DISCOVERY_S, lacks, requirements
from greenroof_ros.graph.validation import Input
from greenroof_ros.pumping.input_rules import InputRules, LevelRule, Verdict

# A pause of this process itself (s): what it has then is of before. For so long after it, too, what
# comes may have waited.
_PAUSE_S = 1.0

RECOVERY = NodeParameter(
    "recovery_time", 10.0, "live: for how long an input that was not good must be good again (s)",
    0.0, 86400.0,
)
FROZEN_MOVEMENT = NodeParameter(
    "frozen_movement", 0.01, "live: a level that shows no change while pump and rain must have "
    "moved it by so much is frozen (m); above the sensor's resolution", 1e-6, 10.0,
)
JUMP_TOLERANCE = NodeParameter(
    "jump_tolerance", 0.02, "live: how far two values of a level may be apart beyond what water "
    "can do between them (m); at least 10 times the sensor's noise (standard deviation)",
    1e-6, 10.0,
)
LEVEL_PARAMETERS = [FROZEN_MOVEMENT, JUMP_TOLERANCE]


def _limit(name: str, default: float, most: float, what: str) -> NodeParameter:
    return NodeParameter(name, default, f"live: greatest age of {what} (s)", 0.1, most)


_LEVEL = _limit("level_limit", 5.0, 60.0, "a level")
_FORECAST = _limit("forecast_limit", 3600.0, 86400.0, "a forecast, since it came")
_FROST = _limit("frost_limit", 60.0, 600.0, "frost")
_GAUGE = _limit("gauge_limit", 60.0, 3600.0, "what the gauges measure")
_FLOW = _limit("flow_limit", 5.0, 60.0, "the pump's flow")
# Of each topic that somebody acts on in a live graph, how old it may be.
LIMITS = {
    "/cistern/level": _LEVEL,
    "/roof/level": _LEVEL,
    "/forecast/precipitation": _FORECAST,
    "/forecast/evapotranspiration": _FORECAST,
    "/weather/frost": _FROST,
    "/gauge/precipitation": _GAUGE,
    "/gauge/temperature": _GAUGE,
    "/pump/command": _limit("command_limit", 3.0, 10.0, "a command; more than tau"),
    "/pump/flow": _FLOW,
    "/pump/meter": _FLOW,
}


def live_parameters(topics: Iterable[str]) -> list[NodeParameter]:
    """Return the parameters of a node that acts on some topics in a live graph, but ``live``."""
    return [*dict.fromkeys(LIMITS[topic] for topic in topics), RECOVERY]

# How many messages of a topic wait for a recorder that is busy, or that the machine is for it.
_RECORDED_DEPTH = 1000


class LiveNode(Protocol):
    """What a live graph needs of its node; see :class:`greenroof_ros.graph.link.LinkedNode`."""

    acted: bool
    inputs: Inputs
    peers: Peers

    def on_inputs(self) -> None:
        """Act."""

    def diagnose(self, part: str, level: bytes, message: str) -> None:
        """Say how a part of the node is."""


class LivePublishers:
    """How many publishers a topic has; of two none is believed.

    Attributes:
        count: of those that live, where the interface gives the topic a liveliness lease; otherwise
            of all that are known.
        on_change: called when that changes.
    """

    def __init__(
        self, node: Node, topic: Topic, peers: Peers, *, recorded: bool, past: bool = False
    ) -> None:
        """Prepare for a subscription.

        Args:
            node: subscribes to it.
            topic: the interface's.
            peers: of the node, which report.
            recorded: the node only keeps what is published, and all of it.
            past: what was said before is asked for, too.
        """
        self.count = 0
        self._past = past
        self.on_change: Callable[[], None] = lambda: None
        self._node = node
        self._topic = topic
        self._peers = peers
        self._recorded = recorded
        self._lease = math.isfinite(topic.qos.lease_s) and not recorded
        self._unfit_since = -math.inf  # when the middleware last said that one is not heard

    def profile(self) -> QoSProfile:
        """Return the profile of the subscription."""
        profile = qos_profile(self._topic.qos, lease=self._lease)
        if self._past:
            return profile
        profile.durability = DurabilityPolicy.VOLATILE
        profile.depth = _RECORDED_DEPTH if self._recorded else 1
        return profile

    def events(self) -> SubscriptionEventCallbacks:
        """Return the callbacks of the subscription, which count."""
        if self._lease:
            return SubscriptionEventCallbacks(
                liveliness=self._on_liveliness, incompatible_qos=self._on_unfit
            )
        return SubscriptionEventCallbacks(
            matched=self._on_matched, incompatible_qos=self._on_unfit
        )

    def names(self) -> list[str]:
        """Return what to call the publishers' nodes."""
        return sorted({call_node(info.node_name) for info in self._known()})

    def problem(self, now: float) -> str:
        """Say that there are two, if there are, or one that is not heard.

        What a second one says may be meant to stop the pump, heard or not.

        One that was killed is known for 20 s more where the topic has no lease. It does not count
        if its node was started again since, and alone reports: another process of that name, beside
        a node that lived all the time, is a second one. A count of two where one is known is the
        middleware's mistake, after a lease that ran out on a busy machine.

        Args:
            now: of the steady clock (s).
        """
        if self._unfit_since > -math.inf:
            required = replace(
                self._topic.qos, lease_s=self._topic.qos.lease_s if self._lease else math.inf,
                durability=self._topic.qos.durability if self._past else "volatile",
            )
            unheard = [one for one in self._known() if lacks(one.qos_profile, required)]
            if not unheard and now - self._unfit_since > DISCOVERY_S:
                self._unfit_since = -math.inf  # it went
            if unheard:
                who = ", ".join(sorted({call_node(one.node_name) for one in unheard}))
                return (
                    f"has a publisher that cannot be heard ({who}): end it, or make it "
                    f"{requirements(required)}"
                )
        if self.count < 2 or len(self._known()) < 2:
            return ""
        names = self.names()
        if not self._lease and len(names) == 1 and self._peers.may_be_one(names[0], now):
            return ""
        return (
            f"has {self.count} publishers ({', '.join(names)}), and must have one: end the other, "
            "or take another ROS_DOMAIN_ID or namespace"
        )

    def _known(self) -> list[Any]:
        return list(self._node.get_publishers_info_by_topic(self._topic.graph_name))

    def _on_liveliness(self, event: Any) -> None:
        self.count = event.alive_count
        self.on_change()

    def _on_matched(self, event: Any) -> None:
        self.count = event.current_count
        self.on_change()

    def _on_unfit(self, event: Any) -> None:
        self._unfit_since = time.monotonic()
        self.on_change()


class _LiveInput:
    """An input with its rules and publishers."""

    def __init__(self, entry: Input, rules: InputRules, publishers: LivePublishers) -> None:
        self.entry = entry
        self.rules = rules
        self.publishers = publishers
        self.verdict = Verdict()
        self.judge(boot_time())
        publishers.on_change = lambda: self.judge(boot_time())

    def judge(self, now: float) -> None:
        """Judge the input as it is now (s since the machine started), and show at it how it is."""
        self.verdict = self.rules.judge(now, self.publishers.problem(time.monotonic()))
        self.entry.good = self.verdict.good
        self.entry.why = self.verdict.why


class Live:
    """Makes a node act every period of the steady clock; a peer's end is not its own.

    That clock goes on while the machine is suspended: what came before is then too old.

    Attributes:
        simulated_time: whether the node's clock is that of a run; here it is the system's.
        doubtful: whether the node must wait; here it never does.
    """

    simulated_time = False
    doubtful = False

    def __init__(self, node: LiveNode) -> None:
        """Begin without a period.

        Args:
            node: that is to act.
        """
        self._node = node
        self._period = math.inf
        self._due = math.inf
        self._inputs: dict[str, _LiveInput] = {}
        self._needed: list[_LiveInput] = []
        self._looked = boot_time()
        self._deaf_until = self._looked

    def act_every(self, period: float) -> None:
        """Let the node act from now on every period (s)."""
        self._period = period
        self._due = boot_time() + period

    def open(
        self, node: Node, entry: Input, callback: Callable[[Any], None] | None, *, raw: bool,
        optional: bool, level: LevelRule | None, **rules_of_lockstep: object,
    ) -> tuple[LivePublishers, Callable[[bytes], None]]:
        """Prepare an input; see :meth:`greenroof_ros.graph.link.LinkedNode.subscribe`."""
        publishers = LivePublishers(node, entry.topic, self._node.peers, recorded=raw)
        if raw:
            assert callback is not None
            return publishers, callback
        limit = LIMITS[entry.topic.name].name
        rules = InputRules(
            boot_time(), node.get_parameter(limit).value,
            node.get_parameter(RECOVERY.name).value, limit_name=limit, level=level,
        )
        self._inputs[entry.topic.name] = one = _LiveInput(entry, rules, publishers)
        if not optional:
            self._needed.append(one)

        def on_message(message: bytes) -> None:
            now = boot_time()
            self._note_pause(now)
            if now < self._deaf_until:
                return
            entry.good = entry.heard = True
            try:
                entry.receive(message)
            except (LockstepError, ValueError, struct.error) as error:
                entry.refused += 1
                entry.good = False
                entry.why = f"was refused: {error}"
            rules.came(now, entry.value, "" if entry.good else entry.why)
            one.judge(now)
            if callback is not None:
                callback(entry.value)

        return publishers, on_message

    def refuse(self, name: str, why: str) -> None:
        """Refuse the newest value of an input: who acts on it cannot."""
        one = self._inputs[name]
        one.entry.refused += 1
        now = boot_time()
        one.rules.refuse(now, f"was refused: {why}")
        one.judge(now)
        self._say()

    def good(self) -> bool:
        """Whether all that the node needs is good now."""
        now = boot_time()
        for one in self._inputs.values():
            one.judge(now)
        return all(one.entry.good for one in self._needed)

    def missing(self) -> str:
        """Name the topics without a publisher, and who should publish them."""
        return self._node.inputs.say(self._node.inputs.absent())

    def due_in(self) -> float:
        """How long until the node acts (s)."""
        return max(0.0, self._due - boot_time())

    def act_if_due(self) -> None:
        """Act once in a period; of periods that were missed, by a pause, none is made good."""
        now = boot_time()
        if now < self._due:
            return
        self._note_pause(now)
        self._due += (math.floor((now - self._due) / self._period) + 1) * self._period
        self._node.acted = True
        self.good()
        self._say()
        self._node.on_inputs()
        # What a node takes to decide is no pause: what it decides on must not be too old then.
        self._looked = boot_time()

    def look(self, now: float) -> None:
        """Look whether the process was stopped, or the machine suspended, and at the peers."""
        self._note_pause(boot_time())
        self._node.peers.look(now)

    def finish(self, now: float) -> None:
        """A live node does not finish."""

    def hear(self, report: Report) -> None:
        """A peer's end is none of this node's."""

    def _note_pause(self, now: float) -> None:
        """Forget all inputs if the process itself stood still."""
        passed, self._looked = now - self._looked, now
        if passed > _PAUSE_S:
            self._deaf_until = now + _PAUSE_S
            for one in self._inputs.values():
                one.rules.paused(now, passed)
                one.judge(now)

    def _say(self) -> None:
        """Say which of the inputs that the node needs are not good, and why."""
        bad = [one for one in self._needed if not one.verdict.good]
        if not bad:
            if self._needed:
                self._node.diagnose("inputs", OK, "all inputs are good")
            return
        level = ERROR if any(one.verdict.alarming for one in bad) else WARN
        self._node.diagnose(
            "inputs", level, "; ".join(f"{one.entry.name} {one.verdict.why}" for one in bad)
        )
