"""Reports on the state of a node and its parts on /diagnostics, and the heartbeat to bringup."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node

from greenroof_ros.base.times import iso
from greenroof_ros.interface.conditions import Diagnosis, Value, identity_of
from greenroof_ros.interface.states import DriveState
from greenroof_ros.live.heartbeat import send_beat
from greenroof_ros.ros.diagnostics import NodeDiagnostics

# The levels of a diagnosis, as ROS tools know them.
OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN
ERROR, STALE = DiagnosticStatus.ERROR, DiagnosticStatus.STALE
# How often the state is published while it does not change (s).
_PUBLISH_S = 1.0


@dataclass(frozen=True)
class PartStatus:
    """The state of a part of a node.

    Attributes:
        level: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
        message: the state, as a sentence.
        code: condition code, for programs; empty if all is well.
        cause: code of the cause; empty if unknown.
        since: time at which the current code appeared, on the system clock (s since 1970).
        began: time at which the current code appeared, on the steady clock (s).
        values: values that occur in the sentence.
    """

    level: bytes
    message: str
    code: str
    cause: str
    since: float
    began: float
    values: Mapping[str, Value] = field(default_factory=dict)

    def for_programs(self) -> dict[str, str]:
        """Return the values for programs, without unknown values.

        The result contains the values in the sentence, the code, the time at which the code
        appeared (ISO 8601), its duration (s), and the cause.
        """
        values = {
            key: f"{value:.6g}" if isinstance(value, (float, int)) else str(value)
            for key, value in self.values.items()
        }
        if self.code:
            age = time.monotonic() - self.began
            values |= {"code": self.code, "since": iso(self.since), "age_s": f"{age:.1f}"}
        if self.cause:
            values["cause"] = self.cause
        return {key: value for key, value in values.items() if value}


class LiveDiagnostics(NodeDiagnostics):
    """Reporter of the state of a node and its parts, which also sends the heartbeat to bringup.

    The status of a part is named after the node and the part: ``/mpc: inputs``.

    Attributes:
        diagnoses: diagnoses of the node's parts, by their names.
        hardware: device to which the parts belong; empty if they belong to the computer itself.
        urgent: whether a diagnosis has changed since the last report.
    """

    def __init__(self, node: Node, role: str) -> None:
        """Open the topic; for the arguments see the base class."""
        super().__init__(node, role)
        self.diagnoses: dict[str, PartStatus] = {}
        self.hardware = ""
        self.urgent = False
        self._published: tuple[object, ...] = ()
        self._published_at = 0.0

    def diagnose(
        self, part: str, diagnosis: Diagnosis | None, well: str = "", level: bytes = ERROR,
        cause: str = "", *, log: bool = True,
    ) -> None:
        """Set the diagnosis of a part; a change is logged, and reported shortly afterward.

        Args:
            part: name of the part.
            diagnosis: diagnosis of the part; None if nothing is wrong.
            well: sentence to report if nothing is wrong.
            level: ``WARN``, ``ERROR`` or ``STALE``, or ``OK`` if the condition is intended.
            cause: code of the cause; empty if unknown.
            log: whether to log a change; false for a message that changes too often.
        """
        before = self.diagnoses.get(part)
        if diagnosis is None:
            diagnosis, level = Diagnosis("", well), OK
        since, began = time.time(), time.monotonic()
        if before is not None and identity_of({**before.values, "code": before.code}) == (
            identity_of({**diagnosis.values, "code": diagnosis.code})
        ):
            since, began = before.since, before.began
        status = self.diagnoses[part] = PartStatus(
            level, diagnosis.sentence, diagnosis.code, cause, since, began, diagnosis.values,
        )
        if not log or status == before:
            return
        self.urgent = True
        logger = self._node.get_logger()
        if level == WARN:
            logger.warning(status.message)
        elif level != OK:
            logger.error(status.message)
        elif before is not None:
            logger.info(status.message)

    def publish(self, values: dict[str, Any]) -> None:
        """Report the state of the node with these values, and the states of its parts.

        Every report is a heartbeat, since bringup must quickly notice when a node hangs. On
        /diagnostics, a report is published if a state, level or diagnosis changes, and otherwise
        once a second.
        """
        self.urgent = False
        status, values = self.status(values)
        send_beat(values.get("drive_state") not in (None, DriveState.CONNECTING.value))
        programs = {
            part: diagnosis.for_programs() for part, diagnosis in self.diagnoses.items()
        }
        now = time.monotonic()
        published = self.state, status.level, values.get("code"), *(
            (part, diagnosis.level, identity_of(programs[part]))
            for part, diagnosis in self.diagnoses.items()
        )
        if published == self._published and now - self._published_at < _PUBLISH_S:
            return
        self._published, self._published_at = published, now
        self.send([status, *(
            DiagnosticStatus(
                level=diagnosis.level, name=f"{status.name}: {part}", message=diagnosis.message,
                hardware_id=self.hardware or self.machine,
                values=[KeyValue(key=key, value=value) for key, value in programs[part].items()],
            )
            for part, diagnosis in self.diagnoses.items()
        )])
