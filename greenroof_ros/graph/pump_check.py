"""Whether a pump driver keeps to the interface, tried over topics alone.

The check plays the other side of a lockstep: plant, weather and controller. So it needs no more of
a driver than a graph does, be it this package's node or another's in any language.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64, String

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.findings import Finding
from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.progress_lines import ProgressLines
from greenroof_ros.graph.domain import choose_transport, make_executor
from greenroof_ros.graph.inputs import call_node
from greenroof_ros.graph.messages import encoder, lacks, message_class, qos_profile, requirements
from greenroof_ros.model.initial_state import initial_state
from greenroof_ros.model.site import Site

# What the check publishes, in the order of a tick; the command comes last.
_PLAYED = ("/clock", "/cistern/level", "/roof/level", "/weather/frost", "/pump/command")
# The simulated time of the first tick (ns since 1970): a summer's day.
_EPOCH_NS = 1_751_371_200_000_000_000
# Within this the ends of topics find each other on one machine (s).
_DISCOVERY_S = 2.0
# A flow is steady once this many answers differ by no more than this share of them.
_STEADY_TICKS, _STEADY = 10, 0.01
# A flow of this share of the steady one is none: a pump that runs down, the noise of a flow meter.
_NONE = 0.01
# More than the flow at command 1 by this share is more than the pumps' maximum: noise is less.
_NOISE = 0.05
# A pump that stood still has, one tick after it may run again, at most this share of its flow.
_AT_REST = 0.5
# What a driver must refuse. NaN comes first, and to a running pump: drivers that keep the command
# before it would go on.
_HOSTILE = (math.nan, math.inf, -math.inf, -1.0, -1e300)
# The cistern begins with so much water above the suction level (m3), enough for all checks but the
# last, and its level falls with what is pumped, at most to so little above it (m): a driver may
# stop 2 cm above it already, for a sensor that is wrong. At the end it falls to just below it.
_WATER = 1.5
_LEAST_ABOVE_SUCTION, _DRY = 0.022, -0.001
# To so far above the suction level rain lifts it after that (m): more than a driver may ask for.
_REFILLED = 0.5


@dataclass(frozen=True)
class Limits:
    """What is asked of the driver, and how long it may take.

    Attributes:
        command: at which the pump is to run, a share of its maximum flow.
        period: least time between two commands (s).
        answer: from a command to its flow (s).
        start: from the first command to a flow, and to a steady one (s).
        stop: from the reason to stop to the flow 0 (s).
        silence: without a command, at whose end the pump must have stopped (s).
        arrival: until the driver is in the graph (s).
    """

    command: float
    period: float
    answer: float
    start: float
    stop: float
    silence: float
    arrival: float


_NOT_RUNNING = "not tried: the pump does not run"


class _ProblemError(Exception):
    """The driver does not keep to a rule; the message says how."""


class _SilentError(_ProblemError):
    """The driver answers no more, and nothing further can be tried."""


class PumpCheck:
    """Tries one driver."""

    def __init__(self, node: Node, driver: str, site: Site, limits: Limits) -> None:
        """Open the topics, in the namespace of the node.

        Args:
            node: that plays the driver's peers.
            driver: name of its node, without namespace.
            site: whose levels it is told.
            limits: what is asked of it.
        """
        self._node = node
        self._driver = driver
        self._site = site
        self._limits = limits
        self._interface = read_topics()
        self._executor = make_executor()
        self._executor.add_node(node)
        # On the roof there is room for what will be pumped.
        self._empty_roof = 0.5 * initial_state(site, "low-low")[1]
        self._volumes = [site.suction_level * site.a1 + _WATER, self._empty_roof]
        self._least_above_suction = _LEAST_ABOVE_SUCTION
        # What is said instead of the truth, by topic.
        self._said_instead: dict[str, float] = {}
        self._ticks = 0
        self._flows: list[float] = []
        self._steady = 0.0
        self._lockstep_problem = ""
        self._state = ""
        self._trying = "waiting for the driver"
        self._lines = ProgressLines()
        self._publish: dict[str, Callable[[Any], None]] = {}

    def run(self) -> list[Finding]:
        """Try everything, and return a finding for each check.

        Raises:
            ConfigurationError: there is no such driver.
            OccupiedError: a graph is at work with it.
        """
        self._wait_for_driver()
        findings = [Finding("its topics fit the interface", self._unfit())]
        if findings[0].problem:
            return findings
        self._join()
        hindered = ""
        checks = self._checks()
        every = len(checks) + 2  # and its topics before, its answers after
        for number, (title, check) in enumerate(checks.items(), start=2):
            self._trying = f"check {number} of {every}: {title}"
            problem, came = hindered, ""
            if not hindered:
                try:
                    came = check()
                except _ProblemError as error:
                    problem = str(error)
                    if isinstance(error, _SilentError):
                        hindered = "not tried: the driver does not answer"
                    elif check == self._runs:
                        hindered = _NOT_RUNNING
            findings.append(Finding(title, problem, came))
        findings.append(Finding("answers each command with exactly one flow", self._lockstep()))
        return findings

    def _checks(self) -> dict[str, Callable[[], str]]:
        limits = self._limits
        checks: dict[str, Callable[[], str]] = {
            "is off at start: no flow before a command, and 0 at command 0": self._off_at_start,
            f"runs at command {limits.command:g}": self._runs,
            "takes a command above 1 as 1": self._clamps,
            "refuses what is not finite or below 0: the flow falls to 0": self._refuses,
            "runs again after refused commands": self._run_steadily,
            f"has stopped after {limits.silence:g} s without a command": self._watchdog,
            "runs again when commands come again": self._run_steadily,
            "stops while /pump/command has a second publisher": self._second_publisher,
            "runs again when one publisher is left": self._run_steadily,
        }
        within = f"the flow is 0 within {limits.stop:g} s, and stays so"
        for topic, value, stops, after in (
            ("/weather/frost", 1.0, "in frost", "the frost is over"),
            ("/weather/frost", math.nan, "while frost is unknown, NaN", "frost is known"),
            ("/cistern/level", math.nan, "while the cistern's level is unknown, NaN",
             "the cistern's level is known"),
            ("/roof/level", math.nan, "while the roof's level is unknown, NaN",
             "the roof's level is known"),
        ):
            checks[f"stops {stops}: {within}"] = partial(self._stops_for, topic, value)
            checks[f"runs again when {after}"] = self._run_steadily
        checks[f"stops when the cistern falls to the suction level: {within}"] = self._runs_dry
        checks["runs again when the cistern has filled again"] = self._run_steadily
        checks["stops at command 0"] = self._stops
        return checks

    # --- the graph ------------------------------------------------------------------------------

    def _name(self, topic: str) -> str:
        return self._node.resolve_topic_name(self._interface[topic].graph_name)

    def _ends(self, infos: list[Any]) -> list[Any]:
        namespace = self._node.get_namespace()
        return [
            info for info in infos
            if info.node_name == self._driver and info.node_namespace == namespace
        ]

    def _wait_for_driver(self) -> None:
        """Wait until the driver has both its topics, and nobody else is there."""
        until = time.monotonic() + self._limits.arrival
        flow, command = self._name("/pump/flow"), self._name("/pump/command")
        while True:
            publishers = self._ends(self._node.get_publishers_info_by_topic(flow))
            subscriptions = self._ends(self._node.get_subscriptions_info_by_topic(command))
            if publishers and subscriptions:
                break
            if time.monotonic() > until:
                raise ConfigurationError(self._absent(flow, command))
            self._spin(0.1)
        for topic in _PLAYED:
            others = self._node.get_publishers_info_by_topic(self._name(topic))
            if others:
                raise OccupiedError(
                    f"{self._name(topic)} has a publisher already "
                    f"({call_node(others[0].node_name)}): the check plays plant, weather and "
                    "controller itself; end the graph first"
                )

    def _absent(self, flow: str, command: str) -> str:
        infos = [
            *self._node.get_publishers_info_by_topic(flow),
            *self._node.get_subscriptions_info_by_topic(command),
        ]
        seen = ", ".join(sorted({call_node(info.node_name) for info in infos})) or "no node"
        return (
            f"no node {self._driver} publishes {flow} and subscribes to {command} within "
            f"{self._limits.arrival:g} s; there is {seen}. Start the driver first, in the same "
            "ROS_DOMAIN_ID and with the same ROS_AUTOMATIC_DISCOVERY_RANGE"
        )

    def _unfit(self) -> str:
        """Return what the ends of its topics lack."""
        found = []
        topic = self._interface["/pump/flow"]
        for info in self._ends(self._node.get_publishers_info_by_topic(self._name(topic.name))):
            lacking = lacks(info.qos_profile, topic.qos)
            if lacking:
                found.append(
                    f"its publisher of {topic.name} {' and '.join(lacking)}; it must be "
                    f"{requirements(topic.qos)}"
                )
        topic = self._interface["/pump/command"]
        required = replace(topic.qos, lease_s=math.inf)
        for info in self._ends(self._node.get_subscriptions_info_by_topic(self._name(topic.name))):
            lacking = lacks(info.qos_profile, required)
            if lacking:
                found.append(
                    f"its subscription to {topic.name} {' and '.join(lacking)}; it must be "
                    f"{requirements(required)}"
                )
        return "; ".join(found)

    def _join(self) -> None:
        """Open the topics, and listen until the driver has found them."""
        flow = self._interface["/pump/flow"]
        self._node.create_subscription(
            Float64, flow.graph_name, self._on_flow, qos_profile(flow.qos)
        )
        self._node.create_subscription(
            String, "pump/state", self._on_state, qos_profile(self._interface["/diagnostics"].qos)
        )
        for name in _PLAYED:
            topic = self._interface[name]
            publisher = self._node.create_publisher(
                message_class(topic.type), topic.graph_name, qos_profile(topic.qos)
            )
            self._publish[name] = _publish(publisher, encoder(topic.type))
        self._spin(_DISCOVERY_S)

    def _on_flow(self, message: Float64) -> None:
        self._flows.append(message.data)

    def _on_state(self, message: String) -> None:
        self._state = message.data

    def _spin(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)
        self._lines.tell(self._trying)

    # --- ticks ----------------------------------------------------------------------------------

    def _answer(self, command: float) -> float:
        """Publish a tick with a command, and return the flow that answers it (m3/s)."""
        began, tau = time.monotonic(), self._site.tau
        cistern, roof = self._volumes
        truth = {
            "/clock": _EPOCH_NS + round(self._ticks * tau * 1e9),
            "/cistern/level": cistern / self._site.a1,
            "/roof/level": roof / self._site.a2,
            "/weather/frost": 0.0,
            "/pump/command": command,
        }
        for topic, value in (truth | self._said_instead).items():
            self._publish[topic](value)
        self._ticks += 1
        while not self._flows:
            left = began + self._limits.answer - time.monotonic()
            if left < 0:
                raise _SilentError(
                    f"no flow within {self._limits.answer:g} s of command {command:g}, the "
                    f"{self._ticks}th{self._said()}"
                )
            self._executor.spin_once(timeout_sec=left)
        self._spin(began + self._limits.period - time.monotonic())
        flow = self._flows[0]
        self._hold_to_one(1)
        high = self._interface["/pump/flow"].high
        if not 0 <= flow <= high:
            raise _ProblemError(f"its flow is {flow:g} m3/s, and must be from 0 to {high:g}")
        least = (self._site.suction_level + self._least_above_suction) * self._site.a1
        self._volumes = [max(cistern - flow * tau, least), roof + flow * tau]
        return flow

    def _hold_to_one(self, answers: int) -> None:
        """Note flows beyond those that were asked for, and forget all that came."""
        if len(self._flows) > answers and not self._lockstep_problem:
            self._lockstep_problem = (
                f"{len(self._flows)} flows where {answers} must come, after "
                f"{self._ticks} commands"
            )
        self._flows.clear()

    def _said(self) -> str:
        return f" (/pump/state: {self._state})" if self._state else ""

    def _flowing(self, flow: float) -> bool:
        return flow > _NONE * self._steady

    def _until_zero(self, command: float, reason: str) -> str:
        """Repeat a command until the flow is 0, and return how long that took, in words.

        Raises:
            _ProblemError: it is not within the limit.
        """
        began = time.monotonic()
        until = began + self._limits.stop
        before = flow = self._answer(command)
        while self._flowing(flow):
            if time.monotonic() > until:
                raise _ProblemError(
                    f"the flow is {flow:.3g} m3/s {self._limits.stop:g} s after {reason} "
                    f"(first answer: {before:.3g}){self._said()}"
                )
            flow = self._answer(command)
        return f"no flow after {time.monotonic() - began:.1f} s"

    def _stay_at_zero(self, command: float, reason: str) -> None:
        """Repeat a command some times, at which the flow must be 0."""
        for _ in range(_STEADY_TICKS):
            flow = self._answer(command)
            if self._flowing(flow):
                raise _ProblemError(f"a flow of {flow:g} m3/s answers {reason}")

    def _must_run(self) -> None:
        """See to it that a stop is not found in a pump that stood before."""
        if self._answer(self._limits.command) < _AT_REST * self._steady:
            raise _ProblemError(_NOT_RUNNING)

    def _steady_flow(self, command: float) -> float:
        """Repeat a command until the flow is steady, and return it (m3/s).

        Raises:
            _ProblemError: it is not, or 0, within the limit.
        """
        until = time.monotonic() + self._limits.start
        flows: list[float] = []
        while True:
            flows = [*flows[-_STEADY_TICKS:], self._answer(command)]
            least, most = min(flows), max(flows)
            if len(flows) > _STEADY_TICKS and least > 0 and most - least <= _STEADY * most:
                self._steady = flows[-1]
                return self._steady
            if time.monotonic() > until:
                what = f"from {least:.3g} to {most:.3g} m3/s" if most else "0"
                raise _ProblemError(
                    f"the flow is {what} after {self._limits.start:g} s at command {command:g}"
                    f"{self._said()}"
                )

    # --- checks ---------------------------------------------------------------------------------

    def _off_at_start(self) -> str:
        if self._flows:
            raise _ProblemError(f"a flow of {self._flows[0]:g} m3/s came before any command")
        for _ in range(_STEADY_TICKS):
            flow = self._answer(0.0)
            if flow > 0:
                raise _ProblemError(f"a flow of {flow:g} m3/s answers command 0")
        return ""

    def _runs(self) -> str:
        return self._run_steadily()

    def _run_steadily(self) -> str:
        began = time.monotonic()
        flow = self._steady_flow(self._limits.command)
        return f"{flow:.3g} m3/s, steady after {time.monotonic() - began:.1f} s"

    def _clamps(self) -> str:
        most = self._steady_flow(1.0)
        beyond = self._steady_flow(3.0)
        if beyond > (1 + _NOISE) * most:
            raise _ProblemError(
                f"the flow is {beyond:.3g} m3/s at command 3, and {most:.3g} at command 1"
            )
        return f"{beyond:.3g} m3/s at command 3, {most:.3g} at command 1"

    def _refuses(self) -> str:
        came = ""
        for value in _HOSTILE:
            stopped = self._until_zero(value, f"command {value:g}")
            came = came or stopped
            self._stay_at_zero(value, f"command {value:g}")
        return came

    def _watchdog(self) -> str:
        """Fall silent; the first flow after it tells whether the pump had stopped meanwhile."""
        before = self._steady_flow(self._limits.command)
        self._spin(self._limits.silence)
        self._hold_to_one(0)
        state = self._state
        after = self._answer(self._limits.command)
        if after > _AT_REST * before:
            raise _ProblemError(
                f"the flow is {after:.3g} m3/s at the first command after {self._limits.silence:g} "
                f"s of silence, and was {before:.3g} before: the pump had not stopped"
            )
        if state.startswith(("starting", "running")):
            raise _ProblemError(f"/pump/state says {state!r} at the end of the silence")
        return f"{after:.3g} m3/s at the first command after it, {before:.3g} before"

    def _second_publisher(self) -> str:
        self._must_run()
        with _intruder(self._node, self._executor):
            try:
                return self._until_zero(self._limits.command, "a second publisher came")
            finally:
                self._hold_to_one(0)

    def _stops_for(self, topic: str, value: float) -> str:
        """Say something for which the pump must stop, while the command goes on."""
        self._must_run()
        self._said_instead = {topic: value}
        reason = f"{value:g} on {topic}"
        try:
            came = self._until_zero(self._limits.command, reason)
            self._stay_at_zero(self._limits.command, reason)
        finally:
            self._said_instead = {}
            if topic == "/roof/level":  # has dried meanwhile: there is room again
                self._volumes[1] = self._empty_roof
        return came

    def _runs_dry(self) -> str:
        """Pump the cistern empty; a driver may stop earlier."""
        self._must_run()
        site, command = self._site, self._limits.command
        self._least_above_suction = _DRY
        dry = (site.suction_level + _DRY) * site.a1
        while self._volumes[0] > dry and self._flowing(self._answer(command)):
            pass
        above = max(0.0, self._volumes[0] / site.a1 - site.suction_level)
        reason = "the cistern fell to the suction level"
        try:
            came = self._until_zero(command, reason)
            self._stay_at_zero(command, reason)
        finally:
            self._volumes[0] = (site.suction_level + _REFILLED) * site.a1
        return f"{came}, {above:.3f} m above the suction level"

    def _stops(self) -> str:
        return self._until_zero(0.0, "command 0")

    def _lockstep(self) -> str:
        self._spin(0.5)
        self._hold_to_one(0)
        return self._lockstep_problem


def _publish(publisher: Any, encode: Callable[[Any], bytes]) -> Callable[[Any], None]:
    return lambda value: publisher.publish(encode(value))


@contextmanager
def _intruder(node: Node, executor: Any) -> Iterator[None]:
    """Have another node with a publisher of the command, which says nothing."""
    topic = read_topics()["/pump/command"]
    other = Node("check_pump_intruder", namespace=node.get_namespace())
    executor.add_node(other)
    other.create_publisher(message_class(topic.type), topic.graph_name, qos_profile(topic.qos))
    try:
        yield
    finally:
        executor.remove_node(other)
        other.destroy_node()


def check_pump(driver: str, site: Site, limits: Limits) -> list[Finding]:
    """Try a driver that runs.

    Args:
        driver: name of its node, with its namespace where it has one: ``/site1/pump``.
        site: whose levels it is told, and whose ticks.
        limits: what is asked of it.

    Returns:
        A finding for each check.

    Raises:
        ConfigurationError: there is no such driver.
        OccupiedError: a graph is at work with it.
    """
    choose_transport()
    namespace, _, name = driver.rpartition("/")
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node("check_pump", namespace=namespace or "/")
        try:
            return PumpCheck(node, name, site, limits).run()
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
