"""What a node says of itself, and where a started node says it to the process that started it."""

from __future__ import annotations

# The states of a node: not all its peers are there; they are; the run is over; so is the process.
STARTING, READY, FINISHED, ENDED = STATES = ("starting", "ready", "finished", "ended")

# What to call the node that has a role of the interface, where its name is not known.
ROLES = {"controller": "the controller", "pump": "the pump driver"}

# The environment variable that holds the file descriptor to which a started node writes its
# reports, one JSON object a line with the key "state".
REPORT_PIPE = "GREENROOF_ROS_REPORT_PIPE"
