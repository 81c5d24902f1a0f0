"""What a pump node does: it turns /pump/command into orders to a drive (Modbus) or relay (MQTT).

It is a lifecycle node. *configure* connects to the drive and reads its nameplate and its own
communication timeout; *activate* lets the pump run, unless that timeout is off, too long or
unreadable; *deactivate* ramps down; *cleanup* stops and disconnects. ``~/stop`` (std_srvs/SetBool)
with true holds the pump: it stays off, regardless of the command, also after a restart; with false
it ends any hold. ``~/hold`` (rcl_interfaces/SetParametersAtomically) holds it for an ``owner``,
with a ``reason`` and an end, ``until`` (s since 1970), if they are given. ``~/reset``
(std_srvs/Trigger), for a person at the pump, clears a latched fault and an unknown state;
``~/clear``, for the page, clears only a fault that needs no person at the pump
(speed_not_followed). If the site file allows it, ``~/dose``
(rcl_interfaces/SetParametersAtomically: ``volume`` in m3, and
``asked_at``, the present time in s since 1970) delivers a volume once, or reports why not.
/pump/flow is published once per tick in every state. In between, the drive can be stopped by wall
time. /pump/state reports what the pump does, and why.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import parameter_value_to_python
from std_srvs.srv import SetBool, Trigger

from greenroof_ros.common.conditions import Diagnosis, joined, read_interlocks
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import state_directory
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.times import boot_time, suspended_time
from greenroof_ros.graph.graph_node import GraphNode
from greenroof_ros.graph.inputs import Input
from greenroof_ros.graph.parameters import site_file
from greenroof_ros.graph.publishers import Publishers
from greenroof_ros.graph.states import PumpState
from greenroof_ros.live.devices.drive import DriveStatus
from greenroof_ros.live.devices.drive_file import LONGEST_RAMP_S, find_drive_file
from greenroof_ros.live.devices.endpoint import Endpoint, read_endpoint
from greenroof_ros.live.devices.exchange import RESET_S, UNREAD_S, DriveExchange, DriveSnapshot
from greenroof_ros.live.engine import LIMITS, PAUSE_S
from greenroof_ros.live.lifecycle import (
    ACTIVE,
    INACTIVE,
    UNCONFIGURED,
    Lifecycle,
    RefusedError,
)
from greenroof_ros.live.live_diagnostics import ERROR, OK, STALE, WARN, LiveDiagnostics
from greenroof_ros.live.live_input import bad_inputs
from greenroof_ros.live.pumping.dose import DONE
from greenroof_ros.live.pumping.ledger import MOST, Ledger
from greenroof_ros.live.pumping.limits import PumpSettings, pump_parameters
from greenroof_ros.live.pumping.pump_control import (
    Decision,
    PumpControl,
    drive_fault,
)
from greenroof_ros.live.pumping.pump_inputs import INPUTS, Observation
from greenroof_ros.model.site import Site

COMMAND_LIMIT = LIMITS["/pump/command"]
# Longest wait of *configure* and *cleanup* for the drive (s): no command is handled meanwhile, and
# a supervisor takes a longer silence for a failure.
_WAIT_S = 1.0
# How long a suspend of the machine is reported (s).
_REPORTED_S = 60.0
# How often the node tries to start automatically, and how often it reports on the drive (s).
_AGAIN_S, _REPORT_S = 0.5, 0.2

_OWN = (
    Parameter("drive", "", meaning="make of drive, a file of config/drives, or a file's path"),
    Parameter(
        "address", "", meaning="address of the drive: tcp://HOST:PORT if it has its own Ethernet "
        "port, gateway://HOST:PORT for a gateway to its serial port, or /dev/tty... for a serial "
        "line; append a comma and its device id if that differs from its file's, such as "
        "gateway://HOST:PORT,17; or of a relay: mqtt://HOST[:PORT]/DEVICE (its topic at a "
        "broker), mqtts:// for TLS",
    ),
    Parameter(
        "broker_login", "", meaning="relay only: YAML file with the broker's username and "
        "password; empty: the broker needs none",
    ),
    Parameter(
        "broker_authority", "", meaning="relay only: file of trusted certificates (PEM); empty: "
        "the system's",
    ),
    Parameter(
        "exchange_period", 0.1, "s", 0.02, 1.0, "time between two rounds of requests to the drive",
    ),
    Parameter("autostart", False, meaning="configure and activate automatically, with retries"),
    Parameter(
        "drive_timeout_limit", 10.0, "s", 0.1, 60.0, "maximum communication timeout that the "
        "drive itself may have",
    ),
    Parameter(
        "activate_without_drive_timeout", False, meaning="activate although the drive itself "
        "would run on when this machine fails: DANGEROUS",
    ),
    Parameter(
        "local_settings_stop_the_pump", False, meaning="confirms that someone has set the pump "
        "to stop when the bus connection ends, and has seen it stop; needed if the setting cannot "
        "be read",
    ),
    Parameter(
        "state_file", "", meaning="file that keeps a hold, a fault and the day's use across "
        "restarts; empty: greenroof_ros/NAME.json in $XDG_STATE_HOME or ~/.local/state",
    ),
)


def common_parameters(site: Site) -> list[Parameter]:
    """Return the parameters of every pump node."""
    return [site_file(), *_OWN, *pump_parameters(site)]


class PumpBehaviour:
    """Runs the pump of a node as commanded, unless an interlock is active.

    The node, in a live graph or in a simulated one, reports when to act: it calls :meth:`step`.
    """

    def __init__(
        self, node: GraphNode, site: Site, values: Mapping[str, Any],
        inputs: Mapping[str, Input], commanders: Publishers, *, clock: Callable[[], float],
        displacements: Callable[[], tuple[float, float]] = lambda: (0.0, 0.0),
        own_flow: Publishers | None = None,
        missing_run: Callable[[], Diagnosis | None] = lambda: None, simulated: bool = False,
    ) -> None:
        """Open the node's topics and services.

        Args:
            node: the node, which also has a :class:`Lifecycle`.
            site: the site.
            values: values of the node's parameters.
            inputs: the node's inputs, by their names in
                :mod:`greenroof_ros.live.pumping.pump_inputs`.
            commanders: the publishers of the command.
            clock: returns the time of the pump control (s).
            displacements: returns how far impossible jumps have shifted both levels so far (m).
            own_flow: the publishers of the flow, to notice a second pump; None if there cannot be
                another.
            missing_run: returns why the drive must not run on levels that may be invented; None if
                it may.
            simulated: whether the plant is simulated.

        Raises:
            ConfigurationError: a parameter, or the drive file, is wrong.
        """
        self._node, self._lifecycle = node, cast(Lifecycle, node)
        self._reports, self._log = cast(LiveDiagnostics, node.reports), node.get_logger()
        self._clock, self._displacements = clock, displacements
        self._own_flow, self._missing_run = own_flow, missing_run
        self._site = site
        endpoint = _read_endpoint(values, node.get_name())
        self._make_exchange = partial(
            DriveExchange, endpoint, values["exchange_period"],
            timeout_limit_s=values["drive_timeout_limit"],
            stops_locally=values["local_settings_stop_the_pump"], checks_simulator=simulated,
        )
        self._exchange = self._make_exchange()
        self._without_timeout: bool = values["activate_without_drive_timeout"]
        self._autostart: bool = values["autostart"]
        self._command_limit: float = values[COMMAND_LIMIT.name]
        settings = {parameter.name: values[parameter.name] for parameter in pump_parameters(site)}
        least_speed = self._exchange.endpoint.file.least_speed
        settings["least_speed"] = max(settings["least_speed"], least_speed)
        self._settings = PumpSettings(**settings)
        own_name = node.get_fully_qualified_name().strip("/").replace("/", "-")
        self._state_file = Path(values["state_file"] or state_directory() / f"{own_name}.json")
        # Time after which a drive that is not responding is stopped (s).
        self._drive_stops_after = UNREAD_S + values["drive_timeout_limit"] + LONGEST_RAMP_S
        if self._without_timeout:
            self._drive_stops_after = math.inf
        self._ledger = Ledger(self._state_file, time.time)
        self._start_control()
        self._decision = Decision(
            None, "off", "not started", {}, 0.0, "", (), at_rest=False, reported_speed=None,
            flow_known=False, blind_for=0.0,
        )
        self._state = PumpState()
        self._reasons: tuple[object, ...] = ()  # as `check` last saw them
        self._watched = time.monotonic()
        self._resetting_until = 0.0
        self._tried_at = self._reported_at = -math.inf
        self._commanded_at, self._timed_at = -math.inf, boot_time()
        self._stepped = clock()
        self._suspended, self._suspended_at = suspended_time(), -math.inf
        self._inputs, self._commanders = inputs, commanders
        node.open_outputs("/pump/flow", "/pump/state")
        node.create_service(SetBool, "~/stop", self._on_stop_request)
        node.create_service(SetParametersAtomically, "~/hold", self._on_hold_request)
        node.create_service(Trigger, "~/clear", self._on_clear_request)
        node.create_service(Trigger, "~/reset", self._on_reset_request)
        node.create_service(SetParametersAtomically, "~/dose", self._on_dose_request)

    # --- state kept across restarts ---------------------------------------------------------------

    def _start_control(self) -> None:
        """Make the pump control, with the state kept in the ledger."""
        self._control = PumpControl(
            self._site, self._settings, self._ledger, self._drive_stops_after
        )
        record = self._ledger.record
        active_hold = self._ledger.active_hold
        if why := record.fault or record.unknown or (active_hold and active_hold.sentence):
            self._log.warning(f"{self._state_file} keeps the pump off: {why}")

    def _acquire_state(self) -> None:
        """Take over the state file, if another process had it or it could not be made."""
        if self._ledger.acquire():
            self._start_control()
            self._reasons = ()  # decide again

    # --- lifecycle --------------------------------------------------------------------------------

    def configure(self) -> None:
        """Connect to the drive, and read its nameplate."""
        self._connect()
        until = boot_time() + _WAIT_S
        while absence := self._exchange.absence(boot_time()):
            if boot_time() > until:
                # The exchange keeps trying: a drive that appears is stopped.
                raise RefusedError(
                    f"not configured: {absence.sentence}; still trying, ask again"
                )
            time.sleep(0.02)
        self._reports.hardware = self._exchange.snapshot.identity

    def activate(self) -> None:
        """Let the pump run, unless the drive would run on unattended or a stop cannot be saved."""
        problem = self._exchange.absence(boot_time())
        if problem is None and not self._without_timeout:
            problem = self._exchange.timeout_problem(self._exchange.snapshot)
        if problem is None:
            self._acquire_state()
            problem = Diagnosis.if_any("state_not_kept", self._ledger.flush())
        if problem is not None:
            raise RefusedError(f"not activated: {problem.sentence}")
        file = self._exchange.endpoint.file
        unverified = file.unverified_and_vital
        if unverified:
            self._reports.diagnose("drive file", Diagnosis.of(
                "drive_file_unverified", file=str(file.path), settings=", ".join(unverified)
            ), level=WARN)

    def deactivate(self) -> None:
        """Ramp down."""
        self.step(boot_time())

    def cleanup(self) -> None:
        """Stop the drive, confirm that it is stopped, and disconnect; refused until it is."""
        self._disconnect(_WAIT_S)

    def requested(self) -> None:
        """End the autostart: someone else now controls the lifecycle."""
        self._autostart = False

    def stop(self) -> None:
        """Stop the drive and confirm that it is stopped, regardless of what ends it.

        Raises:
            OSError: that could not be confirmed; the node's exit code also shows this.
        """
        try:
            self._disconnect(math.inf)
        finally:
            problem = self._ledger.close()
            if problem:
                self._log.error(problem)

    def _connect(self) -> None:
        """Start the exchange, which keeps the drive stopped; a closing one must end first."""
        if self._exchange.closing and self._exchange.close(0.0):
            self._exchange = self._make_exchange()
        self._exchange.start()

    def _disconnect(self, within: float) -> None:
        """Stop the drive and disconnect.

        Args:
            within: longest wait (s); the longest ramp plus a few seconds is enough for any drive.

        Raises:
            RefusedError: it takes longer; stopping continues.
            OSError: the drive did not answer at the end, or is not stopped.
        """
        if not self._exchange.started:
            return
        if not self._exchange.close(within):
            raise RefusedError("the drive is still slowing down, or does not answer; ask again")
        ended, self._exchange = self._exchange, self._make_exchange()
        self._log.info(ended.outcome())

    def _try_autostart(self, now: float) -> None:
        """Try to become *active*; called repeatedly."""
        if now - self._tried_at < _AGAIN_S or self._is_active:
            return
        self._tried_at = now
        self._connect()
        if self._exchange.absence(now):
            return
        if self._lifecycle.lifecycle_state == UNCONFIGURED:
            self._lifecycle.trigger_configure()
        if self._lifecycle.lifecycle_state == INACTIVE:
            self._lifecycle.trigger_activate()

    # --- services ---------------------------------------------------------------------------------

    def _on_stop_request(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self._acquire_state()
        if request.data:
            self._ledger.hold("the operator")
        else:
            self._ledger.release()
        self.step(boot_time())
        if request.data:
            self._exchange.stop()
        response.success, response.message = self._service_result(str(self._state))
        return response

    def _on_hold_request(
        self, request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        self._acquire_state()
        result = response.result
        try:
            self._ledger.hold(**_parse_hold(request))
        except ValueError as error:
            result.successful, result.reason = False, str(error)
        else:
            self.step(boot_time())
            self._exchange.stop()
            result.successful, result.reason = self._service_result(str(self._state))
        self._log.info(f"hold requested: {result.reason}")
        return response

    def _on_reset_request(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._acquire_state()
        cleared = self._control.reset()
        self._exchange.reset()
        self._resetting_until = boot_time() + RESET_S
        response.success, response.message = self._service_result(
            f"cleared: {cleared}" if cleared else "there was no fault"
        )
        self._log.info(f"reset: {response.message}")
        return response

    def _on_clear_request(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._acquire_state()
        if refusal := self._control.clear_refusal:
            response.success, response.message = False, refusal
            return response
        self._control.clear()
        self.step(boot_time())
        response.success, response.message = self._service_result(str(self._state))
        self._log.info(f"fault cleared: {response.message}")
        return response

    def _on_dose_request(
        self, request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        fields = {parameter.name: parameter.value.double_value for parameter in request.parameters}
        self.step(boot_time())  # a reason against it may have just arrived
        if fields.keys() != {"volume", "asked_at"}:
            refusal = "a dose needs volume (m3) and asked_at (s since 1970), and nothing else"
        else:
            refusal = self._control.request_dose(fields["asked_at"], fields["volume"])
        self.step(boot_time())
        response.result.successful = not refusal
        response.result.reason = refusal or str(self._state)
        self._log.info(f"dose requested: {response.result.reason}")
        return response

    def _service_result(self, message: str) -> tuple[bool, str]:
        """Return a service's success, only if the state is saved for a restart, and its message."""
        problem = self._ledger.flush()
        return not problem, f"{message}; but {problem}" if problem else message

    # --- by the clock -----------------------------------------------------------------------------

    def command_received(self) -> None:
        """Note that a command has come."""
        self._commanded_at = boot_time()

    def check(self) -> None:
        """Decide again if the reasons against running change, even if no commands arrive."""
        now = boot_time()
        self._check_suspend(now)
        status = self._exchange.status(now)
        reasons = (
            [*self._reasons_against(now)], _fault(status),
            status is not None and status.at_rest,
            # Decide again every second, since a drive that is not responding comes to rest at some
            # time.
            status is None and not self._decision.at_rest and now // 1,
        )
        if reasons != self._reasons:
            self._reasons = reasons
            self.step(now)
        self._timed_at = boot_time()
        # Again and again: a request expires in a second.
        self._exchange.request_speed(self._decision.speed)
        if self._autostart:
            self._try_autostart(now)
        if now - self._reported_at > _REPORT_S:
            self._reported_at = now
            self._acquire_state()
            self._diagnose(now)

    def _check_suspend(self, now: float) -> None:
        """Report, for a minute, that the machine was suspended while the pump was on."""
        before, self._suspended = self._suspended, suspended_time()
        seconds = self._suspended - before
        if seconds > PAUSE_S and not self._decision.at_rest:
            self._suspended_at = now
            self._reports.diagnose("suspend", Diagnosis.of("suspended", suspended_s=seconds))
        elif now - self._suspended_at > _REPORTED_S:
            self._reports.diagnose("suspend", None, "the machine stays awake while the pump is on")

    # --- the pump ---------------------------------------------------------------------------------

    def _reasons_against(self, now: float) -> Iterator[Diagnosis]:
        """Yield this node's own reasons against running the pump."""
        snapshot, absence = self._exchange.snapshot, self._exchange.absence(now)
        if absence is not None:
            yield absence
        if not self._is_active:
            # While the drive is not responding, the refusal may be out of date.
            yield self._not_active("inactive", "" if absence else self._lifecycle.refusal)
            return
        status = self._exchange.status(now)
        if status is not None:
            if not status.remote:
                yield Diagnosis.of("drive_local", "local")
            yield from filter(None, (
                snapshot.second_master, snapshot.start_failed, snapshot.unguarded,
                None if self._without_timeout else self._exchange.timeout_problem(snapshot),
                self._missing_run(),
            ))
        yield from filter(None, (
            second_publisher(self._commanders, "two_controllers"),
            # Another pump node may have the same drive: then neither runs it.
            self._second_pump(), self._missing_command(),
        ))

    def _not_active(self, case: str, refusal: str) -> Diagnosis:
        if refusal:
            return Diagnosis.of("not_active", "refused", refusal=refusal)
        return Diagnosis.of("not_active", case)

    def _second_pump(self) -> Diagnosis | None:
        """Return that another node publishes a flow; None if none does."""
        if self._own_flow is None:
            return None
        return second_publisher(self._own_flow, "two_pumps")

    def _missing_command(self) -> Diagnosis | None:
        """Return that commands are missing, or that this node was paused; None if neither."""
        now = boot_time()
        if self._commanded_at < 0:
            return Diagnosis.of("no_command", "none")
        if now - self._commanded_at > self._command_limit:
            return Diagnosis.of("no_command", "silent", limit=self._command_limit)
        if now - self._timed_at > PAUSE_S:
            return Diagnosis.of("no_command", "paused", time=now - self._timed_at)
        return None

    def _value(self, name: str) -> float | None:
        """Return the value of an input; None if it is unknown."""
        entry = self._inputs.get(name)
        return float(entry.value) if self._node.acted and entry is not None and entry.good else None

    @property
    def _is_active(self) -> bool:
        return self._lifecycle.lifecycle_state == ACTIVE

    @property
    def drive(self) -> DriveExchange:
        """The communication with the drive."""
        return self._exchange

    def step(self, now: float) -> Decision:
        """Decide on what is known now, give the drive its order, and publish the state.

        Args:
            now: steady clock (s).
        """
        self._check_suspend(now)
        status = self._exchange.status(now)
        observation = Observation(
            **{row.name: self._value(row.name) for row in INPUTS},
            displacements=self._displacements(),
            # 0 until a plant publishes it
            time_ns=self._node.get_clock().now().nanoseconds or None,
            speed=None if status is None else status.speed,
            drive_flow=None if status is None else status.flow,
            drive_ready=status is not None and (status.ready or status.running),
            drive_fault="" if now < self._resetting_until else _fault(status),
            runs_on=status is not None and status.runs_on,
            reasons=[*self._reasons_against(now)],
        )
        dt = self._elapsed()
        # The drive is watched only while the machine is awake; this clock counts only that time.
        awake = time.monotonic()
        drive_dt, self._watched = awake - self._watched, awake
        decided, decision = self._decision, self._control.step(dt, observation, drive_dt)
        self._decision = decision
        self._exchange.request_speed(decision.speed)
        state = PumpState(decision.state, decision.why, tuple(decision.interlocks))
        before, self._state = self._state, state
        if state != before:
            self._node.publish("/pump/state", state.message())
            # Not at every change of the words: they have numbers.
            logged = (decided.state, decided.at_rest, *decided.interlocks)
            if (decision.state, decision.at_rest, *decision.interlocks) != logged:
                self._log.info(str(state))
        return decision

    def _elapsed(self) -> float:
        """Return the time since the last call (s); a pause of this process is one tick."""
        before, self._stepped = self._stepped, self._clock()
        dt, tau = self._stepped - before, self._site.tau
        if dt > tau + PAUSE_S:
            # All ticks since the last step were missed, except the present one.
            self._control.count_unseen(dt - tau)
            return tau
        return dt

    # --- reports ----------------------------------------------------------------------------------

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup shows and waits for."""
        record, decision, dose = self._ledger.record, self._decision, self._control.dose
        active_hold = self._ledger.active_hold
        return {
            "pump_state": self._state.state, "pump_why": self._state.why,
            "stands": decision.at_rest,
            "speed": decision.reported_speed,
            "flow": decision.flow if decision.flow_known else None,
            "active": self._is_active and not self._exchange.snapshot.unguarded,
            "fault": record.fault,
            "no_clear": self._control.clear_refusal,
            "unknown": record.unknown,
            "hold": {
                "owner": record.hold_owner, "reason": record.hold_reason,
                "until": record.hold_until, "said": active_hold.sentence,
            } if active_hold else None,
            "greatest_dose": self._site.greatest_dose,
            "least_dose": self._control.least_dose,
            "no_dose": self._control.dose_refusal,
            "dose": None if dose is None else {**asdict(dose), "said": dose.sentence},
        }

    def _diagnose(self, now: float) -> None:
        """Report each part; texts with numbers are not logged, since they change too often."""
        decision = self._decision
        diagnose = self._reports.diagnose
        self._reports.numbers |= self._numbers()
        first = next(iter(decision.interlocks.values()), None)
        wrong = first is not None and first.code != "quiet_hours"  # these are as intended
        diagnose(
            "pump", first and replace(first, text=str(self._state)), str(self._state),
            ERROR if decision.state == "fault" else WARN if wrong else OK,
            self._cause(first.code) if first else "", log=False,
        )
        diagnose("limits", joined(decision.warnings), "nothing limits the pump", WARN, log=False)
        if self._site.greatest_dose is not None:
            self._diagnose_dose()
        diagnose("flow", self._second_pump(), f"source: {decision.source}")
        self._diagnose_command()
        self._diagnose_inputs()
        levels_known = self._inputs["cistern_level"].good and self._inputs["roof_level"].good
        known_for = f"both levels have not yet been known for {self._settings.averaging_time:g} s"
        diagnose(
            "delivery",
            Diagnosis.of("delivery_blind") if decision.blind_for and not levels_known else None,
            known_for if decision.blind_for else "what is pumped is compared with both levels",
            WARN,
        )
        diagnose(
            "state file", Diagnosis.if_any("state_not_kept", self._ledger.problem),
            "holds and faults are kept",
        )
        self._diagnose_drive(now)

    def _diagnose_inputs(self) -> None:
        """Report what is wrong with the inputs, by part."""
        parts: dict[str, list[str]] = {}
        for row in INPUTS:
            part = read_interlocks()[row.unknown].input if row.unknown else ""
            if part not in ("", "command") and row.name in self._inputs:
                parts.setdefault(part, []).append(row.name)
        for part, names in parts.items():
            problem, level = bad_inputs(self._inputs[name] for name in names), ERROR
            if problem is None:  # perhaps a good value keeps the pump off
                level, problem = WARN, next((
                    reason for code, reason in self._decision.interlocks.items()
                    if part in read_interlocks()[code].explained_by
                ), None)
            elif part == "frost":
                level, problem = WARN, problem.under(self._cause("frost_unknown"))
            well = " and ".join(name.replace("_", " ") for name in names)
            self._reports.diagnose(part, problem, f"known: {well}", level)

    def _numbers(self) -> dict[str, dict[str, float | None]]:
        """Return the numbers behind the report of each part, in the units of the topics."""
        decision = self._decision
        flow = decision.flow if decision.flow_known else None
        known = {name: entry.value if entry.good else None for name, entry in self._inputs.items()}
        return {
            "pump": {"asked_speed": decision.speed, "speed": decision.reported_speed},
            "flow": {"flow": flow},
            "command": {"command": known["command"]},
            "levels": {name: known[name] for name in ("cistern_level", "roof_level")},
            "delivery": {"blind_for_s": decision.blind_for},
            "drive timeout": {"timeout_s": self._exchange.snapshot.timeout_s},
        }

    def _cause(self, code: str) -> str:
        """Return the code that caused an interlock; empty if unknown."""
        of_code = (row.name for row in INPUTS if row.unknown == code and row.name in self._inputs)
        problem = bad_inputs(self._inputs[name] for name in of_code)
        if problem is None:
            return ""
        unknown = code == "frost_unknown" and problem.code == "input_refused"  # NaN: unknown
        return "temperature_unknown" if unknown else problem.code

    def _diagnose_dose(self) -> None:
        """Report the progress of a dose and, for a minute, how it ended."""
        dose = self._control.dose
        if dose is None:
            self._reports.diagnose("dose", None, "no dose is under way", log=False)
            return
        self._reports.numbers["dose"] = {"volume": dose.volume, "delivered": dose.delivered}
        early = dose.ended_early if dose.over not in ("", DONE) else None
        self._reports.diagnose("dose", early, dose.sentence, WARN, dose.cause, log=False)

    def _diagnose_command(self) -> None:
        command, silence = self._inputs["command"], self._missing_command()
        problem = command.problem or second_publisher(self._commanders, "two_controllers")
        if silence and self._node.acted and problem is None:
            self._reports.diagnose("command", silence, level=STALE)
        else:
            well = silence.sentence if silence else "commands are arriving"
            self._reports.diagnose("command", problem, well)

    def _diagnose_drive(self, now: float) -> None:
        if self._lifecycle.lifecycle_state == UNCONFIGURED and not self._autostart:
            why = self._not_active("unconfigured", self._lifecycle.refusal)
            self._reports.diagnose("drive", why, level=WARN)
            return
        snapshot, status = self._exchange.snapshot, self._exchange.status(now)
        if status is None:
            absence, lost = self._exchange.absence(now), bool(snapshot.errors)
            if absence is not None and not lost:
                absence = absence.under("drive_awaited")
            self._reports.diagnose("drive", absence, level=ERROR if lost else WARN)
            return
        self._reports.hardware = snapshot.identity
        trouble = "; ".join(filter(None, (snapshot.problem, status.warning)))
        level, problem = WARN, None
        if status.fault:
            level, problem = ERROR, drive_fault(status.fault, status.runs_on)
        elif not status.remote:
            more = {"problem": trouble} if trouble else {}
            problem = Diagnosis.of("drive_local", "local", *more, **more)
        elif snapshot.second_master:
            problem = snapshot.second_master
        elif trouble:
            problem = Diagnosis.of("drive_warning", warning=trouble)
        self._reports.diagnose("drive", problem, f"connected to {snapshot.identity}", level)
        self._diagnose_timeout(snapshot)

    def _diagnose_timeout(self, snapshot: DriveSnapshot) -> None:
        """Report whether the drive's own communication timeout stops the pump."""
        guard = self._exchange.endpoint.guard
        well = f"without this machine the drive stops after {snapshot.timeout_s or 0:g} s"
        if guard is not None and guard.traps:
            well += f"; beware: {guard.traps}"
        problem, level = self._exchange.timeout_problem(snapshot), ERROR
        if problem is None:
            problem, level = snapshot.unguarded, WARN
        elif self._without_timeout:
            problem, level = problem.under("drive_timeout_waived"), WARN
        self._reports.diagnose("drive timeout", problem, well, level)


