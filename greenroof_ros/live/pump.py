"""The pump node of a live site, which turns /pump/command into commands to a drive or a relay.

Ten times a second, the node decides on the latest values, and allows the pump to run only if these
values are up to date and valid. The node connects to the drive automatically, and does not run the
pump unless the drive's own communication timeout would stop the pump if this node failed.
/pump/flow is published every tau of the site, and /pump/state whenever it changes.

:mod:`greenroof_ros.live.actuator` describes the services ``~/stop``, ``~/release``, ``~/hold``,
``~/clear`` and ``~/reset``. If the site file allows doses, ``~/dose``
(rcl_interfaces/SetParametersAtomically: ``volume`` in m3, and ``asked_at``, the current time in s
since 1970) delivers a volume once, or returns the reason for rejecting the request.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math
import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.actuator import COMMAND, FLOW, STATE, STATE_FILE, ActuatorNode, read_fields
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.devices.drive_file import LIMIT_S, MAX_RAMP_S, find_drive_file
from greenroof_ros.live.devices.exchange import (
    CHOICE,
    RESET_S,
    UNREAD_S,
    DriveExchange,
    DriveSnapshot,
    read_endpoint,
)
from greenroof_ros.live.levels import Levels, live_parameters
from greenroof_ros.live.live_input import bad_inputs
from greenroof_ros.live.node import live_command
from greenroof_ros.live.pumping.interlocks import Decision
from greenroof_ros.live.pumping.limits import Observation, PumpSettings, pump_parameters
from greenroof_ros.live.pumping.pump_control import PumpControl
from greenroof_ros.physics.pump import STANDSTILL
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.parameters import site_file
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.site.site import Site

# No pump delivers at a lower speed, as a share of its rated speed.
_MIN_SPEED = 0.05
_OWN = (
    *CHOICE,
    Parameter(
        "drive_timeout_limit", LIMIT_S, "s", 0.1, 60.0, "maximum permitted value of the drive's "
            "own communication timeout",
    ),
    Parameter(
        "local_settings_stop_the_pump", False, meaning="confirmation that the drive has been set "
            "to stop the pump when the bus connection is lost, and that the pump was observed to "
            "stop in a test; must be true if that setting cannot be read",
    ),
    STATE_FILE,
)
# Topics of the inputs, by the fields of Observation; the pump can run without a flow. The code of
# the interlock while another input is unknown is its name with _unknown.
_INPUTS = {
    "command": COMMAND,
    "cistern_level": "/cistern/level",
    "roof_level": "/roof/level",
    "frost": "/weather/frost",
    "flow": "/pump/meter",
}
# The parts that report on inputs, as in the interlocks of the table.
_INPUT_PARTS = {
    "command": ("command",), "levels": ("cistern_level", "roof_level"), "frost": ("frost",),
}
# The codes that need nobody at once.
_WARNINGS = {"drive_local", "second_master", "start_failed", "drive_guards_later"}
# The fields of a request for a dose.
_DOSE = (
    Parameter("volume", 0.0, "m3", meaning="the volume", optional=False),
    Parameter("asked_at", 0.0, "s", meaning="its time (s since 1970)", optional=False),
)


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(), *_OWN, *pump_parameters(site),
        *live_parameters(_INPUTS.values()),
    ]


class PumpNode(ActuatorNode):
    """Node that runs the pump of a live site as commanded, unless an interlock is active."""

    def __init__(self) -> None:
        """Declare the parameters, and open the topics and services.

        Raises:
            ConfigurationError: if a parameter or the drive file is invalid.
        """
        super().__init__("pump", parameters)
        values = self.values
        endpoint = read_endpoint(
            find_drive_file(values["drive"]), values["address"],
            f"parameter address of {self.get_name()}", values["broker_login"],
            values["broker_authority"],
        )
        self._exchange = DriveExchange(
            endpoint, timeout_limit_s=values["drive_timeout_limit"],
            stops_locally=values["local_settings_stop_the_pump"],
        )
        self.reports.hardware = f"{endpoint.file}, {endpoint}"
        settings = {setting.name: values[setting.name] for setting in pump_parameters(self.site)}
        self._control = PumpControl(
            self.site,
            PumpSettings(min_speed=max(_MIN_SPEED, endpoint.file.min_speed), **settings),
            self.state_file,
            # Time after which a drive that does not respond is stopped (s).
            drive_stops_after=UNREAD_S + values["drive_timeout_limit"] + MAX_RAMP_S,
        )
        self._resetting_until = -math.inf
        self._levels = Levels(self.site, values, self.subscribe)
        for topic in _INPUTS.values():
            if topic not in self.inputs:
                self.subscribe(topic, optional=topic == _INPUTS["flow"])
        self._flows = self.subscribe(FLOW, optional=True).publishers
        self.open_outputs(FLOW, STATE)
        self.open_service("dose", SetParametersAtomically, self._dose)

    # --- requests ---------------------------------------------------------------------------------

    def switch_off(self) -> str:
        """Stop the drive, even during a silence."""
        self._exchange.stop()
        return ""

    def discard_evidence(self, checked: bool = False) -> None:
        """Forget what led to a fault; acknowledge the drive's, which does not count until then."""
        self._control.discard_evidence()
        if checked:
            self._exchange.reset()
            self._resetting_until = boot_time() + RESET_S

    def _dose(self, request: SetParametersAtomically.Request) -> tuple[bool, str]:
        fields = read_fields("dose", request, _DOSE)
        self.decide()  # a reason against the dose may have just arrived
        refusal = self._control.doses.request(fields["asked_at"], fields["volume"], time.time())
        return not refusal, refusal or self.decide()

    # --- by the clock -----------------------------------------------------------------------------

    def on_start(self) -> None:
        """Connect to the drive."""
        self._exchange.start()

    def on_inputs(self) -> None:
        """Publish the flow."""
        flow = self.decision.flow or 0.0  # a number for every tick, also if it is unknown
        if self._levels.cistern.good and self._levels.roof.good:
            self._levels.expect(flow)
        self.publish(FLOW, flow)

    def on_stop(self) -> None:
        """Stop the drive and confirm that it is stopped, whatever ends the node.

        Raises:
            OSError: if the stop could not be confirmed; the node's exit code then also indicates
                this.
        """
        try:
            if self._exchange.started:
                self._exchange.close()
                self.get_logger().info(self._exchange.outcome())
        finally:
            super().on_stop()

    # --- the pump ---------------------------------------------------------------------------------

    def step(self, dt: float) -> Decision:
        """Decide based on the present observations, and command the drive."""
        now, snapshot = boot_time(), self._exchange.snapshot
        # Nobody has observed anything in a pause.
        observed = Observation() if dt > PAUSE_S else self._observe(snapshot, now)
        decision = self._control.step(dt, observed)
        self._exchange.flows_at_rest = (
            decision.request is None and not decision.at_rest
            and decision.speed is not None and abs(decision.speed) <= STANDSTILL
        )
        self._exchange.request_speed(decision.request)
        return decision

    def _observe(self, snapshot: DriveSnapshot, now: float) -> Observation:
        status = snapshot.status_at(now)
        values = {
            name: float(entry.value) if self.acted and (entry := self.inputs[topic]).good else None
            for name, topic in _INPUTS.items()
        }
        if values["flow"] is None and status is not None:
            values["flow"] = status.flow
        return Observation(
            **values,
            displacements=self._levels.displacements,
            time_ns=time.time_ns(),
            speed=None if status is None else status.speed,
            reasons=[reason for _, reason in self._reasons(snapshot, now)],
        )

    def _reasons(self, snapshot: DriveSnapshot, now: float) -> Iterator[tuple[str, Diagnosis]]:
        """Yield this node's own reasons for keeping the pump off, each with the part it is about.

        The most important reason of a part comes first.
        """
        # Another pump node may use the same drive; then neither runs it.
        if conflict := self._flows.describe_conflict():
            yield "flow", Diagnosis.of("two_pumps", topic=self._flows.full_name, problem=conflict)
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

    # --- reports ----------------------------------------------------------------------------------

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup shows and waits for."""
        doses, dose = self._control.doses, self._control.doses.last
        return {
            **super().progress(),
            "max_dose": self.site.max_dose, "min_dose": doses.minimum,
            "no_dose": "the pump must not run now" if self.decision.active else doses.refusal,
            "dose": None if dose is None else {**asdict(dose), "sentence": dose.sentence},
        }

    def report(self) -> None:
        """Report on every part of the node."""
        super().report()
        diagnose, endpoint = self.reports.diagnose, self._exchange.endpoint
        for part, names in _INPUT_PARTS.items():
            bad = bad_inputs(self.inputs[_INPUTS[name]] for name in names)
            diagnose(part, bad, "the latest value is used")
        if unverified := ", ".join(endpoint.file.unverified):
            diagnose("drive file", Diagnosis.of(
                "drive_file_unverified", file=str(endpoint.file.path), settings=unverified
            ), level=WARN)
        snapshot, now = self._exchange.snapshot, boot_time()
        found = dict(reversed([*self._reasons(snapshot, now)]))
        well = {"flow": "this is the only pump node", "drive": f"connected to {endpoint.file}"}
        if snapshot.status_at(now) is not None:  # otherwise the timeout stays as it was
            after = snapshot.timeout_s or 0.0
            well["drive timeout"] = f"if this computer fails, the drive stops after {after:g} s"
        for part, words in well.items():
            reason = found.get(part)
            warns = reason is not None and reason.code in _WARNINGS
            diagnose(part, reason, words, WARN if warns else ERROR)


main = live_command(PumpNode, __doc__)


if __name__ == "__main__":
    main()
