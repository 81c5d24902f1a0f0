"""Check of a controller node against the rules of a lockstep graph, using topics only."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Mapping
from typing import Any, ClassVar

from rclpy.node import Node

from greenroof_ros.controllers.check import trial_values
from greenroof_ros.controllers.outlet import SHARE
from greenroof_ros.graph.lockstep import CLOCK
from greenroof_ros.graph.messages import WithFront
from greenroof_ros.nodes.check import SETTLE_S, BrokenRuleError, NodeCheck, require
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site

_LEVELS = ("/cistern/level", "/roof/level")
_FROST = "/weather/frost"
_FORECASTS = ("/forecast/precipitation", "/forecast/evapotranspiration")
_WEATHER = ("/weather/precipitation", "/weather/evapotranspiration")
_VALVE = "/outlet/command"
_NOT_FINITE = (math.nan, math.inf, -math.inf)
# Inputs for which the command must be 0.
_STOPS = (
    ("in frost", _FROST, (1.0,)),
    ("while frost is not finite", _FROST, _NOT_FINITE),
    ("while the cistern's level is not finite", _LEVELS[0], _NOT_FINITE),
    ("while the roof's level is not finite", _LEVELS[1], _NOT_FINITE),
)
# Number of consecutive ticks in which the command must be 0.
_STOP_TICKS = 3
# Simulated time within which a controller must water again (s), as it may limit the pump's starts.
_WATERS_AGAIN_S = 3600.0
# How long the last input of a tick is held back (s): a node that does not wait for it answers by
# then.
_DELAY_S = 0.1
# By how much a solver's answers to equal inputs may differ.
_EQUAL = 1e-6
# How long a node may take to end when the plant has gone (s).
_END_S = 10.0
# How long a command may take after the last input of a tick (s).
ANSWER_S = 5.0


class ControllerCheck(NodeCheck):
    """Check of one controller node."""

    kind: ClassVar[str] = "controller"
    answer: ClassVar[str] = "command"
    output: ClassVar[str] = "/pump/command"
    inputs: ClassVar[tuple[str, ...]] = (*_LEVELS, _FROST)
    optional: ClassVar[tuple[str, ...]] = _FORECASTS
    played: ClassVar[tuple[str, ...]] = (CLOCK, *inputs, *optional, *_WEATHER)
    peers: ClassVar[str] = "the plant node and the weather node"

    def __init__(self, node: Node, controller: str, site: Site, *, horizon: float) -> None:
        """Prepare a check.

        Args:
            node: the node that plays the controller's peers.
            controller: name of the controller's node, without namespace.
            site: site from which the levels of the check are derived.
            horizon: length of the forecasts (h), with steps of increasing length; 0 for the next M
                ticks.
        """
        super().__init__(node, controller, site.tau, 0.0)
        self._site = site
        # The numbers in front of a forecast: no time of issue, and the ends of the steps.
        self._front = array("d", [math.nan, *look_ahead_ends(site, horizon)[1:]])
        # The values of a tick, by topic; once they are known, those in which the controller waters.
        self._usual = dict.fromkeys(self.played[1:], 0.0)
        self._unanswered = ""
        self._slowest = 0.0
        self.further = (_VALVE,) if site.low_outlet_valve else ()
        self._shares: list[float] = []  # received and not counted yet
        self._wrong_share = ""

    def run_checks(self) -> None:
        """Run all checks in turn; after each stop, the controller must resume watering."""
        with self.check("publishes nothing before the first tick"):
            early = len(self.answers) + len(self._shares)
            self.answers.clear()
            self._shares.clear()
            require(not early, f"{early} commands arrived before any input")
        with self.check("waters a dry roof"):
            self._find_watering()
        for when, topic, values in _STOPS:
            with self.check(f"commands 0 {when}"):
                for value in values:
                    self._must_water()
                    for _ in range(_STOP_TICKS):
                        command = self._command({topic: value})
                        require(
                            command == 0, f"the command is {command:g} with {value:g} on {topic}"
                        )
                self._must_water()
        with self.check("its commands stay valid while a forecast is not finite"):
            for topic in _FORECASTS:
                for value in _NOT_FINITE:
                    self._valid_command({topic: value})
        with self.check("waits for all inputs, and sends the same command whatever their order"):
            require(not self.hindered, self.hindered)
            for topic in filter(self.endpoints, (*self.inputs, *self.optional)):
                self._publish_last(topic)
        with self.check("its commands are finite and not negative at all levels and forecasts"):
            for trial in self._trials():
                self._valid_command(trial)
        if self.further:
            with self.check(
                "its commands to the valve are between 0 and 1, and 0 while an input is not finite"
            ):
                require(not self._wrong_share, self._wrong_share)
        with self.check(f"answers every tick within {ANSWER_S:g} s"):
            require(not self._unanswered, self._unanswered)
            self.result = f"{self.ticks} ticks; the slowest answer took {self._slowest:.3f} s"
        self.check_count()
        with self.check("ends when the plant has stopped"):
            self._end()

    def _find_watering(self) -> None:
        """Find levels and forecasts at which the controller waters the roof.

        Forecasts without rain, dry roofs and full cisterns are tried first, because a controller
        that has seen rain in a forecast may keep its plan for hours.
        """

        def dryness(trial: dict[str, float]) -> tuple[float, float, float]:
            return trial[_FORECASTS[0]], trial[_LEVELS[1]], -trial[_LEVELS[0]]

        for trial in sorted(self._trials(), key=dryness):
            command = self._command(trial)
            if command > 0:
                self._usual.update(trial)
                self.result = f"{command:.3g}{_with(trial)}"
                return
        self.hindered = "not checked: no command was above 0, so a command of 0 would prove nothing"
        raise BrokenRuleError("the command is 0 at all levels and forecasts")

    def _trials(self) -> list[dict[str, float]]:
        return [
            dict(zip((*_LEVELS, *_FORECASTS), trial, strict=True))
            for trial in trial_values(self._site)
        ]

    def _publish_last(self, topic: str) -> None:
        """Publish one input last in a tick, and require that the command does not change.

        For a controller with memory, the command may lie between those of the ticks before and
        after.
        """
        before = self._valid_command({})
        late = self._valid_command({}, last=topic)
        after = self._valid_command({})
        require(
            min(before, after) - _EQUAL <= late <= max(before, after) + _EQUAL,
            f"the command is {late:g} if {topic} comes last, but {before:g} in the tick before and "
            f"{after:g} in the tick after, although the inputs are the same",
        )

    def _must_water(self) -> None:
        """Require a command above 0; otherwise, a later command of 0 would prove nothing."""
        ticks = math.ceil(_WATERS_AGAIN_S / self._site.tau)
        require(
            any(self._valid_command({}) > 0 for _ in range(ticks)),
            f"the command stays 0 for {ticks} ticks at levels at which it was above 0",
        )

    def join(self) -> None:
        """Subscribe to the commands to the outlet valve as well, if the site has a valve."""
        for topic in self.further:
            self.listen(topic, self._shares.append)
        super().join()

    def _end(self) -> None:
        require(bool(self.endpoints(self.output)), "the node stopped before the plant did")
        self.close_publishers()
        until = time.monotonic() + _END_S
        while self.endpoints(self.output):
            require(
                time.monotonic() <= until,
                f"the node is still running {_END_S:g} s after the publisher of {CLOCK} "
                "disappeared",
            )
            self.spin(0.1)

    # --- ticks ----------------------------------------------------------------------------------

    def _valid_command(self, overrides: Mapping[str, float], last: str = "") -> float:
        command = self._command(overrides, last)
        valid = math.isfinite(command) and command >= 0
        require(valid, f"the command is {command:g}{_with(overrides)}")
        return command

    def _command(self, overrides: Mapping[str, float], last: str = "") -> float:
        """Publish a tick, and return the command sent in response.

        Args:
            overrides: values, by topic, that replace the values at which the controller waters.
            last: topic to publish last; empty for the usual order.

        Raises:
            BrokenRuleError: if no command arrives, or a command arrives before the last input.
        """
        self.count_answers(0)
        self.start_tick()
        values = {**self._usual, **overrides}
        early = False
        for topic in self.played[1:]:
            if topic != last:
                self.publish(topic, self._value(topic, values))
        if last:
            self.spin(_DELAY_S)
            early = bool(self.answers or self._shares)
            self.publish(last, self._value(last, values))
        began = time.monotonic()
        if not self.wait_for_answer(began + ANSWER_S):
            ended = "" if self.endpoints(self.output) else "; the node is no longer running"
            lacking = [self.output] if self.further and not self.answers else list(self.further)
            self._unanswered = (
                f"no command{''.join(f' on {topic}' for topic in lacking)} within {ANSWER_S:g} s "
                f"in tick {self.ticks - 1}{_with(overrides)}{ended}"
            )
            raise BrokenRuleError(self.hindered)
        self._slowest = max(self._slowest, time.monotonic() - began)
        if self.ticks == 1:
            self.spin(SETTLE_S)
        command = self.answers[0]
        for share in self._shares[:1]:
            unknown = not all(math.isfinite(overrides.get(name, 0.0)) for name in self.inputs)
            if not (share == 0 if unknown else share in SHARE) and not self._wrong_share:
                self._wrong_share = f"the command to the valve is {share:g}{_with(overrides)}"
        self.count_answers(1)
        require(not early, f"the node answers before it has received the tick's message on {last}")
        return command

    def answered(self) -> bool:
        """Return whether the commands to the pump and to any outlet valve have arrived."""
        return bool(self.answers) and len(self._shares) >= len(self.further)

    def count_answers(self, expected: int) -> None:
        """Stop publishing ticks once too many commands to the pump or the valve have arrived."""
        super().count_answers(expected)
        if len(self._shares) > expected and not self.surplus:
            self.surplus = (
                f"{len(self._shares)} commands to the valve instead of {expected} after tick "
                f"{self.ticks - 1}"
            )
        self._shares.clear()
        if self.surplus:
            self.hindered = "not checked: the node sent more than one command for a tick"

    def _value(self, topic: str, values: Mapping[str, float]) -> Any:
        """Return the content of a message; a forecast has the same rate in all of its steps."""
        value = values[topic]
        if topic not in _FORECASTS:
            return value
        return WithFront(self._front, array("d", [value] * (len(self._front) - 1)))


def _with(values: Mapping[str, float]) -> str:
    words = ", ".join(f"{value:g} on {topic}" for topic, value in values.items())
    return f" with {words}" if words else ""
