"""A drive in the loop of a simulated run: pump node parameters, and waiting for the drive."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from greenroof_ros.bringup.drive import DriveChoice
from greenroof_ros.common.command_line import EXIT_FAILED
from greenroof_ros.common.processes import Signals
from greenroof_ros.experiment.progress import RunProgress
from greenroof_ros.graph.supervision import PUMP
from greenroof_ros.graph.supervisor import START_LIMIT_S, NodeFailed, Supervisor

# How long a drive may take to be ready (s): an ABB's timeout is effective only from 30 s after
# power-up.
_DRIVE_LIMIT_S = 60.0


def drive_parameters(
    drive: DriveChoice, state: Path | None, tau: float, speed: float
) -> dict[str, Any]:
    """Return the parameters of the pump node.

    Args:
        drive: the drive that the node runs.
        state: directory for what must survive a restart; None for the drive's own.
        tau: the site's time step (s).
        speed: simulated time per wall time; 0 for as fast as possible.
    """
    return {
        **drive.parameters(drive.state_file(state)),
        # The time between two rounds of requests (s): a tick in wall time, from 0.02 to 0.1 s.
        "exchange_period": min(max(tau / speed, 0.02), 0.1) if speed else 0.02,
    }


def wait_for_drive(
    supervisor: Supervisor, signals: Signals, state_file: str, progress: RunProgress
) -> None:
    """Wait until the pump node can run its drive, so that no run starts that cannot pump.

    A stop or fault latched in an earlier run keeps the pump off in this one; a warning says so.

    Raises:
        NodeFailed: the node ended or hangs, or the drive could not be run within 60 s.
        InterruptedRun: a signal came.
    """
    progress.say(f"holds and faults of the drive are kept in {state_file}")
    until = time.monotonic() + _DRIVE_LIMIT_S
    report: dict[str, Any] = {}
    while not report.get("active"):
        signals.check()
        supervisor.permit("waiting for nodes")
        supervisor.listen()
        report = supervisor.last.get(PUMP, {})
        diagnoses = report.get("diagnoses", {})
        trouble = "; ".join(
            diagnoses[part]["message"] for part in ("drive", "drive timeout", "state file")
            if part in diagnoses and diagnoses[part]["level"] != "OK"
        )
        progress.waiting(f"waiting for the drive: {trouble or 'the pump node starts'}")
        supervisor.check(START_LIMIT_S)
        if time.monotonic() > until:
            raise NodeFailed(
                f"the drive cannot be run, after {_DRIVE_LIMIT_S:g} s: {trouble}; check its power "
                "and cable, and the address of --drive-at", "", EXIT_FAILED,
            )
    hold = report.get("hold") or {}
    kept_off = report.get("fault") or report.get("unknown") or hold.get("said")
    if kept_off:
        progress.say(
            f"warning: {state_file} keeps the pump off: {kept_off}; a fault is cleared by the "
            "service /pump/reset, a hold by greenroof release; another drive needs --state DIR"
        )
