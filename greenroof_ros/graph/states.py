"""What a node says of itself, and where a started node says it to the process that started it."""

from __future__ import annotations

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
# times a second, whether it may run: one JSON object a line, with the key "hold", empty or why it
# may not, and "at", the time since the machine started (CLOCK_BOOTTIME, s) at which that was so.
PERMIT_PIPE = "GREENROOF_ROS_PERMIT_PIPE"
