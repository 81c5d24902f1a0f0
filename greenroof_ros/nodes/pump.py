"""The pump node: /pump/command in, a drive on Modbus turned, /pump/flow out.

It is a lifecycle node. *configure* connects to the drive and reads its nameplate and its own
communication timeout; *activate* lets the pump run, unless that timeout is off, too long or
unreadable; *deactivate* ramps down, *cleanup* lets go. ``~/stop`` (std_srvs/SetBool) keeps the pump
off over anything, after a restart too; ``~/reset`` (std_srvs/Trigger) clears a latched fault. In
any state each command is answered by the flow, and /pump/state says why the pump stands.
"""

from __future__ import annotations

import math
import re
import threading
import time
from pathlib import Path
from typing import Any

from std_srvs.srv import SetBool, Trigger

from greenroof_ros.common.clock import boot_time, suspended_time
from greenroof_ros.common.command_line import EXIT_DONE, command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.drives.address import parse_drive_address
from greenroof_ros.drives.drive import DriveStatus
from greenroof_ros.drives.drive_file import LONGEST_RAMP_S, find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import RESET_S, UNREAD_S, DriveExchange, Snapshot
from greenroof_ros.graph.inputs import Input
from greenroof_ros.graph.lifecycle import (
    ACTIVATE,
    ACTIVE,
    CONFIGURE,
    INACTIVE,
    UNCONFIGURED,
    Lifecycle,
    RefusedError,
)
from greenroof_ros.graph.link import LISTEN_S, LinkedNode
from greenroof_ros.graph.live import (
    FROZEN_MOVEMENT,
    JUMP_TOLERANCE,
    LEVEL_PARAMETERS,
    LIMITS,
    live_parameters,
)
from greenroof_ros.graph.lockstep import CLOCK
from greenroof_ros.graph.messages import decode_clock
from greenroof_ros.graph.node_help import NodeParser, node_help
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import (
    LIVE,
    declare,
    default_site,
    site_file,
)
from greenroof_ros.graph.permit import PermitReader
from greenroof_ros.graph.reports import ERROR, OK, STALE, WARN
from greenroof_ros.model.site import Site
from greenroof_ros.pumping.input_rules import (
    LevelRule,
    cistern_reach,
    expected_rise,
    roof_reach,
)
from greenroof_ros.pumping.ledger import Ledger, state_directory
from greenroof_ros.pumping.pump_control import Decision, Observation, PumpControl
from greenroof_ros.pumping.settings import PumpSettings, pump_parameters

_NEEDED = ("/pump/command", "/cistern/level", "/roof/level", "/weather/frost")
_METER = "/pump/meter"
# Without a call for so long the drive's thread stops the drive: this node hangs (s).
_DEAD_MAN_S = 1.0
# How long *configure* and *cleanup* wait for the drive at most: no command is answered meanwhile,
# and who watches this node takes a longer silence for a failure (s).
_WAIT_S = 1.0
# How old what the drive said may be (s). Nothing is known of it during a start, of some seconds; a
# lost connection is noticed by the exchange, sooner.
_DRIVE_AGE_S = 10.0
# A pause of this process itself (s), after which what waited for it is no command of now; and for
# how long it is said that the whole machine was suspended (s).
_PAUSE_S, _SAID_S = 1.0, 60.0
# How often a node that is to start by itself tries to, and how often the drive is looked at (s).
_AGAIN_S, _LOOK_S = 0.5, 0.2

