"""Check of a pump driver against the interface, using topics only."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from greenroof_ros.nodes.check import CISTERN, COMMAND, FROST, ROOF, USUAL, NodeCheck, Story, Values
from greenroof_ros.physics.start import initial_states
from greenroof_ros.site.site import Site

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
