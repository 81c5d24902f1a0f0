"""Check over topics alone whether a pump driver conforms to the interface.

The check plays the other nodes of a lockstep graph: plant, weather and controller. So it requires
no more of a driver than a graph does, and works with a driver in any language.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64, String

from greenroof_ros.common.command_line import Finding
from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.interface import Qos, read_topics
from greenroof_ros.common.standard_error import ProgressLines
from greenroof_ros.graph.domain import choose_transport, make_executor
from greenroof_ros.graph.lockstep import RUN, RunIdentity
from greenroof_ros.graph.messages import encoder, lacks, message_class, qos_profile, requirements
from greenroof_ros.graph.publishers import call_node
from greenroof_ros.model.initial_state import initial_state
from greenroof_ros.model.site import Site

# The topics that the check publishes, in the order of a tick; the command comes last.
_COMMAND = "/pump/command"
_PLAYED = ("/clock", "/cistern/level", "/roof/level", "/weather/frost", _COMMAND)
# More ticks than a check ever takes.
_LAST_TICK = 1e9
# The simulated time of the first tick (ns since 1970): a summer's day.
_EPOCH_NS = 1_751_371_200_000_000_000
# Within this time the endpoints of topics discover each other on one machine (s).
_DISCOVERY_S = 2.0
# A flow is steady if more than this many answers vary by at most this share of the largest.
_STEADY_TICKS, _STEADY = 10, 0.01
# A flow up to this share of the steady one counts as 0: a pump running down, or meter noise.
_NONE = 0.01
# A flow more than this share above the flow at command 1 exceeds the maximum: noise is less.
_NOISE = 0.05
# The first flow of a pump that was at rest is at most this share of its steady flow.
_AT_REST = 0.5
# Commands that a driver must refuse. NaN comes first, while the pump runs: a driver that keeps the
# previous command would then go on pumping.
_HOSTILE = (math.nan, math.inf, -math.inf, -1.0, -1e300)
# Reasons to stop although the command goes on: topic, value, and the texts for "when" and "after".
_STOPS = (
    ("/weather/frost", 1.0, "in frost", "the frost is over"),
    ("/weather/frost", math.nan, "while frost is unknown, NaN", "frost is known"),
    (
        "/cistern/level", math.nan, "while the cistern's level is unknown, NaN",
        "the cistern's level is known",
    ),
    (
        "/roof/level", math.nan, "while the roof's level is unknown, NaN",
        "the roof's level is known",
    ),
)
# The cistern starts with this much water above the suction level (m3), enough for all checks before
# the dry-run check. Its level falls as water is pumped, but stays this far above the suction level
# (m), since a driver may stop 2 cm above it to allow for sensor error. Then it falls just below it.
_WATER = 1.5
_LEAST_ABOVE_SUCTION, _DRY = 0.022, -0.001
# After that, rain refills it to this far above the suction level (m): more than a driver may need.
_REFILLED = 0.5
# A pump is on if /pump/state begins with one of these words; text after a colon is for people.
_ON = ("starting", "running")
# The number of checks, for the progress messages.
_CHECKS = 22
_NOT_RUNNING = "not tried: the pump does not run"


@dataclass(frozen=True)
class Limits:
    """The command for the driver, and its time limits.

    Attributes:
        command: command for a running pump, a share of its maximum flow.
        period: least time between two commands (s).
        answer: longest time from a command to its flow (s).
        start: longest time until the flow is steady (s).
        stop: longest time from the reason to stop until the flow is 0 (s).
        silence: time without a command, after which the pump must have stopped (s).
        arrival: longest wait for the driver to join the graph (s).
    """

    command: float
    period: float
    answer: float
    start: float
    stop: float
    silence: float
    arrival: float


class _ProblemError(Exception):
    """The driver breaks a rule; the message says how."""


def _require(right: bool, problem: str) -> None:
    if not right:
        raise _ProblemError(problem)


class PumpCheck:
    """Checks one driver."""

    def __init__(self, node: Node, driver: str, site: Site, limits: Limits) -> None:
        """Open the topics, in the namespace of the node.

        Args:
            node: the node that plays the driver's peers.
            driver: name of the driver's node, without namespace.
            site: the site that sets the levels.
            limits: the command and the time limits.
        """
        self._node = node
        self._driver = driver
        self._site = site
        self._limits = limits
        self._interface = read_topics()
        self._executor = make_executor()
        self._executor.add_node(node)
        # Low, so that the roof has room for all water that will be pumped.
        self._empty_roof = 0.5 * initial_state(site, "low-low")[1]
        self._volumes = [site.suction_level * site.a1 + _WATER, self._empty_roof]
        self._least_above_suction = _LEAST_ABOVE_SUCTION
        self._ticks = 0
        self._flows: list[float] = []
        self._steady = 0.0
        self._findings: list[Finding] = []
        self._came = ""
        self._hindered = ""
        self._lockstep_problem = ""
        self._state = ""
        self._trying = "waiting for the driver"
        self._lines = ProgressLines()
        self._publishers: dict[str, Callable[[Any], None]] = {}

    def run(self) -> list[Finding]:
        """Run all checks, and return a finding for each; only the first if the topics do not fit.

        Raises:
            ConfigurationError: there is no such driver.
            OccupiedError: a graph already uses it.
        """
        self._wait_for_driver()
        unfit = self._unfit()
        self._findings.append(Finding("its topics fit the interface", unfit))
        if not unfit:
            self._join()
            self._try_all()
        return self._findings

    def _try_all(self) -> None:
        """Run all checks in turn; after each stop except the last, the pump must run again."""
        limits, site = self._limits, self._site
        with self._check("is off at start: no flow before a command, and 0 at command 0"):
            early = next(iter(self._flows), 0.0)
            _require(not self._flows, f"a flow of {early:g} m3/s came before any command")
            for _ in range(_STEADY_TICKS):
                flow = self._answer({_COMMAND: 0.0})
                _require(flow <= 0, f"a flow of {flow:g} m3/s answers command 0")
        self._runs(f"at command {limits.command:g}")
        if not self._steady:
            self._hindered = self._hindered or _NOT_RUNNING
        with self._check("takes a command above 1 as 1"):
            most, beyond = self._steady_flow(1.0), self._steady_flow(3.0)
            _require(
                beyond <= (1 + _NOISE) * most,
                f"the flow is {beyond:.3g} m3/s at command 3, and {most:.3g} at command 1",
            )
            self._came = f"{beyond:.3g} m3/s at command 3, {most:.3g} at command 1"
        with self._check("refuses what is not finite or below 0: the flow falls to 0"):
            for value in _HOSTILE:
                self._stop(f"command {value:g}", {_COMMAND: value})
        self._runs("again after refused commands")
        with self._check(f"has stopped after {limits.silence:g} s without a command"):
            self._fall_silent()
        self._runs("again when commands come again")
        with self._check(f"stops while {_COMMAND} has a second publisher"):
            self._must_run()
            with self._intruder():
                self._stop("a second publisher came", {})
        self._runs("again when one publisher is left")
        within = f"the flow is 0 within {limits.stop:g} s, and stays so"
        for topic, value, when, after in _STOPS:
            with self._check(f"stops {when}: {within}"):
                self._must_run()
                self._stop(f"{value:g} on {topic}", {topic: value})
            if topic == "/roof/level":  # the roof is taken to have dried: it has room again
                self._volumes[1] = self._empty_roof
            self._runs(f"again when {after}")
        with self._check(f"stops when the cistern falls to the suction level: {within}"):
            self._must_run()
            self._least_above_suction = _DRY
            dry = (site.suction_level + _DRY) * site.a1
            while self._volumes[0] > dry and self._flowing(self._answer({})):
                pass  # until the suction level; a driver may stop earlier
            above = max(0.0, self._volumes[0] / site.a1 - site.suction_level)
            self._stop("the cistern fell to the suction level", {})
            self._came += f", {above:.3f} m above the suction level"
        self._volumes[0] = (site.suction_level + _REFILLED) * site.a1
        self._runs("again when the cistern has filled again")
        with self._check("stops at command 0"):
            self._stop("command 0", {_COMMAND: 0.0})
        with self._check("answers each command with exactly one flow"):
            self._spin(0.5)
            self._count_answers(0)
            _require(not self._lockstep_problem, self._lockstep_problem)

    @contextmanager
    def _check(self, title: str) -> Iterator[None]:
        """Run a check and note its finding."""
        self._trying = f"check {len(self._findings) + 1} of {_CHECKS}: {title}"
        problem, self._came = "", ""
        try:
            yield
        except _ProblemError as error:
            problem = str(error)
        self._findings.append(Finding(title, problem, self._came))

    # --- the graph ------------------------------------------------------------------------------

    def _name(self, topic: str) -> str:
        return self._node.resolve_topic_name(self._interface[topic].graph_name)

    def _ends(self) -> list[tuple[str, Qos, list[Any]]]:
        """Return the endpoints that the driver needs, each with required profile and candidates."""
        node, flow, command = self._node, self._interface["/pump/flow"], self._interface[_COMMAND]
        publishers = node.get_publishers_info_by_topic(self._name(flow.name))
        subscriptions = node.get_subscriptions_info_by_topic(self._name(command.name))
        return [
            (f"publisher of {flow.name}", flow.qos, publishers),
            (
                f"subscription to {command.name}", replace(command.qos, lease_s=math.inf),
                subscriptions,
            ),
        ]

    def _of_driver(self, infos: list[Any]) -> list[Any]:
        driver = self._driver, self._node.get_namespace()
        return [info for info in infos if (info.node_name, info.node_namespace) == driver]

    def _wait_for_driver(self) -> None:
        """Wait until the driver has both its topics; refuse if other nodes publish its inputs."""
        until = time.monotonic() + self._limits.arrival
        while not all(self._of_driver(infos) for *_, infos in self._ends()):
            if time.monotonic() > until:
                raise ConfigurationError(self._absent())
            self._spin(0.1)
        for topic in _PLAYED:
            publishers = self._node.get_publishers_info_by_topic(self._name(topic))
            if publishers:
                raise OccupiedError(
                    f"{self._name(topic)} already has a publisher "
                    f"({call_node(publishers[0].node_name)}): the check plays plant, weather and "
                    "controller itself; end the graph first"
                )

    def _absent(self) -> str:
        names = {call_node(info.node_name) for *_, infos in self._ends() for info in infos}
        return (
            f"no node {self._driver} publishes {self._name('/pump/flow')} and subscribes to "
            f"{self._name(_COMMAND)} within {self._limits.arrival:g} s; there is "
            f"{', '.join(sorted(names)) or 'no node'}. Start the driver first, in the same "
            "ROS_DOMAIN_ID and with the same ROS_AUTOMATIC_DISCOVERY_RANGE"
        )

    def _unfit(self) -> str:
        """Return what the driver's endpoints lack, as a text; empty if they fit."""
        return "; ".join(
            f"its {end} {' and '.join(lacking)}; it must be {requirements(qos)}"
            for end, qos, infos in self._ends() for info in self._of_driver(infos)
            if (lacking := lacks(info.qos_profile, qos))
        )

    def _join(self) -> None:
        """Open the topics, and listen until the driver has found them."""

        def hear_state(message: String) -> None:
            self._state = message.data

        for name, of, hear in (
            ("/pump/flow", Float64, lambda message: self._flows.append(message.data)),
            ("/pump/state", String, hear_state),
        ):
            topic = self._interface[name]
            profile = qos_profile(topic.qos)
            self._node.create_subscription(of, topic.graph_name, hear, profile)
        for name in (RUN, *_PLAYED):
            self._publishers[name] = self._publisher(self._node, name)
        # A fixed identity: a driver can be checked twice. Its levels change at this speed.
        speed = max(1.0, self._site.tau / self._limits.period)
        self._publishers[RUN](RunIdentity(0.0, _LAST_TICK, speed).values)
        self._spin(_DISCOVERY_S)

    def _publisher(self, node: Node, name: str) -> Callable[[Any], None]:
        """Open a topic, and return a function that publishes a value on it."""
        topic = self._interface[name]
        encode = encoder(topic.type)
        publisher = node.create_publisher(
            message_class(topic.type), topic.graph_name, qos_profile(topic.qos)
        )
        return lambda value: publisher.publish(encode(value))

    def _spin(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)
        self._lines.tell(self._trying)

    # --- ticks ----------------------------------------------------------------------------------

    def _answer(self, overrides: Mapping[str, float]) -> float:
        """Publish a tick, and return the flow that answers its command (m3/s).

        Args:
            overrides: values, by topic, that replace the values of an undisturbed tick.
        """
        _require(not self._hindered, self._hindered)
        began, tau = time.monotonic(), self._site.tau
        cistern, roof = self._volumes
        values: dict[str, float] = {
            "/clock": _EPOCH_NS + round(self._ticks * tau * 1e9),
            "/cistern/level": cistern / self._site.a1,
            "/roof/level": roof / self._site.a2,
            "/weather/frost": 0.0,
            _COMMAND: self._limits.command,
            **overrides,
        }
        for topic, value in values.items():
            self._publishers[topic](value)
        self._ticks += 1
        while not self._flows:
            left = began + self._limits.answer - time.monotonic()
            if left < 0:
                self._hindered = "not tried: the driver does not answer"
                raise _ProblemError(
                    f"no flow within {self._limits.answer:g} s of command {values[_COMMAND]:g}, "
                    f"number {self._ticks}{self._driver_state()}"
                )
            self._executor.spin_once(timeout_sec=left)
        self._spin(began + self._limits.period - time.monotonic())
        flow = self._flows[0]
        self._count_answers(1)
        allowed = self._interface["/pump/flow"].range
        _require(flow in allowed, f"its flow is {flow:g} m3/s, but {allowed.expected()}")
        least = (self._site.suction_level + self._least_above_suction) * self._site.a1
        self._volumes = [max(cistern - flow * tau, least), roof + flow * tau]
        return flow

    def _count_answers(self, answers: int) -> None:
        """Note flows beyond the expected number, and forget all flows."""
        if len(self._flows) > answers and not self._lockstep_problem:
            self._lockstep_problem = (
                f"{len(self._flows)} flows instead of {answers}, after {self._ticks} commands"
            )
        self._flows.clear()

    def _driver_state(self) -> str:
        return f" (/pump/state: {self._state})" if self._state else ""

    def _flowing(self, flow: float) -> bool:
        return flow > _NONE * self._steady

    def _stop(self, reason: str, overrides: Mapping[str, float]) -> None:
        """Repeat a tick until the flow is 0, then ten times more; note how long the stop took.

        Raises:
            _ProblemError: the flow is not 0 within the limit, or does not stay 0.
        """
        began = time.monotonic()
        before = flow = self._answer(overrides)
        while self._flowing(flow):
            _require(
                time.monotonic() <= began + self._limits.stop,
                f"the flow is {flow:.3g} m3/s {self._limits.stop:g} s after {reason} "
                f"(first answer: {before:.3g}){self._driver_state()}",
            )
            flow = self._answer(overrides)
        self._came = self._came or f"no flow after {time.monotonic() - began:.1f} s"
        for _ in range(_STEADY_TICKS):
            flow = self._answer(overrides)
            _require(not self._flowing(flow), f"a flow of {flow:g} m3/s answers {reason}")

    def _must_run(self) -> None:
        """Require that the pump runs: otherwise a check of a stop proves nothing."""
        _require(self._answer({}) >= _AT_REST * self._steady, _NOT_RUNNING)

    def _steady_flow(self, command: float) -> float:
        """Repeat a command until the flow is steady and above 0, and return it (m3/s).

        Raises:
            _ProblemError: this does not happen within the limit.
        """
        until = time.monotonic() + self._limits.start
        flows: list[float] = []
        while True:
            flows = [*flows[-_STEADY_TICKS:], self._answer({_COMMAND: command})]
            least, most = min(flows), max(flows)
            if len(flows) > _STEADY_TICKS and least > 0 and most - least <= _STEADY * most:
                self._steady = flows[-1]
                return self._steady
            expected = f"from {least:.3g} to {most:.3g} m3/s" if most else "0"
            _require(
                time.monotonic() <= until,
                f"the flow is {expected} after {self._limits.start:g} s at command {command:g}"
                f"{self._driver_state()}",
            )

    def _runs(self, when: str) -> None:
        with self._check(f"runs {when}"):
            began = time.monotonic()
            flow = self._steady_flow(self._limits.command)
            self._came = f"{flow:.3g} m3/s, steady after {time.monotonic() - began:.1f} s"

    def _fall_silent(self) -> None:
        """Send nothing for a while; the next flow then shows whether the pump had stopped."""
        before = self._steady_flow(self._limits.command)
        self._spin(self._limits.silence)
        self._count_answers(0)
        state = self._state.partition(":")[0]
        after = self._answer({})
        _require(
            after <= _AT_REST * before,
            f"the flow is {after:.3g} m3/s at the first command after {self._limits.silence:g} s "
            f"of silence, and was {before:.3g} before: the pump had not stopped",
        )
        _require(state not in _ON, f"/pump/state says {state!r} at the end of the silence")
        self._came = f"{after:.3g} m3/s at the first command after it, {before:.3g} before"

    @contextmanager
    def _intruder(self) -> Iterator[None]:
        """Add another node with a publisher of the command, which publishes nothing."""
        intruder = Node("check_pump_intruder", namespace=self._node.get_namespace())
        self._publisher(intruder, _COMMAND)
        try:
            yield
        finally:
            intruder.destroy_node()
            self._count_answers(0)


def check_pump(driver: str, site: Site, limits: Limits) -> list[Finding]:
    """Check a running driver.

    Args:
        driver: name of its node, with its namespace if it has one: ``/site1/pump``.
        site: the site that sets the levels and the tick.
        limits: the command and the time limits.

    Returns:
        A finding for each check.

    Raises:
        ConfigurationError: there is no such driver.
        OccupiedError: a graph already uses it.
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
