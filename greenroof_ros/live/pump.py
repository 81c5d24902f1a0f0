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

import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP
from greenroof_ros.live.actuator import COMMAND, DRIVE_PARAMETERS, FLOW, DriveNode, read_fields
from greenroof_ros.live.devices.drive_file import MAX_RAMP_S
from greenroof_ros.live.devices.exchange import DriveSnapshot
from greenroof_ros.live.live_input import Levels, LiveInput, live_parameters
from greenroof_ros.live.node import live_command
from greenroof_ros.live.pumping.interlocks import Decision
from greenroof_ros.live.pumping.limits import Observation, PumpSettings, pump_parameters
from greenroof_ros.live.pumping.pump_control import PumpControl
from greenroof_ros.physics.pump import STANDSTILL
from greenroof_ros.ros.parameters import site_file
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.site.site import Site

# No pump delivers at a lower speed, as a share of its rated speed.
_MIN_SPEED = 0.05
_POSITION = "/outlet/position"
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
# The fields of a request for a dose.
_DOSE = (
    Parameter("volume", 0.0, "m3", meaning="the volume", optional=False),
    Parameter("asked_at", 0.0, "s", meaning="its time (s since 1970)", optional=False),
)


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(), *DRIVE_PARAMETERS, *pump_parameters(site),
        *live_parameters([*_INPUTS.values(), *([_POSITION] if site.low_outlet_valve else [])]),
    ]


class PumpNode(DriveNode):
    """Node that runs the pump of a live site as commanded, unless an interlock is active."""

    observed, parts = _INPUTS, _INPUT_PARTS

    def __init__(self) -> None:
        """Declare the parameters, and open the topics and services.

        Raises:
            ConfigurationError: if a parameter or the drive file is invalid.
        """
        super().__init__(PUMP, PUMP, parameters)
        values = self.values
        settings = {setting.name: values[setting.name] for setting in pump_parameters(self.site)}
        self._control = PumpControl(
            self.site,
            PumpSettings(min_speed=max(_MIN_SPEED, self.endpoint.file.min_speed), **settings),
            self.state_file,
            # Time after which a drive that does not respond is stopped (s).
            drive_stops_after=self.stops_after_s + MAX_RAMP_S,
        )
        self._levels = Levels(self.site, values, self.subscribe)
        for topic in _INPUTS.values():
            if topic not in self.inputs:
                self.subscribe(topic, optional=topic == _INPUTS["flow"])
        self._outlet: LiveInput | None = None
        if self.site.low_outlet_valve:
            self._outlet = self.subscribe(_POSITION, optional=True)
        self._flows = self.subscribe(FLOW, optional=True).publishers
        self.open_outputs(FLOW)
        self.open_service("dose", SetParametersAtomically, self._dose)

    # --- requests ---------------------------------------------------------------------------------

    def discard_evidence(self, checked: bool = False) -> None:
        """Forget what led to a fault; acknowledge the drive's, which does not count until then."""
        self._control.discard_evidence()
        if checked:
            self.reset_drive()

    def _dose(self, request: SetParametersAtomically.Request) -> tuple[bool, str]:
        fields = read_fields("dose", request, _DOSE)
        self.decide()  # a reason against the dose may have just arrived
        refusal = self._control.doses.request(fields["asked_at"], fields["volume"], time.time())
        return not refusal, refusal or self.decide()

    # --- by the clock -----------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Publish the flow."""
        flow = self.decision.flow or 0.0  # a number for every tick, also if it is unknown
        if self._levels.cistern.good and self._levels.roof.good:
            self._levels.expect(flow)
        self.publish(FLOW, flow)

    # --- the pump ---------------------------------------------------------------------------------

    def step(self, dt: float) -> Decision:
        """Decide based on the present observations, and command the drive."""
        now, snapshot = boot_time(), self.exchange.snapshot
        # Nobody has observed anything in a pause.
        observed = Observation() if dt > PAUSE_S else self._observe(snapshot, now)
        decision = self._control.step(dt, observed)
        self.exchange.flows_at_rest = (
            decision.request is None and not decision.at_rest
            and decision.speed is not None and abs(decision.speed) <= STANDSTILL
        )
        self.exchange.request_speed(decision.request)
        return decision

    def _observe(self, snapshot: DriveSnapshot, now: float) -> Observation:
        status = snapshot.status_at(now)
        values = self.observe()
        if values["flow"] is None and status is not None:
            values["flow"] = status.flow
        return Observation(
            **values,
            displacements=self._levels.displacements,
            time_ns=time.time_ns(),
            speed=None if status is None else status.speed,
            outlet_closed=self._outlet is not None and self._outlet.good and not self._outlet.value,
            reasons=[reason for _, reason in self._reasons(snapshot, now)],
        )

    def _reasons(self, snapshot: DriveSnapshot, now: float) -> Iterator[tuple[str, Diagnosis]]:
        """Yield this node's own reasons for keeping the pump off, each with the part it is about.

        The most important reason of a part comes first.
        """
        # Another pump node may use the same drive; then neither runs it.
        if conflict := self._flows.describe_conflict():
            yield "flow", Diagnosis.of("two_pumps", topic=self._flows.full_name, problem=conflict)
        yield from self.drive_reasons(snapshot, now)

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
        reasons = self._reasons(self.exchange.snapshot, boot_time())
        self.report_parts(reasons, flow="this is the only pump node")


main = live_command(PumpNode, __doc__)


if __name__ == "__main__":
    main()
