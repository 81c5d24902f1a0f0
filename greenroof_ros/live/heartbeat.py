"""The heartbeat of a process of a live site: one byte, four times a second, on a pipe to bringup.

A pipe is used rather than a topic, since discovery can take seconds, and bringup must not miss a
process that hangs. This module does not require ROS.
"""

from __future__ import annotations

import os
from contextlib import suppress
from enum import IntFlag

from greenroof_ros.interface.states import RECORDER
from greenroof_ros.live.devices.sensor_file import QUANTITIES, TANKS

PIPE = "GREENROOF_ROS_HEARTBEAT"
"""environment variable with the file descriptor of the pipe's end, which does not block"""
NOT_REQUIRED = frozenset({
    RECORDER, *(quantity.node for section, quantity in QUANTITIES.items() if section not in TANKS)
})
"""nodes that the site can do without; a node that needs a gauge itself reports its absence"""


class Beat(IntFlag):
    """What a heartbeat says about the nodes of its process."""

    READY = 1  # every node that the pump needs is ready
    AT_REST = 2  # the pump is at rest: this has been read, or follows from the drive's timeout
    REACHED = 4  # the drive has been reached


# The state of each node of this process. A node enters when it is made, so that the process is not
# ready without it; the first heartbeat follows with its first report, since making it takes time.
states: dict[str, Beat] = {}


def send_beat(node: str, state: Beat) -> None:
    """Send the state of a node, together with the last states of this process's other nodes."""
    states[node] = state
    beat = Beat(0)
    for each in states.values():
        beat |= each
    if not all(Beat.READY in each for each in states.values()):
        beat &= ~Beat.READY
    if PIPE in os.environ:
        # A stopped bringup must not block the process, nor one that has ended end it.
        with suppress(BlockingIOError, BrokenPipeError):
            os.write(int(os.environ[PIPE]), bytes([beat]))
