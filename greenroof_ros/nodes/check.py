"""Check of a running node, using topics only, in which the check plays all other nodes.

A check is a story, whose lines say what is sent, what must come, and within which time. The check
demands no more from a node than a graph does, and works with nodes written in any language.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from std_msgs.msg import Float64

from greenroof_ros.base.errors import ConfigurationError, OccupiedError
from greenroof_ros.base.processes import Signals
from greenroof_ros.controllers.check import trial_values
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.physics.start import initial_states
from greenroof_ros.ros import messages
from greenroof_ros.ros.graph_node import name_owner
from greenroof_ros.ros.lockstep import CLOCK, RUN
from greenroof_ros.ros.messages import WithFront
from greenroof_ros.ros.spin import ros
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site

CISTERN, ROOF, FROST = "/cistern/level", "/roof/level", "/weather/frost"
COMMAND = "/pump/command"
# More ticks than a check ever takes, and the time of the first (ns since 1970), on a summer's day.
_LAST_TICK, _EPOCH_NS = 1e9, 1_751_371_200_000_000_000
# How long the tested node may take to join the graph, and the discovery of new topics (s).
ARRIVAL_S, _DISCOVERY_S = 10.0, 2.0
# How long an answer may take after the last input of a tick (s), how long that input is held back
# (a node that does not wait for it answers by then), and when a second answer would have come.
ANSWER_S, _DELAY_S, _SETTLE_S = 5.0, 0.05, 0.5
# How long a node may take to leave the graph after the plant (s).
_END_S = 10.0

Values = Mapping[str, float]
"""Values by topic."""
USUAL: Values = {}
Story = Iterator[tuple[Any, ...]]
"""The lines of a check: what is shown; the function that shows it, and its arguments."""


class BrokenRuleError(Exception):
    """Error for a tested node that breaks a rule: the problem, and whether it ends the story."""


def describe(values: Values) -> str:
    """Return the values that make a tick unusual, or the answers, for a message."""
    return ", ".join(f"{value:.3g} on {topic}" for topic, value in values.items()) or "usual inputs"


class NodeCheck(ABC):
    """Base class for the check of one node; a subclass defines the topics and tells the story.

    Attributes:
        required: topics to which the node must subscribe.
        optional: topics to which the node may subscribe.
        received: messages received on each output since the last tick.
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
        self.site, self.usual, self.period, self.live = site, usual, period, live
        self.received: dict[str, list[Float64]] = {topic: [] for topic in outputs}
        self._publishers: dict[str, Any] = {}
        self._ticks = 0
        self._executor = EventsExecutor()
        self._executor.add_node(self.node)

    @abstractmethod
    def story(self) -> Story:
        """Tell what is checked; a line is told once the lines before it are."""

    def require(self, right: Any, problem: str, *, ends: bool = False) -> None:
        """Raise an error that describes the problem unless a condition holds.

        Args:
            right: the condition.
            problem: what is wrong otherwise.
            ends: whether the rest of the story would then prove nothing.
        """
        if not right:
            raise BrokenRuleError(problem, ends)

    # --- the graph ------------------------------------------------------------------------------

    def _endpoints(self, topic: str) -> list[Any]:
        """Return the tested node's publishers of an output, or its subscriptions to an input."""
        find = (
            self.node.get_publishers_info_by_topic if topic in self.received
            else self.node.get_subscriptions_info_by_topic
        )
        tested = self._tested, self.node.get_namespace()
        return [
            info for info in find(read_topics()[topic].graph_name)
            if (info.node_name, info.node_namespace) == tested
        ]

    def join(self) -> None:
        """Wait for the node, and open the topics.

        Raises:
            ConfigurationError: if the node under test is not found.
            OccupiedError: if other nodes already publish the topics that the check publishes.
        """
        needed = (*self.received, *self.required)
        self.wait(ARRIVAL_S, lambda: all(map(self._endpoints, needed)))
        if not any(map(self._endpoints, needed)):
            raise ConfigurationError(
                f"no node {self._tested} that publishes {needed[0]} was found: start it first, "
                "with the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE"
            )
        for topic in (CLOCK, *self.usual):
            for info in self.node.get_publishers_info_by_topic(read_topics()[topic].graph_name):
                other = name_owner(info)
                raise OccupiedError(f"{topic} already has a publisher ({other}); stop it first")
        for topic, answers in self.received.items():
            entry = read_topics()[topic]
            profile = messages.qos_profile(entry.qos)
            self.node.create_subscription(Float64, entry.graph_name, answers.append, profile)
        self._publishers = {topic: self.open(topic) for topic in (RUN, CLOCK, *self.usual)}
        # The identity is fixed, so a node can be checked twice.
        speed = self.site.tau / self.period if self.period else 0.0
        self.publish(RUN, array("d", [0.0, _LAST_TICK, speed]))
        self.wait(_DISCOVERY_S)

    def match_topics(self) -> None:
        """Require the topics of the interface, with their quality of service."""
        problems = []
        for topic in (*self.received, *self.required, *self.optional):
            qos, infos, end = read_topics()[topic].qos, self._endpoints(topic), "publisher of"
            if topic not in self.received:  # only publishers must have a lease
                end, qos = "subscription to", replace(qos, lease_s=math.inf)
                if self.live:  # it needs no messages from before it joined
                    qos = replace(qos, durability="volatile")
            if not infos and topic not in self.optional:
                problems.append(f"the node has no {end} {topic}")
            for info in infos:
                if lacking := messages.find_lacking(info.qos_profile, qos):
                    problems.append(f"its {end} {topic} must have {lacking}")
        self.require(not problems, "; ".join(problems), ends=True)

    def open(self, topic: str) -> Any:
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

    # --- ticks, and what must come --------------------------------------------------------------

    def tick(self, unusual: Values = USUAL, order: Sequence[str] = ()) -> dict[str, float]:
        """Publish a tick, and return the answer on each output.

        Args:
            unusual: values that replace the usual ones.
            order: topics to publish after all others, the last of them after a delay.

        Raises:
            BrokenRuleError: if no answer arrives in time, or more than one, if an answer arrives
                before the last input, or if it is out of its range.
        """
        self.refuse_more_answers()
        began, values = time.monotonic(), {**self.usual, **unusual}
        self.publish(CLOCK, _EPOCH_NS + round(self._ticks * self.site.tau * 1e9))
        self._ticks += 1
        *first, last = [*(topic for topic in values if topic not in order), *order]
        for topic in first:
            self.publish(topic, values[topic])
        if order:
            self.wait(_DELAY_S)
        early = order and any(self.received.values())
        self.publish(last, values[last])
        self.wait(ANSWER_S, lambda: all(self.received.values()))
        # In the first tick, a second answer is awaited: later, it would count for the next tick.
        self.wait(began + self.period - time.monotonic() + _SETTLE_S * (self._ticks == 1))
        self.require(not early, f"an answer came before the last input in {', '.join(order)}")
        sent = f"with {describe(unusual)}"
        for topic, answers in self.received.items():
            silent = f"nothing came on {topic} within {ANSWER_S:g} s in tick {self._ticks - 1}"
            self.require(answers, f"{silent}, {sent}", ends=True)
            value, allowed = answers[-1].data, read_topics()[topic].range
            self.require(value in allowed, f"{value:g} on {topic} {sent}; it {allowed.expected()}")
        return {topic: answers[-1].data for topic, answers in self.received.items()}

    def refuse_more_answers(self) -> None:
        """Discard the answers, and require that none was superfluous, if the node is not live."""
        for topic, answers in self.received.items():
            number, allowed = len(answers), min(self._ticks, 1)
            answers.clear()
            when = f"in tick {self._ticks - 1}" if allowed else "before any input"
            more = f"{number} messages on {topic} {when}"
            self.require(self.live or number <= allowed, more, ends=True)

    def until(
        self, right: Callable[[Values], bool], sent: Values = USUAL, *, within: float,
        stays: int = 0, ends: bool = False,
    ) -> None:
        """Send a tick again and again until the answers are right.

        Args:
            right: whether answers are right.
            sent: values that replace the usual ones.
            within: time within which the answers must be right (s): real, unless the ticks are as
                fast as possible.
            stays: number of further ticks in which they must stay so.
            ends: whether the story ends if they are not.
        """
        began, first = time.monotonic(), self._ticks
        while not right(answers := self.tick(sent)):
            ticks = (self._ticks - first) * self.site.tau
            passed = time.monotonic() - began if self.period else ticks
            problem = f"{describe(answers)} after {within:g} s with {describe(sent)}"
            self.require(passed <= within, problem, ends=ends)
        for _ in range(stays):
            problem = f"{describe(answers := self.tick(sent))} again with {describe(sent)}"
            self.require(right(answers), problem)

    def answer_in_any_order(self, tolerance: float) -> None:
        """Send the same tick in every order of the inputs, and require the same answers.

        For a node with memory, an answer may lie between those of the ticks before and after.
        """
        before = self.tick()
        for order in permutations(filter(self._endpoints, (*self.required, *self.optional))):
            answers, after = self.tick(order=order), self.tick()
            for topic, answer in answers.items():
                low, high = sorted((before[topic], after[topic]))
                self.require(
                    low - tolerance <= answer <= high + tolerance,
                    f"{answer:g} on {topic} if the inputs come in the order {', '.join(order)}, "
                    f"but {low:g} to {high:g} with the same inputs in the ticks before and after",
                )
            before = after

    def end(self) -> None:
        """Require one answer to the last tick, and that the node leaves the graph after its peers.

        Earlier answers have been counted.
        """
        self.wait(_SETTLE_S)
        self.refuse_more_answers()
        for publisher in self._publishers.values():
            self.node.destroy_publisher(publisher)
        ended = self.wait(_END_S, lambda: not any(map(self._endpoints, self.required)))
        self.require(ended, f"the node still runs {_END_S:g} s after {CLOCK} lost its publisher")


