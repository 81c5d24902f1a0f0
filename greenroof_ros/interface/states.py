"""Roles and states shared by nodes and their observers; this module does not import ROS."""

from __future__ import annotations

import enum
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

# The states of a node: it waits for its peers; they are there; the run is over; it is ending.
STARTING, READY, FINISHED, ENDED = STATES = ("starting", "ready", "finished", "ended")

# Roles in the interface that the code treats specially.
PLANT, PUMP, RECORDER, VALVE = "plant", "pump", "recorder", "valve"

EXTERNAL = "external"
"""stands for a node that the user runs; a controller's parameters are then those of forecasts"""


class DriveState(enum.Enum):
    """States of the pump node, that is, of its ability to run the drive."""

    CONNECTING = "connecting"  # the drive does not answer
    REFUSED = "refused"  # nothing might stop it: its own timeout, or a state that is not saved
    READY = "ready"


PUMP_STATES = ("off", "starting", "running", "stopping", "held", "fault", "unknown")
VALVE_STATES = ("closed", "opening", "open", "closing", "held", "fault", "unknown")


@dataclass(frozen=True)
class ActuatorState:
    """The state of an actuator, published as a JSON object on /pump/state or /outlet/state.

    Attributes:
        state: one of ``PUMP_STATES`` or ``VALVE_STATES``.
        why: the reason, as readable text.
        codes: codes of the conditions that keep the actuator off, starting with the decisive one.
    """

    state: str = "unknown"
    why: str = ""
    codes: Sequence[str] = ()

    def __str__(self) -> str:
        return f"{self.state}: {self.why}" if self.why else self.state

    def message(self) -> str:
        """Return the state as the message that is published on the topic."""
        return json.dumps(asdict(self), ensure_ascii=False)

    @classmethod
    def read(cls, message: str) -> ActuatorState:
        """Return the state in a message, or an unknown state with the text if malformed."""
        try:
            content = json.loads(message)
        except (ValueError, RecursionError):
            content = None
        known = {*PUMP_STATES, *VALVE_STATES}
        if not isinstance(content, dict) or str(content.get("state")) not in known:
            return cls(why=message)
        codes = content.get("codes")
        return cls(
            content["state"], str(content.get("why", "")),
            tuple(map(str, codes)) if isinstance(codes, list) else (),
        )
