"""What keeps the pump off: one table, evaluated from top to bottom.

An interlock is active as long as there is a reason for it, and no pump runs while one is. Its kind
says what follows:

- *latched*: a fault of pump, pipes or drive. It stays until somebody resets it (``~/reset``; some,
  :data:`CLEARED_ON_PAGE`, on the page, too), and is kept over restarts.
- *inhibit*: the site, its operator or a limit forbids pumping. It clears by itself, but for an
  operator's stop and a record that cannot be read, which end by ``~/stop`` with false; a stop on
  the page ends there, too.
- *enable*: a condition for running the pump at all is missing. It clears by itself once that is
  there again: ``not_active`` by *activate*, where somebody had asked for another state,
  ``drive_local`` and ``drive_timeout`` by a person at the panel.

What each code means, and what to do about it, is in ``msg_defs/conditions.yaml``
(:mod:`greenroof_ros.common.interface`).

To add an interlock, add its row here and its words there, and give a reason under its code in
:mod:`.limits` (levels, weather, how long and how much), :mod:`.pump_control` (what the drive shows)
or the pump node (what it knows itself). doc/development.md lists the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

LATCHED, INHIBIT, ENABLE = "latched", "inhibit", "enable"


class Interlock(NamedTuple):
    """One row of the table.

    Attributes:
        kind: what it does, and how it clears.
        source: the module that gives the reason.
        limit: the parameters that set when; empty where there is none.
        follows: whether it is left out where an earlier one of its kind is active, as it may only
            follow from that.
    """

    kind: str
    source: str
    limit: str = ""
    follows: bool = False


_CONTROL, _LIMITS, _NODE = "pump_control", "limits", "nodes/pump"
_FOLLOWING = "follow_time, follow_tolerance, drive_ramp"
_OF_LEVEL = "level_limit, frozen_movement, jump_tolerance, recovery_time"
INTERLOCKS = {
    "turns_backwards": Interlock(LATCHED, _CONTROL),
    "runs_on": Interlock(LATCHED, _CONTROL, _FOLLOWING),
    "drive_fault": Interlock(LATCHED, _CONTROL, follows=True),
    "speed_not_followed": Interlock(LATCHED, _CONTROL, _FOLLOWING),
    "delivery": Interlock(
        LATCHED, _CONTROL,
        "least_delivery, level_tolerance, averaging_time, greatest_loss, level_offset",
    ),
    "fault_unknown": Interlock(LATCHED, _CONTROL, "state_file"),
    "operator_stop": Interlock(INHIBIT, _CONTROL),
    "page_stop": Interlock(INHIBIT, _CONTROL),
    "record_unknown": Interlock(INHIBIT, _CONTROL, "state_file"),
    "cistern_level_unknown": Interlock(INHIBIT, _LIMITS, _OF_LEVEL),
    "cistern_low": Interlock(INHIBIT, _LIMITS, "level_offset, suction_hysteresis"),
    "roof_level_unknown": Interlock(INHIBIT, _LIMITS, _OF_LEVEL),
    "frost_unknown": Interlock(INHIBIT, _LIMITS, "frost_limit, unknown_frost_may_pump"),
    "frost": Interlock(INHIBIT, _LIMITS),
    "longest_run": Interlock(INHIBIT, _LIMITS, "greatest_run"),
    "daily_volume": Interlock(INHIBIT, _LIMITS, "greatest_volume_per_day"),
    "daily_run": Interlock(INHIBIT, _LIMITS, "greatest_run_per_day"),
    "not_active": Interlock(ENABLE, _NODE, "autostart"),
    "drive_lost": Interlock(ENABLE, _NODE, "exchange_period"),
    "drive_local": Interlock(ENABLE, _NODE),
    "second_master": Interlock(ENABLE, _NODE),
    "drive_timeout": Interlock(
        ENABLE, _NODE,
        "drive_timeout_limit, local_settings_stop_the_pump, activate_without_drive_timeout",
    ),
    "drive_guards_later": Interlock(ENABLE, _NODE),
    "no_run": Interlock(ENABLE, _NODE),
    "no_permit": Interlock(ENABLE, _NODE),
    "two_controllers": Interlock(ENABLE, _NODE),
    "two_pumps": Interlock(ENABLE, _NODE),
    "no_command": Interlock(ENABLE, _NODE, "command_limit"),
    "command_unknown": Interlock(ENABLE, _CONTROL, "command_limit, recovery_time", follows=True),
    "command_refused": Interlock(ENABLE, _CONTROL, follows=True),
    "drive_speed_unknown": Interlock(ENABLE, _CONTROL, follows=True),
    "drive_not_ready": Interlock(ENABLE, _CONTROL, follows=True),
}
"""by their codes, which are short and stable"""

CLEARED_ON_PAGE = ("turns_backwards", "runs_on", "speed_not_followed")
"""Faults that the page may clear: neither one of the delivery, nor one of the drive, nor one that
is not known: those need somebody who has looked."""


def evaluate(reasons: Mapping[str, str]) -> dict[str, str]:
    """Return why each interlock is active that is, by its code, in the order of the table.

    Args:
        reasons: why, by code; empty where it is not active.

    Raises:
        KeyError: a code is none of the table.
    """
    unknown = reasons.keys() - INTERLOCKS.keys()
    if unknown:
        raise KeyError(*unknown)
    active: dict[str, str] = {}
    for code, one in INTERLOCKS.items():
        explained = one.follows and any(INTERLOCKS[other].kind == one.kind for other in active)
        if reasons.get(code) and not explained:
            active[code] = reasons[code]
    return active
