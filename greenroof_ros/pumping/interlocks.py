"""What keeps the pump off: one table, evaluated from top to bottom.

An interlock stands as long as there is a reason for it, and no pump runs while one stands. Its kind
says what follows:

- *latched*: a fault of pump, pipes or drive. It stays until somebody resets it (``~/reset``), and
  is kept over restarts.
- *inhibit*: the site, its operator or a limit forbids pumping. It clears by itself, but for what an
  operator has stopped.
- *enable*: something without which nobody may run the pump is missing. It clears by itself.

To add one, add its row here, and give a reason under its code where its source is looked at:
:mod:`.pump_control`, :mod:`.limits` or the pump node.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum


class Kind(Enum):
    """What an interlock does to the pump, and how it clears; the value is the word for people."""

    LATCHED = "latched"
    INHIBIT = "inhibit"
    ENABLE = "enable"


@dataclass(frozen=True)
class Interlock:
    """One row of the table.

    Attributes:
        code: short and stable, for programs.
        kind: what it does, and how it clears.
        reason: when it stands, in general.
        source: who finds that out.
        limit: the parameters that set when; empty where there is none.
        advice: what to do.
        follows: codes that explain it: while one of them has a reason, this one is not said.
    """

    code: str
    kind: Kind
    reason: str
    source: str
    limit: str
    advice: str
    follows: tuple[str, ...] = ()


@dataclass(frozen=True)
class Standing:
    """An interlock that stands.

    Attributes:
        interlock: its row.
        why: this time, with its numbers: a clause.
    """

    interlock: Interlock
    why: str


_LATCHED, _INHIBIT, _ENABLE = Kind.LATCHED, Kind.INHIBIT, Kind.ENABLE
_CONTROL, _NODE, _DRIVE, _OPERATOR = "levels and flow", "pump node", "drive", "operator"
_RESET = "remedy it, then call ~/reset"
# What explains that there is no command, or no speed.
_UNABLE = (
    "not_active", "drive_lost", "drive_local", "drive_timeout", "drive_guards_later", "no_permit",
    "two_controllers", "two_pumps", "no_command",
)
_NO_ORDER = (*_UNABLE, "command_unknown", "command_refused")

INTERLOCKS = (
    Interlock(
        "drive_fault", _LATCHED, "the drive reports a fault", _DRIVE, "",
        f"look it up in the drive's manual, {_RESET}",
    ),
    Interlock(
        "turns_backwards", _LATCHED, "the pump turns backwards", _DRIVE, "",
        "switch the drive off at its panel; look for water that runs back, and for swapped phases; "
        "then call ~/reset",
    ),
    Interlock(
        "speed_not_followed", _LATCHED, "the pump does not turn as it is asked to", _DRIVE,
        "follow_time, follow_tolerance, drive_ramp",
        f"see whether the pump is blocked, and whether the drive's own limits act, {_RESET}",
    ),
    Interlock(
        "delivery", _LATCHED, "the levels do not show the water that was pumped", _CONTROL,
        "least_delivery, level_tolerance, averaging_time, greatest_loss, level_offset",
        f"look at valves, pipes and both level sensors, {_RESET}",
    ),
    Interlock(
        "operator_stop", _INHIBIT, "an operator stopped the pump", _OPERATOR, "",
        "call ~/stop with false when it may run again",
    ),
    Interlock(
        "record_unknown", _INHIBIT, "whether there was a stop or a fault is not known any more",
        "state file", "state_file", "see that pump and pipes are in order, then call ~/stop with "
        "false",
    ),
    Interlock(
        "cistern_level_unknown", _INHIBIT, "the cistern's level is missing, too old or refused",
        _CONTROL, "level_limit", "look at the level sensor and its node",
    ),
    Interlock(
        "cistern_low", _INHIBIT, "the cistern is at the suction level", _CONTROL,
        "level_offset, suction_hysteresis", "wait for rain, or refill the cistern",
    ),
    Interlock(
        "roof_level_unknown", _INHIBIT, "the roof's level is missing, too old or refused",
        _CONTROL, "level_limit", "look at the level sensor and its node",
    ),
    Interlock(
        "frost_unknown", _INHIBIT, "whether there is frost is not known", "weather node",
        "frost_limit", "see that there is a forecast with temperatures, or a thermometer",
    ),
    Interlock("frost", _INHIBIT, "there is frost", "weather node", "", "wait until it thaws"),
    Interlock(
        "longest_run", _INHIBIT, "the pump ran for too long without a break", _CONTROL,
        "greatest_run", "see why so much water is asked for",
    ),
    Interlock(
        "daily_volume", _INHIBIT, "the day's volume was pumped", _CONTROL,
        "greatest_volume_per_day", "see why so much water is asked for, or raise the limit",
    ),
    Interlock(
        "daily_run", _INHIBIT, "the pump ran for as long as it may in a day", _CONTROL,
        "greatest_run_per_day", "see why so much water is asked for, or raise the limit",
    ),
    Interlock(
        "not_active", _ENABLE, "the node is not active", _NODE, "autostart",
        "configure and activate it; its state says what is refused",
    ),
    Interlock(
        "drive_lost", _ENABLE, "the drive is not heard", _DRIVE, "exchange_period",
        "look at the drive's power, cable, gateway and address",
    ),
    Interlock(
        "drive_local", _ENABLE, "the drive is in local control", _DRIVE, "",
        "switch it back to the bus at its panel",
    ),
    Interlock(
        "drive_timeout", _ENABLE, "the drive's own communication timeout does not guard", _DRIVE,
        "drive_timeout_limit, local_settings_stop_the_pump", "set it as the message says",
    ),
    Interlock(
        "drive_guards_later", _ENABLE, "the drive was switched on a moment ago, and its timeout "
        "does not guard yet", _DRIVE, "", "wait",
    ),
    Interlock(
        "no_permit", _ENABLE, "bringup does not let the pump run", "bringup", "",
        "see which node is missing; where bringup has ended, start it again",
    ),
    Interlock(
        "two_controllers", _ENABLE, "/pump/command has a second publisher", _NODE, "",
        "end the one that should not run",
    ),
    Interlock(
        "two_pumps", _ENABLE, "/pump/flow has a second publisher", _NODE, "",
        "end the one that should not run",
    ),
    Interlock(
        "no_command", _ENABLE, "commands do not come", "controller", "command_limit",
        "see whether the controller runs",
    ),
    Interlock(
        "command_unknown", _ENABLE, "there is no command that counts", "controller",
        "command_limit, recovery_time", "see whether the controller runs", _UNABLE,
    ),
    Interlock(
        "command_refused", _ENABLE, "the command is no number from 0 on", "controller", "",
        "take another controller", _UNABLE,
    ),
    Interlock(
        "drive_speed_unknown", _ENABLE, "the drive does not say what the pump turns at", _DRIVE, "",
        "see the drive's panel", _NO_ORDER,
    ),
    Interlock(
        "drive_not_ready", _ENABLE, "the drive is not ready", _DRIVE, "", "see the drive's panel",
        _NO_ORDER,
    ),
)
CODES = tuple(one.code for one in INTERLOCKS)


def evaluate(reasons: Mapping[str, str]) -> tuple[Standing, ...]:
    """Return the interlocks that stand, in the order of the table.

    Args:
        reasons: why, by code; empty where it does not stand.

    Raises:
        KeyError: a code is none of the table.
    """
    unknown = reasons.keys() - set(CODES)
    if unknown:
        raise KeyError(*unknown)
    return tuple(
        Standing(one, reasons[one.code]) for one in INTERLOCKS
        if reasons.get(one.code) and not any(reasons.get(cause) for cause in one.follows)
    )
