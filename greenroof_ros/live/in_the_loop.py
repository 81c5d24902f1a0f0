"""A drive in the loop of a simulated run: the pump node in place of the simulated pump."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from greenroof_ros.common.command_line import EXIT_FAILED
from greenroof_ros.common.processes import Signals
from greenroof_ros.common.standard_error import print_line
from greenroof_ros.experiment.incidents import INCIDENTS, IncidentLog
from greenroof_ros.experiment.progress import RunProgress
from greenroof_ros.graph.states import PUMP
from greenroof_ros.live.drive_choice import DriveChoice
from greenroof_ros.live.supervisor import START_LIMIT_S, NodeFailed, NodeStart, Supervisor

PUMP_NODE = "greenroof_ros.live.loop_pump"
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


class DriveInLoop:
    """The pump node of a simulated run, a process of its own, which runs a drive.

    Used in a ``with`` statement, which begins when the drive can run, and stops the drive at its
    end, regardless of what the pump node reported.

    Attributes:
        log: the incidents of the drive.
        may_run: a warning that the pump may still run after the end; empty if it is stopped.
    """

    def __init__(
        self, drive: DriveChoice, parameters: Mapping[str, Any], directory: Path,
        files: Sequence[Path], namespace: str, signals: Signals, progress: RunProgress,
    ) -> None:
        """Start nothing yet.

        Args:
            drive: the drive.
            parameters: of the pump node.
            directory: of the run.
            files: ROS 2 parameter files; later files override earlier ones.
            namespace: such as ``/site1``; empty for none.
            signals: end the run.
            progress: shows the run.
        """
        self.log = IncidentLog(progress.print_line, directory / INCIDENTS)
        self._state_file = parameters["state_file"]
        self._signals, self._progress = signals, progress
        (directory / "log").mkdir()
        self._supervisor = Supervisor(
            directory / "log", files, namespace, drive.stopper(),
            lambda node, problem: print_line(f"{node}: {problem}"),
        )

    @property
    def may_run(self) -> str:
        """A warning that the pump may still run after the end; empty if it is stopped."""
        return self._supervisor.may_run

    def __enter__(self) -> DriveInLoop:
        """Start the pump node, and wait until it can run its drive.

        So no run starts that cannot pump. A stop or fault latched in an earlier run keeps the pump
        off in this one; a warning states this.

        Raises:
            NodeFailed: the node ended or hangs, or the drive could not be run within 60 s.
            InterruptedRun: a signal came.
        """
        with ExitStack() as ends:
            ends.enter_context(self._supervisor)
            self._supervisor.start(NodeStart(PUMP, PUMP_NODE))
            self._wait_for_drive()
            ends.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """End the pump node, and stop the drive."""
        self._signals.ignore()
        self._supervisor.__exit__(None, None, None)

    def check(self, tick: int) -> None:
        """Read the pump node's reports, and check that it runs.

        Args:
            tick: of the run; -1 before the first.

        Raises:
            NodeFailed: the pump node ended or hangs.
        """
        supervisor = self._supervisor
        supervisor.read_reports(0.0)
        self.log.update(supervisor.last, tick)
        for report in supervisor.last.values():
            self._progress.warn(report["warnings"])
        self._check_node()

    def _check_node(self) -> None:
        """Check that the pump node runs; print its last lines if it does not.

        Raises:
            NodeFailed: it ended or hangs.
        """
        try:
            self._supervisor.check(START_LIMIT_S)
        except NodeFailed as error:
            self._progress.print_line(error.last_lines)
            raise NodeFailed(error.reason, "", error.code) from error

    def _wait_for_drive(self) -> None:
        supervisor, progress = self._supervisor, self._progress
        progress.print_line(f"holds and faults of the drive are kept in {self._state_file}")
        until = time.monotonic() + _DRIVE_LIMIT_S
        report: dict[str, Any] = {}
        while not report.get("active"):
            self._signals.check()
            supervisor.read_reports(0.1)
            report = supervisor.last.get(PUMP, {})
            diagnoses = report.get("diagnoses", {})
            trouble = "; ".join(
                diagnoses[part]["message"] for part in ("drive", "drive timeout", "state file")
                if part in diagnoses and diagnoses[part]["level"] != "OK"
            )
            progress.waiting(f"waiting for the drive: {trouble or 'the pump node starts'}")
            self._check_node()
            if time.monotonic() > until:
                raise NodeFailed(
                    f"the drive cannot be run, after {_DRIVE_LIMIT_S:g} s: {trouble}; check its "
                    "power and cable, and the address of --drive-at", "", EXIT_FAILED,
                )
        hold = report.get("hold") or {}
        kept_off = report.get("fault") or report.get("unknown") or hold.get("said")
        if kept_off:
            progress.print_line(
                f"warning: {self._state_file} keeps the pump off: {kept_off}; a fault is cleared "
                "by greenroof reset, a hold by greenroof release; another drive needs "
                "--state DIR"
            )
