"""What keeps the pump off: one table, evaluated from top to bottom; and the other condition codes.

An interlock is active as long as there is a reason for it, and no pump runs while one is. Its kind
says what follows:

- *latched*: a fault of pump, pipes or drive. It stays until somebody resets it (``~/reset``), and
  is kept over restarts.
- *inhibit*: the site, its operator or a limit forbids pumping. It clears by itself, but for an
  operator's stop and a record that cannot be read, which end by ``~/stop`` with false; one on the
  page ends there, too.
- *enable*: a condition for running the pump at all is missing. It clears by itself once that is
  there again: ``not_active`` by *activate*, where somebody had asked for another state,
  ``drive_local`` and ``drive_timeout`` by a person at the panel.

To add one, add its row here, and give a reason under its code in :mod:`.limits` (levels, weather,
how long and how much), :mod:`.pump_control` (what the drive shows) or the pump node (what it knows
itself). CONTRIBUTING.md lists the rest.

A diagnostic status of a node has a sentence for people and a code for programs. The codes are those
of the interlocks and the others below. A code, once given, keeps its meaning. What to do about each
is said here alone, in the words that the page of ``greenroof watch`` shows.
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
        advice: what to do; ``{node}`` stands for the pump node's name.
        follows: whether an earlier one of its kind explains it, which is then said alone.
    """

    kind: str
    reason: str
    source: str
    limit: str
    advice: str
    follows: bool = False


