"""Checks a running node over topics alone, by playing the other nodes of its lockstep graph.

A check therefore requires no more of a node than a graph does, and works with a node in any
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

from greenroof_ros.common.command_line import CheckResult
from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.standard_error import ProgressLines
from greenroof_ros.graph.domain import choose_transport
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
    """The node breaks a rule; the message states how."""


def require(right: bool, problem: str) -> None:
    """Raise a BrokenRuleError unless the node is right."""
    if not right:
        raise BrokenRuleError(problem)


class NodeCheck(ABC):
    """Checks one node; a subclass defines the topics, and what the node must do.

    Attributes:
        kind: kind of node, for messages.
        answer: name of its answer, for messages.
        output: topic on which it answers a tick with a number.
        further: other topics on which it publishes a number in every tick.
        inputs: topics to which it must subscribe.
        optional: topics to which it may subscribe, in which case the quality of service must fit.
        played: topics that the check publishes, in the order of a tick.
        peers: nodes that the check plays, for messages.
        answers: values received on ``output`` and not counted yet.
        surplus: first tick that had more answers than it should, in words; empty if none.
        results: results of the checks so far.
        result: result of the present check, if it is worth showing.
        hindered: why no more ticks are tried; empty if they are.
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
            speed: simulated time per wall time; 0 for as fast as possible.
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
        """Run all checks and return a result for each, or only the first if the topics do not fit.

        Raises:
            ConfigurationError: if there is no such node.
            OccupiedError: if a graph already uses it.
        """
        self._wait_for_node()
        unfit = self._unfit()
        self.results.append(CheckResult("its topics fit the interface", unfit))
        if not unfit:
            self.join()
            self.run_checks()
        return self.results

    @abstractmethod
    def run_checks(self) -> None:
        """Run all checks in turn, except for the topics."""

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
        """Return the tested node's endpoints on a topic, which are publishers for its output."""
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
        """Wait until the node has all its topics; raise an error if others publish its inputs."""
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
                    f"({display_name(publishers[0].node_name)}): the check replaces {self.peers} "
                    "itself; end the graph first"
                )

    def _absent(self) -> str:
        names = {
            display_name(info.node_name) for topic in (self.output, *self.inputs)
            for info in self._all_endpoints(topic)
        }
        return (
            f"no node {self._tested} publishes {self._name(self.output)} and subscribes to "
            f"{', '.join(map(self._name, self.inputs))} within {ARRIVAL_S:g} s; there is "
            f"{', '.join(sorted(names)) or 'no node'}. Start the {self.kind} first, in the same "
            "ROS_DOMAIN_ID and with the same ROS_AUTOMATIC_DISCOVERY_RANGE"
        )

    def _unfit(self) -> str:
        """Return what the node's endpoints lack, as a text; empty if they fit."""
        problems = []
        for topic in (self.output, *self.further, *self.inputs, *self.optional):
            is_output = topic in (self.output, *self.further)
            end = f"{'publisher of' if is_output else 'subscription to'} {topic}"
            infos = self.endpoints(topic)
            if not infos and topic not in self.optional:
                problems.append(f"it has no {end}")
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
        """Open the topics, and listen until the node has found them."""
        self.listen(self.output, self.answers.append)
        for name in (RUN, *self.played):
            self._publishers[name] = self.open_publisher(self.node, name)
        # The identity is fixed, so a node can be checked twice.
        self._publishers[RUN](RunIdentity(0.0, _LAST_TICK, self._speed).values)
        self.spin(_DISCOVERY_S)

    def listen(self, name: str, callback: Callable[[Any], None]) -> None:
        """Pass each value on a topic to a callback; a malformed message does not count."""
        topic = self.interface[name]
        decode = decoder(topic.type)

        def receive(message: bytes) -> None:
            with suppress(MalformedMessageError):
                callback(decode(message))

        self.node.create_subscription(
            message_class(topic.type), topic.graph_name, receive, qos_profile(topic.qos), raw=True
        )

    def close_publishers(self) -> None:
        """Close every topic of a tick, as nodes that end do."""
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
            BrokenRuleError: if no more ticks are tried.
        """
        require(not self.hindered, self.hindered)
        self._lines.update(self._current_check)
        self.publish(CLOCK, _EPOCH_NS + round(self.ticks * self._tau * 1e9))
        self.ticks += 1

    def publish(self, topic: str, value: Any) -> None:
        """Publish a value."""
        self._publishers[topic](value)

    def wait_for_answer(self, until: float) -> bool:
        """Wait until the node has answered; return whether it has by then (steady clock, s)."""
        while not self.answered():
            remaining = until - time.monotonic()
            if remaining < 0:
                self.hindered = f"not tried: the {self.kind} does not answer"
                return False
            self._executor.spin_once(timeout_sec=remaining)
        return True

    def answered(self) -> bool:
        """Whether the node has answered the tick."""
        return bool(self.answers)

    def count_answers(self, expected: int) -> None:
        """Note answers beyond the expected number, and forget all: they hide later answers."""
        if len(self.answers) > expected and not self.surplus:
            self.surplus = (
                f"{len(self.answers)} {self.answer}s instead of {expected} after tick "
                f"{self.ticks - 1}"
            )
        self.answers.clear()

    def check_count(self) -> None:
        """Check that no tick had more than one answer, the last one neither."""
        with self.check(f"publishes exactly one {self.answer} for each tick"):
            self.spin(SETTLE_S)
            self.count_answers(0)
            require(not self.surplus, self.surplus)

    def spin(self, seconds: float) -> None:
        """Receive messages for this time, and show the progress."""
        until = time.monotonic() + seconds
        while (remaining := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=remaining)
        self._lines.update(self._current_check)


def check_node(
    name: str, tested: str, make: Callable[[Node, str], NodeCheck]
) -> list[CheckResult]:
    """Join the graph of a running node, check it, and return a result for each check.

    Args:
        name: name of the node that plays the peers.
        tested: name of the node under test, with its namespace if it has one: ``/site1/pump``.
        make: function that returns the check, given the node that plays the peers, in that
            namespace, and the tested node's name without it.

    Raises:
        ConfigurationError: if there is no such node.
        OccupiedError: if a graph already uses it.
    """
    choose_transport()
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
