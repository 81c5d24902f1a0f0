"""The pump node of a live site, which turns /pump/command into commands to a drive or a relay.

The node acts once per tau of the site on the latest values, and allows the pump to run only if
these values are up to date and valid. The node connects to the drive automatically, and does not
run the pump unless the drive's own communication timeout would stop the pump if this node failed.
Between two such steps, checks on the steady clock can stop the drive. /pump/flow is published every
tau, and /pump/state whenever it changes.

``~/stop`` (std_srvs/SetBool) with true holds the pump, which then stays off, regardless of the
command, even after a restart. With false, the service ends any hold. ``~/hold``
(rcl_interfaces/SetParametersAtomically) holds the pump for an ``owner``, optionally with a
``reason`` and an end, ``until`` (s since 1970). ``~/reset`` (std_srvs/Trigger), for a person at the
pump, clears a latched fault and an unknown state; ``~/clear``, for the page, clears only a fault
that needs no person at the pump (speed_not_followed). If the site file allows doses, ``~/dose``
(rcl_interfaces/SetParametersAtomically: ``volume`` in m3, and ``asked_at``, the current time in s
since 1970) delivers a volume once, or returns the reason for rejecting the request.
"""

from __future__ import annotations

from greenroof_ros.ros import begin_node

begin_node(__name__)

import math
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import parameter_value_to_python
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import state_directory
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import DriveState, PumpState
from greenroof_ros.live.boot_clock import boot_time, suspended_time
from greenroof_ros.live.devices.drive import DriveStatus
from greenroof_ros.live.devices.drive_file import MAX_RAMP_S, find_drive_file
from greenroof_ros.live.devices.endpoint import CHOICE, Endpoint, read_endpoint
from greenroof_ros.live.devices.exchange import RESET_S, UNREAD_S, DriveExchange, DriveSnapshot
from greenroof_ros.live.levels import LIMITS, Levels, live_parameters
from greenroof_ros.live.node import PAUSE_S, LiveNode, live_command
from greenroof_ros.live.pump_reports import PumpReports
from greenroof_ros.live.pumping.limits import (
    PumpSettings,
    check_command_limit,
    pump_parameters,
)
from greenroof_ros.live.pumping.pump_control import Decision, PumpControl
from greenroof_ros.live.pumping.pump_inputs import INPUTS, Observation
from greenroof_ros.live.pumping.state_file import MAX_NUMBER, StateFile
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.site.site import Site

COMMAND_LIMIT = LIMITS["/pump/command"]
# For how long a suspension of the machine, or a changed state file, is reported (s).
_REPORTED_S = 60.0
# Interval at which a state that could not be saved is written again, and at which the node reports
# on the drive (s).
_AGAIN_S, _REPORT_S = 0.5, 0.2

_OWN = (
    *CHOICE,
    Parameter(
        "drive_timeout_limit", 10.0, "s", 0.1, 60.0, "maximum permitted value of the drive's own "
            "communication timeout",
    ),
    Parameter(
        "local_settings_stop_the_pump", False, meaning="confirmation that the drive has been set "
            "to stop the pump when the bus connection is lost, and that the pump was observed to "
            "stop in a test; must be true if that setting cannot be read",
    ),
    Parameter(
        "state_file", "", meaning="file that preserves holds, faults and the pump's usage in the "
            "last 24 h across restarts; if empty, greenroof_ros/NAME.json in $XDG_STATE_HOME or "
            "~/.local/state",
    ),
)


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(), *_OWN, *pump_parameters(site),
        *live_parameters(row.topic for row in INPUTS),
    ]


