"""The valve of the low outlet, if it can only be fully open or closed, and rests after it closed.

A motor or a solenoid endures a limited number of moves. Closing is never delayed, because an open
valve can do harm; only the next opening waits.
"""

from __future__ import annotations

from typing import Any

from greenroof_ros.physics.storm_water import HOUR_S

OPENS_AT = 0.5
"""command (share) at which such a valve opens; at a smaller one, it closes"""
# A valve: whether it is open, the time since it last closed, and the time for which it then stays
# closed (s); the latter is 0 for a valve that follows every command.
OPEN, SINCE, REST = range(3)
# An opening that is due, apart from rounding, must not wait for another tick.
_ROUNDING = 1 - 1e-9


def make_valve(moves_per_hour: float | None) -> tuple[float, ...]:
    """Return a closed valve that may open at once.

    Args:
        moves_per_hour: ``valve_moves_per_hour`` of the site; None for a valve that follows every
            command.
    """
    rest = 0.0 if moves_per_hour is None else 2 * HOUR_S / moves_per_hour
    return 0.0, rest, rest


def move_valve(valve: Any, seconds: float, command: float) -> float:
    """Return the opening of a valve from now on (share), and record whether it moves.

    The valve closes at once, and at a command that is NaN, too. It opens again as soon as it has
    been closed for long enough, if it is commanded to. No hour therefore has more moves than its
    maximum.

    Args:
        valve: the valve, from :func:`make_valve`, as a list or an array.
        seconds: time since the last call (s).
        command: command to the valve (share); 0 if frost closes the valve.
    """
    if valve[REST] == 0:
        return command
    valve[SINCE] += seconds
    if not command >= OPENS_AT:
        if valve[OPEN] > 0:
            valve[OPEN], valve[SINCE] = 0.0, 0.0
    elif valve[SINCE] >= valve[REST] * _ROUNDING:
        valve[OPEN] = 1.0
    opening: float = valve[OPEN]
    return opening