_CONTROL, _LIMITS, _NODE = "pump_control", "limits", "nodes/pump"
# What ends the advice on each fault.
RESET = "then clear the fault: ros2 service call {node}/reset std_srvs/srv/Trigger"
_RELEASE = 'ros2 service call {node}/stop std_srvs/srv/SetBool "{{data: false}}"'
_FOLLOWING = "follow_time, follow_tolerance, drive_ramp"
_OF_LEVEL = "level_limit, frozen_movement, jump_tolerance, recovery_time"
_LEVEL = (
    "A water level is not known or not believed, so the pump stands. Check that level's sensor and "
    "its program."
)
_DAY = (
    "The pump has done all it may in a day, and goes on tomorrow. If so much is right, raise its "
    "limit; otherwise look for what asks for it."
)
_SILENT_CONTROLLER = (
    "The controller says nothing, so the pump stands. See whether the controller runs, and read "
    "its log."
)
_TWO = (
    "Two programs do the same work, so neither is believed. End the one that should not run, or "
    "give it another ROS_DOMAIN_ID or namespace."
)
_PANEL = (
    "The drive does not say what it does, or is not ready. See its panel; the pump goes on by "
    "itself when it is ready."
)
INTERLOCKS = {
    "turns_backwards": Interlock(
        LATCHED, "the pump turns backwards", _CONTROL, "",
        "Switch the drive off at its panel. Water runs back through the pump, or two phases of the "
        f"motor are swapped: have an electrician look, {RESET}",
    ),
    "runs_on": Interlock(
        LATCHED, "the pump turns although it is told to stop", _CONTROL, _FOLLOWING,
        "The pump turns although it should stand. Stop it at its drive's panel or main switch now; "
        f"find out why it runs on (a stuck contactor, a hand switch), {RESET}",
    ),
    "drive_fault": Interlock(
        LATCHED,
        "the drive reports a fault, and not only that its own communication timeout has passed",
        _CONTROL, "",
        "The drive has switched the pump off by itself. Look the fault up in the drive's manual, "
        f"remedy it, {RESET}", follows=True,
    ),
    "speed_not_followed": Interlock(
        LATCHED, "the pump does not turn as it is asked to", _CONTROL, _FOLLOWING,
        "The pump turns at another speed than is asked for. See whether it is blocked, and whether "
        f"the drive's own limits hold it, {RESET}",
    ),
    "delivery": Interlock(
        LATCHED, "the levels do not show the water that was pumped", _CONTROL,
        "least_delivery, level_tolerance, averaging_time, greatest_loss, level_offset",
        "The levels do not show the water that was pumped. Look, as the message says, for a burst "
        "pipe or a leak, a closed valve, somebody else who takes water, and at both level sensors, "
        f"{RESET}",
    ),
    "fault_unknown": Interlock(
        LATCHED, "a fault is kept that this version has no code for", _CONTROL, "state_file",
        f"The pump stays off. Remedy what is said, {RESET}",
    ),
    "operator_stop": Interlock(
        INHIBIT, "an operator stopped the pump", _CONTROL, "",
        f"Somebody holds the pump off. When it may run again: {_RELEASE}",
    ),
    "page_stop": Interlock(
        INHIBIT, "somebody stopped the pump on the page", _CONTROL, "",
        "Somebody holds the pump off on the page. When it may run again, release it there "
        f"(greenroof watch --allow-release), or: {_RELEASE}",
    ),
    "record_unknown": Interlock(
        INHIBIT, "whether there was a stop or a fault is not known any more", _CONTROL,
        "state_file",
        "What the pump's program had noted is lost, so the pump stays off. See that pump and pipes "
        f"are in order, then release it: {_RELEASE}",
    ),
    "cistern_level_unknown": Interlock(
        INHIBIT, "the cistern's level is not known, or not believed", _LIMITS, _OF_LEVEL, _LEVEL
    ),
    "cistern_low": Interlock(
        INHIBIT, "the cistern is at the suction level", _LIMITS, "level_offset, suction_hysteresis",
        "There is too little water in the cistern to pump. Nothing to do: it goes on after rain; "
        "if the roof must be watered before, refill the cistern.",
    ),
    "roof_level_unknown": Interlock(
        INHIBIT, "the roof's level is not known, or not believed", _LIMITS, _OF_LEVEL, _LEVEL
    ),
    "frost_unknown": Interlock(
        INHIBIT, "whether there is frost is not known", _LIMITS,
        "frost_limit, unknown_frost_may_pump",
        "It is not known whether there is frost, so the pump stands. See whether the weather "
        "program runs and has a temperature.",
    ),
    "frost": Interlock(
        INHIBIT, "there is frost", _LIMITS, "",
        "Nothing to do: the pump stands in frost, and goes on when it thaws.",
    ),
    "longest_run": Interlock(
        INHIBIT, "the pump ran for too long without a break", _LIMITS, "greatest_run",
        "The pump ran for as long as it may at a time, and rests. If it rests often, see why it is "
        "asked for so much water.",
    ),
    "daily_volume": Interlock(
        INHIBIT, "the day's volume was pumped", _LIMITS, "greatest_volume_per_day", _DAY
    ),
    "daily_run": Interlock(
        INHIBIT, "the pump ran for as long as it may in a day", _LIMITS, "greatest_run_per_day",
        _DAY,
    ),
    "not_active": Interlock(
        ENABLE, "the node is not active", _NODE, "autostart",
        "The pump's program does not run the pump yet. It says why; without a reason it waits for "
        "somebody to configure and activate it.",
    ),
    "drive_lost": Interlock(
        ENABLE, "the drive is not heard", _NODE, "exchange_period",
        "The drive is not heard. See that it has power, and look at its cable, gateway and "
        "address, and for another program that has it; the pump goes on by itself when it answers.",
    ),
    "drive_local": Interlock(
        ENABLE, "the drive is in local control", _NODE, "",
        "The drive was switched to hand at its panel. Switch it back to the bus (remote); the pump "
        "goes on by itself.",
    ),
    "second_master": Interlock(
        ENABLE, "somebody else writes to the drive", _NODE, "",
        "Another controller writes to the drive at the same time. End it, or take the drive off "
        "that line; the pump goes on by itself.",
    ),
    "drive_timeout": Interlock(
        ENABLE, "the drive's own communication timeout does not guard", _NODE,
        "drive_timeout_limit, local_settings_stop_the_pump, activate_without_drive_timeout",
        "If this computer failed, the drive might run on, so the pump is not run. Have the drive "
        "set as the message says; then it goes on.",
    ),
    "drive_guards_later": Interlock(
        ENABLE, "the drive was connected a moment ago, and its timeout may not guard yet", _NODE,
        "",
        "The drive was just switched on. Nothing to do: the pump goes on by itself in a while.",
    ),
    "no_permit": Interlock(
        ENABLE, "bringup does not let the pump run", _NODE, "",
        "The program that watches over the site (bringup) hangs or has ended, so the pump stands. "
        "Start it again.",
    ),
    "two_controllers": Interlock(
        ENABLE, "/pump/command has a second publisher, or one that cannot be heard", _NODE, "", _TWO
    ),
    "two_pumps": Interlock(
        ENABLE, "/pump/flow has a second publisher, or one that cannot be heard", _NODE, "", _TWO
    ),
    "no_command": Interlock(
        ENABLE, "commands do not come", _NODE, "command_limit", _SILENT_CONTROLLER
    ),
    "command_unknown": Interlock(
        ENABLE, "there is no command that counts", _CONTROL, "command_limit, recovery_time",
        _SILENT_CONTROLLER, follows=True,
    ),
    "command_refused": Interlock(
        ENABLE, "the command is no number from 0 on", _CONTROL, "",
        "The controller commands nonsense, so the pump stands. Start it again, or take another "
        "controller.", follows=True,
    ),
    "drive_speed_unknown": Interlock(
        ENABLE, "the drive does not say what the pump turns at", _CONTROL, "", _PANEL, follows=True
    ),
    "drive_not_ready": Interlock(
        ENABLE, "the drive is not ready", _CONTROL, "", _PANEL, follows=True
    ),
}
"""by their codes, which are short and stable"""

CLEARED_ON_PAGE = ("turns_backwards", "runs_on", "speed_not_followed")
"""Faults that the page may clear: neither one of the delivery, nor one of the drive, nor one that
is not known: those need somebody who has looked."""