def check_node(make: Callable[[], NodeCheck]) -> Iterator[tuple[str, str]]:
    """Run ROS and the check that a function makes, and yield what comes of each line of its story.

    Each line comes with the problem; empty if there is none.

    Raises:
        ConfigurationError, OccupiedError: see :meth:`NodeCheck.join`.
    """
    Signals(interrupt=True)  # the node leaves the graph
    with ros([]):
        check = make()
        try:
            check.join()
            for title, act, *arguments in check.story():
                try:
                    act(*arguments)
                    yield title, ""
                except BrokenRuleError as error:
                    problem, ends = error.args
                    yield title, f"{problem}; nothing else was checked" if ends else problem
                    if ends:
                        break
        finally:
            check.node.destroy_node()


# --- the check of a controller --------------------------------------------------------------------

_FORECASTS = ("/forecast/precipitation", "/forecast/evapotranspiration")
_NOT_FINITE = (math.nan, math.inf, -math.inf)
# Number of ticks after the first in which the command must stay 0.
_STAYS = 2
# Share of its target at which a roof is dry, and of its outlet's level at which a cistern is full,
# for a valve to open. Simulated time within which a controller must water that roof (s), as it may
# limit the pump's starts.
_DRY, _FULL, _WATERS_S = 0.5, 1.5, 3600.0
# By how much a solver's answers to equal inputs may differ.
_EQUAL = 1e-6


