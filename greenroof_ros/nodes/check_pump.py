"""Check of a pump driver against the interface, using topics only."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import ClassVar

from rclpy.node import Node
from std_msgs.msg import String

from greenroof_ros.interface.states import PumpState
from greenroof_ros.nodes.check import NodeCheck, require
from greenroof_ros.physics.start import initial_states
from greenroof_ros.site.site import Site

_COMMAND = "/pump/command"
# A flow is steady if more than this many answers vary by at most this share of the largest.
_STEADY_TICKS, _STEADY = 10, 0.01
# A flow up to this share of the steady one counts as 0, as the pump runs down or the meter is
# noisy.
_NONE = 0.01
# A flow more than this share above the flow at command 1 exceeds the maximum, as noise is smaller.
_NOISE = 0.05
# The first flow of a pump that was stopped is at most this share of its steady flow.
_AT_REST = 0.5
# Commands that a driver must reject. NaN comes first, while the pump is running: a driver that
# keeps the previous command would then go on pumping.
_HOSTILE = (math.nan, math.inf, -math.inf, -1.0, -1e300)
# Reasons to stop although the command continues: topic, value, and the texts for "when" and
# "after".
_STOPS = (
    ("/weather/frost", 1.0, "in frost", "the frost is over"),
    ("/weather/frost", math.nan, "while frost is unknown (NaN)", "frost is known"),
    (
        "/cistern/level", math.nan, "while the cistern's level is unknown (NaN)",
        "the cistern's level is known",
    ),
    (
        "/roof/level", math.nan, "while the roof's level is unknown (NaN)",
        "the roof's level is known",
    ),
)
# The cistern starts with this much water above the suction level (m3), which is enough for all
# checks before the dry-run check. Its level falls as water is pumped, but stays this far above the
# suction level (m), since a driver may stop 2 cm above it to allow for sensor error. The dry-run
# check begins there, and lets the level fall just below the suction level.
_WATER = 1.5
_MIN_ABOVE_SUCTION, _DRY = 0.022, -0.001
# After that, rain refills it to this far above the suction level (m), which is more than a driver
# may need.
_REFILLED = 0.5
# How long the last input of a tick is held back (s): a driver that does not wait for it answers by
# then.
_DELAY_S = 0.05
# The states of /pump/state in which a pump is on.
_ON = ("starting", "running")
_NOT_RUNNING = "not checked: the pump does not run"
# Longest time from a command to its flow, and until that flow is steady (s).
ANSWER_S, START_S = 5.0, 60.0
# Longest time from a reason to stop until the flow is 0 (s): the longest ramp of a drive, and the
# time that it takes to notice.
STOP_S = 35.0
# Time without a command after which the pump must have stopped (s).
SILENCE_S = 5.0


class PumpCheck(NodeCheck):
    """Check of one pump driver."""

    kind: ClassVar[str] = "driver"
    answer: ClassVar[str] = "flow"
    output: ClassVar[str] = "/pump/flow"
    inputs: ClassVar[tuple[str, ...]] = (_COMMAND,)
    played: ClassVar[tuple[str, ...]] = (
        "/clock", "/cistern/level", "/roof/level", "/weather/frost", _COMMAND,
    )
    peers: ClassVar[str] = "the plant node, the weather node and the controller"

    def __init__(
        self, node: Node, driver: str, site: Site, *, command: float, period: float, live: bool
    ) -> None:
        """Prepare a check.

        Args:
            node: the node that plays the driver's peers.
            driver: name of the driver's node, without namespace.
            site: site from which the levels of the check are derived.
            command: command at which the pump is run (share of its maximum flow).
            period: minimum time between two commands (s).
            live: whether the driver publishes its flow at its own rate rather than once per
                command.
        """
        self._passed = period if live else site.tau  # in a tick (s)
        super().__init__(node, driver, site.tau, max(1.0, self._passed / period))
        self.live, self._period, self._usual = live, period, command
        self._site = site
        # Low, so that the roof has room for all water that will be pumped.
        self._empty_roof = 0.5 * initial_states(site)["low-low"][1]
        self._volumes = [site.suction_level * site.a1 + _WATER, self._empty_roof]
        self._above_suction = _MIN_ABOVE_SUCTION
        self._steady = 0.0
        self._state: PumpState | None = None

    def run_checks(self) -> None:
        """Run all checks in turn; after each stop except the last, the pump must run again."""
        site = self._site
        with self.check("is off at the start: no flow before the first command or at command 0"):
            early = next(iter(self.answers), 0.0)
            none = max(self.answers, default=0.0) <= 0 if self.live else not self.answers
            require(none, f"a flow of {early:g} m3/s arrived before any command")
            self.answers.clear()
            for _ in range(_STEADY_TICKS):
                flow = self._answer({_COMMAND: 0.0})
                require(flow <= 0, f"the flow is {flow:g} m3/s at command 0")
        self._runs(f"at command {self._usual:g}")
        if not self._steady:
            self.hindered = self.hindered or _NOT_RUNNING
        if not self.live:
            with self.check("waits for all inputs of a tick, in whatever order they arrive"):
                for order in itertools.permutations(self.played[1:]):
                    self._answer({}, order)
        with self.check("treats a command above 1 as 1"):
            most, beyond = self._steady_flow(1.0), self._steady_flow(3.0)
            require(
                beyond <= (1 + _NOISE) * most,
                f"the flow is {beyond:.3g} m3/s at command 3, and {most:.3g} at command 1",
            )
            self.result = f"{beyond:.3g} m3/s at command 3, {most:.3g} at command 1"
        with self.check("rejects commands that are not finite or below 0: the flow falls to 0"):
            for value in _HOSTILE:
                self._stop(f"command {value:g}", {_COMMAND: value})
        self._runs("again after rejected commands")
        with self.check(f"stops within {SILENCE_S:g} s of the last command"):
            self._fall_silent()
        self._runs("again once commands resume")
        with self.check(f"stops while {_COMMAND} has a second publisher"):
            self._must_run()
            with self._intruder():
                self._stop("a second publisher appeared", {})
        self._runs("again once only one publisher is left")
        within = f"the flow falls to 0 within {STOP_S:g} s and stays there"
        for topic, value, when, after in _STOPS:
            with self.check(f"stops {when}: {within}"):
                self._must_run()
                self._stop(f"{value:g} on {topic}", {topic: value})
            if topic == "/roof/level":  # the roof is assumed to have dried, so it has room again
                self._volumes[1] = self._empty_roof
            self._runs(f"again when {after}")
        with self.check(f"stops when the cistern falls to the suction level: {within}"):
            self._volumes[0] = (site.suction_level + _MIN_ABOVE_SUCTION) * site.a1
            self._steady_flow(self._usual)
            self._above_suction = _DRY
            dry = (site.suction_level + _DRY) * site.a1
            while self._volumes[0] > dry and self._flowing(self._answer({})):
                pass  # down to the suction level, although a driver may stop earlier
            above = max(0.0, self._volumes[0] / site.a1 - site.suction_level)
            self._stop("the cistern fell to the suction level", {})
            self.result += f", {above:.3f} m above the suction level"
        self._volumes[0] = (site.suction_level + _REFILLED) * site.a1
        self._runs("again once the cistern has refilled")
        with self.check("stops at command 0"):
            self._stop("command 0", {_COMMAND: 0.0})
        if not self.live:
            self.check_count()

    def join(self) -> None:
        """Subscribe to the pump's state as well."""

        def receive_state(message: String) -> None:
            self._state = PumpState.read(message.data)

        self.listen("/pump/state", receive_state)
        super().join()

    # --- ticks ----------------------------------------------------------------------------------

    def _answer(self, overrides: Mapping[str, float], order: Sequence[str] = ()) -> float:
        """Publish a tick, and return the flow reported in response to its command (m3/s).

        Args:
            overrides: values by topic that replace the values of an undisturbed tick.
            order: order in which the topics are published, the last after a delay; by default, the
                command comes last, without a delay.

        Raises:
            BrokenRuleError: if the flow arrives before the last input, or not in time.
        """
        if order:  # a second flow of the tick before is not one of this tick
            self.spin(_DELAY_S)
            self._count(0)
        began = time.monotonic()
        self.start_tick()
        cistern, roof = self._volumes
        values: dict[str, float] = {
            "/cistern/level": cistern / self._site.a1,
            "/roof/level": roof / self._site.a2,
            "/weather/frost": 0.0,
            _COMMAND: self._usual,
            **overrides,
        }
        early = False
        for topic in order[:-1] or values:
            self.publish(topic, values[topic])
        if order:
            self.spin(_DELAY_S)
            early = bool(self.answers)
            self.publish(order[-1], values[order[-1]])
        require(
            self.wait_for_answer(began + ANSWER_S),
            f"no flow arrived within {ANSWER_S:g} s of command number {self.ticks}, which was "
            f"{values[_COMMAND]:g}{self._driver_state()}",
        )
        self.spin(began + self._period - time.monotonic())
        flow = self.answers[-1]
        self._count(1)
        require(not early, f"a flow arrived before the last of {', '.join(order)}")
        allowed = self.interface["/pump/flow"].range
        require(flow in allowed, f"the flow is {flow:g} m3/s, but {allowed.expected()}")
        minimum = (self._site.suction_level + self._above_suction) * self._site.a1
        pumped = flow * self._passed
        self._volumes = [max(cistern - pumped, minimum), roof + pumped]
        return flow

    def _count(self, expected: int) -> None:
        """Count and discard the flows since the last tick; a live driver may publish more."""
        if self.live:
            del self.answers[expected:]
        self.count_answers(expected)

    def _driver_state(self) -> str:
        return f" (/pump/state: {self._state})" if self._state is not None else ""

    def _flowing(self, flow: float) -> bool:
        return flow > _NONE * self._steady

    def _stop(self, reason: str, overrides: Mapping[str, float]) -> None:
        """Repeat a tick until the flow is 0 and then ten more times, and record the stopping time.

        Raises:
            BrokenRuleError: if the flow is not 0 within the limit or does not stay 0.
        """
        began = time.monotonic()
        before = flow = self._answer(overrides)
        while self._flowing(flow):
            require(
                time.monotonic() <= began + STOP_S,
                f"{STOP_S:g} s after {reason}, the flow is still {flow:.3g} m3/s "
                f"(first answer: {before:.3g} m3/s){self._driver_state()}",
            )
            flow = self._answer(overrides)
        self.result = self.result or f"no flow after {time.monotonic() - began:.1f} s"
        for _ in range(_STEADY_TICKS):
            flow = self._answer(overrides)
            require(not self._flowing(flow), f"the flow is {flow:g} m3/s again after {reason}")

    def _must_run(self) -> None:
        """Require that the pump is running; otherwise, a check of a stop would prove nothing."""
        require(self._answer({}) >= _AT_REST * self._steady, _NOT_RUNNING)

    def _steady_flow(self, command: float) -> float:
        """Repeat a command until the flow is steady and above 0, and return it (m3/s).

        Raises:
            BrokenRuleError: if the flow is not steady and above 0 within the limit.
        """
        until = time.monotonic() + START_S
        flows: list[float] = []
        while True:
            flows = [*flows[-_STEADY_TICKS:], self._answer({_COMMAND: command})]
            minimum, most = min(flows), max(flows)
            if len(flows) > _STEADY_TICKS and minimum > 0 and most - minimum <= _STEADY * most:
                self._steady = flows[-1]
                return self._steady
            expected = f"from {minimum:.3g} to {most:.3g} m3/s" if most else "0"
            require(
                time.monotonic() <= until,
                f"the flow is {expected} after {START_S:g} s at command {command:g}"
                f"{self._driver_state()}",
            )

    def _runs(self, when: str) -> None:
        with self.check(f"runs {when}"):
            began = time.monotonic()
            flow = self._steady_flow(self._usual)
            self.result = f"{flow:.3g} m3/s, steady after {time.monotonic() - began:.1f} s"

    def _fall_silent(self) -> None:
        """Send nothing for a while, and infer from the next flow whether the pump had stopped."""
        before = self._steady_flow(self._usual)
        self.spin(SILENCE_S)
        if self.live:
            last = self.answers[-1] if self.answers else math.nan
            require(last <= 0, f"the flow is {last:g} m3/s at the end of the silence")
        self._count(0)
        state = "" if self._state is None else self._state.state
        after = self._answer({})
        require(
            after <= _AT_REST * before,
            f"the flow is {after:.3g} m3/s at the first command after {SILENCE_S:g} s "
            f"of silence, and was {before:.3g} m3/s before the silence: the pump had not stopped",
        )
        require(state not in _ON, f"/pump/state reports {state!r} at the end of the silence")
        self.result = (
            f"{after:.3g} m3/s at the first command after the silence, {before:.3g} m3/s before "
            "the silence"
        )

    @contextmanager
    def _intruder(self) -> Iterator[None]:
        """Add a second node with a publisher for the command, which publishes nothing."""
        intruder = Node("check_pump_intruder", namespace=self.node.get_namespace())
        self.open_publisher(intruder, _COMMAND)
        try:
            yield
        finally:
            intruder.destroy_node()
            self._count(0)
