"""What the nodes with a drive or a relay have in common: its connection, reasons and reports."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.actuator import ActuatorNode
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.devices.drive_file import LIMIT_S, find_drive_file
from greenroof_ros.live.devices.exchange import (
    CHOICE,
    RESET_S,
    DriveExchange,
    DriveSnapshot,
    read_endpoint,
)
from greenroof_ros.live.live_input import bad_inputs
from greenroof_ros.physics.pump import STANDSTILL
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.site.site import Site

TIMEOUT_LIMIT = Parameter(
    "drive_timeout_limit", LIMIT_S, "s", 0.1, 60.0, "maximum value of the drive's own "
        "communication timeout",
)
LOCAL_SETTINGS = Parameter(
    "local_settings_stop_the_pump", False, meaning="confirmation that the drive stopped the "
        "pump in a test when the bus was lost, if its settings cannot be read",
)
DRIVE_PARAMETERS = (*CHOICE, TIMEOUT_LIMIT, LOCAL_SETTINGS)
# The codes that need nobody at once.
_WARNINGS = {"drive_local", "second_master", "start_failed", "drive_guards_later"}


class DriveNode(ActuatorNode):
    """A node that drives its actuator over Modbus, or switches it with a relay over MQTT.

    Attributes:
        observed: topics of the observations, by the names of their fields.
        parts: names of the observations that each part of the node reports on.
    """

    observed: Mapping[str, str]
    parts: Mapping[str, Sequence[str]]

    def __init__(
        self, name: str, role: str, parameters: Callable[[Site], Iterable[Parameter]]
    ) -> None:
        """Prepare the connection; see :class:`ActuatorNode`.

        Raises:
            ConfigurationError: if a parameter or the drive file is invalid.
        """
        super().__init__(name, role, parameters)
        values = self.values
        self.endpoint = read_endpoint(
            find_drive_file(values["drive"]), values["address"],
            f"parameter address of {self.get_name()}", values["broker_login"],
            values["broker_authority"],
        )
        self.exchange = DriveExchange(
            self.endpoint, timeout_limit_s=values[TIMEOUT_LIMIT.name],
            stops_locally=values[LOCAL_SETTINGS.name],
        )
        self.reports.hardware = f"{self.endpoint.file}, {self.endpoint}"
        self._resetting_until = -math.inf

    def observe(self) -> dict[str, float | None]:
        """Return the latest value of every observation, by its name; None if it is unknown."""
        return {
            name: float(entry.value) if self.acted and (entry := self.inputs[topic]).good else None
            for name, topic in self.observed.items()
        }

    def switch_off(self) -> str:
        """Stop the drive, even during a silence."""
        self.exchange.stop()
        return ""

    def reset_drive(self) -> None:
        """Acknowledge the drive's fault, which does not count until then."""
        self.exchange.reset()
        self._resetting_until = boot_time() + RESET_S

    def on_start(self) -> None:
        """Connect to the drive."""
        self.exchange.start()

    def on_stop(self) -> None:
        """Stop the drive and confirm that it is stopped, whatever ends the node.

        Raises:
            OSError: if the stop could not be confirmed; the node's exit code then also indicates
                this.
        """
        try:
            if self.exchange.started:
                self.exchange.close()
                self.get_logger().info(self.exchange.outcome())
        finally:
            super().on_stop()

    def drive_reasons(
        self, snapshot: DriveSnapshot, now: float
    ) -> Iterator[tuple[str, Diagnosis]]:
        """Yield the drive's reasons for keeping the actuator off, each with the part it is about.

        The most important reason of a part comes first.
        """
        status = snapshot.status_at(now)
        if status is None:
            problem = snapshot.problem or f"it has not responded for {LIMIT_S:g} s"
            yield "drive", Diagnosis.of("drive_lost", problem=problem)
        # A fault that is being acknowledged does not count, unless the pump turns backwards.
        elif now < self._resetting_until and (status.speed or 0.0) >= -STANDSTILL:
            pass
        elif status.fault and status.runs_on:
            yield "drive", Diagnosis.of("runs_on", "drive", fault=status.fault)
        elif status.fault:
            yield "drive", Diagnosis.of("drive_fault", fault=status.fault)
        if status is not None and not status.remote:
            yield "drive", Diagnosis.of("drive_local", "local")
        for reason in filter(None, (snapshot.second_master, snapshot.start_failed)):
            yield "drive", reason
        if status is not None and not status.ready and not status.running:
            yield "motor", Diagnosis.of("drive_not_ready")
        # Nothing might stop it if this computer failed, or nothing keep it off after a restart.
        if status is not None and snapshot.unguarded:
            yield "drive timeout", snapshot.unguarded
        if not self.state_file.saved:
            why = self.state_file.problem or "the state is not saved yet"
            yield "state file", Diagnosis.of("state_not_kept", why=why)

    def report_parts(self, reasons: Iterable[tuple[str, Diagnosis]], **well: str) -> None:
        """Report on the inputs and on the drive.

        Args:
            reasons: the reasons, as from :meth:`drive_reasons`.
            well: what is reported about each further part, if there is no reason about it.
        """
        for part, names in self.parts.items():
            topics = [self.observed[name] for name in names if name in self.observed]
            bad = bad_inputs(self.inputs[topic] for topic in topics)
            self.reports.diagnose(part, bad, "the latest value is used")
        file, snapshot = self.endpoint.file, self.exchange.snapshot
        if unverified := ", ".join(file.unverified):
            self.reports.diagnose("drive file", Diagnosis.of(
                "drive_file_unverified", file=str(file.path), settings=unverified
            ), level=WARN)
        found, told = dict(reversed([*reasons])), {**well, "drive": f"connected to {file}"}
        if snapshot.status_at(boot_time()) is not None:  # otherwise the timeout stays as it was
            after = snapshot.timeout_s or 0.0
            told["drive timeout"] = f"if this computer fails, the drive stops after {after:g} s"
        for part, words in told.items():
            reason = found.get(part)
            warns = reason is not None and reason.code in _WARNINGS
            self.reports.diagnose(part, reason, words, WARN if warns else ERROR)
