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

from greenroof_ros.ros import begin_node

begin_node(__name__)

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

from rcl_interfaces.srv import SetParametersAtomically

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis, read_interlocks
from greenroof_ros.interface.states import DriveState, PumpState
from greenroof_ros.live.actuator import REPORTED_S, STATE_FILE, ActuatorNode, read_fields
from greenroof_ros.live.boot_clock import boot_time, suspended_time
from greenroof_ros.live.devices.drive_file import MAX_RAMP_S, find_drive_file
from greenroof_ros.live.devices.exchange import (
    CHOICE,
    RESET_S,
    UNREAD_S,
    DriveExchange,
    DriveSnapshot,
    Endpoint,
    read_endpoint,
)
from greenroof_ros.live.levels import LIMITS, Levels, live_parameters
from greenroof_ros.live.live_diagnostics import ERROR, OK, WARN
from greenroof_ros.live.live_input import bad_inputs, join_diagnoses
from greenroof_ros.live.node import live_command
from greenroof_ros.live.pumping.dose import DONE, Dose
from greenroof_ros.live.pumping.limits import (
    PumpSettings,
    check_command_limit,
    pump_parameters,
)
from greenroof_ros.live.pumping.pump_control import Decision, PumpControl, drive_fault
from greenroof_ros.live.pumping.pump_inputs import INPUTS, Observation
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.site.site import Site

COMMAND_LIMIT = LIMITS["/pump/command"]
# Interval between two decisions, and between two reports on the parts of the node (s).
_STEP_S, _REPORT_S = 0.1, 0.2

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
    STATE_FILE,
)
# The parts that report on inputs, as in the interlocks of the table.
_PARTS = {
    "command": ("command",), "levels": ("cistern_level", "roof_level"), "frost": ("frost",),
}
# The fields of a request for a dose.
_DOSE = (
    Parameter("volume", 0.0, "m3", meaning="the volume"),
    Parameter("asked_at", 0.0, "s", meaning="time of the request (s since 1970)"),
)


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(), *_OWN, *pump_parameters(site),
        *live_parameters(INPUTS.values()),
    ]