_OWN = (
    Parameter("drive", "", meaning="make of drive, a file of config/drives, or a file's path"),
    Parameter(
        "address", "", meaning="of the drive: tcp://HOST:PORT where it has an Ethernet port of "
        "its own, gateway://HOST:PORT of a gateway to its serial port, or /dev/tty... of a "
        "serial line; after a comma its device id, where that is not its file's, such as "
        "gateway://HOST:PORT,17",
    ),
    Parameter(
        "exchange_period", 0.1, "s", 0.02, 1.0, "time between two rounds of requests to the drive",
    ),
    Parameter("autostart", False, meaning="configure and activate by itself, until that works"),
    Parameter(
        "drive_timeout_limit", 10.0, "s", 0.1, 60.0, "greatest communication timeout that the "
        "drive itself may have",
    ),
    Parameter(
        "activate_without_drive_timeout", False, meaning="activate although the drive itself "
        "would run on when this machine fails: DANGEROUS",
    ),
    Parameter(
        "local_settings_stop_the_pump", False, meaning="a person has set the pump so that it "
        "stands when the bus lets go of it, and has seen that it does; needed where that cannot "
        "be read",
    ),
    Parameter(
        "state_file", "", meaning="keeps a stop, a fault and the day's use over restarts; "
        "without it greenroof_ros/NAME.json in $XDG_STATE_HOME or ~/.local/state",
    ),
)


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters, but for the site."""
    return [
        LIVE, *_OWN, *pump_parameters(site), *live_parameters([*_NEEDED, _METER]),
        *LEVEL_PARAMETERS,
    ]


class _Drive:
    """The drive of the parameters, and what speaks against using it."""

    def __init__(self, values: dict[str, Any], node_name: str) -> None:
        """Read its file.

        Raises:
            ConfigurationError: a parameter or the file is wrong.
        """
        key = f"parameter {{}} of {node_name}"
        if not values["drive"]:
            raise ConfigurationError(
                "must be given: the make of the drive, as a file of config/drives without .yaml, "
                "or the path of a file of one's own", key=key.format("drive"),
            )
        self.file = read_drive_file(find_drive_file(values["drive"]))
        self._address = parse_drive_address(values["address"], key.format("address"))
        self._period = values["exchange_period"]
        self._limit = values["drive_timeout_limit"]
        self.without_timeout = values["activate_without_drive_timeout"]
        self._stops_locally = values["local_settings_stop_the_pump"]
        self._exchange: DriveExchange | None = None
        self._leaving: threading.Thread | None = None

    @property
    def snapshot(self) -> Snapshot:
        """What is known of it."""
        return Snapshot() if self._exchange is None else self._exchange.snapshot

    def connect(self) -> None:
        """Begin to keep it stopped, once it is let go of."""
        if self._leaving is not None and not self._leaving.is_alive():
            self._exchange = self._leaving = None
        if self._exchange is None:
            self._exchange = DriveExchange(
                self.file, self._address, self._period, _DEAD_MAN_S,
                timeout_limit_s=self._limit,
            )
            self._exchange.start()

    def let_go(self, within: float | None = None) -> str:
        """Stop it, and return what it says then.

        Args:
            within: how long to wait for that at most (s); without it the longest ramp and a few
                seconds.

        Raises:
            RefusedError: it takes longer, and goes on.
            OSError: it was not heard at the end, or does not stand.
        """
        if self._exchange is None:
            return ""
        if self._leaving is None:
            self._leaving = threading.Thread(target=self._exchange.close, daemon=True)
            self._leaving.start()
        self._leaving.join(within)
        if self._leaving.is_alive():
            raise RefusedError("the drive is still slowing down, or not heard; ask again")
        snapshot, self._exchange, self._leaving = self._exchange.snapshot, None, None
        status = snapshot.status
        # A thread that still talks to it has not read that it stands.
        if status is not None and status.stands and not snapshot.connected:
            return f"let go of the drive: {status}"
        if status is None or snapshot.connected:
            what = f"the drive was not heard at the end ({snapshot.problem or 'no last answer'})"
        else:
            what = f"the drive does not stand at the end: {status}"
        rest = "nothing but its own panel stops it now: its communication timeout is not known"
        if snapshot.timeout_known:
            rest = "nothing but its own panel stops it now: its communication timeout is off"
        if snapshot.timeout_s is not None:
            rest = f"its own timeout of {snapshot.timeout_s:g} s has to stop it"
        raise OSError(f"{what}; {rest}")

    def demand(self, speed: float | None) -> None:
        """Ask for a speed, share of the rated one; None for off."""
        if self._exchange is not None:
            self._exchange.demand(speed)

    def reset(self) -> None:
        """Have its fault acknowledged."""
        if self._exchange is not None:
            self._exchange.reset()

    def status(self, now: float) -> DriveStatus | None:
        """Return what it said last, unless that is too old."""
        snapshot = self.snapshot
        return snapshot.status if now - snapshot.read_at < _DRIVE_AGE_S else None

    def absence(self, now: float) -> str:
        """Return why it cannot be heard; empty where it can."""
        if self._leaving is not None:
            return "no connection to the drive: it is being let go of; clean up first"
        if self.status(now) is not None:
            return ""
        return f"no connection to the drive: {self.snapshot.problem}"

    @property
    def timeout_traps(self) -> str:
        """When its own communication timeout does not guard although it reads well."""
        own = self.file.timeout.over(self._address)
        return "" if own is None else own.traps

    def timeout_problem(self, snapshot: Snapshot) -> str:
        """Return what is wrong with its own communication timeout; empty where nothing is."""
        known, seconds = snapshot.timeout_known, snapshot.timeout_s
        own = self.file.timeout.over(self._address)
        repair = f"; to set it: {own.how_to_set}" if own is not None else ""
        if not known:
            return (
                "the drive's own communication timeout could not be read "
                f"({snapshot.timeout_note}){repair}"
            )
        if seconds is None:
            return (
                "the drive's own communication timeout is off "
                f"({snapshot.timeout_note}){repair}"
            )
        if seconds > self._limit:
            return (
                f"the drive's own communication timeout is {seconds:g} s, and must be at most "
                f"{self._limit:g} s (drive_timeout_limit){repair}"
            )
        if own is not None and own.local_settings_decide and not self._stops_locally:
            return (
                "after the drive's own communication timeout, or this node's end, the pump does "
                "what is set in itself, which cannot be read: set it to stop there, see that it "
                f"does, and say so (local_settings_stop_the_pump: true){repair}"
            )
        return ""


class PumpNode(Lifecycle, LinkedNode):
    """Turns the pump as commanded, while nothing speaks against it."""

    def __init__(self) -> None:
        """Declare the parameters, and open topics and services."""
        LinkedNode.__init__(self, "pump", "pump")
        self._site = site = self.declare_site()
        values = declare(self, parameters(site)[1:])  # the link declares the first
        self._drive = _Drive(values, self.get_name())
        self.act_every(site.tau)
        given = {one.name: values[one.name] for one in pump_parameters(site)}
        given["least_speed"] = max(given["least_speed"], self._drive.file.least_speed)
        settings = PumpSettings(**given)
        self._settings, self._state_file = settings, self._place_of_state(values)
        drive_stops_after = UNREAD_S + values["drive_timeout_limit"] + LONGEST_RAMP_S
        if self._drive.without_timeout:
            drive_stops_after = math.inf
        self._drive_stops_after = drive_stops_after
        self._begin_with(Ledger(self._state_file, time.time))
        self._permit = PermitReader()
        self._command_limit = self._checked_command_limit(values)
        self._autostart: bool = values["autostart"]
        self._without_timeout = self._drive.without_timeout
        self._resetting_until = 0.0
        self._decision = Decision(
            None, "off", "not started", (), 0.0, "", "", stands=False, turns_at=None,
            flow_known=False, blind_for=0.0,
        )
        self._state = self._logged = ""
        self._reasons: tuple[object, ...] = ()
        now = time.monotonic()
        # Both of the clock that goes on in a suspend, as the permit's.
        self._commanded = -math.inf
        self._idle_at = boot_time()
        self._suspended, self._suspend_seen = suspended_time(), -math.inf
        self._simulated = 0.0
        self._stepped: float | None = None
        self._decided = now
        self._tried = self._looked_at = -_AGAIN_S
        self._rules = [
            LevelRule(reach, values[FROZEN_MOVEMENT.name], values[JUMP_TOLERANCE.name])
            for reach in (cistern_reach(site), roof_reach(site))
        ]
        on_command = self._on_command if self.live else None
        self._command = self.subscribe("/pump/command", on_command, heals=True)
        self._cistern = self.subscribe("/cistern/level", level=self._rules[0])
        self._roof = self.subscribe("/roof/level", level=self._rules[1])
        self._frost = self.subscribe("/weather/frost")
        self._meter: Input | None = None
        if self.live:
            self._meter = self.subscribe(_METER, optional=True)
            self._rival = self.rivals("/pump/flow")
        else:
            self.subscribe(CLOCK, self._on_clock, raw=True)
        self._publish_flow = self.publish_topic("/pump/flow")
        self._publish_state = self.publish_topic("/pump/state")
        Lifecycle.__init__(self)
        self.create_service(SetBool, "~/stop", self._on_stop_request)
        self.create_service(Trigger, "~/reset", self._on_reset_request)
        self._step(now, 0.0)

    def _begin_with(self, ledger: Ledger) -> None:
        """Control the pump with what a ledger knows of before."""
        self._ledger = ledger
        self._control = PumpControl(
            self._site, self._settings, ledger, self._drive_stops_after
        )
        kept = ledger.record
        why = kept.fault or kept.held or kept.unknown
        if why:
            self.get_logger().warning(f"{self._state_file} keeps the pump off: {why}")

    def _take_state(self) -> None:
        """Take the state file over, as it is by now, if another had it or it could not be made.

        What was stopped or found here meanwhile counts on.
        """
        mine = self._ledger
        if mine.writes:
            return
        ledger = Ledger(self._state_file, time.time)
        if not ledger.writes:
            return
        held, fault = mine.record.held, mine.record.fault
        self._begin_with(ledger)
        self._reasons = ()  # decide anew
        # A release of before is not one of what this file says, or of its not being readable.
        if held and held != mine.found.held:
            ledger.stop(held)
        if fault and fault != mine.found.fault:
            ledger.fault(fault, mine.record.fault_code)

    def _place_of_state(self, values: dict[str, Any]) -> Path:
        if values["state_file"]:
            return Path(values["state_file"])
        name = self.get_fully_qualified_name().strip("/").replace("/", "-")
        return state_directory() / f"{name}.json"

    def _checked_command_limit(self, values: dict[str, Any]) -> float:
        """Return the greatest age of a command (s).

        Raises:
            ConfigurationError: in a live graph the pump would never run with it.
        """
        name, tau = LIMITS["/pump/command"].name, self._site.tau
        limit: float = values[name]
        if self.live and limit <= tau:
            raise ConfigurationError(
                f"must be more than tau of the site, {tau:g} s: a command comes once in that time",
                key=f"parameter {name} of {self.get_name()}", value=limit,
            )
        return limit

    # --- lifecycle ------------------------------------------------------------------------------

    def configure(self) -> None:
        """Connect to the drive, and read what it is."""
        self._drive.connect()
        until = time.monotonic() + _WAIT_S
        while self._drive.absence(time.monotonic()):
            if time.monotonic() > until:
                # It is tried on: a drive that comes is stopped.
                raise RefusedError(
                    f"not configured: {self._drive.absence(until)}; it is tried on, ask again"
                )
            time.sleep(0.02)
        self.reports.hardware = self._drive.snapshot.identity

    def activate(self) -> None:
        """Let the pump run, unless the drive would run on alone, or a stop could not be kept."""
        absence = self._drive.absence(time.monotonic())
        if absence:
            raise RefusedError(f"not activated: {absence}")
        problem = self._drive.timeout_problem(self._drive.snapshot)
        if problem and not self._without_timeout:
            raise RefusedError(f"not activated: {problem}")
        self._take_state()
        problem = self._ledger.kept()
        if problem:
            raise RefusedError(f"not activated: {problem}")
        unverified = self._drive.file.unverified_and_vital
        if unverified:
            self.diagnose(
                "drive file", WARN, f"{self._drive.file.path} was not verified against a manual "
                f"in: {', '.join(unverified)}; watch the pump start and stop before you rely on it",
                "drive_file_unverified",
            )

    def deactivate(self) -> None:
        """Ramp down."""
        self._step(time.monotonic(), 0.0)

    def clean_up(self) -> None:
        """Stop the drive, read that it stands, and let go of it.

        Raises:
            RefusedError: it does not stand yet; it is gone on with.
            OSError: that could not be read.
        """
        self._let_go(_WAIT_S)

    def _let_go(self, within: float | None) -> None:
        said = self._drive.let_go(within)
        if said:
            self.get_logger().info(said)

    def on_asked(self) -> None:
        """Leave the lifecycle to who asked."""
        self._autostart = False

    def on_stop(self) -> None:
        """Stop the drive and read that back, whatever ends the node.

        Raises:
            OSError: it could not be read; the node's exit code says so, too.
        """
        try:
            self._let_go(None)
        finally:
            problem = self._ledger.close()
            if problem:
                self.get_logger().error(problem)

    def _start_by_itself(self, now: float) -> None:
        """Go towards *active* where that is possible, again and again."""
        if now - self._tried < _AGAIN_S or self.lifecycle_state == ACTIVE:
            return
        self._tried = now
        self._drive.connect()
        if self._drive.absence(now):
            return
        if self.lifecycle_state == UNCONFIGURED:
            self.change(CONFIGURE)
        if self.lifecycle_state == INACTIVE:
            self.change(ACTIVATE)

    # --- services -------------------------------------------------------------------------------

    def _on_stop_request(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        self._take_state()
        self._control.stop(request.data)
        self._step(time.monotonic(), 0.0)
        problem = self._ledger.kept()
        response.success = not problem
        response.message = f"{self._state}; but {problem}" if problem else self._state
        return response

    def _on_reset_request(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._take_state()
        cleared = self._control.reset()
        self._drive.reset()
        self._resetting_until = time.monotonic() + RESET_S
        response.message = f"cleared: {cleared}" if cleared else "there was no fault"
        problem = self._ledger.kept()
        response.success = not problem
        if problem:
            response.message += f"; but {problem}"
        self.get_logger().info(f"reset: {response.message}")
        return response

    # --- inputs ---------------------------------------------------------------------------------

    def _on_command(self, value: float) -> None:
        """Note that a command came, in a live graph; in lockstep the node acts on each."""
        self._commanded = boot_time()

    def _on_clock(self, message: bytes) -> None:
        self.set_time(decode_clock(message))

    def on_inputs(self) -> None:
        """Act on a command, in lockstep; in a live graph, act because it is time to."""
        now = time.monotonic()
        if not self.live:
            self._commanded = boot_time()
            self._simulated += self._site.tau
        self._step(now, self._passed(now))
        if self.live:
            self._expect()
        self._publish_flow(self._decision.flow)

    def _passed(self, now: float) -> float:
        """Return the time since the last step (s): simulated, or that of the steady clock."""
        before, self._stepped = self._stepped, now if self.live else self._simulated
        return 0.0 if before is None else self._stepped - before

    def on_idle(self) -> float:
        """Stop where something speaks against running, whether or not commands come."""
        now = time.monotonic()
        self._look_for_suspend(now)
        status = self._drive.status(now)
        reasons = (
            self._reasons_against(now), _fault(status),
            status is not None and status.stands,
            # Once a second, whether a drive that is not heard must stand by now.
            status is None and not self._decision.stands and now // 1,
        )
        if reasons != self._reasons:
            self._reasons = reasons
            self._step(now, 0.0)
        self._idle_at = boot_time()
        self._drive.demand(self._decision.speed)
        if self._autostart:
            self._start_by_itself(now)
        if now - self._looked_at > _LOOK_S:
            self._looked_at = now
            self._take_state()
            self._diagnose(now)
        return LISTEN_S

    def progress(self) -> dict[str, Any]:
        """Return what bringup shows, and waits for."""
        kept = self._ledger.record
        return {
            "pump": self._state, "pump_state": self._decision.state,
            "stands": self._decision.stands,
            "speed": self._decision.turns_at,
            "flow": self._decision.flow if self._decision.flow_known else None,
            "active": self.lifecycle_state == ACTIVE and not self._drive.snapshot.unguarded,
            "fault": kept.fault, "held": kept.held or kept.unknown,
        }

    # --- the pump -------------------------------------------------------------------------------

    def _reasons_against(self, now: float) -> dict[str, str]:
        """Return what this node has against running the pump, by interlock."""
        status, absence = self._drive.status(now), self._drive.absence(now)
        if self.lifecycle_state != ACTIVE:
            refusal = self.refusal or "the node is not active"
            return {"not_active": refusal, "drive_lost": "" if absence in refusal else absence}
        reasons = {"drive_lost": absence}
        if status is not None:
            if not status.remote:
                reasons["drive_local"] = (
                    "the drive is in local control: hand it over to the bus at its panel"
                )
            if not self._without_timeout:
                reasons["drive_timeout"] = self._drive.timeout_problem(self._drive.snapshot)
            reasons["drive_guards_later"] = self._drive.snapshot.unguarded
        reasons["no_permit"] = self._permit.missing(boot_time())
        reasons["two_controllers"] = self._command.publishers.said(now)
        if self.live:
            # Another pump node may have the same drive: neither runs it then.
            reasons["two_pumps"] = self._rival(now)
        reasons["no_command"] = self._silence()
        return reasons

    def _look_for_suspend(self, now: float) -> None:
        """Say, for a minute, that the machine was suspended while the pump was on."""
        before, self._suspended = self._suspended, suspended_time()
        seconds = self._suspended - before
        if seconds > _PAUSE_S and not self._decision.stands:
            self._suspend_seen = now
            self.diagnose(
                "suspend", ERROR, f"the machine was suspended for {seconds:.0f} s while the pump "
                "was on, and only the drive's own communication timeout could stop it: keep this "
                "machine from suspending", "suspended",
            )
        elif now - self._suspend_seen > _SAID_S:
            self.diagnose("suspend", OK, "the machine stays awake while the pump is on")

    def _silence(self) -> str:
        """Return that commands are missing, by the steady clock alone."""
        now = boot_time()
        if self._commanded < 0:
            return "no command has come yet"
        if now - self._commanded > self._command_limit:
            return f"no command has come for {self._command_limit:g} s (command_limit)"
        if now - self._idle_at > _PAUSE_S:
            return f"this node itself stood still for {now - self._idle_at:.0f} s"
        return ""

    def _value(self, entry: Input | None) -> float | None:
        """Return the value of an input; None where it is not good, or none has come."""
        return float(entry.value) if self.acted and entry is not None and entry.good else None

    def _step(self, now: float, dt: float) -> None:
        """Decide on what is known, and say it."""
        status, frost = self._drive.status(now), self._value(self._frost)
        seen = Observation(
            command=self._value(self._command),
            cistern_level=self._value(self._cistern),
            roof_level=self._value(self._roof),
            displacements=(self._rules[0].displacement, self._rules[1].displacement),
            frost=None if frost is None else frost > 0,
            speed=None if status is None else status.speed,
            flow=self._value(self._meter),
            drive_flow=None if status is None else status.flow,
            drive_ready=status is not None and (status.ready or status.running),
            drive_fault="" if now < self._resetting_until else _fault(status),
            runs_on=status is not None and status.runs_on,
            reasons=self._reasons_against(now),
        )
        time_now = now if self.live else self._simulated
        drive_dt, self._decided = now - self._decided, now
        self._decision = decision = self._control.step(time_now, dt, seen, drive_dt)
        self._drive.demand(decision.speed)
        state = f"{decision.state}: {decision.why}"
        if state != self._state:
            self._state = state
            self._publish_state(state)
        without_numbers = re.sub(r"[\d.]+", "", state)
        if without_numbers != self._logged:
            self._logged = without_numbers
            self.get_logger().info(state)

    def _expect(self) -> None:
        """Expect of the levels what the pump does to them in a tick."""
        if self._cistern.good and self._roof.good:
            rises = expected_rise(
                self._site, self._decision.flow, 0.0, self._cistern.value, self._roof.value
            )
            for rule, rise in zip(self._rules, rises, strict=True):
                rule.expect(rise * self._site.tau)

    def _diagnose(self, now: float) -> None:
        """Say how each part is; what has numbers in it changes too often for the log."""
        decision = self._decision
        code = decision.interlocks[0].interlock.code if decision.interlocks else ""
        level = ERROR if decision.state == "fault" else WARN if code else OK
        say = self.reports.diagnose
        say("pump", level, self._state, code, self._cause(code))
        limits = decision.warning or "nothing limits the pump"
        say("limits", WARN if decision.warning else OK, limits,
            "limited" if decision.warning else "", "")
        say("flow", OK, f"known so: {decision.source}", "", "")
        trouble = self._command.publishers.said(now) or (
            "" if self._command.good else f"{self._command.name} {self._command.why}"
        )
        silence = self._silence()
        late = bool(silence) and self.acted
        self.diagnose(
            "command", ERROR if trouble else STALE if late else OK,
            trouble or silence or "commands come",
            self._command.code or "two_controllers" if trouble else "no_command" if late else "",
        )
        bad = [one for one in (self._cistern, self._roof) if not one.good]
        self.diagnose(
            "levels", ERROR if bad else OK,
            "; ".join(f"{one.name} {one.why}" for one in bad) or "both levels are good",
            bad[0].code if bad else "",
        )
        frost = f"{self._frost.name} {self._frost.why}" if not self._frost.good else ""
        if self._frost.good and self._frost.value > 0:
            frost = "there is frost"
        blind = (
            f"blind for {decision.blind_for:.0f} s: a level is unknown, or both were not known for "
            f"{self._settings.averaging_time:g} s yet"
        )
        self.diagnose(
            "delivery", WARN if decision.blind_for else OK,
            blind if decision.blind_for else "what is pumped is compared with both levels",
            "delivery_blind" if decision.blind_for else "",
        )
        kept = self._ledger.problem
        self.diagnose(
            "state file", ERROR if kept else OK, kept or "stops and faults are kept",
            "state_not_kept" if kept else "",
        )
        self.diagnose(
            "frost", WARN if frost else OK, frost or "there is no frost",
            "frost" if self._frost.good and frost else self._cause("frost_unknown"),
        )
        if self._permit.given:
            why = self._permit.missing(boot_time())
            self.diagnose(
                "supervisor", WARN if why else OK, why or "bringup lets the pump run",
                "no_permit" if why else "",
            )
        self._diagnose_drive(now)

    def _cause(self, code: str) -> str:
        """Return the code from which an interlock follows; empty where that is not known."""
        inputs = {
            "cistern_level_unknown": self._cistern, "roof_level_unknown": self._roof,
            "frost_unknown": self._frost, "command_unknown": self._command,
        }
        cause = inputs[code].code if code in inputs else ""
        unknown = code == "frost_unknown" and cause == "input_refused"  # a NaN says so
        return "temperature_unknown" if unknown else cause

    def _diagnose_drive(self, now: float) -> None:
        if self.lifecycle_state == UNCONFIGURED and not self._autostart:
            self.diagnose(
                "drive", WARN, self.refusal or "the node is not configured", "not_active"
            )
            return
        snapshot, status = self._drive.snapshot, self._drive.status(now)
        if status is None:
            level, code = (ERROR, "drive_lost") if snapshot.errors else (WARN, "drive_awaited")
            self.diagnose("drive", level, self._drive.absence(now), code)
            return
        self.reports.hardware = snapshot.identity
        if status.fault:
            code = "runs_on" if status.runs_on else "drive_fault"
            self.diagnose("drive", ERROR, f"the drive reports a fault: {status.fault}", code)
        elif snapshot.problem or status.warning or not status.remote:
            local = "" if status.remote else "it is in local control"
            said = "; ".join(filter(None, (snapshot.problem, status.warning, local)))
            code = "drive_warning" if status.remote else "drive_local"
            self.diagnose("drive", WARN, f"the drive: {said}", code)
        else:
            self.diagnose("drive", OK, f"connected to {snapshot.identity}")
        problem, later = self._drive.timeout_problem(snapshot), snapshot.unguarded
        level, code = (
            (WARN, "drive_timeout_waived") if problem and self._without_timeout
            else (ERROR, "drive_timeout") if problem
            else (WARN, "drive_guards_later") if later else (OK, "")
        )
        said = problem or later or (
            f"without this machine the drive stops after {snapshot.timeout_s:g} s"
        )
        traps = self._drive.timeout_traps
        self.diagnose("drive timeout", level, f"{said}; beware: {traps}" if traps else said, code)


def _fault(status: DriveStatus | None) -> str:
    """Return a drive's fault, but not that its own timeout has stopped it: that heals."""
    return "" if status is None or status.timed_out else status.fault


def _help() -> str:
    """Return the node's help."""
    return node_help(
        "pump", "pump", f"{__doc__}", [LIVE, site_file(), *parameters(default_site())[1:]],
        "--ros-args -p drive:=danfoss_fc202 -p address:=gateway://127.0.0.1:5020 "
        "-p autostart:=true",
    )


@command
def main() -> int:
    """Run the node."""
    arguments = NodeParser().own_arguments()
    if arguments.help:
        print(_help())
        return EXIT_DONE
    return run_node(PumpNode)


if __name__ == "__main__":
    main()
