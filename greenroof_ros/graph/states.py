"""The words that nodes and their observers share: roles, and states of a node. Needs no ROS."""

from __future__ import annotations

# The states of a node: it waits for its peers; they are there; the run is over; it ends.
STARTING, READY, FINISHED, ENDED = STATES = ("starting", "ready", "finished", "ended")

# Roles in the interface that code treats specially, and how to name one whose node is not known.
PLANT, PUMP, RECORDER = "plant", "pump", "recorder"
ROLES = {"controller": "the controller", PUMP: "the pump driver"}
