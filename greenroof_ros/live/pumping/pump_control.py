"""Control of the pump at every step: the pump follows the command unless an interlock is active."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from greenroof_ros.base.times import duration
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PumpState
from greenroof_ros.live.pumping.delivery import DeliveryCheck
from greenroof_ros.live.pumping.dose import FULL, INTERLOCK, UNSEEN, Doses
from greenroof_ros.live.pumping.interlocks import evaluate, latch, state_of, stored_reasons
from greenroof_ros.live.pumping.limits import Pulses, PumpLimits, PumpSettings
from greenroof_ros.live.pumping.pump_inputs import Observation
from greenroof_ros.live.pumping.state_file import SAVE_EVERY_S, StateFile
from greenroof_ros.physics.pump import STANDSTILL, flow_at
from greenroof_ros.site.site import Site

# A measured flow above this multiple of the maximum flow is implausible.
_MAX_FLOW = 1.5
# Speeds above this (share of the rated speed) and levels beyond this (m) are implausible.
_MAX_SPEED = 2.0
_MAX_LEVEL = 100.0
# This many consecutive failed starts are a fault.
_FAILED_STARTS = 3
# A meter may show a flow for 10 s after its end (sensor_file). If it shows one for longer than this
# (s), water is flowing.
_AFTERFLOW_S = 12.0


@dataclass(frozen=True)
class Decision:
    """Command to the drive, and the values that are reported.

    Attributes:
        speed: requested speed (share of the rated speed); None for off.
        state: off, starting, running, stopping, fault, held, or unknown, if the pump is commanded
            off, but may still be turning.
        why: reason for the state, in words.
        interlocks: the active interlocks by code, in the order of their table.
        flow: best current estimate of the flow (m3/s); None if it is unknown.
        source: source of the flow, in words.
        warnings: conditions that an operator should know about although they do not stop the pump.
        at_rest: whether the pump is stopped, either as reported or because of the drive's own
            timeout.
        reported_speed: speed that the drive reports (share of the rated speed), negative if the
            pump turns backwards; None if the drive does not respond or its value is implausible.
        delivery_checked: whether both levels have been known for long enough to check the delivery.
    """

    speed: float | None
    state: str
    why: str
    interlocks: Mapping[str, Diagnosis]
    flow: float | None
    source: str
    warnings: Sequence[Diagnosis]
    at_rest: bool
    reported_speed: float | None
    delivery_checked: bool

    @property
    def shown(self) -> PumpState:
        """The state as it is published."""
        return PumpState(self.state, self.why, tuple(self.interlocks))

    @property
    def flows_at_rest(self) -> bool:
        """Whether the drive reports standstill although a meter shows that the pump is running."""
        speed = self.reported_speed
        rests = self.speed is None and speed is not None and abs(speed) <= STANDSTILL
        return rests and not self.at_rest


class PumpControl:
    """Conversion of commands into speeds, with the pump kept off while an interlock is active.

    Attributes:
        doses: requests for doses, with the dose that is waiting, is running or has just ended.
    """

    def __init__(
        self, site: Site, settings: PumpSettings, state_file: StateFile,
        drive_stops_after: float,
    ) -> None:
        """Add the worst-case usage since the state was saved, and start with the pump off.

        Args:
            site: the site.
            settings: the pump's limits.
            state_file: state file, with the state before this start.
            drive_stops_after: time after which a drive that does not respond has stopped (s);
                infinite if it may run on.
        """
        self._site = site
        self._settings = settings
        self._state_file = state_file
        self._drive_stops_after = drive_stops_after
        state_file.count_unseen(drive_stops_after + SAVE_EVERY_S, flow_at(site, 1.0, site.z_o))
        self._limits = PumpLimits(site, settings, state_file)
        self._pulses = Pulses(site, settings)
        self._delivery = DeliveryCheck(site, settings)
        self.doses = Doses(site, time.time())
        self._setpoint: float | None = None
        # Speed that the slowest permitted ramp has reached on its way to the requested speed (share
        # of the rated speed); 1 at first, since the pump may have been running.
        self._ramped = 1.0
        self._follow_error_for = 0.0
        self._failed_starts = 0  # consecutive
        self._flowed_for = 0.0
        self._unknown_for = 0.0
        # Highest speed that the drive may have had when it last answered, share of the rated speed;
        # 1 at first, since it may not be stopped yet.
        self._max_speed = 1.0

    def discard_evidence(self) -> None:
        """Discard the evidence that led to a fault, since the fault has been cleared."""
        self._delivery = DeliveryCheck(self._site, self._settings)
        self._follow_error_for = self._flowed_for = 0.0
        self._failed_starts = 0

    def count_unseen(self, dt: float) -> None:
        """Account for unmonitored time, such as a suspension of the computer; the pump is then off.

        In the worst case, the pump ran on until the drive's own timeout stopped it. The unmonitored
        time does not count as time without a response from the drive: whether the drive has stopped
        must be read again.

        Args:
            dt: time since the last step (s).
        """
        self._max_speed = max(self._max_speed, self._setpoint or 0.0)
        ran = min(dt, self._drive_stops_after - self._unknown_for)
        if self._must_be_at_rest():
            ran = 0.0
        volume = ran * self._unseen_flow(Observation())
        self._limits.count(ran, ran > 0)
        self._limits.count(dt - ran, ran == dt)
        self._state_file.count(dt, ran, volume)
        self._delivery.step(dt, None, None, 0.0, volume)
        self._pulses.clear()
        self.doses.end(UNSEEN, f"the pump was not monitored for {dt:.0f} s")
        if self._setpoint is not None:
            self._limits.switch(False)
        self._setpoint = None

    def step(self, dt: float, observed: Observation) -> Decision:
        """Determine the state and the speed of the pump for this step.

        Args:
            dt: time since the last step (s); 0 at the first step.
            observed: present observations.
        """
        backwards, reported = _backwards(observed), observed.speed
        observed = _plausible(observed)
        warnings: list[Diagnosis] = []
        computed = None
        if observed.speed is not None and observed.cistern_level is not None:
            computed = flow_at(self._site, observed.speed, observed.cistern_level)
        known_flow, source = self._flow(observed, computed, warnings)
        flow = known_flow or 0.0
        self._unknown_for = self._unknown_for + dt if observed.speed is None else 0.0
        latest = self._max_speed if observed.speed is None else observed.speed
        self._max_speed = max(latest, self._setpoint or 0.0)
        unseen = self._unseen_flow(observed)
        # A meter may show no flow while the pump runs, if a valve is closed or the meter is broken.
        minimum = max(flow, computed or 0.0)
        self._count(dt, observed.speed, unseen, minimum)
        under_way = self.doses.present is not None
        self.doses.advance(dt, max(minimum, unseen) * dt)
        self._pulses.count(flow * dt, dt)
        undelivered = self._delivery.step(
            dt, observed.cistern_level, observed.roof_level, minimum * dt, max(flow, unseen) * dt,
            observed.displacements,
        )
        command, missing = observed.command, list[Diagnosis]()
        if command is None:
            missing.append(Diagnosis.of("command_unknown"))
        elif command > 1:
            warnings.append(Diagnosis.of("limited", "above", command=command))
            command = 1.0
        full = observed.roof_level is not None and observed.roof_level >= self._site.z_veg
        if full:
            self.doses.end(FULL, "the roof is at its target")
        if under_way and self.doses.present is None:
            self._pulses.clear()  # commands during a dose leave nothing outstanding
        dosed = command is not None and self.doses.present is not None
        if observed.speed is None and not backwards:
            missing.append(Diagnosis.of("drive_speed_unknown"))
        if not observed.drive_ready and not backwards:
            missing.append(Diagnosis.of("drive_not_ready"))
        active = evaluate([
            *self._faults(dt, observed, backwards, undelivered),
            *self._limits.reasons(1.0 if dosed else command, observed),
            *observed.reasons, *missing,
        ])
        setpoint = None
        if active:
            state, why = state_of(active)
            self._pulses.clear()
            self.doses.end(INTERLOCK, why, next(iter(active)))
            self.doses.inhibited = why
        else:
            assert command is not None
            assert observed.cistern_level is not None
            self.doses.minimum = self._pulses.min_pulse(observed.cistern_level)
            if dosed:
                command = self._dose_command(observed.cistern_level)
            setpoint, why = self._follow(command, full, observed.cistern_level, warnings)
            state = "off" if setpoint is None else "running"
            self.doses.inhibited = "the roof is at its target" if full else ""
            assert observed.roof_level is not None
            room = self._site.x2_star - self._site.roof_volume(observed.roof_level)
            if not full and room < self.doses.minimum:
                self.doses.inhibited = (
                    "the roof needs less than the pump's minimum pulse to reach its target"
                )
            if (dose := self.doses.present) is not None:
                dose.begun, dose.why = dose.begun or setpoint is not None, why
                why = f"a dose of {dose.volume:g} m3: {why}"
        if (setpoint is None) != (self._setpoint is None):
            self._limits.switch(setpoint is not None)
            if setpoint is None:  # a drive that is told to stop has its time again
                self._follow_error_for = 0.0
        self._setpoint = setpoint

        turning = observed.speed is not None and observed.speed > STANDSTILL
        if state == "running" and self._has_follow_error(observed.speed):
            state = "starting"
        elif state == "off" and turning:
            state = "stopping"
        elif state in ("fault", "held") and turning:
            why += f"; the pump is still turning, at {observed.speed:.2f} of its rated speed"
        if observed.speed is None:
            # A drive that answers but reports an implausible speed has not timed out.
            at_rest = reported is None and self._must_be_at_rest()
            if not at_rest and not backwards:
                why += "; it is unknown whether the pump has stopped"
                state = "unknown" if state == "off" else state
        else:
            at_rest = setpoint is None and not turning and not self._flows_on
        if at_rest and known_flow is None:
            known_flow = 0.0
        levels_known = observed.cistern_level is not None and observed.roof_level is not None
        return Decision(
            setpoint, state, why, active, known_flow, source, warnings, at_rest,
            reported if backwards else observed.speed, levels_known and self._delivery.has_mean,
        )

    def _dose_command(self, cistern_level: float) -> float:
        """Return the command for the current dose: at least the minimum share, to avoid pulses."""
        maximum = flow_at(self._site, 1.0, cistern_level)
        return max(self.doses.share(maximum), self._pulses.min_share(cistern_level))

    def _flow(
        self, observed: Observation, computed: float | None, warnings: list[Diagnosis]
    ) -> tuple[float | None, str]:
        """Return the current flow (m3/s; None if unknown), and its source.

        Args:
            observed: the measurements.
            computed: expected flow at the current speed (m3/s); None if unknown.
            warnings: list to which warnings about implausible flows are added.
        """
        site = self._site
        rests = observed.speed is not None and observed.speed <= STANDSTILL
        if rests and self._setpoint is None and not self._flowed_for:
            return 0.0, "the pump is stopped"
        level = site.z_o if observed.cistern_level is None else observed.cistern_level
        maximum = _MAX_FLOW * flow_at(site, 1.0, level)
        for flow, source in (
            (observed.flow, "flow meter"), (observed.drive_flow, "the drive's own")
        ):
            if flow is not None and flow <= maximum:
                return flow, source
            if flow is not None:
                warnings.append(Diagnosis.of(
                    "limited", "flow", source=source, flow=flow, max=maximum / _MAX_FLOW
                ))
        return computed, "unknown, assumed 0" if computed is None else "computed from the speed"

    def _unseen_flow(self, observed: Observation) -> float:
        """Return the worst-case flow while the drive does not respond (m3/s); 0 once stopped."""
        if observed.speed is not None or self._must_be_at_rest():
            return 0.0
        level = self._site.z_o if observed.cistern_level is None else observed.cistern_level
        return flow_at(self._site, min(1.0, self._max_speed), level)

    def _must_be_at_rest(self) -> bool:
        """Whether a pump of unknown speed has stopped, at the latest by the drive's timeout."""
        return self._max_speed <= STANDSTILL or self._unknown_for > self._drive_stops_after

    def _count(self, dt: float, speed: float | None, unseen: float, measured: float) -> None:
        """Record the time since the last step as on or off, and the higher of two flows (m3/s)."""
        turns = speed is not None and speed > STANDSTILL
        on = self._setpoint is not None or turns or unseen > measured
        self._limits.count(dt, on)
        self._state_file.count(dt, dt if on else 0.0, max(measured, unseen) * dt)

    def _has_follow_error(self, speed: float | None) -> bool:
        """Whether the speed differs from the requested speed by more than the tolerance."""
        setpoint = self._setpoint or 0.0
        return speed is not None and abs(speed - setpoint) > self._settings.follow_tolerance

    def _is_beyond_ramp(self, speed: float, dt: float) -> bool:
        """Whether the speed of the pump cannot be explained by the drive's ramp.

        The speed of a drive that obeys lies between the speed that the slowest ramp has reached and
        the requested speed. The ramp continues from the drive's current speed, so a new request is
        measured from that speed. The ramp begins when the pump begins to turn.
        """
        if self._setpoint is not None and speed <= STANDSTILL:
            self._ramped = speed
            return True
        setpoint, ramp, tolerance = (
            self._setpoint or 0.0, self._settings.drive_ramp, self._settings.follow_tolerance
        )
        step = dt / ramp if ramp else math.inf
        self._ramped += min(max(setpoint - self._ramped, -step), step)
        minimum, maximum = sorted((setpoint, self._ramped))
        if minimum <= speed <= maximum:
            self._ramped = speed
        return not minimum - tolerance <= speed <= maximum + tolerance

    @property
    def _flows_on(self) -> bool:
        """Whether a meter has shown flow for so long that the reported standstill must be false."""
        return self._flowed_for > _AFTERFLOW_S

    def _flows_at_rest(self, dt: float, observed: Observation) -> Diagnosis | None:
        """Return a fault if a meter shows flow although the drive reports standstill.

        A drive knows the state of its motor, and a relay its last command; neither detects a welded
        contact.
        """
        level = self._site.z_o if observed.cistern_level is None else observed.cistern_level
        minimum = self._settings.min_flow * flow_at(self._site, 1.0, level)
        measured = max(observed.flow or 0.0, observed.drive_flow or 0.0)
        speed = observed.speed
        at_rest = self._setpoint is None and speed is not None and speed <= STANDSTILL
        self._flowed_for = self._flowed_for + dt if at_rest and measured > minimum else 0.0
        if not self._flows_on:
            return None
        return Diagnosis.of("runs_on", "flow", flow=measured, time=self._flowed_for)

    def _faults(
        self, dt: float, observed: Observation, backwards: Diagnosis | None,
        undelivered: Diagnosis | None,
    ) -> list[Diagnosis]:
        """Return the current faults, of which one is latched, and the reasons in the state file."""
        failed_start = next(
            (reason for reason in observed.reasons if reason.code == "start_failed"), None
        )
        if failed_start and self._setpoint is not None:
            self._failed_starts += 1
        if observed.speed is not None:  # a short silence does not reset the timer
            beyond = self._is_beyond_ramp(observed.speed, dt)
            self._follow_error_for = self._follow_error_for + dt if beyond else 0.0
            if self._setpoint is not None and not beyond and not failed_start:
                self._failed_starts = 0
        found = [undelivered, self._flows_at_rest(dt, observed), backwards]
        if observed.speed is not None and self._follow_error_for > self._settings.follow_time:
            code = "runs_on" if self._setpoint is None else "speed_not_followed"
            found.append(Diagnosis.of(
                code, "speed", speed=observed.speed, requested=self._setpoint or 0.0,
                time=self._follow_error_for, ramp=self._settings.drive_ramp,
            ))
        if self._failed_starts >= _FAILED_STARTS:
            found.append(Diagnosis.of(
                "speed_not_followed", "starts", starts=self._failed_starts, why=failed_start or ""
            ))
        if observed.drive_fault:
            found.append(drive_fault(observed.drive_fault, observed.runs_on))
        faults = [fault for fault in found if fault is not None]
        latch(self._state_file, faults)
        return [*faults, *stored_reasons(self._state_file)]

    def _follow(
        self, command: float, full: bool, cistern_level: float, warnings: list[Diagnosis]
    ) -> tuple[float | None, str]:
        """Return the speed for a command (None for off), and the reason; no interlock is active."""
        pulses, on = self._pulses, self._setpoint is not None
        demanded = 0.0 if full else command
        since_start = self._limits.since_start
        share = pulses.update(demanded, cistern_level, on, since_start)
        minimum, pulse = pulses.min_share(cistern_level), pulses.min_pulse(cistern_level)
        why = "as commanded"
        if demanded < minimum:
            why = "in pulses, since the command is below the minimum flow"
            if pulses.outstanding > pulse:
                warnings.append(Diagnosis.of(
                    "limited", "outstanding", litres=1e3 * pulses.outstanding, pulse=1e3 * pulse
                ))
        if on and share == 0 and since_start < self._settings.min_on:
            share, why = minimum, f"it must stay on for at least {self._settings.min_on:g} s"
        if share == 0 and (full or command == 0):
            return None, "the roof is at its target" if full else "the command is 0"
        wait, why_wait = self._limits.wait()
        if share == 0:
            due_in = max(wait, pulses.due_in(cistern_level, since_start))
            return None, f"the next pulse is due in {duration(math.ceil(due_in))}"
        if on:
            return pulses.speed(share, cistern_level), why
        if wait > 0:
            return None, f"it may start in {duration(math.ceil(wait))}: {why_wait}"
        return pulses.speed(minimum, cistern_level), why  # it starts at its minimum


