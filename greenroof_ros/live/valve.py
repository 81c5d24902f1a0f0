"""The node of the outlet valve on a live site, which turns /outlet/command into openings.

The valve hangs on a relay, whose own timer closes it if this computer fails: on opens it, and off
closes it. Ten times a second, the node decides on the latest values, and lets the valve be open
only if these values are up to date and valid. /outlet/position and /outlet/flow are published every
tau of the site, and /outlet/state whenever it changes.

:mod:`greenroof_ros.live.actuator` describes the services ``~/stop``, ``~/release``, ``~/hold``,
``~/clear`` and ``~/reset``. ``~/open`` (rcl_interfaces/SetParametersAtomically: ``owner``, and
``until`` in s since 1970) opens the valve by hand until a time, or until an interlock becomes
active; a time that has passed ends this.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math
import time
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.states import VALVE
from greenroof_ros.live.actuator import DRIVE_PARAMETERS, FLOW, DriveNode, read_fields
from greenroof_ros.live.live_input import Levels, live_parameters
from greenroof_ros.live.node import live_command
from greenroof_ros.live.pumping.interlocks import Decision
from greenroof_ros.live.pumping.state_file import MAX_TIME
from greenroof_ros.live.pumping.valve_control import (
    ValveControl,
    ValveObservation,
    ValveSettings,
    valve_parameters,
)
from greenroof_ros.ros.diagnostics import WARN
from greenroof_ros.ros.parameters import site_file
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.site.site import Site

_POSITION, _OUTFLOW = "/outlet/position", "/outlet/flow"
# Topics of the inputs, by the fields of ValveObservation.
_INPUTS = {
    "command": "/outlet/command",
    "cistern_level": "/cistern/level",
    "frost": "/weather/frost",
    "rain": "/gauge/precipitation",
    "pumped": FLOW,
    "opened": "/outlet/open_switch",
    "closed": "/outlet/closed_switch",
}
_SWITCHES = "opened", "closed"
# The parts that report on inputs, as in the interlocks of the table.
_INPUT_PARTS = {
    "command": ("command",), "levels": ("cistern_level",), "frost": ("frost",), "rain": ("rain",),
    "switches": _SWITCHES,
}
# The fields of a request to open the valve.
_OPEN = (
    Parameter("owner", "", meaning="whoever opens the valve", optional=False),
    Parameter("until", 0.0, "s", 0.0, MAX_TIME, "end (s since 1970)", optional=False),
)


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(), *DRIVE_PARAMETERS, *valve_parameters(site),
        *live_parameters([*_INPUTS.values(), "/roof/level"]),
    ]


class ValveNode(DriveNode):
    """Node that opens the outlet valve of a live site, unless an interlock is active."""

    parts = _INPUT_PARTS

    def __init__(self) -> None:
        """Declare the parameters, and open the topics and services.

        Raises:
            ConfigurationError: if a parameter or the relay file is invalid.
        """
        super().__init__(VALVE, VALVE, parameters)
        site, values = self.site, self.values
        settings = {each.name: values[each.name] for each in valve_parameters(site)}
        self._control = ValveControl(
            site, ValveSettings(**settings), self.state_file,
            relay_stops_after=self.stops_after_s,
        )
        missing = {
            *(() if values["has_switches"] else _SWITCHES), *(() if site.irrigated else ["pumped"])
        }
        self.observed = {name: _INPUTS[name] for name in _INPUTS if name not in missing}
        Levels(site, values, self.subscribe, needs_roof=False)
        for topic in self.observed.values():
            if topic not in self.inputs:
                self.subscribe(topic, optional=topic == FLOW)
        self.open_outputs(_POSITION, _OUTFLOW)
        self.open_service("open", SetParametersAtomically, self._open)

    def discard_evidence(self, checked: bool = False) -> None:
        """Forget what led to a fault."""
        self._control.discard_evidence()

    def _open(self, request: SetParametersAtomically.Request) -> tuple[bool, str]:
        control, fields = self._control, read_fields("open", request, _OPEN)
        seconds = fields["until"] - time.time()
        control.opened_by, control.open_for = fields["owner"], max(0.0, seconds)
        state = self.decide()
        opened = self.decision.request is not None
        if not opened:  # it must rest, or an interlock is active: it does not open later by itself
            control.open_for = 0.0
        return seconds <= 0 or opened, state

    def on_inputs(self) -> None:
        """Publish position and flow, which are NaN if they are unknown."""
        for topic, value in (_POSITION, self.decision.position), (_OUTFLOW, self.decision.flow):
            self.publish(topic, math.nan if value is None else value)

    def step(self, dt: float) -> Decision:
        """Decide based on the present observations, and switch the relay."""
        now, snapshot = boot_time(), self.exchange.snapshot
        observed = ValveObservation()  # nobody has observed anything in a pause
        if dt <= PAUSE_S:
            status = snapshot.status_at(now)
            observed = ValveObservation(
                **{"pumped": 0.0, **self.observe()},
                on=None if status is None else status.running,
                reasons=[reason for _, reason in self.drive_reasons(snapshot, now)],
            )
        decision = self._control.step(dt, observed)
        self.exchange.request_speed(decision.request)
        return decision

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup and the page show."""
        control, decision = self._control, self.decision
        return {
            **super().progress(),
            "position": decision.position, "commanded": decision.request is not None,
            "opened_by": control.opened_by if control.open_for else "",
            "open_until": time.time() + control.open_for if control.open_for else None,
        }

    def report(self) -> None:
        """Report on every part of the node."""
        super().report()
        self.reports.diagnose("opening", self._control.stuck, "it opens", WARN)
        self.report_parts(self.drive_reasons(self.exchange.snapshot, boot_time()))


main = live_command(ValveNode, __doc__)


if __name__ == "__main__":
    main()
