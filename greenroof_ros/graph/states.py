"""The words of :mod:`greenroof_ros.common.states`."""

from greenroof_ros.common.states import (
    ENDED,
    FINISHED,
    PLANT,
    PUMP,
    PUMP_STATES,
    READY,
    RECORDER,
    ROLES,
    STARTING,
    STATES,
    DriveState,
    PumpState,
)

__all__ = [
    "ENDED", "FINISHED", "PLANT", "PUMP", "PUMP_STATES", "READY", "RECORDER", "ROLES", "STARTING",
    "STATES", "DriveState", "PumpState",
]
