"""Check of a pump driver against the interface, using topics only."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from std_msgs.msg import String

from greenroof_ros.interface.states import PumpState
from greenroof_ros.nodes.check import USUAL, NodeCheck, Story, StoryEndError, Values, require
from greenroof_ros.physics.start import initial_states
from greenroof_ros.site.site import Site

CISTERN, ROOF, FROST = "/cistern/level", "/roof/level", "/weather/frost"
COMMAND, FLOW = "/pump/command", "/pump/flow"
# A flow is steady if this many answers vary by at most this share of the largest. A pump that is
# off must stay off for as many further ticks.
_STEADY_TICKS, _STEADY = 11, 0.01
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
# The cistern has this much water above the suction level (m3), which is enough for all checks. Its
# level falls as water is pumped, but stays this far above the suction level (m), since a driver may
# stop 2 cm above it to allow for sensor error. Then it is this far below that level, and after rain
# this far above it, which is more than a driver may need.
_WATER, _ABOVE_SUCTION, _BELOW_SUCTION, _REFILLED = 1.5, 0.022, 0.001, 0.5
# The states of /pump/state in which a pump is on.
_ON = ("starting", "running")
# Longest time from a command until the flow is steady (s).
START_S = 60.0
# Longest time from a reason to stop until the flow is 0 (s): the longest ramp of a drive, and the
# time that it takes to notice.
STOP_S = 35.0
# Time without a command after which the pump must have stopped (s).
SILENCE_S = 5.0
# Least number of ticks of the story, and how often it starts and stops the pump.
_TICKS, _STARTS = 280, 10


def describe_duration(period: float) -> str:
    """Return how long the check takes, which depends on how fast the pump starts and stops.

    Args:
        period: minimum duration of a tick (s).
    """
    shortest = _TICKS * period + SILENCE_S
    longest = shortest + _STARTS * (START_S + STOP_S)
    return f"{math.ceil(shortest / 60)} to {math.ceil(longest / 60)} minutes"


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
        self._flows = deque[float](maxlen=_STEADY_TICKS)
        self._steady = 0.0
        self._state = PumpState()
        self.listen("/pump/state", self._receive_state)

    def story(self) -> Story:
        """Tell what must stop a pump, after which it must run again."""
        suction, command = self.site.suction_level, self.usual[COMMAND]
        yield "is off at command 0", self._stop, 0.0, {COMMAND: 0.0}
        yield f"runs steadily at command {command:g}", self._run
        if not self.live:
            tolerance = _AT_REST * self._steady
            yield "waits for its inputs in any order", self.answer_in_any_order, tolerance
        yield "treats a command above 1 as 1", self._limit
        for value in _HOSTILE:
            yield f"rejects command {value:g}", self._stop, STOP_S, {COMMAND: value}
        yield "runs steadily again", self._run
        yield f"stops within {SILENCE_S:g} s of the last command", self._fall_silent
        yield "runs steadily again", self._run
        second = self.open(COMMAND)
        yield f"stops while {COMMAND} has a second publisher", self._stop, STOP_S, USUAL
        self.node.destroy_publisher(second)
        yield "runs steadily again", self._run
        for when, sent, afterwards in (
            ("in frost", {FROST: 1.0}, {}),
            ("while frost is unknown (NaN)", {FROST: math.nan}, {}),
            ("while the cistern's level is unknown (NaN)", {CISTERN: math.nan}, {}),
            ("while the roof's level is unknown (NaN)", {ROOF: math.nan}, {ROOF: self._dry_roof}),
            ("when the cistern is at the suction level", {CISTERN: suction - _BELOW_SUCTION},
             {CISTERN: suction + _REFILLED}),
        ):
            yield f"stops {when}", self._stop, STOP_S, sent
            self.usual |= afterwards
            yield "runs steadily again", self._run
        yield "stops at command 0", self._stop, STOP_S, {COMMAND: 0.0}
        if not self.live:
            yield "sends exactly one flow for each tick", self.answer_once

    def tick(self, unusual: Values = USUAL, order: Sequence[str] = ()) -> dict[str, float]:
        """Publish a tick, and move the water that is pumped."""
        answers = super().tick(unusual, order)
        self._flows.append(answers[FLOW])
        pumped = answers[FLOW] * (self.period if self.live else self.site.tau)
        lowest = self.site.suction_level + _ABOVE_SUCTION
        self.usual[CISTERN] = max(self.usual[CISTERN] - pumped / self.site.a1, lowest)
        self.usual[ROOF] += pumped / self.site.a2
        return answers

    def _stop(self, within: float, sent: Values) -> str:
        return self.until(
            lambda answers: answers[FLOW] <= _NONE * self._steady, sent, within=within,
            stays=_STEADY_TICKS - 1,
        )

    def _run(self, sent: Values = USUAL) -> str:
        """Repeat a tick until the flow is steady and above 0."""

        def steady(_: Values) -> bool:
            least, most = min(self._flows), max(self._flows)
            enough = len(self._flows) == _STEADY_TICKS and least > 0
            return enough and most - least <= _STEADY * most

        self._flows.clear()
        measured = self.until(steady, sent, within=START_S, error=StoryEndError)
        self._steady = self._flows[-1]
        return measured

    def _limit(self) -> str:
        self._run({COMMAND: 1.0})
        most = self._steady
        measured = self._run({COMMAND: 3.0})
        require(self._steady <= (1 + _NOISE) * most, f"{measured}; {most:g} at command 1")
        return measured

    def _fall_silent(self) -> str:
        """Send nothing for a while; unless the flow goes on coming, infer it from the next one."""
        self._run()
        self.wait(SILENCE_S)
        state, most = self._state.state, 0.0 if self.live else _AT_REST * self._steady
        flow = self.received[FLOW][-1] if self.live else self.tick()[FLOW]
        flows = f"{flow:.3g} m3/s after the silence, {self._steady:.3g} before it"
        require(flow <= most, f"{flows}: the pump had not stopped")
        require(state not in _ON, f"/pump/state reports {state!r} at the end of the silence")
        return flows

    def _receive_state(self, message: String) -> None:
        self._state = PumpState.read(message.data)
        self.remark = f" (/pump/state: {self._state})"
