"""List of the conditions that keep a starting site from pumping, with their remedies."""

from __future__ import annotations

import math
from collections.abc import Callable

from greenroof_ros.interface.alarm import advise
from greenroof_ros.interface.states import PUMP, STARTING, DriveState, PumpState
from greenroof_ros.ros.alarms import ROLE, Judge
from greenroof_ros.ros.reports import Reports, StatusDiagnosis

# How long the list must have been unchanged before it is printed (s).
_SETTLED_S = 1.0
# States of the pump node in which it cannot run its drive yet.
_NOT_READY = {DriveState.CONNECTING.value, DriveState.REFUSED.value}
# Decimal places of each level (m).
_PLACES = {"cistern": 3, "roof": 4}


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
        self._printed: list[tuple[str, str]] | None = None
        self._last_missing: tuple[list[tuple[str, str]], float] = ([], -math.inf)

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
        missing = {
            (name, diagnosis.code): f"  {name}: {diagnosis.sentence}. "
            f"{advise(diagnosis.code, diagnosis.role, name.partition(': ')[0])}"
            for name, diagnosis in wrong.items()
            if _is_own(diagnosis, judge.diagnoses.get(judge.causes.get(name, "")))
            and judge.has_lasted(now, name)
        }
        why = _explain_wait(reports)
        stopped = any(diagnosis.stops_pump for diagnosis in wrong.values())
        if why and not stopped:
            missing[why, ""] = f"  {why}"
        levels = {name: reports.level(name) for name in _PLACES}
        finished = not (stopped or why or None in levels.values())
        codes = list(missing)
        if codes != self._last_missing[0]:
            self._last_missing = codes, now
        title = "missing:" if self._printed is None else "still missing:"
        settled = now - self._last_missing[1] > _SETTLED_S
        if missing and codes != self._printed and (finished or settled):
            self._printed = codes
            self._tell("\n".join([title, *missing.values()]))
        if finished:
            self._tell("running: " + ", ".join(
                f"{name} {level:.{_PLACES[name]}f} m" for name, level in levels.items()
            ))
        return finished


def _is_own(diagnosis: StatusDiagnosis, cause: StatusDiagnosis | None) -> bool:
    """Return whether the list has a diagnosis of its own for what a cause does not explain."""
    return cause is None or cause.role == ROLE or (diagnosis.stops_pump and not cause.stops_pump)


def _explain_wait(reports: Reports) -> str:
    """Return which nodes are not ready, or why the pump is kept off; empty if neither is so."""
    unready = ", ".join(
        f"{name} is missing" if node is None else f"{name} is starting"
        for name in reports.expected
        if (node := reports.nodes.get(name)) is None or node.state == STARTING
    )
    if unready or reports.value(PUMP, "drive_state") not in _NOT_READY:
        return unready
    state, why = (reports.value(PUMP, key) or "" for key in ("pump_state", "pump_why"))
    return f"the pump is kept off: {PumpState(state or 'unknown', why)}"