class ControllerCheck(NodeCheck):
    """Check of one controller node; it also commands an outlet valve if the site has one."""

    required = (CISTERN, ROOF, FROST)
    optional = _FORECASTS

    def __init__(self, controller: str, site: Site, *, horizon: float) -> None:
        """Prepare a check.

        Args:
            controller: name of the controller's node.
            site: site from which the levels of the check are derived.
            horizon: length of the forecasts (h), with steps of increasing length; 0 for the next M
                ticks.
        """
        outputs = [COMMAND, "/outlet/command"] if site.low_outlet_valve else [COMMAND]
        usual = {
            CISTERN: _FULL * site.z_o, ROOF: _DRY * site.z_veg,
            **dict.fromkeys((FROST, *self.optional), 0.0),
        }
        super().__init__(controller, site, outputs, usual)
        # The numbers in front of a forecast: no time of issue, and the ends of the steps.
        self._front = array("d", [math.nan, *look_ahead_ends(site, horizon)[1:]])

    def story(self) -> Story:
        """Tell when a controller must not water, after which it must water again."""
        yield "its topics match the interface", self.match_topics
        yield "waters a dry roof", self._water
        yield "commands 0 in frost", self._command_0, FROST, (1.0,)
        for topic in self.required:
            yield f"commands 0 while {topic} is not finite", self._command_0, topic, _NOT_FINITE
        for topic in self.optional:
            hidden = [{topic: value} for value in _NOT_FINITE]
            yield f"its commands are valid while {topic} is not", self._answer, hidden
        yield "waits for its inputs in any order", self.answer_in_any_order, _EQUAL
        trials = [
            dict(zip((CISTERN, ROOF, *_FORECASTS), trial, strict=True))
            for trial in trial_values(self.site)
        ]
        yield "its commands are valid at all levels", self._answer, trials
        yield "sends one command for each tick, and ends with the plant", self.end

    def _command_0(self, topic: str, values: Sequence[float]) -> None:

        def off(answers: Values) -> bool:
            """Return whether the pump is off, and the valve closed unless there is just frost."""
            return not (answers[COMMAND] if math.isfinite(values[0]) else any(answers.values()))

        for value in values:
            self._water()
            self.until(off, {topic: value}, within=0.0, stays=_STAYS)
        self._water()

    def _water(self) -> None:
        """Require a command above 0; otherwise, a later command of 0 would prove nothing."""
        self.until(lambda answers: answers[COMMAND] > 0, within=_WATERS_S, ends=True)

    def _answer(self, trials: Iterable[Values]) -> None:
        for trial in trials:
            self.tick(trial)

    def publish(self, topic: str, value: Any) -> None:
        """Publish a value; a forecast has it in all of its steps."""
        if topic in _FORECASTS:
            value = WithFront(self._front, array("d", [value] * (len(self._front) - 1)))
        super().publish(topic, value)


