"""What an alarm means to an operator, and what to do about it.

A table: of which node and part, words of its sentence, and what an operator should know and do;
where that is what a condition code says, it stands with the code. The first row that fits counts,
so that what is dangerous stands above what only follows from it. No number of a sentence is read:
it stands beside the advice.
"""

from __future__ import annotations

import re
from functools import lru_cache

from greenroof_ros.pumping.interlocks import CONDITIONS, RESET
from greenroof_ros.pumping.pump_control import OPERATOR_STOPPED, STANDS_UNKNOWN, STILL_TURNS

# Where no row fits, and of other devices, of which nothing is known here.
OTHER = "Nothing is known about this here; read the log of the node that says so."
FOREIGN = "Another device or program says so, not the green roof: see its own instructions."

# What to do about each condition.
_OF = {code: advice for code, (_, advice) in CONDITIONS.items()}
_SENSORS = r"(cistern|roof)_sensor: "
_PUMP_OR_INPUTS = r"pump: .*|controller: (inputs|forecast)"

# Whatever it was, each input of which something is said keeps all rules again.
_RECOVERING = r"^([^;]*; now it is good, and counts after [^;]*(; |$))+$"
_LINE = r"no valid answer|refused with exception|the answer |connection was closed|registers came"

# (role and part, words of the sentence, advice); both are regular expressions, the first of all of
# "ROLE: PART", the second of some of the sentence.
_TABLE: tuple[tuple[str, str, str], ...] = (
    # --- it is over already ---
    (_PUMP_OR_INPUTS, _RECOVERING, _OF["input_recovering"]),
    # --- another one has the pump ---
    (
        r"pump: .*", r"runs this drive already|the lock .* cannot be opened",
        "Another program on this computer has the drive, or a lock file of it is not readable. End "
        "the other program; the message names what to do.",
    ),
    # --- the pump turns and should not, or nobody knows ---
    (r"pump: .*", r"told to stop|acknowledges \*stop\*|stuck contactor", _OF["runs_on"]),
    (
        r"pump: .*", f"{OPERATOR_STOPPED}.*{STILL_TURNS}",
        "Somebody stopped the pump, and it still turns. If it does not stand within seconds, stop "
        "it at its drive's panel or main switch, and find out why it runs on.",
    ),
    (r"pump: .*", r"turns backwards", _OF["turns_backwards"]),
    (
        r"pump: ", r"^ended: .*(not heard at the end|not stand at the end)",
        "The pump's program has ended without seeing the pump stand. Go and see; stop it at its "
        "drive's panel or main switch if it turns.",
    ),
    # --- faults that latch ---
    (r"pump: .*", r"the drive reports", _OF["drive_fault"]),
    (r"pump: .*", r"the speed does not follow", _OF["speed_not_followed"]),
    (
        r"pump: .*", r"a burst pipe or a leak",
        "Water leaves the cistern and does not reach the roof. Look for a burst pipe behind the "
        f"pump, and at the roof's level sensor, {RESET}",
    ),
    (
        r"pump: .*", r"a closed valve",
        "The pump runs and moves no water. Open the valves; see whether the pump is blocked, the "
        f"pipe or the cistern empty, or a level sensor stuck, {RESET}",
    ),
    (
        r"pump: .*", r"its sensor is stuck or drifts",
        "Water arrives on the roof and the cistern does not fall. Measure the cistern by hand: its "
        f"level sensor is perhaps stuck, or water flows in, {RESET}",
    ),
    (
        r"pump: .*", r"a leak, or somebody else takes water",
        "The cistern loses more water than is pumped. Look for a leak, and whether somebody else "
        f"takes water, {RESET}",
    ),
    (r"pump: pump", r"^fault: ", _OF["fault_unknown"]),
    (
        r"pump: .*", f"{STANDS_UNKNOWN}|it stands has not been known",
        "The drive is not heard, and whether the pump stands is not known. Go and see; look at the "
        "drive's power, cable, gateway and address.",
    ),
    # --- held ---
    (r"pump: .*", OPERATOR_STOPPED, _OF["operator_stop"]),
    (r"pump: .*", r"whether there was a stop or a fault is not known", _OF["record_unknown"]),
    (
        r"pump: .*", r"has it already; end that one",
        "Two programs for the same pump run on this computer. End the one that should not.",
    ),
    (
        r"pump: .*", r"cannot be written: |could not be written within|not yet on the disk",
        _OF["state_not_kept"],
    ),
    # --- the drive ---
    (r"pump: .*", r"somebody else writes to the drive", _OF["second_master"]),
    (r"pump: .*", r"in local control", _OF["drive_local"]),
    (r"pump: .*", r"does not guard for", _OF["drive_guards_later"]),
    (
        r"pump: .*", r"the exchange with the drive has ended",
        "The pump's program cannot talk to the drive any more. Start it again.",
    ),
    (r"pump: .*", r"not yet connected", _OF["drive_awaited"]),
    (
        r"pump: .*", r"no connection to the drive|not configured: |the node is not configured",
        _OF["drive_lost"],
    ),
    (
        r"pump: drive", f"^the drive: .*({_LINE}|cannot connect)",
        "The drive answers badly, or not every time. If it stays so, look at its cable, gateway "
        "and address.",
    ),
    (
        r"pump: drive", r"^the drive: .*(no effect|is no share|believable|cannot be)",
        "The drive does not do what it is told, or says what cannot be. See its panel.",
    ),
    (r"pump: .*", r"communication timeout|what is set in itself", _OF["drive_timeout"]),
    (r"pump: drive file", r"", _OF["drive_file_unverified"]),
    (
        r"pump: .*", r"speed of the drive is unknown|drive is not ready|had stopped by itself",
        _OF["drive_speed_unknown"],
    ),
    (r"pump: drive", r"^the drive: ", _OF["drive_warning"]),
    (r"pump: .*", r"not activated|the node is not active", _OF["not_active"]),
    # --- two of a kind ---
    (
        r".*", r"has \d+ publishers|two processes report|publishers? of|came twice",
        _OF["two_controllers"],
    ),
    (
        r".*", r"cannot be heard \(",
        "A program publishes in a way that cannot be received. End it, or change it as the message "
        "says.",
    ),
    # --- bringup ---
    (r"pump: .*", r"bringup has (ended|given no permit)", _OF["no_permit"]),
    (
        r"pump: supervisor|pump: pump", r"is missing|is silent|is starting|waits for|^starting$",
        "A program of the site is not there, so the pump stands. bringup starts it again by "
        "itself; if it does not come, read its log.",
    ),
    # --- water and limits ---
    (r"pump: .*", r"the cistern is at .* not above", _OF["cistern_low"]),
    (r"pump: .*", r"without a break", _OF["longest_run"]),
    (r"pump: .*", r"in this day", _OF["daily_volume"]),
    (
        r"pump: limits", r"are outstanding",
        "The pump lags behind what is asked for, since it may not start more often. Nothing to do "
        "if this passes within the hour.",
    ),
    (
        r"pump: limits", r"is not believed",
        "The flow meter reads more than the pump can deliver. Check the meter and its unit.",
    ),
    (
        r"pump: limits", r"is above 1",
        "The controller asks for more than the pump can deliver; it gets all there is. Nothing to "
        "do.",
    ),
    # --- frost ---
    (r"pump: .*|controller: .*", r"(?<!whether )there is frost", _OF["frost"]),
    (
        r"weather: frost", r"may run all the same",
        "The temperature is not known, and the pump may run all the same, as was set. In winter "
        "see to it that it does not freeze.",
    ),
    (r"weather: frost", r"the temperature is unknown", _OF["temperature_unknown"]),
    # --- commands ---
    (r"pump: .*", r"no command|/pump/command (has not come|is older)", _OF["no_command"]),
    (
        r"pump: .*|controller: command",
        r"the command .* is refused|/pump/command was refused|must be a finite number",
        _OF["command_refused"],
    ),
    # --- what a node takes in ---
    (r".*", r"this node itself stood still", _OF["input_paused"]),
    (
        r".*", r"is its unit wrong",
        "A level is higher than its tank. Check the sensor's unit, scale and offset.",
    ),
    (r".*", r"is frozen", _OF["input_frozen"]),
    (r".*", r"/level jumped", _OF["input_jump"]),
    (
        r"controller: (inputs|forecast)", r"members",
        "The controller takes one forecast, and several came. Set all_members of the weather node "
        "to false, or take another controller.",
    ),
    (r"weather: (rain gauge|thermometer)", r"", _OF["gauge_bad"]),
    (r"pump: delivery", r"", _OF["delivery_blind"]),
    (_PUMP_OR_INPUTS, r"/level |level of the", _OF["cistern_level_unknown"]),
    (r"pump: .*", r"frost", _OF["frost_unknown"]),
    (r"controller: forecast", r"", _OF["no_forecast"]),
    (
        r"controller: inputs", r"/forecast/|/weather/",
        "The controller has no good forecast or temperature, so it commands no water. See whether "
        "the weather program runs and its file is fresh.",
    ),
    (
        r".*: refused", r"",
        "Some program publishes nonsense there; it is taken for 0. See which one publishes it, and "
        "end or mend it.",
    ),
    # --- the weather, the recording, the sensors ---
    (r"weather: forecast", r"what was read before holds on", _OF["forecast_unreadable"]),
    (r"weather: forecast", r"", _OF["forecast_missing"]),
    (
        r"recorder: recording", r"No space left",
        "The disk is full, so nothing is recorded; watering goes on. Make room on the disk.",
    ),
    (r"recorder: recording", r"", _OF["not_recorded"]),
    (
        f"{_SENSORS}sensor", r": says ",
        "The level sensor answers, but with no possible level. Check the sensor, and its scale and "
        "range in the sensors' file.",
    ),
    (f"{_SENSORS}sensor", r"", _OF["sensor_lost"]),
    # --- nodes ---
    (
        r".*: ", r"^ended: .*No space left",
        "The disk is full, and the run has ended. Make room, and start it again.",
    ),
    (
        r".*: ", r"^ended: .*nothing came within",
        "A program that this one waited for hung or was ended, and the run has ended. Read that "
        "one's log, and start the run again.",
    ),
    (
        r".*: ", r"^ended: .*(has ended|and the run with it)",
        "The run has ended with another program of it. Read that one's log, and start the run "
        "again.",
    ),
    (r".*: ", r"^ended: ", "The program has failed. Mend what it says, and start the run again."),
    (
        r"pump: ", r"^not heard",
        "Nobody here knows whether the pump runs. Go and see; stop it at its panel if it should "
        "not. bringup starts the program again, or else start it yourself.",
    ),
    (
        r"controller: ", r"^not heard",
        "The controller hangs or was ended; the pump stands without its commands. bringup starts "
        "it again, or else start it yourself.",
    ),
    (
        _SENSORS, r"^not heard",
        "The program that reads a level hangs or was ended, so the pump stands. bringup starts it "
        "again, or else start it yourself.",
    ),
    (
        r"weather: ", r"^not heard",
        "The weather program hangs or was ended; the pump stands without its word on frost. "
        "bringup starts it again, or else start it yourself.",
    ),
    (
        r"recorder: ", r"^not heard",
        "Nothing is recorded; on a live site watering goes on. bringup starts it again, or else "
        "start it yourself.",
    ),
    (
        r"plant: ", r"^not heard",
        "The simulation hangs or was ended, and the run with it. Read its log, and start the run "
        "again.",
    ),
    (
        r".*", r"^not heard",
        "It has stopped reporting. See whether it still runs, and start it again.",
    ),
    (
        r".*: (process)?", r"; starts again in ",
        "The program ended or hung, and bringup started it again. Nothing to do, unless it happens "
        "often: then read its log.",
    ),
    (
        r".*: ", r"^waits for ",
        "It cannot begin yet. Start the program that it waits for, if it does not come by itself.",
    ),
)


def advise(node: str, role: str, part: str, message: str) -> str:
    """Return what an alarm means and what to do about it, in a sentence or two.

    Args:
        node: its fully qualified name, for the services that the advice names.
        role: of the node, as the interface calls it; empty for another device.
        part: of the node; empty for the node itself.
        message: its own sentence.
    """
    return _find(role, part, message).format(node=node) if role else FOREIGN


@lru_cache(maxsize=1000)
def _find(role: str, part: str, message: str) -> str:
    where = f"{role}: {part}"
    return next(
        (
            advice for place, words, advice in _TABLE
            if re.fullmatch(place, where) and re.search(words, message)
        ),
        OTHER,
    )
