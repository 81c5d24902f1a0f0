"""The inputs of the pump node, and all the values available to its control at a step.

A new input requires a row and a field in this module, its topic with the maximum age in
``msg_defs/topics.yaml``, and its conditions in ``msg_defs/conditions.yaml``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from greenroof_ros.interface.conditions import Diagnosis

INPUTS = {
    "command": "/pump/command",
    "cistern_level": "/cistern/level",
    "roof_level": "/roof/level",
    "frost": "/weather/frost",
    "flow": "/pump/meter",
}
"""Topics of the inputs, by the fields of :class:`Observation`; the pump can run without a flow. The
code of the interlock while another input is unknown is its name with ``_unknown``."""


@dataclass(frozen=True)
class Observation:
    """Observations at a step; None stands for a value that is unknown or too old.

    Attributes:
        command: share of the maximum flow, as received.
        cistern_level: level of the cistern (m).
        roof_level: level of the roof (m).
        displacements: total displacements of both readings by jumps that water cannot cause (m).
        frost: frost signal: 1 if there is frost, otherwise 0.
        time_ns: system time (ns since 1970).
        speed: speed of the drive, as a share of the rated speed; negative if the pump turns
            backwards.
        flow: flow that a flow meter or, without one, the drive measures (m3/s).
        drive_ready: whether the drive is running, or would run if requested.
        drive_fault: the drive's fault, as text; empty if there is none.
        runs_on: whether the fault means that the drive does not obey a stop.
        reasons: the pump node's own reasons for keeping the pump off.
    """

    command: float | None = None
    cistern_level: float | None = None
    roof_level: float | None = None
    displacements: tuple[float, float] = (0.0, 0.0)
    frost: float | None = None
    time_ns: int = 0
    speed: float | None = None
    flow: float | None = None
    drive_ready: bool = False
    drive_fault: str = ""
    runs_on: bool = False
    reasons: Sequence[Diagnosis] = ()
