"""What an alarm means to an operator, and what to do about it.

A table: of which node and part, words of its sentence, and what an operator should know and do. The
first row that fits counts, so that what is dangerous stands above what only follows from it. No
number of a sentence is read: it stands beside the advice.
"""

from __future__ import annotations

import re
from functools import lru_cache

from greenroof_ros.pumping.pump_control import OPERATOR_STOPPED, STANDS_UNKNOWN, STILL_TURNS

# Where no row fits, and of other devices, of which nothing is known here.
OTHER = "Nothing is known about this here; read the log of the node that says so."
FOREIGN = "Another device or program says so, not the green roof: see its own instructions."

_RESET = "then clear the fault: ros2 service call {node}/reset std_srvs/srv/Trigger"
_RELEASE = (
    'ros2 service call {node}/stop std_srvs/srv/SetBool "{{data: false}}"'
)
_SENSORS = r"(cistern|roof)_sensor: "
_PUMP_OR_INPUTS = r"pump: .*|controller: (inputs|forecast)"

# Whatever it was, each input of which something is said keeps all rules again.
_RECOVERING = r"^([^;]*; now it is good, and counts after [^;]*(; |$))+$"
_LINE = r"no valid answer|refused with exception|the answer |connection was closed|registers came"

# (role and part, words of the sentence, advice); both are regular expressions, the first of all of
# "ROLE: PART", the second of some of the sentence.
_TABLE: tuple[tuple[str, str, str], ...] = (
    # --- it is over already ---
    (
        _PUMP_OR_INPUTS, _RECOVERING,
        "It is good again. Nothing to do: it counts when it has been good for a while.",
    ),
    # --- another one has the pump ---
    (
        r"pump: .*", r"runs this drive already|the lock .* cannot be opened",
        "Another program on this computer has the drive, or a lock file of it is not readable. End "
        "the other program; the message names what to do.",
    ),
    # --- the pump turns and should not, or nobody knows ---
    (
        r"pump: .*", r"told to stop|acknowledges \*stop\*|stuck contactor",
        "The pump turns although it should stand. Stop it at its drive's panel or main switch now; "
        f"find out why it runs on (a stuck contactor, a hand switch), {_RESET}",
    ),
    (
        r"pump: .*", f"{OPERATOR_STOPPED}.*{STILL_TURNS}",
        "Somebody stopped the pump, and it still turns. If it does not stand within seconds, stop "
        "it at its drive's panel or main switch, and find out why it runs on.",
    ),
    (
        r"pump: .*", r"turns backwards",
        "Switch the drive off at its panel. Water runs back through the pump, or two phases of the "
        f"motor are swapped: have an electrician look, {_RESET}",
    ),
    (
        r"pump: ", r"^ended: .*(not heard at the end|not stand at the end)",
        "The pump's program has ended without seeing the pump stand. Go and see; stop it at its "
        "drive's panel or main switch if it turns.",
    ),
    # --- faults that latch ---
    (
        r"pump: .*", r"the drive reports",
        "The drive has switched the pump off by itself. Look the fault up in the drive's manual, "
        f"remedy it, {_RESET}",
    ),
    (
        r"pump: .*", r"the speed does not follow",
        "The pump turns at another speed than is asked for. See whether it is blocked, and whether "
        f"the drive's own limits hold it, {_RESET}",
    ),
    (
        r"pump: .*", r"a burst pipe or a leak",
        "Water leaves the cistern and does not reach the roof. Look for a burst pipe behind the "
        f"pump, and at the roof's level sensor, {_RESET}",
    ),
    (
        r"pump: .*", r"a closed valve",
        "The pump runs and moves no water. Open the valves; see whether the pump is blocked, the "
        f"pipe or the cistern empty, or a level sensor stuck, {_RESET}",
    ),
    (
        r"pump: .*", r"its sensor is stuck or drifts",
        "Water arrives on the roof and the cistern does not fall. Measure the cistern by hand: its "
        f"level sensor is perhaps stuck, or water flows in, {_RESET}",
    ),
    (
        r"pump: .*", r"a leak, or somebody else takes water",
        "The cistern loses more water than is pumped. Look for a leak, and whether somebody else "
        f"takes water, {_RESET}",
    ),
    (r"pump: pump", r"^fault: ", f"The pump stays off. Remedy what is said, {_RESET}"),
    (
        r"pump: .*", f"{STANDS_UNKNOWN}|it stands has not been known",
        "The drive is not heard, and whether the pump stands is not known. Go and see; look at the "
        "drive's power, cable, gateway and address.",
    ),
    # --- held ---
    (
        r"pump: .*", OPERATOR_STOPPED,
        f"Somebody holds the pump off. When it may run again: {_RELEASE}",
    ),
    (
        r"pump: .*", r"whether there was a stop or a fault is not known",
        "What the pump's program had noted is lost, so the pump stays off. See that pump and pipes "
        f"are in order, then release it: {_RELEASE}",
    ),
    (
        r"pump: .*", r"has it already; end that one",
        "Two programs for the same pump run on this computer. End the one that should not.",
    ),
    (
        r"pump: .*", r"cannot be written: |could not be written within|not yet on the disk",
        "A stop would be forgotten at a restart. Make room on the disk and let the program write "
        "that file.",
    ),
    # --- the drive ---
    (
        r"pump: .*", r"somebody else writes to the drive",
        "Another controller writes to the drive at the same time. End it, or take the drive off "
        "that line; the pump goes on by itself.",
    ),
    (
        r"pump: .*", r"in local control",
        "The drive was switched to hand at its panel. Switch it back to the bus (remote); the pump "
        "goes on by itself.",
    ),
    (
        r"pump: .*", r"does not guard for",
        "The drive was just switched on. Nothing to do: the pump goes on by itself in a while.",
    ),
    (
        r"pump: .*", r"the exchange with the drive has ended",
        "The pump's program cannot talk to the drive any more. Start it again.",
    ),
    (
        r"pump: .*", r"not yet connected",
        "The drive is being called. Nothing to do, unless it stays so: then see that the drive has "
        "power, and look at cable, gateway and address.",
    ),
    (
        r"pump: .*", r"no connection to the drive|not configured: |the node is not configured",
        "The drive is not heard. See that it has power, and look at its cable, gateway and "
        "address; the pump goes on by itself when it answers.",
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
    (
        r"pump: .*", r"communication timeout|what is set in itself",
        "If this computer failed, the drive might run on, so the pump is not run. Have the drive "
        "set as the message says; then it goes on.",
    ),
    (
        r"pump: drive file", r"",
        "The settings for this make of drive were not all tried. Watch the pump start and stop "
        "once before you rely on it.",
    ),
    (
        r"pump: .*", r"speed of the drive is unknown|drive is not ready|had stopped by itself",
        "The drive does not say what it does, or is not ready. See its panel; the pump goes on by "
        "itself when it is ready.",
    ),
    (
        r"pump: drive", r"^the drive: ",
        "The drive warns, and the pump may run on. Look it up in the drive's manual before "
        "it becomes a fault.",
    ),
    (
        r"pump: .*", r"not activated|the node is not active",
        "The pump's program does not run the pump yet. It says why; without a reason it waits for "
        "somebody to configure and activate it.",
    ),
    # --- two of a kind ---
    (
        r".*", r"has \d+ publishers|two processes report|publishers? of|came twice",
        "Two programs do the same work, so neither is believed. End the one that should not run, "
        "or give it another ROS_DOMAIN_ID or namespace.",
    ),
    (
        r".*", r"cannot be heard \(",
        "A program publishes in a way that cannot be received. End it, or change it as the message "
        "says.",
    ),
    # --- bringup ---
    (
        r"pump: .*", r"bringup has (ended|given no permit)",
        "The program that watches over the site (bringup) hangs or has ended, so the pump stands. "
        "Start it again.",
    ),
    (
        r"pump: supervisor|pump: pump", r"is missing|is silent|is starting|waits for|^starting$",
        "A program of the site is not there, so the pump stands. bringup starts it again by "
        "itself; if it does not come, read its log.",
    ),
    # --- water and limits ---
    (
        r"pump: .*", r"the cistern is at .* not above",
        "There is too little water in the cistern to pump. Nothing to do: it goes on after rain; "
        "if the roof must be watered before, refill the cistern.",
    ),
    (
        r"pump: .*", r"without a break",
        "The pump ran for as long as it may at a time, and rests. If it rests often, see why it is "
        "asked for so much water.",
    ),
    (
        r"pump: .*", r"in this day",
        "The pump has done all it may in a day, and goes on tomorrow. If so much is right, raise "
        "its limit; otherwise look for what asks for it.",
    ),
    (
        r"pump: limits", r"are owed",
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
    (
        r"pump: .*|controller: .*", r"(?<!whether )there is frost",
        "Nothing to do: the pump stands in frost, and goes on when it thaws.",
    ),
    (
        r"weather: frost", r"may run all the same",
        "The temperature is not known, and the pump may run all the same, as was set. In winter "
        "see to it that it does not freeze.",
    ),
    (
        r"weather: frost", r"the temperature is unknown",
        "The temperature is not known, so the pump stands. See that the forecast has temperatures, "
        "or that the thermometer is heard.",
    ),
    # --- commands ---
    (
        r"pump: .*", r"no command|/pump/command (has not come|is older)",
        "The controller says nothing, so the pump stands. See whether the controller runs, and "
        "read its log.",
    ),
    (
        r"pump: .*|controller: command",
        r"the command .* is refused|/pump/command was refused|must be a finite number",
        "The controller commands nonsense, so the pump stands. Start it again, or take another "
        "controller.",
    ),
    # --- what a node takes in ---
    (
        r".*", r"this node itself stood still",
        "The computer was too busy or asleep for a moment. Nothing to do, unless it happens often: "
        "then end what keeps it busy.",
    ),
    (
        r".*", r"is its unit wrong",
        "A level is higher than its tank. Check the sensor's unit, scale and offset.",
    ),
    (
        r".*", r"is frozen",
        "A level sensor repeats the same value although water must have moved. See whether it is "
        "stuck or disconnected.",
    ),
    (
        r".*", r"/level jumped",
        "A level moved faster than water can. Check the sensor, its cable and its mounting; it "
        "counts again when it is steady.",
    ),
    (
        r"controller: (inputs|forecast)", r"members",
        "The controller takes one forecast, and several came. Set all_members of the weather node "
        "to false, or take another controller.",
    ),
    (
        r"weather: (rain gauge|thermometer)", r"",
        "An instrument of the weather station is not heard or not believed; the forecast, if there "
        "is one, is used instead. Check it when you can.",
    ),
    (
        r"pump: delivery", r"",
        "Whether the water arrives cannot be checked for now. Nothing to do, unless a level stays "
        "unknown.",
    ),
    (
        _PUMP_OR_INPUTS, r"/level |level of the",
        "A water level is not known or not believed, so the pump stands. Check that level's "
        "sensor and its program.",
    ),
    (
        r"pump: .*", r"frost",
        "It is not known whether there is frost, so the pump stands. See whether the weather "
        "program runs and has a temperature.",
    ),
    (
        r"controller: forecast", r"",
        "The controller has no good forecast: until it has one, plain on/off waters by the level. "
        "See whether the weather program runs and its file is fresh.",
    ),
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
    (
        r"weather: forecast", r"what was read before holds on",
        "The newest forecast file cannot be read; the one before is used as long as it reaches. "
        "See what writes it.",
    ),
    (
        r"weather: forecast", r"",
        "There is no forecast for now, so plain on/off waters by the level; without a thermometer "
        "the pump stands. See that whatever fetches the forecast still does, and the clock.",
    ),
    (
        r"recorder: recording", r"No space left",
        "The disk is full, so nothing is recorded; watering goes on. Make room on the disk.",
    ),
    (
        r"recorder: recording", r"",
        "Nothing is recorded; watering goes on. See that its directory is there and can be "
        "written.",
    ),
    (
        f"{_SENSORS}sensor", r": says ",
        "The level sensor answers, but with no possible level. Check the sensor, and its scale and "
        "range in the sensors' file.",
    ),
    (
        f"{_SENSORS}sensor", r"",
        "The level sensor does not answer. See that it has power, and look at its cable, gateway "
        "and address.",
    ),
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
