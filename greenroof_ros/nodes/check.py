"""Check of a running node, using topics only, in which the check plays all other nodes.

A check is a story, whose lines say what is sent, what must come, and within which time. The check
demands no more from a node than a graph does, and works with nodes written in any language.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import permutations
from typing import Any

from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher

from greenroof_ros.base.errors import ConfigurationError, OccupiedError
from greenroof_ros.base.processes import Signals
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros import messages
from greenroof_ros.ros.errors import MalformedMessageError
from greenroof_ros.ros.lockstep import CLOCK, RUN, RunIdentity
from greenroof_ros.ros.publishers import display_name
from greenroof_ros.ros.spin import ros
from greenroof_ros.site.site import Site

# More ticks than a check ever takes.
_LAST_TICK = 1e9
# Simulated time of the first tick (ns since 1970), on a summer's day.
_EPOCH_NS = 1_751_371_200_000_000_000
# How long the tested node may take to join the graph, and its topics to be discovered (s).
ARRIVAL_S, _DISCOVERY_S = 10.0, 2.0
# How long an answer may take after the last input of a tick (s).
ANSWER_S = 5.0
# Time within which a second answer would follow the first (s), awaited in the first and last ticks.
_SETTLE_S = 0.5
# How long the last input of a tick is held back (s): a node that does not wait for it answers by
# then.
_DELAY_S = 0.05
# How long a node may take to leave the graph after the plant (s).
_END_S = 10.0

Values = Mapping[str, float]
"""Values by topic."""
USUAL: Values = {}
Result = tuple[str, str, str]
"""A line, its problem, and what was measured; each of the last two may be empty."""
Story = Iterator[tuple[Any, ...]]
"""The lines of a check: what is shown; the function that shows it, and its arguments."""


class BrokenRuleError(Exception):
    """Error for a tested node that breaks a rule; the message describes the fault."""


class StoryEndError(BrokenRuleError):
    """Error for a broken rule after which the rest of the story would prove nothing."""


def require(right: bool, problem: str, error: type[BrokenRuleError] = BrokenRuleError) -> None:
    """Raise an error that describes the problem unless a condition holds."""
    if not right:
        raise error(problem)


def describe(values: Values) -> str:
    """Return the values that make a tick unusual, or the answers, for a message."""
    return ", ".join(f"{value:.3g} on {topic}" for topic, value in values.items()) or "usual inputs"


class NodeCheck(ABC):
    """Base class for the check of one node; a subclass defines the topics and tells the story.

    Attributes:
        required: topics to which the node must subscribe.
        optional: topics to which the node may subscribe.
        received: values received on each output since the last tick.
        remark: text that is added to the description of a fault.
    """

    required: tuple[str, ...]
    optional: tuple[str, ...]

    def __init__(
        self, tested: str, site: Site, outputs: Sequence[str], usual: dict[str, float], *,
        period: float = 0.0, live: bool = False,
    ) -> None:
        """Prepare a check; ROS must be running.

        Args:
            tested: name of the node under test, with its namespace if there is one: /site1/pump.
            site: site for which the node is checked.
            outputs: topics on which the node responds to each tick with a number.
            usual: values of an undisturbed tick, in the order of their publication.
            period: minimum duration of a tick (s); 0 to run as fast as possible.
            live: whether the node belongs to a live graph, where it publishes at its own rate.
        """
        namespace, _, self._tested = tested.rpartition("/")
        self.node = Node("check", namespace=namespace or "/")
        self.site, self.outputs, self.usual = site, outputs, usual
        self.period, self.live = period, live
        self.received: dict[str, list[float]] = {topic: [] for topic in outputs}
        self.remark = ""
        self._publishers: dict[str, Publisher] = {}
        self._ticks = 0
        self._executor = EventsExecutor()
        self._executor.add_node(self.node)

    @abstractmethod
    def story(self) -> Story:
        """Tell what is checked in ticks; a line is told once the lines before it are."""

    def run(self) -> Iterator[Result]:
        """Yield each line of the story, with the problem, and what was measured if there is none.

        Raises:
            ConfigurationError: if the node under test is not found.
            OccupiedError: if other nodes already publish the topics that the check publishes.
        """
        self._find_node()
        for title, act, *arguments in self._whole_story():
            try:
                yield title, "", act(*arguments) or ""
            except StoryEndError as error:
                yield title, f"{error}{self.remark}; nothing else was checked", ""
                return
            except BrokenRuleError as error:
                yield title, f"{error}{self.remark}", ""

    def _whole_story(self) -> Story:
        yield "its topics match the interface", self._match_topics
        yield "sends nothing before the first tick", self._wait_for_tick
        yield from self.story()

    # --- the graph ------------------------------------------------------------------------------

    def _endpoints(self, topic: str) -> list[Any]:
        """Return the tested node's publishers of an output, or its subscriptions to an input."""
        tested = self._tested, self.node.get_namespace()
        find = (
            self.node.get_publishers_info_by_topic if topic in self.outputs
            else self.node.get_subscriptions_info_by_topic
        )
        infos = find(read_topics()[topic].graph_name)
        return [info for info in infos if (info.node_name, info.node_namespace) == tested]

    def _find_node(self) -> None:
        """Wait until the node has all its topics; raise an error if its inputs have publishers."""
        needed = (*self.outputs, *self.required)
        if not self.wait(ARRIVAL_S, lambda: any(map(self._endpoints, needed))):
            others = sorted({*self.node.get_node_names()} - {self.node.get_name()})
            raise ConfigurationError(
                f"no node {self._tested} that publishes {needed[0]} was found within "
                f"{ARRIVAL_S:g} s; found: {', '.join(others) or 'no node'}. Start it first, with "
                "the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE"
            )
        self.wait(_DISCOVERY_S, lambda: all(map(self._endpoints, needed)))
        for topic in (CLOCK, *self.usual):
            for info in self.node.get_publishers_info_by_topic(read_topics()[topic].graph_name):
                raise OccupiedError(
                    f"{topic} already has a publisher ({display_name(info.node_name)}); the check "
                    "publishes this topic itself, so stop the graph first"
                )

    def _match_topics(self) -> None:
        problems = []
        for topic in (*self.outputs, *self.required, *self.optional):
            qos, infos, end = read_topics()[topic].qos, self._endpoints(topic), "publisher of"
            if topic not in self.outputs:  # only publishers must have a lease
                qos, end = replace(qos, lease_s=math.inf), "subscription to"
            if not infos and topic not in self.optional:
                problems.append(f"the node has no {end} {topic}")
            if self.live and topic not in self.outputs:
                continue  # it needs no messages from before it joined
            for info in infos:
                if lacking := " and ".join(messages.find_lacking(info.qos_profile, qos)):
                    needs = messages.describe_qos(qos)
                    problems.append(f"its {end} {topic} {lacking}; it must be {needs}")
        require(not problems, "; ".join(problems), StoryEndError)

    def _wait_for_tick(self) -> None:
        """Open the topics, wait until the node has discovered them, and require its silence."""
        for topic, values in self.received.items():
            self.listen(topic, values.append)
        self._publishers = {topic: self.open(topic) for topic in (RUN, CLOCK, *self.usual)}
        # The identity is fixed, so a node can be checked twice.
        speed = self.site.tau / self.period if self.period else 0.0
        self.publish(RUN, RunIdentity(0.0, _LAST_TICK, speed).values)
        self.wait(_DISCOVERY_S)
        # A live pump publishes that it is off.
        early = [
            value for values in self.received.values() for value in values
            if not (self.live and value <= 0)
        ]
        for values in self.received.values():
            values.clear()
        require(not early, f"{len(early)} messages arrived before any input: {early[:3]}")

    def listen(self, topic: str, callback: Callable[[Any], None]) -> None:
        """Pass each value received on a topic to a callback; malformed messages are ignored."""
        entry = read_topics()[topic]
        decode = messages.decoder(entry.type)

        def receive(message: bytes) -> None:
            with suppress(MalformedMessageError):
                callback(decode(message))

        self.node.create_subscription(
            messages.message_class(entry.type), entry.graph_name, receive,
            messages.qos_profile(entry.qos), raw=True,
        )

    def open(self, topic: str) -> Publisher:
        """Return a new publisher of a topic."""
        entry = read_topics()[topic]
        return self.node.create_publisher(
            messages.message_class(entry.type), entry.graph_name, messages.qos_profile(entry.qos)
        )

    def publish(self, topic: str, value: Any) -> None:
        """Publish a value."""
        self._publishers[topic].publish(messages.encoder(read_topics()[topic].type)(value))

    def wait(self, seconds: float, done: Callable[[], bool] = lambda: False) -> bool:
        """Receive messages for a time (s), or until something is done; return whether it is."""
        until = time.monotonic() + seconds
        while not (over := done()) and (remaining := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=min(remaining, 0.1))
        return over

    # --- ticks ----------------------------------------------------------------------------------

    def tick(self, unusual: Values = USUAL, order: Sequence[str] = ()) -> dict[str, float]:
        """Publish a tick, and return the answer on each output.

        Args:
            unusual: values that replace the usual ones.
            order: topics to publish after all others, the last of them after a delay.

        Raises:
            StoryEndError: if no answer arrives in time, or more than one.
            BrokenRuleError: if an answer arrives before the last input, or is out of its range.
        """
        self._discard_answers()
        began, values = time.monotonic(), {**self.usual, **unusual}
        self.publish(CLOCK, _EPOCH_NS + round(self._ticks * self.site.tau * 1e9))
        self._ticks += 1
        *first, last = [*(topic for topic in values if topic not in order), *order]
        for topic in first:
            self.publish(topic, values[topic])
        if order:
            self.wait(_DELAY_S)
        early = bool(order) and any(self.received.values())
        self.publish(last, values[last])
        self.wait(ANSWER_S, lambda: all(self.received.values()))
        self.wait(began + self.period - time.monotonic())
        if self._ticks == 1:
            self.wait(_SETTLE_S)
        require(not early, f"an answer came before the last input in {', '.join(order)}")
        for topic, answers in self.received.items():
            require(
                bool(answers), f"nothing came on {topic} within {ANSWER_S:g} s in tick "
                f"{self._ticks - 1}, with {describe(unusual)}", StoryEndError,
            )
            allowed = read_topics()[topic].range
            require(
                answers[-1] in allowed,
                f"{answers[-1]:g} on {topic} with {describe(unusual)}; it {allowed.expected()}",
            )
        return {topic: answers[-1] for topic, answers in self.received.items()}

    def _discard_answers(self) -> None:
        """Discard the answers, and require that none was superfluous, if the node is not live."""
        for topic, answers in self.received.items():
            number = len(answers)
            answers.clear()
            require(
                self.live or number <= 1,
                f"{number} messages on {topic} in tick {self._ticks - 1}", StoryEndError,
            )

    # --- what must come -------------------------------------------------------------------------

    @property
    def _now(self) -> float:
        """The time of the ticks (s): real, unless they are as fast as possible."""
        return time.monotonic() if self.period else self._ticks * self.site.tau

    def until(
        self, right: Callable[[Values], bool], sent: Values = USUAL, *, within: float,
        stays: int = 0, error: type[BrokenRuleError] = BrokenRuleError,
    ) -> str:
        """Send a tick again and again until the answers are right, and return what was measured.

        Args:
            right: whether answers are right.
            sent: values that replace the usual ones.
            within: time within which the answers must be right (s).
            stays: number of further ticks in which they must stay so.
            error: what to raise if they are not.
        """
        began = self._now
        while not right(answers := self.tick(sent)):
            problem = f"{describe(answers)} after {within:g} s with {describe(sent)}"
            require(self._now <= began + within, problem, error)
        measured = f"{describe(answers)} after {self._now - began:.1f} s"
        for _ in range(stays):
            answers = self.tick(sent)
            require(right(answers), f"{describe(answers)} again with {describe(sent)}", error)
        return measured

    def answer_in_any_order(self, tolerance: float) -> None:
        """Send the same tick in every order of the inputs, and require the same answers.

        For a node with memory, an answer may lie between those of the ticks before and after.
        """
        before = self.tick()
        for order in permutations(filter(self._endpoints, (*self.required, *self.optional))):
            answers, after = self.tick(order=order), self.tick()
            for topic, answer in answers.items():
                low, high = sorted((before[topic], after[topic]))
                require(
                    low - tolerance <= answer <= high + tolerance,
                    f"{answer:g} on {topic} if the inputs come in the order {', '.join(order)}, "
                    f"but {low:g} to {high:g} with the same inputs in the ticks before and after",
                )
            before = after

    def answer_once(self) -> str:
        """Require that no answer follows that to the last tick; earlier ones have been counted."""
        self.wait(_SETTLE_S)
        self._discard_answers()
        return f"{self._ticks} ticks"

    def end_with_peers(self) -> None:
        """Close the topics, as ending nodes do, and require that the node leaves the graph."""
        for publisher in self._publishers.values():
            self.node.destroy_publisher(publisher)
        ended = self.wait(_END_S, lambda: not self._endpoints(self.outputs[0]))
        require(ended, f"the node still runs {_END_S:g} s after {CLOCK} has lost its publisher")


def check_node(make: Callable[[], NodeCheck]) -> Iterator[Result]:
    """Run ROS and the check that a function makes, and yield the results as they come."""
    Signals(interrupt=True)  # the node leaves the graph
    with ros([]):
        check = make()
        try:
            yield from check.run()
        finally:
            check.node.destroy_node()