class PumpNode(LiveNode):
    """Node that runs the pump of a live site as commanded, unless an interlock is active."""

    def __init__(self) -> None:
        """Declare the parameters, and open the topics and services.

        Raises:
            ConfigurationError: if a parameter or the drive file is invalid.
        """
        super().__init__("pump", "pump")
        site = self._site = self.declare_site()
        values = declare(self, parameters(site))
        check_command_limit(
            values[COMMAND_LIMIT.name], site.tau,
            f"parameter {COMMAND_LIMIT.name} of {self.get_name()}",
        )
        endpoint = _read_endpoint(values, self.get_name())
        self._exchange = DriveExchange(
            endpoint, timeout_limit_s=values["drive_timeout_limit"],
            stops_locally=values["local_settings_stop_the_pump"],
        )
        settings = {parameter.name: values[parameter.name] for parameter in pump_parameters(site)}
        settings["min_speed"] = max(settings["min_speed"], endpoint.file.min_speed)
        self._settings = PumpSettings(**settings)
        # Time after which a drive that does not respond is stopped (s).
        self._drive_stops_after = UNREAD_S + values["drive_timeout_limit"] + MAX_RAMP_S
        own_name = self.get_fully_qualified_name().strip("/").replace("/", "-")
        self._state_file = StateFile(
            Path(values["state_file"] or state_directory() / f"{own_name}.json"), site.zone
        )
        # Why a stop would be forgotten at a restart; empty once the state has been saved.
        self._unsaved, self._saved_at = "the state is not saved yet", -math.inf
        self._start_control()
        self._decision = Decision(
            None, "off", "not started", {}, 0.0, "", (), at_rest=False, reported_speed=None,
            flow_known=False, blind_for=0.0,
        )
        self._state = PumpState()
        self._reasons: tuple[object, ...] = ()  # the reasons as `on_timer` last saw them
        self._resetting_until = self._reported_at = -math.inf
        self._stepped, self._watched = boot_time(), time.monotonic()
        self._suspended, self._suspended_at = suspended_time(), -math.inf
        self._changed_at = -math.inf  # when the state file was found to be changed
        self._levels = Levels(site, values, self.subscribe)
        of_levels = {"cistern_level": self._levels.cistern, "roof_level": self._levels.roof}
        self._by_name = {
            row.name: of_levels.get(row.name) or self.subscribe(
                row.topic, optional=not row.unknown
            )
            for row in INPUTS
        }
        self._flows = self.subscribe("/pump/flow", optional=True).publishers
        self._pump_reports = PumpReports(self.reports, self._by_name, self._exchange)
        self.open_outputs("/pump/flow", "/pump/state")
        self._open_service("stop", SetBool, self._stop_or_release)
        self._open_service(
            "hold", SetParametersAtomically, lambda request: self._hold(**_parse_hold(request))
        )
        self._open_service("clear", Trigger, self._clear)
        self._open_service("reset", Trigger, self._reset)
        self._open_service("dose", SetParametersAtomically, self._dose)

    # --- state kept across restarts ---------------------------------------------------------------

    def _start_control(self) -> None:
        """Create the pump control, with the state from the state file."""
        self._control = PumpControl(
            self._site, self._settings, self._state_file, self._drive_stops_after
        )
        stored, active_hold = self._state_file.state, self._state_file.active_hold
        if why := stored.fault or stored.unknown or (active_hold and active_hold.sentence):
            self.get_logger().warning(f"{self._state_file.file} keeps the pump off: {why}")

    def _acquire_state(self) -> None:
        """Acquire the state file if another process held it."""
        if self._state_file.acquire():
            self._start_control()
            self._reasons = ()  # decide again

    # --- services ---------------------------------------------------------------------------------

    def _open_service(
        self, name: str, kind: Any, act: Callable[[Any], tuple[bool, str]]
    ) -> None:
        """Offer a service that returns success and a message; an error rejects a request."""

        def answer(request: Any, response: Any) -> Any:
            self._acquire_state()
            try:
                done, said = act(request)
            except ValueError as error:
                done, said = False, str(error)
            except Exception as error:  # no request may end the node that stops the pump
                self.get_logger().error(traceback.format_exc())
                done, said = False, f"the request failed: {error}"
            if kind is SetParametersAtomically:
                response.result.successful, response.result.reason = done, said
            else:
                response.success, response.message = done, said
            self.get_logger().info(f"{name} requested: {said}")
            return response

        self.create_service(kind, f"~/{name}", answer)

    def _saved(self, said: str) -> tuple[bool, str]:
        """Save the state after a request; return whether this succeeded, and the response."""
        problem = self._state_file.flush()
        return not problem, f"{said}; but {problem}" if problem else said

    def _hold(self, **fields: Any) -> tuple[bool, str]:
        as_requested = self._state_file.hold(**fields)
        self._step()
        self._exchange.stop()
        remark = "" if as_requested else "; the earlier hold lasts longer and was not shortened"
        return self._saved(f"{self._state}{remark}")

    def _stop_or_release(self, request: SetBool.Request) -> tuple[bool, str]:
        if request.data:
            return self._hold(owner="the operator")
        self._state_file.release()
        self._step()
        return self._saved(str(self._state))

    def _reset(self, request: Trigger.Request) -> tuple[bool, str]:
        cleared = self._control.reset()
        self._exchange.reset()
        self._resetting_until = boot_time() + RESET_S
        return self._saved(f"cleared: {cleared}" if cleared else "there was no fault")

    def _clear(self, request: Trigger.Request) -> tuple[bool, str]:
        if refusal := self._control.clear_refusal:
            raise ValueError(refusal)
        self._control.clear()
        self._step()
        return self._saved(str(self._state))

    def _dose(self, request: SetParametersAtomically.Request) -> tuple[bool, str]:
        fields = {parameter.name: parameter.value.double_value for parameter in request.parameters}
        if fields.keys() != {"volume", "asked_at"}:
            raise ValueError(
                "a dose must have volume (m3) and asked_at (s since 1970); other keys are not "
                "allowed")
        self._step()  # a reason against the dose may have just arrived
        refusal = self._control.request_dose(fields["asked_at"], fields["volume"])
        self._step()
        return not refusal, refusal or str(self._state)

    # --- by the clock -----------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Decide, and publish the flow."""
        flow = self._step().flow
        if self._levels.cistern.good and self._levels.roof.good:
            self._levels.expect(flow)
        self.publish("/pump/flow", flow)

    def on_timer(self, now: float) -> None:
        """Decide again if the reasons for keeping the pump off change, even without a command."""
        self._exchange.start()
        now = boot_time()
        self._check_suspend(now)
        if self._unsaved and now - self._saved_at > _AGAIN_S:
            # The state must be saved once before the pump may run.
            self._unsaved = self._state_file.flush()
            self._saved_at = boot_time()
        command, snapshot = self._by_name["command"], self._exchange.snapshot
        status = snapshot.status_at(now)
        command.check()  # of a command, only the age depends on the time
        reasons = (
            [*self._reasons_against(snapshot, now)], command.good, _fault(status),
            status is not None and status.at_rest,
            # Decide again every second, since a drive that does not respond comes to rest at some
            # time.
            status is None and not self._decision.at_rest and now // 1,
        )
        if reasons != self._reasons:
            self._reasons = reasons
            self._step()
        # Repeatedly, since a request expires after a second.
        self._exchange.request_speed(self._decision.speed)
        if now - self._reported_at > _REPORT_S:
            self._reported_at = now
            self._acquire_state()
            if self._state_file.check():
                self._changed_at = now
            self._pump_reports.update(
                now, self._site, self._state, self._decision, self._control.doses.last,
                self._state_file.problem, now - self._changed_at < _REPORTED_S, self._second_pump(),
            )

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
            problem = self._state_file.close()
            if problem:
                self.get_logger().error(problem)

    def _check_suspend(self, now: float) -> None:
        """Report, for a minute, that the computer was suspended while the pump was on."""
        before, self._suspended = self._suspended, suspended_time()
        seconds = self._suspended - before
        if seconds > PAUSE_S and not self._decision.at_rest:
            self._suspended_at = now
            self.reports.diagnose("suspend", Diagnosis.of("suspended", suspended_s=seconds))
        elif now - self._suspended_at > _REPORTED_S:
            self.reports.diagnose("suspend", None,
                "the computer is kept awake while the pump is on")

    # --- the pump ---------------------------------------------------------------------------------

    @property
    def _drive_state(self) -> DriveState:
        stored, snapshot = self._state_file.state, self._exchange.snapshot
        if stored.fault or stored.unknown:
            return DriveState.FAULT
        if snapshot.absence_at(boot_time()):
            return DriveState.CONNECTING
        if any(self._unfit_drive(snapshot)):
            return DriveState.REFUSED
        return DriveState.STOPPED if self._state_file.active_hold else DriveState.READY

    def _unfit_drive(self, snapshot: DriveSnapshot) -> Iterator[Diagnosis]:
        """Yield the reasons why a responding drive must not run yet, as nothing might stop it."""
        yield from filter(None, (
            snapshot.unguarded,
            self._exchange.timeout_problem(snapshot),
            Diagnosis.if_any("state_not_kept", self._unsaved),
        ))

    def _reasons_against(self, snapshot: DriveSnapshot, now: float) -> Iterator[Diagnosis]:
        """Yield this node's own reasons for keeping the pump off."""
        if absence := snapshot.absence_at(now):
            yield absence
        if (status := snapshot.status_at(now)) is not None:
            if not status.remote:
                yield Diagnosis.of("drive_local", "local")
            yield from filter(None, (snapshot.second_master, snapshot.start_failed))
            yield from self._unfit_drive(snapshot)
        # Another pump node may use the same drive; then neither runs it.
        if second := self._second_pump():
            yield second

    def _second_pump(self) -> Diagnosis | None:
        """Return a diagnosis if the flow has a second publisher.

        An incompatible publisher is named, since it may be trying to stop the pump.
        """
        flows = self._flows
        if not (second := flows.describe_second()):
            return None
        problem = flows.describe_incompatible() or second
        return Diagnosis.of("two_pumps", topic=flows.full_name, problem=problem)

    def _value(self, name: str) -> float | None:
        """Return the value of an input; None if it is unknown."""
        entry = self._by_name[name]
        return float(entry.value) if self.acted and entry.good else None

    def _step(self) -> Decision:
        """Decide based on the current observations, command the drive, and publish the state."""
        now = boot_time()
        self._check_suspend(now)
        self.check_inputs()
        snapshot = self._exchange.snapshot
        status = snapshot.status_at(now)
        observation = Observation(
            **{row.name: self._value(row.name) for row in INPUTS},
            displacements=self._levels.displacements,
            time_ns=time.time_ns(),
            speed=None if status is None else status.speed,
            drive_flow=None if status is None else status.flow,
            drive_ready=status is not None and (status.ready or status.running),
            drive_fault="" if now < self._resetting_until else _fault(status),
            runs_on=status is not None and status.runs_on,
            reasons=[*self._reasons_against(snapshot, now)],
        )
        dt = self._elapsed()
        # The drive is watched only while the machine is awake, and this clock counts only that
        # time.
        awake = time.monotonic()
        drive_dt, self._watched = awake - self._watched, awake
        decided, decision = self._decision, self._control.step(dt, observation, drive_dt)
        self._decision = decision
        self._exchange.disbelieved = decision.disbelieved
        self._exchange.request_speed(decision.speed)
        state = PumpState(decision.state, decision.why, tuple(decision.interlocks))
        before, self._state = self._state, state
        if state != before:
            self.publish("/pump/state", state.message())
            # Not at every change of the words, since they contain numbers.
            logged = (decided.state, decided.at_rest, *decided.interlocks)
            if (decision.state, decision.at_rest, *decision.interlocks) != logged:
                self.get_logger().info(str(state))
        return decision

    def _elapsed(self) -> float:
        """Return the time since the last call (s); a pause of this process counts as one tick."""
        before, self._stepped = self._stepped, boot_time()
        dt, tau = self._stepped - before, self._site.tau
        if dt > tau + PAUSE_S:
            # All ticks since the last step were missed, except the present one.
            self._control.count_unseen(dt - tau)
            return tau
        return dt

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup shows and waits for."""
        stored, active_hold = self._state_file.state, self._state_file.active_hold
        decision, dose = self._decision, self._control.doses.last
        return {
            "pump_state": self._state.state, "pump_why": self._state.why,
            "stands": decision.at_rest,
            "speed": decision.reported_speed,
            "flow": decision.flow if decision.flow_known else None,
            "drive_state": self._drive_state.value,
            "fault": stored.fault,
            "no_clear": self._control.clear_refusal,
            "unknown": stored.unknown,
            "hold": {
                "owner": stored.hold_owner, "reason": stored.hold_reason,
                "since": stored.hold_since, "until": stored.hold_until,
                "said": active_hold.sentence,
            } if active_hold else None,
            "max_dose": self._site.max_dose,
            "min_dose": self._control.min_pulse,
            "no_dose": self._control.dose_refusal,
            "dose": None if dose is None else {**asdict(dose), "said": dose.sentence},
        }


def _read_endpoint(values: Mapping[str, Any], node_name: str) -> Endpoint:
    """Return the drive that a node's parameters specify.

    Raises:
        ConfigurationError: if a parameter or the drive file is invalid.
    """
    key = f"parameter {{}} of {node_name}"
    if not values["drive"]:
        raise ConfigurationError(
            "must be the make of the drive (the name of a file in config/drives, without .yaml) "
            "or the path of your own drive file", key=key.format("drive"),
        )
    return read_endpoint(
        find_drive_file(values["drive"]), values["address"], key.format("address"),
        values["broker_login"], values["broker_authority"],
    )


def _parse_hold(request: SetParametersAtomically.Request) -> dict[str, Any]:
    """Return the owner, the reason and the end of a requested hold.

    Raises:
        ValueError: if the request is not a valid request for a hold.
    """
    fields = {
        parameter.name: parameter_value_to_python(parameter.value)
        for parameter in request.parameters
    }
    kinds = {"owner": str, "reason": str, "until": float}
    if not fields.get("owner") or not all(
        name in kinds and isinstance(value, kinds[name]) for name, value in fields.items()
    ):
        raise ValueError(
            "a hold must have an owner (text) and may have a reason (text) and until (s since "
            "1970, a floating-point number); other keys are not allowed"
        )
    if "until" in fields and not time.time() < fields["until"] <= MAX_NUMBER:
        raise ValueError(
            f"until = {fields['until']:.15g}: must be in the future (s since 1970) and at most "
            f"{MAX_NUMBER:g}"
        )
    return fields


def _fault(status: DriveStatus | None) -> str:
    """Return a drive's fault, except for a trip of its own timeout, which clears automatically."""
    return "" if status is None or status.timed_out else status.fault


main = live_command(PumpNode, "live.pump", __doc__, parameters)


if __name__ == "__main__":
    main()