# --- the check of a pump driver -------------------------------------------------------------------

FLOW = "/pump/flow"
# A flow is steady if this many answers vary by at most this share of the largest. A pump that is
# off must stay off for as many further ticks.
_STEADY_TICKS, _STEADY = 11, 0.01
# A flow up to this share of the steady one counts as 0, as the pump runs down or the meter is
# noisy. The first flow of a pump that was stopped is at most the second share.
_NONE, _AT_REST = 0.01, 0.5
# A flow more than this share above the flow at command 1 exceeds the maximum, as noise is smaller.
_NOISE = 0.05
# Commands at which a pump must be off.
_NO_COMMANDS = (math.nan, math.inf, -1.0, 0.0)
# The cistern has this much water above the suction level (m3), which is enough for all checks. Its
# level falls as water is pumped, but stays this far above the suction level (m), since a driver may
# stop 2 cm above it to allow for sensor error. Then it is this far below that level, and after rain
# this far above it, which is more than a driver may need.
_WATER, _ABOVE_SUCTION, _BELOW_SUCTION, _REFILLED = 1.5, 0.022, 0.001, 0.5
# Longest time from a command until the flow is steady, and from a reason to stop until the flow is
# 0 (s): the longest ramp of a drive, and the time that it takes to notice.
START_S, STOP_S = 60.0, 35.0
# Time without a command after which the pump must have stopped (s).
SILENCE_S = 5.0
# Least number of ticks of the story, and how often it starts and stops the pump.
_TICKS, _STARTS = 330, 11


def describe_duration(period: float) -> str:
    """Return how long the check takes, which depends on how fast the pump starts and stops.

    Args:
        period: minimum duration of a tick (s).
    """
    longest = _TICKS * period + SILENCE_S + _STARTS * (START_S + STOP_S)
    return f"up to {math.ceil(longest / 60)} minutes"


