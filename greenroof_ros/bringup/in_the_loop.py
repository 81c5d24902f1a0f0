"""Hardware in the loop: what a run with a real or simulated drive has beside a simulated one."""

from __future__ import annotations

import sys
import time

from greenroof_ros.bringup.drive import DriveChoice
from greenroof_ros.common.command_line import EXIT_FAILED
from greenroof_ros.common.signals import Signals
from greenroof_ros.experiment.progress import RunProgress
from greenroof_ros.experiment.run import Run
from greenroof_ros.graph.node_processes import NodeFailed
from greenroof_ros.graph.states import PUMP
from greenroof_ros.graph.supervisor import Supervisor

# How long a drive may take until it may run (s); an ABB's timeout guards 30 s after power-up only.
_DRIVE_LIMIT_S = 60.0


def speed_of(asked: float | None, drive: DriveChoice | None) -> float:
    """Return the simulated time per wall time; 0 for as fast as it goes, which no drive does."""
    if asked is not None:
        return asked
    return 0.0 if drive is None else 1.0


def exchange_period(run: Run, speed: float) -> float:
    """Return the time between two rounds of requests to the drive (s): a tick, within limits."""
    return min(max(run.site.tau / speed, 0.02), 0.1) if speed else 0.02


def wait_for_drive(
    supervisor: Supervisor, signals: Signals, state_file: str, progress: RunProgress,
    start_limit_s: float,
) -> None:
    """Wait until the pump node may run its drive: no run begins that could not pump.

    What was latched in another run holds the pump in this one, and is said.

    Raises:
        NodeFailed: it ended, or something speaks against the drive for too long.
        InterruptedRun: a signal came.
    """
    until = time.monotonic() + _DRIVE_LIMIT_S
    while not supervisor.last.get(PUMP, {}).get("active"):
        signals.check()
        supervisor.permit.tell("waiting for nodes")
        supervisor.reports()
        said = supervisor.last.get(PUMP, {}).get("diagnoses", {})
        trouble = "; ".join(
            message for part in ("drive", "drive timeout", "state file")
            for level, message, _ in [said.get(part, ("OK", "", ""))] if level != "OK"
        )
        progress.waiting(f"waiting for the drive: {trouble or 'the pump node starts'}")
        supervisor.check(start_limit_s)
        if time.monotonic() > until:
            reason = (
                f"the drive cannot be run, after {_DRIVE_LIMIT_S:g} s: {trouble}; check its power "
                "and cable, and the address of --drive-at"
            )
            raise NodeFailed(reason, "", EXIT_FAILED, [PUMP], "no drive")
    said = supervisor.last[PUMP]
    latched = said.get("fault") or said.get("held")
    if latched:
        print(
            f"warning: the pump stays off, by {state_file}: {latched}; a fault is cleared by the "
            "service /pump/reset, a stop by /pump/stop with false, and --state DIR is another's",
            file=sys.stderr,
        )
