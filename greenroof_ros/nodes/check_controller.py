"""Check of a controller node against the rules of a lockstep graph, using topics only."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Sequence
from typing import Any

from greenroof_ros.controllers.check import trial_values
from greenroof_ros.nodes.check import CISTERN, COMMAND, FROST, ROOF, NodeCheck, Story, Values
from greenroof_ros.ros.messages import WithFront
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site

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