class PumpCheck(NodeCheck):
    """Check of one pump driver."""

    required = (COMMAND,)
    optional = (CISTERN, ROOF, FROST)

    def __init__(
        self, driver: str, site: Site, *, command: float, period: float, live: bool
    ) -> None:
        """Prepare a check.

        Args:
            driver: name of the driver's node.
            site: site from which the levels of the check are derived.
            command: command at which the pump is run (share of its maximum flow).
            period: minimum time between two commands (s).
            live: whether the driver publishes its flow at its own rate rather than once per
                command.
        """
        # Low, so that the roof has room for all water that will be pumped.
        self._dry_roof = 0.5 * initial_states(site)["low-low"][1] / site.a2
        cistern = site.suction_level + _WATER / site.a1
        usual = {CISTERN: cistern, ROOF: self._dry_roof, FROST: 0.0, COMMAND: command}
        super().__init__(driver, site, [FLOW], usual, period=period, live=live)
        self._steady = 0.0

    def story(self) -> Story:
        """Tell what must stop a pump, after which it must run again."""
        suction, command = self.site.suction_level, self.usual[COMMAND]
        yield "its topics match the interface", self.match_topics
        yield "is off at command 0", self._stay_off, {COMMAND: 0.0}, 0.0
        yield f"runs steadily at command {command:g}", self._run
        if not self.live:
            tolerance = _AT_REST * self._steady
            yield "waits for its inputs in any order", self.answer_in_any_order, tolerance
        yield "treats a command above 1 as 1", self._limit
        for when, sent, afterwards in (
            *((f"at command {value:g}", {COMMAND: value}, {}) for value in _NO_COMMANDS),
            ("in frost", {FROST: 1.0}, {}),
            ("while frost is unknown (NaN)", {FROST: math.nan}, {}),
            ("while the cistern's level is unknown (NaN)", {CISTERN: math.nan}, {}),
            ("while the roof's level is unknown (NaN)", {ROOF: math.nan}, {ROOF: self._dry_roof}),
            ("when the cistern is at the suction level", {CISTERN: suction - _BELOW_SUCTION},
             {CISTERN: suction + _REFILLED}),
        ):
            yield f"stops {when}, and runs again", self._stop, sent, afterwards
        yield f"stops while {COMMAND} has a second publisher, and runs again", self._double
        yield f"stops within {SILENCE_S:g} s of the last command", self._fall_silent

    def tick(self, unusual: Values = USUAL, order: Sequence[str] = ()) -> dict[str, float]:
        """Publish a tick, and move the water that is pumped."""
        answers = super().tick(unusual, order)
        pumped = answers[FLOW] * (self.period if self.live else self.site.tau)
        lowest = self.site.suction_level + _ABOVE_SUCTION
        self.usual[CISTERN] = max(self.usual[CISTERN] - pumped / self.site.a1, lowest)
        self.usual[ROOF] += pumped / self.site.a2
        return answers

    def _stay_off(self, sent: Values, within: float) -> None:
        self.until(
            lambda answers: answers[FLOW] <= _NONE * self._steady, sent, within=within,
            stays=_STEADY_TICKS - 1,
        )

    def _run(self, sent: Values = USUAL) -> float:
        """Repeat a tick until the flow is steady and above 0; return it."""
        flows = deque[float](maxlen=_STEADY_TICKS)

        def steady(answers: Values) -> bool:
            flows.append(answers[FLOW])
            varies = max(flows) - min(flows) > _STEADY * max(flows)
            return len(flows) == _STEADY_TICKS and min(flows) > 0 and not varies

        self.until(steady, sent, within=START_S, ends=True)
        self._steady = flows[-1]
        return self._steady

    def _stop(self, sent: Values, afterwards: Values = USUAL) -> None:
        """Require that the pump stops, and that it runs again afterwards."""
        self._stay_off(sent, STOP_S)
        self.usual |= afterwards
        self._run()

    def _double(self) -> None:
        second = self.open(COMMAND)
        self._stay_off(USUAL, STOP_S)
        self.node.destroy_publisher(second)
        self._run()

    def _limit(self) -> None:
        most, more = self._run({COMMAND: 1.0}), self._run({COMMAND: 3.0})
        too_much = f"{more:.3g} m3/s at command 3, {most:.3g} m3/s at command 1"
        self.require(more <= (1 + _NOISE) * most, too_much)
        self._run()

    def _fall_silent(self) -> None:
        """Send nothing for a while; unless the flow goes on coming, infer it from the next one."""
        self.wait(SILENCE_S)
        flow = self.received[FLOW][-1].data if self.live else self.tick()[FLOW]
        runs_on = f"{flow:.3g} m3/s after the silence, {self._steady:.3g} m3/s before it"
        self.require(flow <= (0.0 if self.live else _AT_REST * self._steady), runs_on)
