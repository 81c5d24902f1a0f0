"""Sample and hold: nodes that act at every tick of the steady clock on the latest input values.

A live graph has no plant and no clock topic. A node does not wait for an input that is missing,
late or invalid. The rules of :mod:`greenroof_ros.live.pumping.input_rules` determine which inputs
are invalid, and the node acts accordingly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.boot_clock import boot_time, suspended_time
from greenroof_ros.live.live_diagnostics import ERROR, WARN, LiveDiagnostics
from greenroof_ros.live.live_input import LiveInput, bad_inputs
from greenroof_ros.live.pumping.input_rules import (
    AWAITED,
    LevelRule,
    Wetting,
    cistern_bounds,
    expected_movement,
    roof_bounds,
)
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.site.site import Site

# After a pause, the inputs are outdated. Messages that arrive within PAUSE_S after it are ignored,
# since they may have been waiting.
# Longest time after its start at which a node first acts (s).
_FIRST_S = 1.0

RECOVERY = Parameter(
    "recovery_time", 10.0, "s", 0.0, 86400.0,
        "time for which an input that has violated a rule must satisfy all rules before it is "
        "used again",
)
_FROZEN_MOVEMENT = Parameter(
    "frozen_movement", 0.01, "", 1e-6, 10.0,
        "change in level that the pump and the rain should have caused before an unchanged level "
        "is considered frozen (m); must exceed the sensor's resolution",
)
_JUMP_TOLERANCE = Parameter(
    "jump_tolerance", 0.02, "", 1e-6, 10.0,
        "maximum difference between two successive values of a level, in excess of the change that "
        "water can cause in the time between them (m); should be at "
        "least 10 times the standard deviation of the sensor's noise",
)


# The maximum age of every topic on which nodes act in a live graph.
LIMITS = {
    topic.name: Parameter(
        age.parameter, age.default, "s", 0.1, age.max, f"maximum age of {age.quantity}"
    )
    for topic in read_topics().values() if (age := topic.max_age) is not None
}
_LEVEL = LIMITS["/roof/level"]


def live_parameters(topics: Iterable[str]) -> list[Parameter]:
    """Return the parameters of a live node that acts on the given topics."""
    limits = dict.fromkeys(LIMITS[topic] for topic in topics)
    of_levels = [_FROZEN_MOVEMENT, _JUMP_TOLERANCE] if _LEVEL in limits else []
    return [*limits, RECOVERY, *of_levels]


class Levels:
    """Levels of the cistern and the roof as inputs, with checks for physically possible changes.

    Attributes:
        cistern: the cistern's level.
        roof: the roof's level.
    """

    def __init__(
        self, site: Site, values: Mapping[str, Any], subscribe: Callable[..., LiveInput]
    ) -> None:
        """Open both inputs.

        Args:
            site: site to which the tanks belong.
            values: values of the node's :func:`live_parameters`.
            subscribe: function that opens an input:
                :meth:`greenroof_ros.live.node.LiveNode.subscribe`.
        """
        self._site, self._frozen_movement = site, values[_FROZEN_MOVEMENT.name]
        self._rules = [
            LevelRule(bounds, self._frozen_movement, values[_JUMP_TOLERANCE.name])
            for bounds in (cistern_bounds(site), roof_bounds(site))
        ]
        self._wetting = Wetting()
        self.cistern = subscribe("/cistern/level", level=self._rules[0])
        self.roof = subscribe("/roof/level", level=self._rules[1])

    @property
    def displacements(self) -> tuple[float, float]:
        """Total displacements of both levels' readings by impossible jumps so far (m)."""
        cistern, roof = self._rules
        return cistern.displacement, roof.displacement

    def expect(self, flow: float, rain: float = 0.0) -> None:
        """Set the level changes that a tick's pump flow (m3/s) and rain (m/s) must cause."""
        tau = self._site.tau
        movements = expected_movement(
            self._site, flow, rain, self._wetting.excess(rain, tau), self.cistern.value,
            self.roof.value, self._frozen_movement,
        )
        for rule, movement in zip(self._rules, movements, strict=True):
            rule.expect(movement, tau)


class SampleAndHold:
    """Schedule of a node that acts once per period of the steady clock, even without its peers.

    This clock (CLOCK_BOOTTIME) keeps running while the computer is suspended, so inputs received
    before a suspension are too old.

    Attributes:
        inputs: the node's inputs.
        has_acted: whether a node with a period has acted or is acting; always true without a
            period.
    """

    def __init__(self, act: Callable[[], None], reports: LiveDiagnostics) -> None:
        """Initialize without a period.

        Args:
            act: function that makes the node act.
            reports: reporter of invalid inputs.
        """
        self._act, self._reports = act, reports
        self.inputs: list[LiveInput] = []
        self._period = math.inf
        self._due = math.inf
        self.has_acted = True
        self._checked_at = boot_time()
        self._ignoring_until = self._checked_at

    def set_period(self, period: float) -> None:
        """Set the period of the node's actions (s); the first action follows after at most 1 s."""
        self._period, self.has_acted = period, False
        self._due = boot_time() + min(period, _FIRST_S)

    def receiver(self, entry: LiveInput) -> Callable[[bytes], None]:
        """Include an input in the checks, and return the receiver of its messages."""
        self.inputs.append(entry)

        def on_message(message: bytes) -> None:
            now = boot_time()
            self._handle_pause(now)
            if now >= self._ignoring_until:
                entry.receive(message)

        return on_message

    def check_inputs(self) -> None:
        """Check all inputs at the current time; after a pause of this process, all are too old."""
        self._handle_pause(boot_time())
        for entry in self.inputs:
            entry.check()

    @property
    def required(self) -> list[LiveInput]:
        """The inputs without which the node does not act."""
        return [entry for entry in self.inputs if not entry.optional]

    @property
    def due_in(self) -> float:
        """Time until the node's next action (s)."""
        return max(0.0, self._due - boot_time())

    def check(self) -> None:
        """Act if the period has passed; periods that were missed during a pause are skipped."""
        now = boot_time()
        self._handle_pause(now)
        if now < self._due:
            return
        self._due += (math.floor((now - self._due) / self._period) + 1) * self._period
        before = suspended_time()
        self.check_inputs()
        self._diagnose_inputs()
        self.has_acted = True
        self._act()
        # The time that a node takes to decide is not a pause, so it must not make its inputs too
        # old. A suspension of the machine while it decides is a pause.
        slept = suspended_time() - before
        self._checked_at = boot_time() - slept

    def _handle_pause(self, now: float) -> None:
        """Clear all inputs if this process was paused."""
        passed, self._checked_at = now - self._checked_at, now
        if passed > PAUSE_S:
            self._ignoring_until = now + PAUSE_S
            for entry in self.inputs:
                entry.rules.clear(passed)
                entry.check()

    def _diagnose_inputs(self) -> None:
        required = self.required
        if required:
            bad = bad_inputs(required)
            level = WARN if bad is not None and bad.code in AWAITED else ERROR
            self._reports.diagnose("inputs", bad, "all inputs are valid", level)
