"""The interlocks that keep the pump off: one table, evaluated from top to bottom.

An interlock is active while there is a reason for it. The pump does not run while any interlock is
active. There are three kinds:

- *latched*: a fault of the pump, pipes or drive, or a lost record of one. It stays until somebody
  resets it, even across restarts.
- *inhibit*: the site, its operator or a limit forbids pumping.
- *enable*: a condition for running the pump at all is missing.

Inhibits and enables clear by themselves when their cause is gone, unless their row says otherwise.

What each code means, and what to do about it, is in ``msg_defs/conditions.yaml``
(:mod:`greenroof_ros.common.interface`).

To add an interlock, add its row here and its wording there, and give a reason under its code in
:mod:`.limits` (levels, weather, run time and volume), :mod:`.pump_control` (state of the drive, and
everything that latches) or the pump node (what only it knows). doc/development.md lists the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

LATCHED, INHIBIT, ENABLE = "latched", "inhibit", "enable"
_CLEARS = {LATCHED: "~/reset", INHIBIT: "itself", ENABLE: "itself"}


class Interlock(NamedTuple):
    """One row of the table.

    Attributes:
        kind: latched, inhibit or enable.
        source: the module that gives the reason.
        limit: the parameters that decide when it is active; empty if there are none.
        follows: whether it is left out if an earlier interlock of its kind is active, because it
            may merely be a consequence of that one.
        by: what clears it, if that differs from its kind: a person, a service or a transition.
        on_page: whether the page can also clear it.
    """

    kind: str
    source: str
    limit: str = ""
    follows: bool = False
    by: str = ""
    on_page: bool = False

    @property
    def clears_by(self) -> str:
        """What clears it."""
        return (self.by or _CLEARS[self.kind]) + (" or the page" if self.on_page else "")


_CONTROL, _LIMITS, _NODE = "pump_control", "limits", "live/pump_behaviour"
_FOLLOWING = "follow_time, follow_tolerance, drive_ramp"
_OF_LEVEL = "level_limit, frozen_movement, jump_tolerance, recovery_time"
_AT_PANEL = "somebody at the drive's panel"
INTERLOCKS = {
    "turns_backwards": Interlock(LATCHED, _CONTROL),
    "runs_on": Interlock(LATCHED, _CONTROL, f"{_FOLLOWING}, least_flow"),
    "drive_fault": Interlock(LATCHED, _CONTROL, follows=True),
    "speed_not_followed": Interlock(LATCHED, _CONTROL, _FOLLOWING, on_page=True),
    "delivery": Interlock(
        LATCHED, _CONTROL,
        "least_delivery, level_tolerance, averaging_time, greatest_loss, level_offset",
    ),
    "fault_unknown": Interlock(LATCHED, _CONTROL, "state_file"),
    "record_unknown": Interlock(LATCHED, _CONTROL, "state_file"),
    "hold": Interlock(
        INHIBIT, _CONTROL, by="itself at its end, greenroof release, ~/stop with false",
        on_page=True,
    ),
    "cistern_level_unknown": Interlock(INHIBIT, _LIMITS, _OF_LEVEL),
    "cistern_low": Interlock(INHIBIT, _LIMITS, "level_offset, suction_hysteresis"),
    "roof_level_unknown": Interlock(INHIBIT, _LIMITS, _OF_LEVEL),
    "frost_unknown": Interlock(INHIBIT, _LIMITS, "frost_limit, unknown_frost_may_pump"),
    "frost": Interlock(INHIBIT, _LIMITS),
    "quiet_hours": Interlock(INHIBIT, _LIMITS),
    "longest_run": Interlock(INHIBIT, _LIMITS, "greatest_run"),
    "daily_volume": Interlock(INHIBIT, _LIMITS, "greatest_volume_per_day"),
    "daily_run": Interlock(INHIBIT, _LIMITS, "greatest_run_per_day"),
    "not_active": Interlock(
        ENABLE, _NODE, "autostart", by="itself; or activate, if another state was requested",
    ),
    "drive_lost": Interlock(ENABLE, _NODE, "exchange_period"),
    "drive_local": Interlock(ENABLE, _NODE, by=_AT_PANEL),
    "second_master": Interlock(ENABLE, _NODE),
    "start_failed": Interlock(ENABLE, _NODE, "least_off"),
    "drive_timeout": Interlock(
        ENABLE, _NODE,
        "drive_timeout_limit, local_settings_stop_the_pump, activate_without_drive_timeout",
        by=_AT_PANEL,
    ),
    "drive_guards_later": Interlock(ENABLE, _NODE),
    "no_run": Interlock(ENABLE, _NODE),
    "two_controllers": Interlock(ENABLE, _NODE),
    "two_pumps": Interlock(ENABLE, _NODE),
    "no_command": Interlock(ENABLE, _NODE, "command_limit"),
    "command_unknown": Interlock(ENABLE, _CONTROL, "command_limit, recovery_time", follows=True),
    "command_refused": Interlock(ENABLE, _CONTROL, follows=True),
    "drive_speed_unknown": Interlock(ENABLE, _CONTROL, follows=True),
    "drive_not_ready": Interlock(ENABLE, _CONTROL, follows=True),
}
"""The table, by code. Codes are short and do not change."""


def evaluate(reasons: Mapping[str, str]) -> dict[str, str]:
    """Return the active interlocks, in the order of the table: the reason of each, by code.

    Args:
        reasons: the reason by code; empty if the interlock is not active.

    Raises:
        KeyError: a code is not in the table.
    """
    unknown = reasons.keys() - INTERLOCKS.keys()
    if unknown:
        raise KeyError(*unknown)
    active: dict[str, str] = {}
    for code, interlock in INTERLOCKS.items():
        explained = interlock.follows and any(
            INTERLOCKS[earlier].kind == interlock.kind for earlier in active
        )
        if reasons.get(code) and not explained:
            active[code] = reasons[code]
    return active