class PumpNode(ActuatorNode):
    """Node that runs the pump of a live site as commanded, unless an interlock is active."""

    def __init__(self) -> None:
        """Declare the parameters, and open the topics and services.

        Raises:
            ConfigurationError: if a parameter or the drive file is invalid.
        """
        super().__init__("pump")
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
        self.reports.hardware = str(endpoint)
        settings = {parameter.name: values[parameter.name] for parameter in pump_parameters(site)}
        settings["min_speed"] = max(settings["min_speed"], endpoint.file.min_speed)
        self._settings = PumpSettings(**settings)
        # Time after which a drive that does not respond is stopped (s).
        self._drive_stops_after = UNREAD_S + values["drive_timeout_limit"] + MAX_RAMP_S
        self.open_state_file(values[STATE_FILE.name], site.zone)
        self._decision = Decision(
            None, "unknown", "", {}, None, "", (), at_rest=False, reported_speed=None,
            delivery_checked=False,
        )
        self._resetting_until = self._reported_at = self._suspended_at = -math.inf
        self._stepped, self._suspended = boot_time(), suspended_time()
        self._levels = Levels(site, values, self.subscribe)
        of_levels = {"cistern_level": self._levels.cistern, "roof_level": self._levels.roof}
        self._by_name = {
            name: of_levels.get(name) or self.subscribe(topic, optional=name == "flow")
            for name, topic in INPUTS.items()
        }
        self._flows = self.subscribe("/pump/flow", optional=True).publishers
        self.open_outputs("/pump/flow", "/pump/state")
        self.open_service("dose", SetParametersAtomically, self._dose)

    # --- requests ---------------------------------------------------------------------------------

    def load(self) -> None:
        """Create the pump control, with the state from the state file."""
        self._control = PumpControl(
            self._site, self._settings, self.state_file, self._drive_stops_after
        )

    def decide(self) -> PumpState:
        """Decide now, command the drive, and return the state of the pump."""
        return self._step().shown

    def switch_off(self) -> None:
        """Stop the drive, even during a silence."""
        self._exchange.stop()

    def discard_evidence(self) -> None:
        """Forget what led to a fault."""
        self._control.discard_evidence()

    def acknowledge(self) -> None:
        """Acknowledge the drive's fault, which does not count until that is done."""
        self._exchange.reset()
        self._resetting_until = boot_time() + RESET_S

    def _dose(self, request: SetParametersAtomically.Request) -> tuple[bool, str]:
        fields = read_fields("dose", request, _DOSE, {"volume", "asked_at"})
        self._step()  # a reason against the dose may have just arrived
        refusal = self._control.doses.request(fields["asked_at"], fields["volume"], time.time())
        return not refusal, refusal or str(self.decide())

    # --- by the clock -----------------------------------------------------------------------------

    def on_start(self) -> None:
        """Connect to the drive."""
        self._exchange.start()
        self._stepped = boot_time()

    def on_inputs(self) -> None:
        """Decide, and publish the flow."""
        flow = self._step().flow or 0.0  # a number for every tick, also if it is unknown
        if self._levels.cistern.good and self._levels.roof.good:
            self._levels.expect(flow)
        self.publish("/pump/flow", flow)

    def on_timer(self, now: float) -> None:
        """Decide again, and report."""
        now = boot_time()
        if now - self._stepped >= _STEP_S:
            self._step()
        if now - self._reported_at > _REPORT_S:
            self._reported_at = now
            self.check_state_file()
            self._report(now)

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

    def _trouble(self) -> DriveState | None:
        """Return the state of a drive that cannot run; None if it can."""
        snapshot = self._exchange.snapshot
        if snapshot.absence_at(boot_time()):
            return DriveState.CONNECTING
        return DriveState.REFUSED if any(self._lacks_protection(snapshot)) else None

    def _lacks_protection(self, snapshot: DriveSnapshot) -> Iterator[Diagnosis]:
        """Yield the reasons why a responding drive must not run yet, as nothing might stop it."""
        yield from filter(None, (
            snapshot.unguarded,
            self._exchange.timeout_problem(snapshot),
            Diagnosis.if_any("state_not_kept", self.state_file.unsaved),
        ))

    def _reasons(self, snapshot: DriveSnapshot, now: float) -> Iterator[Diagnosis]:
        """Yield this node's own reasons for keeping the pump off."""
        if absence := snapshot.absence_at(now):
            yield absence
        if (status := snapshot.status_at(now)) is not None:
            if not status.remote:
                yield Diagnosis.of("drive_local", "local")
            yield from filter(None, (snapshot.second_master, snapshot.start_failed))
            yield from self._lacks_protection(snapshot)
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
        now, dt = boot_time(), self._elapsed()
        self.check_inputs()
        snapshot = self._exchange.snapshot
        status = snapshot.status_at(now)
        # A trip of the drive's own timeout clears automatically, and one that is being
        # acknowledged does not count.
        counts = status is not None and not status.timed_out and now >= self._resetting_until
        before, decision = self._decision, self._control.step(dt, Observation(
            **{name: self._value(name) for name in INPUTS},
            displacements=self._levels.displacements,
            time_ns=time.time_ns(),
            speed=None if status is None else status.speed,
            drive_flow=None if status is None else status.flow,
            drive_ready=status is not None and (status.ready or status.running),
            drive_fault=status.fault if status is not None and counts else "",
            runs_on=status is not None and status.runs_on,
            reasons=[*self._reasons(snapshot, now)],
        ))
        self._decision = decision
        self._exchange.flows_at_rest = decision.flows_at_rest
        self._exchange.request_speed(decision.speed)
        if decision.shown != before.shown:
            self.publish("/pump/state", decision.shown.message())
            # Not at every change of the words, since they contain numbers.
            logged = (before.state, before.at_rest, *before.interlocks)
            if (decision.state, decision.at_rest, *decision.interlocks) != logged:
                self.get_logger().info(str(decision.shown))
        return decision

    def _elapsed(self) -> float:
        """Return the time since the last step (s); 0 after a pause, which nobody monitored."""
        now, suspended = boot_time(), suspended_time()
        dt, slept = now - self._stepped, suspended - self._suspended
        self._stepped, self._suspended = now, suspended
        if slept > PAUSE_S and not self._decision.at_rest:
            self._suspended_at = now
            self.reports.diagnose("suspend", Diagnosis.of("suspended", suspended_s=slept))
        elif now - self._suspended_at > REPORTED_S:
            self.reports.diagnose("suspend", None,
                "the computer is kept awake while the pump is on")
        if dt <= PAUSE_S:
            return dt
        self._control.count_unseen(dt)
        return 0.0

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup shows and waits for."""
        decision, doses = self._decision, self._control.doses
        dose = doses.last
        return {
            "pump_state": decision.state, "pump_why": decision.why,
            "at_rest": decision.at_rest,
            "speed": decision.reported_speed,
            "flow": decision.flow,
            "drive_state": self.device_state(self._trouble()).value,
            **super().progress(),
            "max_dose": self._site.max_dose,
            "min_dose": doses.minimum,
            "no_dose": doses.refusal,
            "dose": None if dose is None else {**asdict(dose), "sentence": dose.sentence},
        }

    # --- reports on the parts; messages that contain numbers are not logged -----------------------

    def _report(self, now: float) -> None:
        """Report on every part of the node, at a time of `boot_time` (s)."""
        decision = self._decision
        diagnose = self.reports.diagnose
        first = next(iter(decision.interlocks.values()), None)
        wrong = first is not None and first.code != "quiet_hours"  # these are as intended
        level, shown = ERROR if decision.state == "fault" else WARN if wrong else OK, first
        if decision.state != "fault" and not decision.at_rest:
            # What the pump does matters more than why it should be off.
            if decision.reported_speed is None:
                level, shown = ERROR, Diagnosis("stands_unknown")
            elif "hold" in decision.interlocks:
                shown = Diagnosis("stop_not_followed")
        diagnose(
            "pump", shown and replace(shown, text=str(decision.shown)), str(decision.shown), level,
            self._cause(first.code) if first else "", log=False,
        )
        warnings = join_diagnoses(decision.warnings)
        diagnose("limits", warnings, "nothing limits the pump", WARN, log=False)
        if self._site.max_dose is not None:
            self._diagnose_dose(self._control.doses.last)
        diagnose("flow", self._second_pump(), f"source: {decision.source}")
        self._diagnose_inputs(decision)
        levels_known = self._levels.cistern.good and self._levels.roof.good
        diagnose(
            "delivery",
            None if levels_known else Diagnosis.of("delivery_blind"),
            "the pumped volume is compared with both levels" if decision.delivery_checked
            else "the levels have not yet been known for long enough",
            WARN,
        )
        self._diagnose_drive(now)

    def _diagnose_inputs(self, decision: Decision) -> None:
        for part, names in _PARTS.items():
            diagnosis, level = bad_inputs(self._by_name[name] for name in names), ERROR
            if diagnosis is None:  # a good value may still keep the pump off
                level, diagnosis = WARN, next((
                    reason for code, reason in decision.interlocks.items()
                    if part in read_interlocks()[code].explained_by
                ), None)
            elif part == "frost":
                level, diagnosis = WARN, diagnosis.change_code(self._cause("frost_unknown"))
            well = " and ".join(name.replace("_", " ") for name in names)
            self.reports.diagnose(part, diagnosis, f"known: {well}", level)

    def _cause(self, code: str) -> str:
        """Return the code that caused an interlock; empty if unknown."""
        entry = self._by_name.get(code.removesuffix("_unknown"))
        if entry is None or (diagnosis := entry.diagnosis) is None:
            return ""
        unknown = code == "frost_unknown" and diagnosis.code == "input_refused"  # NaN means unknown
        return "temperature_unknown" if unknown else diagnosis.code

    def _diagnose_dose(self, dose: Dose | None) -> None:
        """Report the progress of a dose and, for a minute after its end, its outcome."""
        if dose is None:
            self.reports.diagnose("dose", None, "no dose is under way", log=False)
            return
        early = dose.ended_early if dose.over not in ("", DONE) else None
        self.reports.diagnose("dose", early, dose.sentence, WARN, dose.cause, log=False)

    def _diagnose_drive(self, now: float) -> None:
        snapshot = self._exchange.snapshot
        status, absence = snapshot.status_at(now), snapshot.absence_at(now)
        file = self._exchange.endpoint.file
        if unverified := ", ".join(file.unverified_and_vital):
            self.reports.diagnose("drive file", Diagnosis.of(
                "drive_file_unverified", file=str(file.path), settings=unverified
            ), level=WARN)
        if absence is not None:
            lost = bool(snapshot.errors)
            self.reports.diagnose(
                "drive", absence if lost else absence.change_code("drive_awaited"),
                level=ERROR if lost else WARN,
            )
        if status is None:
            return
        self.reports.hardware = f"{snapshot.identity}, {self._exchange.endpoint}"
        warning = "; ".join(filter(None, (snapshot.problem, status.warning)))
        level, diagnosis = WARN, None
        if status.fault:
            level, diagnosis = ERROR, drive_fault(status.fault, status.runs_on)
        elif not status.remote:
            more = {"problem": warning} if warning else {}
            diagnosis = Diagnosis.of("drive_local", "local", *more, **more)
        elif snapshot.second_master:
            diagnosis = snapshot.second_master
        elif warning:
            diagnosis = Diagnosis.of("drive_warning", warning=warning)
        self.reports.diagnose("drive", diagnosis, f"connected to {snapshot.identity}", level)
        self._diagnose_timeout(snapshot)

    def _diagnose_timeout(self, snapshot: DriveSnapshot) -> None:
        guard = self._exchange.endpoint.guard
        well = f"if this computer fails, the drive stops after {snapshot.timeout_s or 0:g} s"
        if guard is not None and guard.traps:
            well += f"; beware: {guard.traps}"
        diagnosis, level = self._exchange.timeout_problem(snapshot), ERROR
        if diagnosis is None:
            diagnosis, level = snapshot.unguarded, WARN
        self.reports.diagnose("drive timeout", diagnosis, well, level)


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


main = live_command(PumpNode, __doc__)


if __name__ == "__main__":
    main()