def _read_endpoint(values: Mapping[str, Any], node_name: str) -> Endpoint:
    """Return the drive that a node's parameters choose.

    Raises:
        ConfigurationError: a parameter or the drive file is wrong.
    """
    key = f"parameter {{}} of {node_name}"
    if not values["drive"]:
        raise ConfigurationError(
            "must be given: the make of the drive, as a file of config/drives without .yaml, or "
            "the path of your own file", key=key.format("drive"),
        )
    return read_endpoint(
        find_drive_file(values["drive"]), values["address"], key.format("address"),
        values["broker_login"], values["broker_authority"],
    )


def second_publisher(publishers: Publishers, code: str) -> Diagnosis | None:
    """Return that a topic has a second publisher, under this code; None if it has none.

    If one of them is incompatible, it is named: it may be trying to stop the pump.
    """
    second = publishers.second()
    if not second:
        return None
    return Diagnosis.of(
        code, topic=publishers.full_name, problem=publishers.incompatible() or second
    )


def _parse_hold(request: SetParametersAtomically.Request) -> dict[str, Any]:
    """Return owner, reason and end of a requested hold.

    Raises:
        ValueError: it is not such a request.
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
            "a hold needs an owner (text), and may have a reason (text) and until (s since 1970, a "
            "floating-point number), and nothing else"
        )
    if "until" in fields and not time.time() < fields["until"] <= MOST:
        raise ValueError(
            f"until = {fields['until']:.15g}: must be in the future, in s since 1970, and at most "
            f"{MOST:g}"
        )
    return fields


def _fault(status: DriveStatus | None) -> str:
    """Return a drive's fault, except a stop by its own timeout, which clears automatically."""
    return "" if status is None or status.timed_out else status.fault
