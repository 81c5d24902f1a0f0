"""Check of a controller node against the rules of a lockstep graph, using topics only."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Sequence
from typing import Any

from greenroof_ros.controllers.check import trial_values
from greenroof_ros.nodes.check import NodeCheck, Story, StoryEndError, Values, describe
from greenroof_ros.ros.messages import WithFront
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site

CISTERN, ROOF, FROST, COMMAND = "/cistern/level", "/roof/level", "/weather/frost", "/pump/command"
_FORECASTS = ("/forecast/precipitation", "/forecast/evapotranspiration")
_NOT_FINITE = (math.nan, math.inf, -math.inf)
# Inputs for which the command must be 0.
_STOPS = (
    ("in frost", FROST, (1.0,)),
    ("while frost is not finite", FROST, _NOT_FINITE),
    ("while the cistern's level is not finite", CISTERN, _NOT_FINITE),
    ("while the roof's level is not finite", ROOF, _NOT_FINITE),
)
# Number of ticks after the first in which the command must stay 0.
_STAYS = 2
# Simulated time within which a controller must water again (s), as it may limit the pump's starts.
_WATERS_AGAIN_S = 3600.0
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
        weather = ("/weather/precipitation", "/weather/evapotranspiration")
        usual = dict.fromkeys((*self.required, *self.optional, *weather), 0.0)
        super().__init__(controller, site, outputs, usual)
        # The numbers in front of a forecast: no time of issue, and the ends of the steps.
        self._front = array("d", [math.nan, *look_ahead_ends(site, horizon)[1:]])
        self._trials = [
            dict(zip((CISTERN, ROOF, *_FORECASTS), trial, strict=True))
            for trial in trial_values(site)
        ]

    def story(self) -> Story:
        """Tell when a controller must not water, after which it must water again."""
        yield "waters a dry roof", self._find_watering
        for when, topic, values in _STOPS:
            yield f"commands 0 {when}", self._command_0, topic, values
        hidden = [{topic: value} for topic in _FORECASTS for value in _NOT_FINITE]
        yield "its commands are valid while a forecast is not", self._answer, hidden
        yield "waits for its inputs in any order", self.answer_in_any_order, _EQUAL
        yield "its commands are valid at all levels", self._answer, self._trials
        yield "sends exactly one command for each tick", self.answer_once
        yield "ends when the plant has ended", self.end_with_peers

    def _find_watering(self) -> str:
        """Find levels and forecasts at which the controller waters the roof.

        Forecasts without rain, dry roofs and full cisterns are tried first, because a controller
        that has seen rain in a forecast may keep its plan for hours.
        """

        def dryness(trial: Values) -> tuple[float, float, float]:
            return trial[_FORECASTS[0]], trial[ROOF], -trial[CISTERN]

        for trial in sorted(self._trials, key=dryness):
            answers = self.tick(trial)
            if answers[COMMAND] > 0:
                self.usual |= trial
                return f"{describe(answers)} with {describe(trial)}"
        # A command of 0 would prove nothing.
        raise StoryEndError(f"{COMMAND} is 0 at all levels and forecasts")

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
        self.until(lambda answers: answers[COMMAND] > 0, within=_WATERS_AGAIN_S)

    def _answer(self, trials: Iterable[Values]) -> None:
        for trial in trials:
            self.tick(trial)

    def publish(self, topic: str, value: Any) -> None:
        """Publish a value; a forecast has it in all of its steps."""
        if topic in _FORECASTS:
            value = WithFront(self._front, array("d", [value] * (len(self._front) - 1)))
        super().publish(topic, value)
