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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import parameter_value_to_python
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.base.files import state_directory
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP, VALVE, DriveState
from greenroof_ros.live.devices.drive_file import LIMIT_S, find_drive_file
from greenroof_ros.live.devices.exchange import (
    CHOICE,
    RESET_S,
    UNREAD_S,
    DriveExchange,
    DriveSnapshot,
    read_endpoint,
)
from greenroof_ros.live.live_input import LIMITS, bad_inputs
from greenroof_ros.live.node import LiveNode
from greenroof_ros.live.pumping.interlocks import Decision, clear_refusal
from greenroof_ros.live.pumping.limits import check_command_limit
from greenroof_ros.live.pumping.state_file import MAX_TIME, StateFile
from greenroof_ros.physics.pump import STANDSTILL
from greenroof_ros.ros.diagnostics import ERROR, OK, WARN
from greenroof_ros.ros.parameters import check_value, declare
from greenroof_ros.site.site import Site

STATE_FILE = Parameter(
    "state_file", "", meaning="file that preserves holds, faults and the use in the last 24 h; if "
        "empty, greenroof_ros/NAME.json in $XDG_STATE_HOME or ~/.local/state",
)
COMMAND, FLOW = "/pump/command", "/pump/flow"
COMMAND_LIMIT = LIMITS[COMMAND]
_STATES = {PUMP: "/pump/state", VALVE: "/outlet/state"}
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
        self.open_outputs(_STATES[role])
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

    def open_service(self, name: str, kind: Any, act: Callable[[Any], tuple[bool, str]]) -> None:
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


TIMEOUT_LIMIT = Parameter(
    "drive_timeout_limit", LIMIT_S, "s", 0.1, 60.0, "maximum value of the drive's own "
        "communication timeout",
)
LOCAL_SETTINGS = Parameter(
    "local_settings_stop_the_pump", False, meaning="confirmation that the drive stopped the "
        "pump in a test when the bus was lost, if its settings cannot be read",
)
DRIVE_PARAMETERS = (*CHOICE, TIMEOUT_LIMIT, LOCAL_SETTINGS, STATE_FILE)
# The codes that need nobody at once.
_WARNINGS = {"drive_local", "second_master", "start_failed", "drive_guards_later"}


class DriveNode(ActuatorNode):
    """A node that drives its actuator over Modbus, or switches it with a relay over MQTT.

    Attributes:
        observed: topics of the observations, by the names of their fields.
        parts: names of the observations that each part of the node reports on.
        stops_after_s: time after which a drive that does not respond is told to stop by its own
            timeout (s).
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
        self.stops_after_s = UNREAD_S + values[TIMEOUT_LIMIT.name]
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

    def drive_reasons(self, snapshot: DriveSnapshot, now: float) -> Iterator[tuple[str, Diagnosis]]:
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
