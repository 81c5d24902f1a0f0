"""The code of each condition that a node reports, with what it means and what to do about it.

A diagnostic status has a sentence for people and a code for programs; the codes are those of the
interlocks, which keep the pump off, and the others below. A code, once given, keeps its meaning.
"""

from __future__ import annotations

from dataclasses import dataclass

from greenroof_ros.pumping.interlocks import INTERLOCKS


@dataclass(frozen=True)
class Condition:
    """What a code stands for.

    Attributes:
        meaning: what is so.
        advice: what to do.
    """

    meaning: str
    advice: str


CONDITIONS = {one.code: Condition(one.reason, one.advice) for one in INTERLOCKS} | {
    # --- inputs: by the rule that one breaks, of greenroof_ros.pumping.input_rules ---
    "input_waiting": Condition("an input has not come yet", "see whether its node runs"),
    "input_silent": Condition("an input is too old", "see whether its node runs"),
    "input_refused": Condition("an input's value cannot be", "check its source, and its unit"),
    "input_publishers": Condition(
        "an input has a second publisher, or one that is not heard", "end it, or mend its settings"
    ),
    "input_paused": Condition(
        "this node stood still, and what it knew is old", "see what keeps the machine busy"
    ),
    "input_frozen": Condition(
        "a level does not change although water must move", "look at the level sensor"
    ),
    "input_jump": Condition("a level moved faster than water can", "look at the level sensor"),
    "input_recovering": Condition("an input is good again, and counts in a moment", "wait"),
    # --- the controller ---
    "controller_failed": Condition("the controller cannot decide", "read its message"),
    "no_forecast": Condition(
        "the controller has no forecast; on/off waters by the level after a while",
        "see whether the weather node runs and its forecast is fresh",
    ),
    # --- the weather node ---
    "forecast_missing": Condition("no forecast covers now", "see what fetches the forecast"),
    "forecast_unreadable": Condition(
        "the newest forecast file cannot be read; the one before counts", "see what writes it"
    ),
    "temperature_unknown": Condition(
        "the temperature is not known", "see that the forecast has it, or that a thermometer is "
        "heard",
    ),
    "gauge_bad": Condition(
        "a gauge is not heard or not believed; the forecast counts instead", "look at the gauge"
    ),
    # --- the pump node ---
    "limited": Condition("the pump does not do all that is asked for", "read what limits it"),
    "delivery_blind": Condition(
        "whether the pumped water arrives cannot be checked for now", "wait; see to the levels"
    ),
    "state_not_kept": Condition(
        "a stop or a fault would be forgotten at a restart", "make room on the disk"
    ),
    "suspended": Condition(
        "the machine was suspended while the pump was on", "keep it from suspending"
    ),
    "drive_awaited": Condition("the drive is being called", "wait"),
    "drive_warning": Condition("the drive warns", "look it up in the drive's manual"),
    "drive_timeout_waived": Condition(
        "the drive would run on when this machine fails, and may", "set the drive's timeout"
    ),
    "drive_file_unverified": Condition(
        "not all of this make's settings were tried", "watch the pump start and stop once"
    ),
    # --- the recorder and the sensors ---
    "not_recorded": Condition("nothing is recorded; watering goes on", "see to the disk"),
    "sensor_lost": Condition(
        "the sensor does not answer, or with no possible level", "look at its power, cable and "
        "address",
    ),
    "sensor_hangs": Condition("the sensor is not read any more", "start the node again"),
}
