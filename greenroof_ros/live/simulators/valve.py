"""A simulated valve at the low outlet of a cistern, which follows the contact of its relay."""

from __future__ import annotations

import time
from collections.abc import Callable

FAULTS = "stuck_open", "stuck_closed", "leak", "wrong_switch"
# Flow through a valve that leaks (m3/s).
LEAK = 2.0 / 60_000
# The end switches are on within this share of the ends.
_AT_END = 0.01


class SimulatedValve:
    """A valve that opens while its relay is on, and otherwise closes.

    Attributes:
        position: share to which the valve is open, 0 to 1.
        fault: the fault that it has; empty for none.
    """

    def __init__(self, on: Callable[[], bool], travel_s: float, fault: str = "") -> None:
        """Initialize a closed valve.

        Args:
            on: function that returns whether the relay is on.
            travel_s: time that the valve takes to open or to close (s).
            fault: one of `FAULTS`; empty for none.
        """
        self._on, self._travel_s = on, travel_s
        self.position, self._at = 0.0, time.monotonic()
        self.fault = fault

    def advance(self) -> float:
        """Move the valve until now, and return its position."""
        before, self._at = self._at, time.monotonic()
        opens = self._on()
        if self.fault != ("stuck_closed" if opens else "stuck_open"):
            way = (self._at - before) / self._travel_s
            self.position = min(max(self.position + (way if opens else -way), 0.0), 1.0)
        return self.position

    def switches(self) -> dict[str, float]:
        """Return the states of the end switches, by their sections of the sensor file."""
        is_open = self.position >= 1 - _AT_END or self.fault == "wrong_switch"
        return {"open_switch": is_open, "closed_switch": self.position <= _AT_END}
