"""The words that nodes and their observers share: roles and states. Needs no ROS."""

from __future__ import annotations

import enum
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

# The states of a node: it waits for its peers; they are there; the run is over; it is ending.
STARTING, READY, FINISHED, ENDED = STATES = ("starting", "ready", "finished", "ended")

# Roles in the interface that the code treats specially, and how to call one whose node is unknown.
PLANT, PUMP, RECORDER = "plant", "pump", "recorder"
ROLES = {"controller": "the controller", PUMP: "the pump driver"}


class DriveState(enum.Enum):
    """Whether the pump node can run its drive: the state of the node."""

    CONNECTING = "connecting"  # the drive does not answer
    REFUSED = "refused"  # nothing might stop it: its own timeout, or a state that is not saved
    READY = "ready"
    STOPPED = "stopped"  # someone holds the pump
    FAULT = "fault"  # a fault is latched, or it is unknown whether there was one


PUMP_STATES = ("off", "starting", "running", "stopping", "held", "fault", "unknown")


@dataclass(frozen=True)
class PumpState:
    """What a pump is doing: the content of /pump/state, a JSON object.

    Attributes:
        state: one of ``PUMP_STATES``.
        why: the reason, for people.
        codes: codes of the conditions that keep the pump off, the decisive one first.
    """

    state: str = "unknown"
    why: str = ""
    codes: Sequence[str] = ()

    def __str__(self) -> str:
        return f"{self.state}: {self.why}" if self.why else self.state

    def message(self) -> str:
        """Return the state as it is published on the topic."""
        return json.dumps(asdict(self), ensure_ascii=False)

    @classmethod
    def read(cls, message: str) -> PumpState:
        """Return a message's content; if malformed, an unknown state with its text as reason."""
        try:
            content = json.loads(message)
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict) or content.get("state") not in PUMP_STATES:
            return cls(why=message)
        codes = content.get("codes")
        return cls(
            content["state"], str(content.get("why", "")),
            tuple(map(str, codes)) if isinstance(codes, list) else (),
        )
