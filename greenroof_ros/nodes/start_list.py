"""List of the conditions that keep a starting site from pumping, with their remedies."""

from __future__ import annotations

from collections.abc import Callable

from greenroof_ros.interface.alarm import advise
from greenroof_ros.interface.states import DriveState
from greenroof_ros.ros.alarms import ROLE, Diagnoses, find_causes
from greenroof_ros.ros.reports import Reports

# For how long a condition must have lasted before it is listed, at least (s).
_SETTLED_S = 1.0
# States of the pump node in which it cannot run its drive yet.
_NOT_READY = {DriveState.CONNECTING.value, DriveState.REFUSED.value}


class StartList:
    """List of the conditions that keep a starting site from pumping.

    The list covers everything that is missing or wrong, except warnings and mere consequences. It
    is printed again when its codes change, not when its sentences change, since these contain
    numbers. Startup is complete when nothing keeps the pump off; later losses raise alarms.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        """Begin the start.

        Args:
            tell: function that prints lines for human readers.
        """
        self._tell = tell
        self._printed: list[tuple[str, str]] = []  # names and codes

    def update(self, now: float, diagnoses: Diagnoses, reports: Reports) -> bool:
        """Print the list if it has changed; return True, and print a line, if startup is complete.

        Args:
            now: current time (steady clock, s).
            diagnoses: the current diagnoses, by status name.
            reports: the last reports of the nodes.
        """
        wrong = {
            name: diagnosis for name, diagnosis in diagnoses.items()
            if diagnosis.is_serious and diagnosis.role != ROLE
        }
        causes = find_causes(wrong)
        lines = {
            (name, each.code):
                f"  {name}: {each.sentence}. {advise(each.code, each.role, each.node)}"
            for name, each in wrong.items()
            if name not in causes and now - each.began >= max(_SETTLED_S, each.condition.lasts)
        }
        if lines and [*lines] != self._printed:
            self._printed = [*lines]
            self._tell("\n".join(["missing:", *lines.values()]))
        cistern, roof = map(reports.value, ("cistern_level", "roof_level"))
        known = isinstance(cistern, (int, float)) and isinstance(roof, (int, float))
        kept_off = any(each.stops_pump for each in wrong.values())
        if kept_off or not known or reports.value("drive_state") in _NOT_READY:
            return False
        self._tell(f"running: cistern {cistern:.3f} m, roof {roof:.4f} m")
        return True
