"""What can be known of a graph without ROS: a node's states and reports, and what ends a run."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

# The states of a node: not all its peers are there; they are; the run is over; so is the process.
STARTING, READY, FINISHED, ENDED = STATES = ("starting", "ready", "finished", "ended")

# What to call the node that has a role of the interface, where its name is not known.
ROLES = {"controller": "the controller", "pump": "the pump driver"}

# Nodes that their supervisors treat in their own ways.
PUMP, RECORDER = "pump", "recorder"

# The environment variable that holds the file descriptor to which a started node writes its
# reports, one JSON object a line with the key "state".
REPORT_PIPE = "GREENROOF_ROS_REPORT_PIPE"

# The environment variable that holds the file descriptor from which a started pump node reads, four
# times a second, whether it may run: one JSON object a line, with the key "inhibit", empty or why
# it may not, and "at", the time since the machine started (CLOCK_BOOTTIME, s) at which that was so.
PERMIT_PIPE = "GREENROOF_ROS_PERMIT_PIPE"


class LockstepError(Exception):
    """The graph cannot go on; the message names the topic and the node."""


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_number(value: object) -> bool:
    """Whether it is a number, or None, which stands for unknown."""
    return value is None or (isinstance(value, (int, float)) and not isinstance(value, bool))


def _is_list(value: object) -> bool:
    return isinstance(value, list) and all(map(_is_text, value))


# What its readers take for granted of what a report says.
_IS_AS_EXPECTED: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("pump", "pump_state", "failure", "fault", "held"), _is_text),
    **dict.fromkeys(("cistern_level", "roof_level", "command", "flow", "speed"), _is_number),
    **dict.fromkeys(("warnings", "waiting"), _is_list),
    **dict.fromkeys(("stands", "active"), lambda value: isinstance(value, bool)),
    "tick": lambda value: type(value) is int,
    "refused": lambda value: isinstance(value, dict)
    and all(type(count) is int for count in value.values()),
    "diagnoses": lambda value: isinstance(value, dict)
    and all(_is_list(said) and len(said) == 3 for said in value.values()),
}


def read_report(line: bytes) -> dict[str, Any] | None:
    """Return the report in a line of the pipe, or None where there is none.

    A node that was started again can be of another version than its supervisor, where the package
    was changed meanwhile. What is of another type than readers expect is as if it were not said.
    """
    try:
        report = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(report, dict) or report.get("state") not in STATES:
        return None
    said = {
        key: value for key, value in report.items()
        if key not in _IS_AS_EXPECTED or _IS_AS_EXPECTED[key](value)
    }
    return {"warnings": [], "refused": {}, **said}
