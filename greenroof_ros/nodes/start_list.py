"""List of the conditions that keep a starting site from pumping, with their remedies."""

from __future__ import annotations

import math
from collections.abc import Callable

from greenroof_ros.interface.alarm import advise
from greenroof_ros.interface.states import PUMP, STARTING, DriveState
from greenroof_ros.ros.alarms import ROLE, Judge
from greenroof_ros.ros.reports import Reports

# How long the list must have been unchanged before it is printed (s).
_SETTLED_S = 1.0
# States of the pump node in which it cannot run its drive yet.
_NOT_READY = {DriveState.CONNECTING.value, DriveState.REFUSED.value}


class StartList:
    """List of the conditions that keep a starting site from pumping.

    The list covers everything that is missing or wrong, except warnings. A condition that is merely
    a consequence is listed only if it stops the pump and its cause does not. The list is printed
    again when its codes change, not when its sentences change, since these contain numbers. Startup
    is complete when nothing is missing; later losses raise alarms.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        """Begin the start.

        Args:
            tell: function that prints lines for human readers.
        """
        self._tell = tell
        # What is missing, by name and code: as last printed, and as last seen and since when.
        self._printed: list[tuple[str, str]] = []
        self._missing: list[tuple[str, str]] = []
        self._since = -math.inf

    def update(self, now: float, judge: Judge, reports: Reports) -> bool:
        """Print the list if it has changed; return True, and print a line, if startup is complete.

        Args:
            now: current time (steady clock, s).
            judge: object that evaluates the current conditions.
            reports: the last reports of the nodes.
        """
        wrong = {
            name: diagnosis for name, diagnosis in judge.diagnoses.items()
            if diagnosis.is_serious and diagnosis.role != ROLE
        }
        lines = dict[tuple[str, str], str]()
        for name, diagnosis in wrong.items():
            if judge.has_lasted(now, name) and judge.causes.get(name) not in wrong:
                advice = advise(diagnosis.code, diagnosis.role, name.partition(": ")[0])
                lines[name, diagnosis.code] = f"  {name}: {diagnosis.sentence}. {advice}"
        stopped = any(diagnosis.stops_pump for diagnosis in wrong.values())
        why = "" if stopped else _explain_wait(reports)
        if why:
            lines[why, ""] = f"  {why}"
        if [*lines] != self._missing:
            self._missing, self._since = [*lines], now
        if lines and self._missing != self._printed and now - self._since > _SETTLED_S:
            self._printed = self._missing
            self._tell("\n".join(["missing:", *lines.values()]))
        cistern, roof = reports.level("cistern"), reports.level("roof")
        if stopped or why or cistern is None or roof is None:
            return False
        self._tell(f"running: cistern {cistern:.3f} m, roof {roof:.4f} m")
        return True


def _explain_wait(reports: Reports) -> str:
    """Return which nodes are not ready, or why the pump is kept off; empty if neither is so."""
    for name in reports.expected:
        node = reports.nodes.get(name)
        if node is None or node.state == STARTING:
            return f"{name} is {'missing' if node is None else 'starting'}"
    if reports.value(PUMP, "drive_state") in _NOT_READY:
        return f"the pump is kept off: {reports.value(PUMP, 'pump_why') or 'unknown'}"
    return ""