# What each code means, and what to do.
CONDITIONS = {code: (one.reason, one.advice) for code, one in INTERLOCKS.items()} | {
    # --- inputs: by the rule that one breaks, of input_rules ---
    "input_waiting": ("an input has not come yet", "See whether its node runs."),
    "input_silent": ("an input is too old", "See whether its node runs."),
    "input_refused": ("an input's value cannot be", "Check its source, and its unit."),
    "input_publishers": ("an input has a second publisher, or one that is not heard", _TWO),
    "input_paused": (
        "this node stood still, and what it knew is old",
        "The computer was too busy or asleep for a moment. Nothing to do, unless it happens often: "
        "then end what keeps it busy.",
    ),
    "input_frozen": (
        "a level does not change although water must move",
        "A level sensor repeats the same value although water must have moved. See whether it is "
        "stuck or disconnected.",
    ),
    "input_jump": (
        "a level moved faster than water can",
        "A level moved faster than water can. Check the sensor, its cable and its mounting; it "
        "counts again when it is steady.",
    ),
    "input_recovering": (
        "an input is good again, and counts in a moment",
        "It is good again. Nothing to do: it counts when it has been good for a while.",
    ),
    # --- the controller ---
    "controller_failed": ("the controller cannot decide", "Read its message."),
    "no_forecast": (
        "the controller has no forecast; on/off waters by the level after a while",
        "The controller has no good forecast: until it has one, plain on/off waters by the level. "
        "See whether the weather program runs and its file is fresh.",
    ),
    # --- the weather node ---
    "forecast_missing": (
        "no forecast covers now",
        "There is no forecast for now, so plain on/off waters by the level; without a thermometer "
        "the pump stands. Put a newer file in its place, which is read by itself; see that "
        "whatever fetches it still does, and the clock.",
    ),
    "forecast_of_record": (
        "no forecast covers now; spells of past weather stand for one",
        "There is no forecast for now: the controller plans with what usually falls. See that "
        "whatever fetches the forecast still does, and the clock.",
    ),
    "record_short": (
        "too few past forecasts are known to dress this one",
        "The forecast is used as it was issued, since too few like it are known. Nothing to do, if "
        "the file is being filled; otherwise make it of more months.",
    ),
    "record_not_kept": (
        "what fell after each forecast is not kept",
        "What falls after each forecast is not written down. See to the disk and to that file.",
    ),
    "forecast_unreadable": (
        "the newest forecast file cannot be read; the one before counts",
        "The newest forecast file cannot be read; the one before is used as long as it reaches. "
        "See what writes it.",
    ),
    "temperature_unknown": (
        "the temperature is not known",
        "The temperature is not known, so the pump stands. Let the forecast have a column of "
        "temperature, or a node publish /gauge/temperature.",
    ),
    "gauge_bad": (
        "a gauge is not heard or not believed; the forecast counts instead",
        "An instrument of the weather station is not heard or not believed; the forecast, if there "
        "is one, is used instead. Check it when you can.",
    ),
    # --- the pump node ---
    "limited": ("the pump does not do all that is asked for", "Read what limits it."),
    "delivery_blind": (
        "whether the pumped water arrives cannot be checked for now",
        "Whether the water arrives cannot be checked for now. Nothing to do, unless a level stays "
        "unknown.",
    ),
    "state_not_kept": (
        "a stop or a fault would be forgotten at a restart",
        "A stop would be forgotten at a restart. Make room on the disk and let the program write "
        "that file.",
    ),
    "suspended": ("the machine was suspended while the pump was on", "Keep it from suspending."),
    "drive_awaited": (
        "the drive is being called",
        "The drive is being called. Nothing to do, unless it stays so: then see that the drive has "
        "power, and look at cable, gateway and address.",
    ),
    "drive_warning": (
        "the drive warns",
        "The drive warns, and the pump may run on. Look it up in the drive's manual before it "
        "becomes a fault.",
    ),
    "drive_timeout_waived": (
        "the drive would run on when this machine fails, and may",
        "If this computer failed, the drive would run on, which was allowed. Better have the drive "
        "set as the message says.",
    ),
    "drive_file_unverified": (
        "not all of this make's settings were tried",
        "The settings for this make of drive were not all tried. Watch the pump start and stop "
        "once before you rely on it.",
    ),
    # --- any node, and bringup ---
    "peers_awaited": (
        "not all of the node's peers are there yet, so it does nothing", "Start what it waits for."
    ),
    "node_failed": ("the node has failed and ended", "Mend what it says, and start it again."),
    "disk_hangs": ("the disk takes nothing; logs and summary wait in memory", "See to the disk."),
    # --- the recorder and the sensors ---
    "not_recorded": (
        "nothing is recorded; watering goes on",
        "Nothing is recorded; watering goes on. See that its directory is there, can be written "
        "and has room.",
    ),
    "sensor_lost": (
        "the sensor does not answer, or with no possible level",
        "The level sensor does not answer. See that it has power, and look at its cable, gateway "
        "and address.",
    ),
    "sensor_hangs": ("the sensor is not read any more", "Start the node again."),
}


def advice_on(code: str) -> str:
    """Return what to do about a code; of one that is not known, as of another version, to read."""
    return CONDITIONS.get(code, ("", "read its message"))[1]


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
