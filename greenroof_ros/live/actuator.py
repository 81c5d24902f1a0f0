"""What the nodes of all actuators have in common: one path, the state file, and the services.

Ten times a second, and at each request, a node observes, decides, acts, and publishes the state.

``~/stop`` (std_srvs/SetBool) with true holds the actuator, which then stays off, regardless of the
command, even after a restart. ``~/release`` (std_srvs/Trigger) ends any hold, as does ``~/stop``
with false. ``~/hold`` (rcl_interfaces/SetParametersAtomically) holds the actuator for an ``owner``,
optionally with a ``reason`` and an end, ``until`` (s since 1970). ``~/reset`` (std_srvs/Trigger),
for a person at the actuator, clears a latched fault and an unknown state; ``~/clear``, for the
page, clears only a fault that needs no person (speed_not_followed).
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import parameter_value_to_python
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.base.files import state_directory
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP, VALVE, DriveState
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.levels import LIMITS
from greenroof_ros.live.node import LiveNode
from greenroof_ros.live.pumping.interlocks import Decision, clear_refusal
from greenroof_ros.live.pumping.limits import check_command_limit
from greenroof_ros.live.pumping.state_file import MAX_TIME, StateFile
from greenroof_ros.ros.diagnostics import ERROR, OK, WARN
from greenroof_ros.ros.parameter_file import check_value
from greenroof_ros.ros.parameters import declare
from greenroof_ros.site.site import Site

STATE_FILE = Parameter(
    "state_file", "", meaning="file that preserves holds, faults and the use in the last 24 h; if "
        "empty, greenroof_ros/NAME.json in $XDG_STATE_HOME or ~/.local/state",
)
COMMAND, FLOW, STATE = "/pump/command", "/pump/flow", "/pump/state"
COMMAND_LIMIT = LIMITS[COMMAND]
_STATES = {PUMP: STATE, VALVE: "/outlet/state"}
_UNKNOWN = {PUMP: "standstill_unknown", VALVE: "valve_may_be_open"}
# Interval between two decisions (s).
_STEP_S = 0.1
# The reasons that are as intended, of which nobody is warned.
_INTENDED = {"quiet_hours", "wet_weather"}
# The interlocks for which no drive is run, whatever is commanded.
_REFUSED = {"drive_timeout", "drive_guards_later", "state_not_kept"}
# The fields of a hold.
_HOLD = (
    Parameter("owner", "", meaning="whoever requests the hold", optional=False),
    Parameter("reason", "", meaning="the reason"),
    Parameter("until", 0.0, "s", 0.0, MAX_TIME, "end of the hold (s since 1970)"),
)


class ActuatorNode(LiveNode):
    """A node that commands an actuator, and keeps it off during a hold or a latched fault.

    Attributes:
        site: the site.
        values: values of the parameters.
        state_file: holds, faults and usage.
        decision: the last decision.
    """

    def __init__(
        self, name: str, role: str, parameters: Callable[[Site], Iterable[Parameter]]
    ) -> None:
        """Join the graph, and open the state file and the services.

        Args:
            name: name of the node.
            role: ``pump`` or ``valve``, which is also the name of its part that acts.
            parameters: function that returns the node's parameters at a site.

        Raises:
            ConfigurationError: if a parameter is invalid, or another process uses the state file.
        """
        super().__init__(name, role)
        self.site = self.declare_site()
        self.values = declare(self, parameters(self.site))
        own_name = self.get_fully_qualified_name().strip("/").replace("/", "-")
        path = self.values[STATE_FILE.name] or state_directory() / f"{own_name}.json"
        self.state_file = StateFile(Path(path), self.site.zone)
        self.decision = Decision({})
        self._stepped, self._reported_at = boot_time(), -math.inf
        limit = self.values[COMMAND_LIMIT.name]
        check_command_limit(limit, self.site.tau, f"parameter {COMMAND_LIMIT.name}")
        self.open_service("stop", SetBool, self._stop)
        self.open_service("release", Trigger, lambda request: self._release())
        self.open_service("hold", SetParametersAtomically, self._hold)
        self.open_service("clear", Trigger, lambda request: self._clear(checked=False))
        self.open_service("reset", Trigger, lambda request: self._clear(checked=True))

    # --- to override ------------------------------------------------------------------------------

    def step(self, dt: float) -> Decision:
        """Observe, decide and act, and return the decision.

        Args:
            dt: time since the last step (s).
        """
        raise NotImplementedError

    def switch_off(self) -> str:
        """Switch off now, because someone requests it; return why that does not succeed, if so."""
        raise NotImplementedError

    def discard_evidence(self, checked: bool = False) -> None:
        """Forget what led to a fault that has been cleared.

        Args:
            checked: whether a person has checked the device, whose own fault is acknowledged.
        """
        raise NotImplementedError

    # --- the path ---------------------------------------------------------------------------------

    def decide(self) -> str:
        """Observe, decide and act now; publish the state, and return it in words."""
        now = boot_time()
        dt, self._stepped = now - self._stepped, now
        self.check_inputs()
        before, self.decision = self.decision.shown, self.step(dt)
        shown = self.decision.shown
        if shown != before:
            self.publish(_STATES[self.role], shown.message())
            # Not at every change of the words, since they contain numbers.
            if (shown.state, shown.codes) != (before.state, before.codes):
                self.get_logger().info(str(shown))
        return str(shown)

    def on_timer(self, now: float) -> None:
        """Decide again, and report."""
        if boot_time() - self._stepped >= _STEP_S:
            self.decide()
        if now - self._reported_at >= _STEP_S:  # requests, which decide, may be frequent
            self._reported_at = now
            self.state_file.check()
            self.report()

    def report(self) -> None:
        """Report on the parts of the node; messages that contain numbers are not logged."""
        decision, words = self.decision, str(self.decision.shown)
        first = next(iter(decision.active.values()), None)
        level, shown = OK, first
        if decision.state == "fault":
            level = ERROR
        elif not decision.at_rest and decision.speed is None:
            # What the pump does matters more than why it should be off.
            level, shown = ERROR, Diagnosis(_UNKNOWN[self.role])
        elif first is not None and first.code not in _INTENDED:
            level = WARN
            if (self.role, first.code) == (PUMP, "hold") and not decision.at_rest:
                shown = Diagnosis("stop_not_followed")
        found = shown and replace(shown, text=words)
        self.reports.diagnose(self.role, found, words, level, log=False)
        problem = Diagnosis.if_any("state_not_kept", self.state_file.problem)
        self.reports.diagnose("state file", problem, "holds and faults are being saved")

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup and the page show."""
        decision, stored, hold = self.decision, self.state_file.state, self.state_file.active_hold
        state = DriveState.REFUSED if _REFUSED & decision.active.keys() else DriveState.READY
        if decision.speed is None:
            state = DriveState.CONNECTING
        return {
            f"{self.role}_state": decision.state, f"{self.role}_why": decision.why,
            "at_rest": decision.at_rest,
            "speed": decision.speed, "flow": decision.flow, "drive_state": state.value,
            "fault": stored.fault, "no_clear": clear_refusal(self.state_file),
            "hold": {
                "owner": stored.hold_owner, "reason": stored.hold_reason,
                "since": stored.hold_since, "until": stored.hold_until, "sentence": hold.sentence,
            } if hold else None,
        }

    def on_stop(self) -> None:
        """Write the state and release its file."""
        if problem := self.state_file.close():
            self.get_logger().error(problem)

    # --- services ---------------------------------------------------------------------------------

    def open_service(
        self, name: str, kind: Any, act: Callable[[Any], tuple[bool, str]]
    ) -> None:
        """Offer a service that returns success and a message; an error rejects a request."""

        def answer(request: Any, response: Any) -> Any:
            try:
                done, message = act(request)
            except Exception as error:  # no request may end the node that stops the pump
                if not isinstance(error, ValueError):
                    self.get_logger().error(traceback.format_exc())
                done, message = False, str(error)
            if kind is SetParametersAtomically:
                response.result.successful, response.result.reason = done, message
            else:
                response.success, response.message = done, message
            self.get_logger().info(f"{name} requested: {message}")
            return response

        self.create_service(kind, f"~/{name}", answer)

    def _answer(self, message: str, problem: str = "") -> tuple[bool, str]:
        """Save the state after a request; return whether the request succeeded, and the response.

        Args:
            message: the response.
            problem: another problem than that the state is not saved; empty if there is none.
        """
        problem = "; ".join(filter(None, (problem, self.state_file.flush())))
        return not problem, f"{message}; but {problem}" if problem else message

    def _stop(self, request: SetBool.Request) -> tuple[bool, str]:
        return self.hold(owner="the operator") if request.data else self._release()

    def _hold(self, request: SetParametersAtomically.Request) -> tuple[bool, str]:
        fields = read_fields("hold", request, _HOLD)
        if not fields["owner"]:
            raise ValueError("a hold must have an owner")
        if fields.get("until", math.inf) <= time.time():
            raise ValueError(f"until = {fields['until']:.15g}: must be in the future")
        return self.hold(**fields)

    def hold(self, **fields: Any) -> tuple[bool, str]:
        """Hold the actuator; for the fields see :meth:`StateFile.hold`."""
        as_requested = self.state_file.hold(**fields)
        state, problem = self.decide(), self.switch_off()
        remark = "" if as_requested else "; the earlier hold lasts longer and was not shortened"
        return self._answer(f"{state}{remark}", problem)

    def _release(self) -> tuple[bool, str]:
        self.state_file.release()
        return self._answer(self.decide())

    def _clear(self, checked: bool) -> tuple[bool, str]:
        if not checked and (refusal := clear_refusal(self.state_file)):
            raise ValueError(refusal)
        fault = self.state_file.state.fault
        self.state_file.change(fault="", fault_code="")
        self.discard_evidence(checked)
        return self._answer(f"cleared: {fault}" if fault else "there was no fault")


def read_fields(
    name: str, request: SetParametersAtomically.Request, table: Iterable[Parameter]
) -> dict[str, Any]:
    """Return the fields of a request, by name.

    Args:
        name: name of the service, for messages.
        request: the request.
        table: the fields that a request may have, and must have unless they are optional.

    Raises:
        ValueError: if a field is missing, unknown or invalid.
    """
    known = {parameter.name: parameter for parameter in table}
    needed = [parameter.name for parameter in known.values() if not parameter.optional]
    fields = {
        parameter.name: parameter_value_to_python(parameter.value)
        for parameter in request.parameters
    }
    if not set(needed) <= fields.keys() <= known.keys():
        must = " and ".join(needed)
        raise ValueError(f"a {name} must have {must}; it may only have {', '.join(known)}")
    for field, value in fields.items():
        try:
            fields[field] = check_value(known[field], value)
        except ValueError as error:
            raise ValueError(f"{field} = {value}: {error}") from None
    return fields
