"""What the nodes of all actuators have in common: the state file, and the services that use it.

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
from datetime import tzinfo
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import parameter_value_to_python
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.base.files import state_directory
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP, DriveState, PumpState
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.node import LiveNode
from greenroof_ros.live.pumping.interlocks import clear_refusal
from greenroof_ros.live.pumping.state_file import MAX_NUMBER, StateFile
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.parameter_file import check_value

STATE_FILE = Parameter(
    "state_file", "", meaning="file that preserves holds, faults and the pump's usage in the "
        "last 24 h across restarts; if empty, greenroof_ros/NAME.json in $XDG_STATE_HOME or "
        "~/.local/state",
)
# For how long a suspension of the machine, or a changed state file, is reported (s).
REPORTED_S = 60.0
# The fields of a hold; the owner is needed.
_HOLD = (
    Parameter("owner", "", meaning="whoever requests the hold"),
    Parameter("reason", "", meaning="the reason"),
    Parameter("until", 0.0, "s", 0.0, MAX_NUMBER, "end of the hold (s since 1970)"),
)


class ActuatorNode(LiveNode):
    """A node that commands an actuator, and keeps it off during a hold or a latched fault."""

    def __init__(self, name: str) -> None:
        """Join the graph.

        Args:
            name: name of the node.
        """
        super().__init__(name, PUMP)

    # --- to override ------------------------------------------------------------------------------

    def load(self) -> None:
        """Begin with the state in the state file, which has just been read."""

    def decide(self) -> PumpState:
        """Act on the present state at once, and return the state of the actuator."""
        raise NotImplementedError

    def switch_off(self) -> None:
        """Switch the actuator off now, because someone requests it."""

    def out_of_reach(self) -> str:
        """Return why a hold does not switch the actuator off; empty if it does."""
        return ""

    def discard_evidence(self) -> None:
        """Forget what led to a fault that has been cleared."""

    def acknowledge(self) -> None:
        """Acknowledge a fault of the device itself, because a person has checked it."""

    # --- state kept across restarts ---------------------------------------------------------------

    def open_state_file(self, path: str, zone: tzinfo) -> None:
        """Open the state file and the services.

        Args:
            path: value of the parameter :data:`STATE_FILE`.
            zone: time zone in which the times of a hold are shown.
        """
        own_name = self.get_fully_qualified_name().strip("/").replace("/", "-")
        self.state_file = StateFile(Path(path or state_directory() / f"{own_name}.json"), zone)
        self._begin()
        self.open_service("stop", SetBool, self._stop)
        self.open_service("release", Trigger, lambda request: self._release())
        self.open_service("hold", SetParametersAtomically, self._hold)
        self.open_service("clear", Trigger, self._clear)
        self.open_service("reset", Trigger, self._reset)

    def check_state_file(self) -> None:
        """Acquire the state file if another process held it, repair it, and report on it."""
        self._acquire()
        self.state_file.check()
        diagnosis, level = Diagnosis.if_any("state_not_kept", self.state_file.problem), ERROR
        if diagnosis is None and boot_time() - self.state_file.changed_at < REPORTED_S:
            diagnosis, level = Diagnosis.of("state_changed"), WARN
        self.reports.diagnose("state file", diagnosis, "holds and faults are being saved", level)

    def _acquire(self) -> None:
        if self.state_file.acquire():
            self._begin()

    def _begin(self) -> None:
        self.load()
        self.state_file.save()  # once, before the actuator may be switched on
        stored, hold = self.state_file.state, self.state_file.active_hold
        if why := stored.fault or stored.unknown or (hold and hold.sentence):
            self.get_logger().warning(f"{self.state_file.file} keeps the pump off: {why}")

    def device_state(self, trouble: DriveState | None) -> DriveState:
        """Return the state of the device, given what is wrong with the device itself, if any."""
        stored = self.state_file.state
        if stored.fault or stored.unknown:
            return DriveState.FAULT
        return trouble or (DriveState.STOPPED if self.state_file.active_hold else DriveState.READY)

    def progress(self) -> dict[str, Any]:
        """Return what the state file says, for bringup and the page."""
        stored, hold = self.state_file.state, self.state_file.active_hold
        return {
            "fault": stored.fault,
            "no_clear": clear_refusal(self.state_file),
            "unknown": stored.unknown,
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
            self._acquire()
            try:
                done, message = act(request)
            except ValueError as error:
                done, message = False, str(error)
            except Exception as error:  # no request may end the node that stops the pump
                self.get_logger().error(traceback.format_exc())
                done, message = False, f"the request failed: {error}"
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
        fields = read_fields("hold", request, _HOLD, {"owner"})
        if not fields["owner"]:
            raise ValueError("a hold must have an owner")
        if fields.get("until", math.inf) <= time.time():
            raise ValueError(f"until = {fields['until']:.15g}: must be in the future")
        return self.hold(**fields)

    def hold(self, **fields: Any) -> tuple[bool, str]:
        """Hold the actuator; for the fields see :meth:`StateFile.hold`."""
        as_requested = self.state_file.hold(**fields)
        state = self.decide()
        self.switch_off()
        remark = "" if as_requested else "; the earlier hold lasts longer and was not shortened"
        return self._answer(f"{state}{remark}", self.out_of_reach())

    def _release(self) -> tuple[bool, str]:
        self.state_file.release()
        return self._answer(str(self.decide()))

    def _reset(self, request: Trigger.Request) -> tuple[bool, str]:
        stored = self.state_file.state
        cleared = "; ".join(filter(None, (stored.fault, stored.unknown)))
        self.state_file.clear_unknown()
        self._clear_fault()
        self.acknowledge()
        return self._answer(f"cleared: {cleared}" if cleared else "there was no fault")

    def _clear(self, request: Trigger.Request) -> tuple[bool, str]:
        if refusal := clear_refusal(self.state_file):
            raise ValueError(refusal)
        self._clear_fault()
        return self._answer(str(self.decide()))

    def _clear_fault(self) -> None:
        if self.state_file.state.fault:
            self.state_file.fault("", "")
            self.discard_evidence()


def read_fields(
    name: str, request: SetParametersAtomically.Request, table: Iterable[Parameter],
    needed: set[str],
) -> dict[str, Any]:
    """Return the fields of a request, by name.

    Args:
        name: name of the service, for messages.
        request: the request.
        table: the fields that a request may have.
        needed: names of the fields that a request must have.

    Raises:
        ValueError: if a field is missing, unknown or invalid.
    """
    known = {parameter.name: parameter for parameter in table}
    fields = {
        parameter.name: parameter_value_to_python(parameter.value)
        for parameter in request.parameters
    }
    if not needed <= fields.keys() <= known.keys():
        must = " and ".join(field for field in known if field in needed)
        raise ValueError(f"a {name} must have {must}; it may only have {', '.join(known)}")
    for field, value in fields.items():
        try:
            fields[field] = check_value(known[field], value)
        except ValueError as error:
            raise ValueError(f"{field} = {value}: {error}") from None
    return fields