def drive_fault(fault: str, runs_on: bool) -> Diagnosis:
    """Return the fault of a drive; ``runs_on`` means that the drive does not obey a stop."""
    if runs_on:
        return Diagnosis.of("runs_on", "drive", fault=fault)
    return Diagnosis.of("drive_fault", fault=fault)


def _backwards(observed: Observation) -> Diagnosis | None:
    """Return a fault if the pump turns backwards faster than noise would explain."""
    if observed.speed is None or not -_MAX_SPEED <= observed.speed < -STANDSTILL:
        return None
    return Diagnosis.of("turns_backwards", speed=-observed.speed)


def _plausible(observed: Observation) -> Observation:
    """Return the observation with implausible values replaced by None."""

    def checked(value: float | None, minimum: float, maximum: float) -> float | None:
        return value if value is not None and minimum <= value <= maximum else None

    speed = checked(observed.speed, -STANDSTILL, _MAX_SPEED)
    return replace(
        observed,
        cistern_level=checked(observed.cistern_level, -_MAX_LEVEL, _MAX_LEVEL),
        roof_level=checked(observed.roof_level, -_MAX_LEVEL, _MAX_LEVEL),
        speed=None if speed is None else max(0.0, speed),
        drive_flow=checked(observed.drive_flow, 0.0, math.inf),
    )
