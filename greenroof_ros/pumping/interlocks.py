"""What keeps the pump off: one table, evaluated from top to bottom; and the other condition codes.

An interlock is active as long as there is a reason for it, and no pump runs while one is. Its kind
says what follows:

- *latched*: a fault of pump, pipes or drive. It stays until somebody resets it (``~/reset``), and
  is kept over restarts.
- *inhibit*: the site, its operator or a limit forbids pumping. It clears by itself, but for an
  operator's stop and a record that cannot be read, which end by ``~/stop`` with false.
- *enable*: a condition for running the pump at all is missing. It clears by itself once that is
  there again: ``not_active`` by *activate*, where somebody had asked for another state,
  ``drive_local`` and ``drive_timeout`` by a person at the panel.

To add one, add its row here, and give a reason under its code in :mod:`.limits` (levels, weather,
how long and how much), :mod:`.pump_control` (what the drive shows) or the pump node (what it knows
itself). CONTRIBUTING.md lists the rest.

A diagnostic status of a node has a sentence for people and a code for programs. The codes are those
of the interlocks and the others below. A code, once given, keeps its meaning.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

LATCHED, INHIBIT, ENABLE = "latched", "inhibit", "enable"


class Interlock(NamedTuple):
    """One row of the table.

    Attributes:
        kind: what it does, and how it clears.
        reason: when it is active, in general.
        source: the module that gives the reason.
        limit: the parameters that set when; empty where there is none.
        advice: what to do.
        explained_by: codes that explain it: while one of them has a reason, this one is not said.
    """

    kind: str
    reason: str
    source: str
    limit: str
    advice: str
    explained_by: tuple[str, ...] = ()


_CONTROL, _LIMITS, _NODE = "pump_control", "limits", "nodes/pump"
_RESET = "remedy it, then call ~/reset"
# What explains that there is no command, or no speed.
_UNABLE = (
    "not_active", "drive_lost", "drive_local", "drive_timeout", "drive_guards_later", "no_permit",
    "two_controllers", "two_pumps", "no_command",
)
_NO_ORDER = (*_UNABLE, "command_unknown", "command_refused")

INTERLOCKS = {
    "turns_backwards": Interlock(
        LATCHED, "the pump turns backwards", _CONTROL, "", "switch the drive off at its panel; "
        "look for water that runs back, and for swapped phases; then call ~/reset",
    ),
    "runs_on": Interlock(
        LATCHED, "the pump turns although it is told to stop", _CONTROL,
        "follow_time, follow_tolerance, drive_ramp", "stop it at the drive's panel or main switch "
        "now; find out why it runs on (a stuck contactor, a hand switch), then call ~/reset",
    ),
    "drive_fault": Interlock(
        LATCHED,
        "the drive reports a fault, and not only that its own communication timeout has passed",
        _CONTROL, "", f"look it up in the drive's manual, {_RESET}", ("turns_backwards", "runs_on"),
    ),
    "speed_not_followed": Interlock(
        LATCHED, "the pump does not turn as it is asked to", _CONTROL,
        "follow_time, follow_tolerance, drive_ramp",
        f"see whether the pump is blocked, and whether the drive's own limits act, {_RESET}",
    ),
    "delivery": Interlock(
        LATCHED, "the levels do not show the water that was pumped", _CONTROL,
        "least_delivery, level_tolerance, averaging_time, greatest_loss, level_offset",
        f"look at valves, pipes and both level sensors, {_RESET}",
    ),
    "fault_unknown": Interlock(
        LATCHED, "a fault is kept that this version has no code for", _CONTROL, "state_file",
        f"read what it says, {_RESET}",
    ),
    "operator_stop": Interlock(
        INHIBIT, "an operator stopped the pump", _CONTROL, "",
        "call ~/stop with false when it may run again",
    ),
    "record_unknown": Interlock(
        INHIBIT, "whether there was a stop or a fault is not known any more", _CONTROL,
        "state_file", "see that pump and pipes are in order, then call ~/stop with false",
    ),
    "cistern_level_unknown": Interlock(
        INHIBIT, "the cistern's level is not known, or not believed", _LIMITS,
        "level_limit, frozen_movement, jump_tolerance, recovery_time",
        "look at the level sensor and its node",
    ),
    "cistern_low": Interlock(
        INHIBIT, "the cistern is at the suction level", _LIMITS, "level_offset, suction_hysteresis",
        "wait for rain, or refill the cistern",
    ),
    "roof_level_unknown": Interlock(
        INHIBIT, "the roof's level is not known, or not believed", _LIMITS,
        "level_limit, frozen_movement, jump_tolerance, recovery_time",
        "look at the level sensor and its node",
    ),
    "frost_unknown": Interlock(
        INHIBIT, "whether there is frost is not known", _LIMITS,
        "frost_limit, unknown_frost_may_pump",
        "see that there is a forecast with temperatures, or a thermometer",
    ),
    "frost": Interlock(INHIBIT, "there is frost", _LIMITS, "", "wait until it thaws"),
    "longest_run": Interlock(
        INHIBIT, "the pump ran for too long without a break", _LIMITS, "greatest_run",
        "see why so much water is asked for",
    ),
    "daily_volume": Interlock(
        INHIBIT, "the day's volume was pumped", _LIMITS, "greatest_volume_per_day",
        "see why so much water is asked for, or raise the limit",
    ),
    "daily_run": Interlock(
        INHIBIT, "the pump ran for as long as it may in a day", _LIMITS, "greatest_run_per_day",
        "see why so much water is asked for, or raise the limit",
    ),
    "not_active": Interlock(
        ENABLE, "the node is not active", _NODE, "autostart",
        "configure and activate it; its state says what is refused",
    ),
    "drive_lost": Interlock(
        ENABLE, "the drive is not heard", _NODE, "exchange_period",
        "look at the drive's power, cable, gateway and address",
    ),
    "drive_local": Interlock(
        ENABLE, "the drive is in local control", _NODE, "", "switch it back to the bus at its panel"
    ),
    "drive_timeout": Interlock(
        ENABLE, "the drive's own communication timeout does not guard", _NODE,
        "drive_timeout_limit, local_settings_stop_the_pump, activate_without_drive_timeout",
        "set it as the message says",
    ),
    "drive_guards_later": Interlock(
        ENABLE, "the drive was connected a moment ago, and its timeout may not guard yet", _NODE,
        "", "wait",
    ),
    "no_permit": Interlock(
        ENABLE, "bringup does not let the pump run", _NODE, "",
        "see which node is missing; where bringup has ended, start it again",
    ),
    "two_controllers": Interlock(
        ENABLE, "/pump/command has a second publisher, or one that cannot be heard", _NODE, "",
        "end the one that should not run, or mend its quality of service",
    ),
    "two_pumps": Interlock(
        ENABLE, "/pump/flow has a second publisher, or one that cannot be heard", _NODE, "",
        "end the one that should not run, or mend its quality of service",
    ),
    "no_command": Interlock(
        ENABLE, "commands do not come", _NODE, "command_limit", "see whether the controller runs"
    ),
    "command_unknown": Interlock(
        ENABLE, "there is no command that counts", _CONTROL, "command_limit, recovery_time",
        "see whether the controller runs", _UNABLE,
    ),
    "command_refused": Interlock(
        ENABLE, "the command is no number from 0 on", _CONTROL, "", "take another controller",
        _UNABLE,
    ),
    "drive_speed_unknown": Interlock(
        ENABLE, "the drive does not say what the pump turns at", _CONTROL, "",
        "see the drive's panel", _NO_ORDER,
    ),
    "drive_not_ready": Interlock(
        ENABLE, "the drive is not ready", _CONTROL, "", "see the drive's panel", _NO_ORDER
    ),
}
"""by their codes, which are short and stable"""

# What each code means, and what to do.
CONDITIONS = {code: (one.reason, one.advice) for code, one in INTERLOCKS.items()} | {
    # --- inputs: by the rule that one breaks, of input_rules ---
    "input_waiting": ("an input has not come yet", "see whether its node runs"),
    "input_silent": ("an input is too old", "see whether its node runs"),
    "input_refused": ("an input's value cannot be", "check its source, and its unit"),
    "input_publishers": (
        "an input has a second publisher, or one that is not heard", "end it, or mend its settings"
    ),
    "input_paused": (
        "this node stood still, and what it knew is old", "see what keeps the machine busy"
    ),
    "input_frozen": (
        "a level does not change although water must move", "look at the level sensor"
    ),
    "input_jump": ("a level moved faster than water can", "look at the level sensor"),
    "input_recovering": ("an input is good again, and counts in a moment", "wait"),
    # --- the controller ---
    "controller_failed": ("the controller cannot decide", "read its message"),
    "no_forecast": (
        "the controller has no forecast; on/off waters by the level after a while",
        "see whether the weather node runs and its forecast is fresh",
    ),
    # --- the weather node ---
    "forecast_missing": ("no forecast covers now", "see what fetches the forecast"),
    "forecast_unreadable": (
        "the newest forecast file cannot be read; the one before counts", "see what writes it"
    ),
    "temperature_unknown": (
        "the temperature is not known",
        "see that the forecast has it, or that a thermometer is heard",
    ),
    "gauge_bad": (
        "a gauge is not heard or not believed; the forecast counts instead", "look at the gauge"
    ),
    # --- the pump node ---
    "limited": ("the pump does not do all that is asked for", "read what limits it"),
    "delivery_blind": (
        "whether the pumped water arrives cannot be checked for now", "wait; see to the levels"
    ),
    "state_not_kept": (
        "a stop or a fault would be forgotten at a restart", "make room on the disk"
    ),
    "suspended": ("the machine was suspended while the pump was on", "keep it from suspending"),
    "drive_awaited": ("the drive is being called", "wait"),
    "drive_warning": ("the drive warns", "look it up in the drive's manual"),
    "drive_timeout_waived": (
        "the drive would run on when this machine fails, and may", "set the drive's timeout"
    ),
    "drive_file_unverified": (
        "not all of this make's settings were tried", "watch the pump start and stop once"
    ),
    # --- the recorder and the sensors ---
    "not_recorded": ("nothing is recorded; watering goes on", "see to the disk"),
    "sensor_lost": (
        "the sensor does not answer, or with no possible level",
        "look at its power, cable and address",
    ),
    "sensor_hangs": ("the sensor is not read any more", "start the node again"),
}


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
    return {
        code: reasons[code] for code, one in INTERLOCKS.items()
        if reasons.get(code) and not any(reasons.get(cause) for cause in one.explained_by)
    }
