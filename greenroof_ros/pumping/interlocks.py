"""What keeps the pump off: one table, evaluated from top to bottom.

An interlock is active as long as there is a reason for it, and no pump runs while one is. Its kind
says what follows:

- *latched*: a fault of pump, pipes or drive. It stays until somebody resets it (``~/reset``), and
  is kept over restarts.
- *inhibit*: the site, its operator or a limit forbids pumping. It clears by itself, but for an
  operator's stop and a record that cannot be read, which end by ``~/stop`` with false.
- *enable*: a condition for running the pump at all is missing. It clears by itself.

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
        reason: when it is active, in general.
        source: the module that finds that out.
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
class ActiveInterlock:
    """An interlock that is active.

    Attributes:
        interlock: its row.
        why: this time, with its numbers: a clause.
    """

    interlock: Interlock
    why: str


_LATCHED, _INHIBIT, _ENABLE = Kind.LATCHED, Kind.INHIBIT, Kind.ENABLE
_CONTROL, _LIMITS, _NODE = "pump_control", "limits", "nodes/pump"
_DELIVERY, _LEDGER = "delivery", "ledger"
_RESET = "remedy it, then call ~/reset"
# What explains that there is no command, or no speed.
_UNABLE = (
    "not_active", "drive_lost", "drive_local", "drive_timeout", "drive_guards_later", "no_permit",
    "two_controllers", "two_pumps", "no_command",
)
_NO_ORDER = (*_UNABLE, "command_unknown", "command_refused")

INTERLOCKS = (
    Interlock(
        "turns_backwards", _LATCHED, "the pump turns backwards", _CONTROL, "",
        "switch the drive off at its panel; look for water that runs back, and for swapped phases; "
        "then call ~/reset",
    ),
    Interlock(
        "runs_on", _LATCHED, "the pump turns although it is told to stop", _CONTROL,
        "follow_time, follow_tolerance, drive_ramp",
        "stop it at the drive's panel or main switch now; find out why it runs on (a stuck "
        "contactor, a hand switch), then call ~/reset",
    ),
    Interlock(
        "drive_fault", _LATCHED, "the drive reports a fault, and not only that its own "
        "communication timeout has passed", _CONTROL, "",
        f"look it up in the drive's manual, {_RESET}", ("turns_backwards", "runs_on"),
    ),
    Interlock(
        "speed_not_followed", _LATCHED, "the pump does not turn as it is asked to", _CONTROL,
        "follow_time, follow_tolerance, drive_ramp",
        f"see whether the pump is blocked, and whether the drive's own limits act, {_RESET}",
    ),
    Interlock(
        "delivery", _LATCHED, "the levels do not show the water that was pumped", _DELIVERY,
        "least_delivery, level_tolerance, averaging_time, greatest_loss, level_offset",
        f"look at valves, pipes and both level sensors, {_RESET}",
    ),
    Interlock(
        "fault_unknown", _LATCHED, "a fault is kept that this version has no code for",
        _CONTROL, "state_file", f"read what it says, {_RESET}",
    ),
    Interlock(
        "operator_stop", _INHIBIT, "an operator stopped the pump", _CONTROL, "",
        "call ~/stop with false when it may run again",
    ),
    Interlock(
        "record_unknown", _INHIBIT, "whether there was a stop or a fault is not known any more",
        _LEDGER, "state_file", "see that pump and pipes are in order, then call ~/stop with "
        "false",
    ),
    Interlock(
        "cistern_level_unknown", _INHIBIT, "the cistern's level is not known, or not believed",
        _LIMITS, "level_limit, frozen_movement, jump_tolerance, recovery_time",
        "look at the level sensor and its node",
    ),
    Interlock(
        "cistern_low", _INHIBIT, "the cistern is at the suction level", _LIMITS,
        "level_offset, suction_hysteresis", "wait for rain, or refill the cistern",
    ),
    Interlock(
        "roof_level_unknown", _INHIBIT, "the roof's level is not known, or not believed",
        _LIMITS, "level_limit, frozen_movement, jump_tolerance, recovery_time",
        "look at the level sensor and its node",
    ),
    Interlock(
        "frost_unknown", _INHIBIT, "whether there is frost is not known", "weather node",
        "frost_limit, unknown_frost_may_pump",
        "see that there is a forecast with temperatures, or a thermometer",
    ),
    Interlock("frost", _INHIBIT, "there is frost", _LIMITS, "", "wait until it thaws"),
    Interlock(
        "longest_run", _INHIBIT, "the pump ran for too long without a break", _LIMITS,
        "greatest_run", "see why so much water is asked for",
    ),
    Interlock(
        "daily_volume", _INHIBIT, "the day's volume was pumped", _LIMITS,
        "greatest_volume_per_day", "see why so much water is asked for, or raise the limit",
    ),
    Interlock(
        "daily_run", _INHIBIT, "the pump ran for as long as it may in a day", _LIMITS,
        "greatest_run_per_day", "see why so much water is asked for, or raise the limit",
    ),
    Interlock(
        "not_active", _ENABLE, "the node is not active", _NODE, "autostart",
        "configure and activate it; its state says what is refused",
    ),
    Interlock(
        "drive_lost", _ENABLE, "the drive is not heard", _NODE, "exchange_period",
        "look at the drive's power, cable, gateway and address",
    ),
    Interlock(
        "drive_local", _ENABLE, "the drive is in local control", _NODE, "",
        "switch it back to the bus at its panel",
    ),
    Interlock(
        "drive_timeout", _ENABLE, "the drive's own communication timeout does not guard", _NODE,
        "drive_timeout_limit, local_settings_stop_the_pump, activate_without_drive_timeout",
        "set it as the message says",
    ),
    Interlock(
        "drive_guards_later", _ENABLE, "the drive was connected a moment ago, and its timeout "
        "may not guard yet", _NODE, "", "wait",
    ),
    Interlock(
        "no_permit", _ENABLE, "bringup does not let the pump run", _NODE, "",
        "see which node is missing; where bringup has ended, start it again",
    ),
    Interlock(
        "two_controllers", _ENABLE, "/pump/command has a second publisher, or one that cannot be "
        "heard", _NODE, "", "end the one that should not run, or mend its quality of service",
    ),
    Interlock(
        "two_pumps", _ENABLE, "/pump/flow has a second publisher, or one that cannot be heard",
        _NODE, "", "end the one that should not run, or mend its quality of service",
    ),
    Interlock(
        "no_command", _ENABLE, "commands do not come", _NODE, "command_limit",
        "see whether the controller runs",
    ),
    Interlock(
        "command_unknown", _ENABLE, "there is no command that counts", "controller",
        "command_limit, recovery_time", "see whether the controller runs", _UNABLE,
    ),
    Interlock(
        "command_refused", _ENABLE, "the command is no number from 0 on", _CONTROL, "",
        "take another controller", _UNABLE,
    ),
    Interlock(
        "drive_speed_unknown", _ENABLE, "the drive does not say what the pump turns at",
        _CONTROL, "", "see the drive's panel", _NO_ORDER,
    ),
    Interlock(
        "drive_not_ready", _ENABLE, "the drive is not ready", _CONTROL, "", "see the drive's panel",
        _NO_ORDER,
    ),
)
CODES = tuple(one.code for one in INTERLOCKS)
LATCHED = frozenset(one.code for one in INTERLOCKS if one.kind is Kind.LATCHED)


def evaluate(reasons: Mapping[str, str]) -> tuple[ActiveInterlock, ...]:
    """Return the active interlocks, in the order of the table.

    Args:
        reasons: why, by code; empty where it is not active.

    Raises:
        KeyError: a code is none of the table.
    """
    unknown = reasons.keys() - set(CODES)
    if unknown:
        raise KeyError(*unknown)
    return tuple(
        ActiveInterlock(one, reasons[one.code]) for one in INTERLOCKS
        if reasons.get(one.code) and not any(reasons.get(cause) for cause in one.follows)
    )
