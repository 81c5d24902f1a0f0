"""Check of a running node, using topics only, in which the check plays all other nodes.

The check demands no more from a node than a graph does, and works with nodes written in any
language.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, ClassVar

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from greenroof_ros.base.errors import ConfigurationError, OccupiedError
from greenroof_ros.base.processes import Signals
from greenroof_ros.base.standard_error import ProgressLines
from greenroof_ros.graph.domain import prepare_ros
from greenroof_ros.graph.errors import MalformedMessageError
from greenroof_ros.graph.lockstep import CLOCK, RUN, RunIdentity
from greenroof_ros.graph.messages import (
    decoder,
    describe_qos,
    encoder,
    find_lacking,
    message_class,
    qos_profile,
)
from greenroof_ros.graph.publishers import display_name
from greenroof_ros.graph.spin import make_executor
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.nodes.check_results import CheckResult

# More ticks than a check ever takes.
_LAST_TICK = 1e9
# Simulated time of the first tick (ns since 1970), on a summer's day.
_EPOCH_NS = 1_751_371_200_000_000_000
# Time within which the endpoints of topics discover each other on one machine (s).
_DISCOVERY_S = 2.0
# Time within which a second answer would follow the first (s), awaited in the first and last ticks.
SETTLE_S = 0.5
# How long the tested node may take to join the graph (s).
ARRIVAL_S = 10.0


class BrokenRuleError(Exception):
    """Error for a tested node that breaks a rule; the message describes the fault."""


def require(right: bool, problem: str) -> None:
    """Raise a BrokenRuleError that describes the problem unless a condition holds."""
    if not right:
        raise BrokenRuleError(problem)


class NodeCheck(ABC):
    """Base class for the check of one node; a subclass defines the topics and the rules.

    Attributes:
        kind: name for the kind of node in messages, such as ``driver``.
        answer: name for the node's answer in messages, such as ``flow``.
        output: topic on which the node responds to each tick with a number.
        further: additional topics on which the node publishes a number in every tick.
        inputs: topics to which the node must subscribe.
        optional: topics to which the node may subscribe, provided that it uses the right quality of
            service.
        played: topics that the check publishes, in the order of a tick.
        peers: names, for messages, of the nodes that the check plays.
        answers: values received on ``output`` but not counted yet.
        surplus: message about the first tick with too many answers; empty if there is none.
        results: results of the checks so far.
        result: measurement of the current check, as text for the table; empty if there is none.
        hindered: reason why no more ticks can be published; empty if there is none.
        ticks: number of ticks published.
        live: whether the node belongs to a live graph.
    """

    kind: ClassVar[str]
    answer: ClassVar[str]
    output: ClassVar[str]
    inputs: ClassVar[tuple[str, ...]]
    optional: ClassVar[tuple[str, ...]] = ()
    played: ClassVar[tuple[str, ...]]
    peers: ClassVar[str]
    live = False
    further: tuple[str, ...] = ()

    def __init__(self, node: Node, tested: str, tau: float, speed: float) -> None:
        """Prepare a check, in the namespace of the node that plays the peers.

        Args:
            node: node that plays the peers.
            tested: name of the node under test, without namespace.
            tau: simulated time of a tick (s).
            speed: ratio of simulated time to wall time; 0 to run as fast as possible.
        """
        self.node = node
        self.interface = read_topics()
        self.answers: list[float] = []
        self.surplus = ""
        self.results: list[CheckResult] = []
        self.result = ""
        self.hindered = ""
        self.ticks = 0
        self._tested, self._tau, self._speed = tested, tau, speed
        self._executor = make_executor()
        self._executor.add_node(node)
        self._current_check = f"waiting for the {self.kind}"
        self._lines = ProgressLines()
        self._publishers: dict[str, Callable[[Any], None]] = {}

    def run(self) -> list[CheckResult]:
        """Run all checks, or only the first if the topics are wrong, and return the results.

        Raises:
            ConfigurationError: if the node under test is not found.
            OccupiedError: if other nodes already publish the topics that the check publishes.
        """
        self._wait_for_node()
        unfit = self._unfit()
        self.results.append(CheckResult("its topics match the interface", unfit))
        if not unfit:
            self.join()
            self.run_checks()
        return self.results

    @abstractmethod
    def run_checks(self) -> None:
        """Run all checks except the check of the topics."""

    @contextmanager
    def check(self, title: str) -> Iterator[None]:
        """Run a check, and store its result."""
        self._current_check = f"check {len(self.results) + 1}: {title}"
        problem, self.result = "", ""
        try:
            yield
        except BrokenRuleError as error:
            problem = str(error)
        self.results.append(CheckResult(title, problem, self.result))

    # --- the graph ------------------------------------------------------------------------------

    def endpoints(self, name: str) -> list[Any]:
        """Return the tested node's publishers of an output, or its subscriptions to an input."""
        tested = self._tested, self.node.get_namespace()
        return [
            info for info in self._all_endpoints(name)
            if (info.node_name, info.node_namespace) == tested
        ]

    def _all_endpoints(self, name: str) -> list[Any]:
        find = (
            self.node.get_publishers_info_by_topic if name in (self.output, *self.further)
            else self.node.get_subscriptions_info_by_topic
        )
        return list(find(self._name(name)))

    def _name(self, topic: str) -> str:
        return self.node.resolve_topic_name(self.interface[topic].graph_name)

    def _wait_for_node(self) -> None:
        """Wait until the node has all its topics; raise an error if its inputs have publishers."""
        until, needed = time.monotonic() + ARRIVAL_S, (self.output, *self.further, *self.inputs)
        while not any(map(self.endpoints, needed)):
            if time.monotonic() > until:
                raise ConfigurationError(self._absent())
            self.spin(0.1)
        until = time.monotonic() + _DISCOVERY_S
        while not all(map(self.endpoints, needed)) and time.monotonic() < until:
            self.spin(0.1)
        for topic in self.played:
            publishers = self.node.get_publishers_info_by_topic(self._name(topic))
            if publishers:
                raise OccupiedError(
                    f"{self._name(topic)} already has a publisher "
                    f"({display_name(publishers[0].node_name)}): the check itself takes the "
                    f"place of {self.peers}, so stop the graph first"
                )

    def _absent(self) -> str:
        names = {
            display_name(info.node_name) for topic in (self.output, *self.inputs)
            for info in self._all_endpoints(topic)
        }
        return (
            f"no node {self._tested} that publishes {self._name(self.output)} and subscribes to "
            f"{', '.join(map(self._name, self.inputs))} was found within {ARRIVAL_S:g} s; found: "
            f"{', '.join(sorted(names)) or 'no node'}. Start the {self.kind} first, with the same "
            "ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE"
        )

    def _unfit(self) -> str:
        """Return a description of the faults in the node's endpoints; empty if there are none."""
        problems = []
        for topic in (self.output, *self.further, *self.inputs, *self.optional):
            is_output = topic in (self.output, *self.further)
            end = f"{'publisher of' if is_output else 'subscription to'} {topic}"
            infos = self.endpoints(topic)
            if not infos and topic not in self.optional:
                problems.append(f"the node has no {end}")
            if self.live and not is_output:
                continue  # it needs no messages from before it joined
            qos = self.interface[topic].qos
            if not is_output:  # only publishers must have a lease
                qos = replace(qos, lease_s=math.inf)
            problems += [
                f"its {end} {' and '.join(lacking)}; it must be {describe_qos(qos)}"
                for info in infos if (lacking := find_lacking(info.qos_profile, qos))
            ]
        return "; ".join(problems)

    def join(self) -> None:
        """Open the topics, and wait until the node has discovered them."""
        self.listen(self.output, self.answers.append)
        for name in (RUN, *self.played):
            self._publishers[name] = self.open_publisher(self.node, name)
        # The identity is fixed, so a node can be checked twice.
        self._publishers[RUN](RunIdentity(0.0, _LAST_TICK, self._speed).values)
        self.spin(_DISCOVERY_S)

    def listen(self, name: str, callback: Callable[[Any], None]) -> None:
        """Pass each value received on a topic to a callback; malformed messages are ignored."""
        topic = self.interface[name]
        decode = decoder(topic.type)

        def receive(message: bytes) -> None:
            with suppress(MalformedMessageError):
                callback(decode(message))

        self.node.create_subscription(
            message_class(topic.type), topic.graph_name, receive, qos_profile(topic.qos), raw=True
        )

    def close_publishers(self) -> None:
        """Close the publishers of all topics of a tick, as nodes do when they stop."""
        names = set(map(self._name, self.played))
        for publisher in list(self.node.publishers):
            if publisher.topic_name in names:
                self.node.destroy_publisher(publisher)

    def open_publisher(self, node: Node, name: str) -> Callable[[Any], None]:
        """Open a topic, and return a function that publishes a value on it."""
        topic = self.interface[name]
        encode = encoder(topic.type)
        publisher = node.create_publisher(
            message_class(topic.type), topic.graph_name, qos_profile(topic.qos)
        )
        return lambda value: publisher.publish(encode(value))

    # --- ticks ----------------------------------------------------------------------------------

    def start_tick(self) -> None:
        """Publish the time of the next tick.

        Raises:
            BrokenRuleError: if no more ticks are published, for the reason in ``hindered``.
        """
        require(not self.hindered, self.hindered)
        self._lines.update(self._current_check)
        self.publish(CLOCK, _EPOCH_NS + round(self.ticks * self._tau * 1e9))
        self.ticks += 1

    def publish(self, topic: str, value: Any) -> None:
        """Publish a value."""
        self._publishers[topic](value)

    def wait_for_answer(self, until: float) -> bool:
        """Wait for an answer until a time (s, `time.monotonic`); return whether it has arrived."""
        while not self.answered():
            remaining = until - time.monotonic()
            if remaining < 0:
                self.hindered = f"not checked: the {self.kind} does not answer"
                return False
            self._executor.spin_once(timeout_sec=remaining)
        return True

    def answered(self) -> bool:
        """Return whether the node has answered the tick."""
        return bool(self.answers)

    def count_answers(self, expected: int) -> None:
        """Record any surplus answers, and discard all answers, since they could mask later ones."""
        if len(self.answers) > expected and not self.surplus:
            self.surplus = (
                f"{len(self.answers)} {self.answer}s instead of {expected} after tick "
                f"{self.ticks - 1}"
            )
        self.answers.clear()

    def check_count(self) -> None:
        """Check that no tick, including the last, had more than one answer."""
        with self.check(f"publishes exactly one {self.answer} for each tick"):
            self.spin(SETTLE_S)
            self.count_answers(0)
            require(not self.surplus, self.surplus)

    def spin(self, seconds: float) -> None:
        """Receive messages for a given duration (s), and show the progress."""
        until = time.monotonic() + seconds
        while (remaining := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining)
        self._lines.update(self._current_check)


def check_node(
    name: str, tested: str, make: Callable[[Node, str], NodeCheck]
) -> list[CheckResult]:
    """Join the graph of a running node, check the node, and return the result of each check.

    Args:
        name: name of the node that plays the peers.
        tested: name of the node under test, with its namespace if there is one: ``/site1/pump``.
        make: function that returns the check; it receives the node that plays the peers, and the
            name of the tested node without namespace.

    Raises:
        ConfigurationError: if the node under test is not found.
        OccupiedError: if other nodes already publish the topics that the check publishes.
    """
    prepare_ros()
    Signals(interrupt=True)  # the node leaves the graph
    namespace, _, tested_name = tested.rpartition("/")
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(name, namespace=namespace or "/")
        try:
            return make(node, tested_name).run()
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
