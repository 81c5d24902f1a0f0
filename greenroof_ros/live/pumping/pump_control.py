"""Control of the pump at every step: the pump follows the command unless an interlock is active.

A dose, a volume requested by an operator, is delivered once instead of the controller's command.
Anything that would stop the pump ends the dose, and a restart of the node discards it; the operator
must then request another dose. No dose therefore starts later than expected or continues
unattended.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

from greenroof_ros.base.times import duration
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.delivery import DeliveryCheck
from greenroof_ros.live.pumping.interlocks import Decision, Following, evaluate, state_of
from greenroof_ros.live.pumping.limits import Observation, Pulses, PumpLimits, PumpSettings
from greenroof_ros.live.pumping.state_file import SAVE_EVERY_S, StateFile
from greenroof_ros.physics.pump import STANDSTILL, flow_at, speed_for
from greenroof_ros.site.site import Site

EXPIRES_S = 60.0
"""A request expires at this age (s), both on arrival and while its dose waits to begin."""
# Near its end, a dose flows at its remaining volume divided by this time (s), so it ends exactly.
_SLOWS_S = 30.0
# How long a dose is still reported after its end (s).
_REPORTED_S = 60.0


def litres(volume: float) -> str:
    """Return a volume (m3) in words, in litres."""
    return f"{1000 * volume:.0f} litres"


@dataclass
class Dose:
    """One dose.

    Attributes:
        id: time of the request, according to the requester's system clock (s since 1970).
        volume: requested volume (m3).
        age: time since the request, or, once the dose is over, since its end (s).
        delivered: volume delivered so far (m3).
        begun: whether the pump was ever on for it.
        over: ``done`` if all of it was delivered, ``ended`` if it ended early; empty until then.
        why: what the pump is doing for the dose, or why the dose is waiting or has ended.
    """

    id: float
    volume: float
    age: float = 0.0
    delivered: float = 0.0
    begun: bool = False
    over: str = ""
    why: str = ""

    @property
    def flow(self) -> float:
        """The most that may flow now (m3/s)."""
        return (self.volume - self.delivered) / _SLOWS_S

    @property
    def sentence(self) -> str:
        """State of the dose, as a sentence."""
        progress = f"{1000 * self.delivered:.0f} of {litres(self.volume)}"
        if self.over == "done":
            return f"the dose of {litres(self.volume)} was delivered"
        if self.over:
            return f"the dose ended early, after {progress}: {self.why}"
        return f"a dose: {progress}; {self.why}"


class Doses:
    """Requests for doses, and the progress of the latest dose.

    A request is identified by the time at which it was made. The request must be newer than both
    the previous request and this object, so that a repeated request is not carried out a second
    time, even after a restart.

    Attributes:
        last: the latest dose, until some time after its end; None if there is no dose.
        minimum: the minimum volume (m3), which the pump delivers in a minimum pulse; infinite until
            the level is known.
        inhibited: reason why the pump must not run now; empty if it may run.
    """

    def __init__(self, site: Site, now: float) -> None:
        """Initialize without a dose.

        Args:
            site: site, which determines whether doses are allowed, and their maximum volume.
            now: system time (s since 1970).
        """
        self._largest = site.max_dose
        self._newest = now
        self.last: Dose | None = None
        self.minimum, self.inhibited = math.inf, "the pump has not been checked yet"

    @property
    def present(self) -> Dose | None:
        """The dose that is waiting or running; None if there is none."""
        return None if self.last is None or self.last.over else self.last

    @property
    def refusal(self) -> str:
        """The reason why any request would be rejected now; empty if there is none."""
        if self._largest is None:
            return "the site file does not allow doses (max_dose)"
        if (present := self.present) is not None:
            return f"another dose is under way: {present.sentence}"
        return self.inhibited and f"the pump must not run now: {self.inhibited}"

    def request(self, requested_at: float, volume: float, now: float) -> str:
        """Accept a request and return an empty string, or return the reason for its rejection.

        Args:
            requested_at: time at which the request was made (s since 1970), which is the dose's id.
            volume: requested volume (m3).
            now: system time (s since 1970).
        """
        age, before = now - requested_at, self._newest
        if abs(age) <= EXPIRES_S:  # even if it is refused below
            self._newest = max(before, requested_at)
        if self._largest is None or self.refusal:
            return self.refusal
        if not self.minimum <= volume <= self._largest:  # nor a NaN
            return f"a dose is from {math.ceil(1000 * self.minimum)} to {litres(self._largest)}"
        if not abs(age) <= EXPIRES_S or requested_at <= before:
            return (
                f"the request was made {age:.0f} s ago: it must be newer than {EXPIRES_S:g} s, the "
                "previous request and the start of the pump node; repeat it, or synchronize the "
                "clocks"
            )
        self.last = Dose(requested_at, volume, max(0.0, age))
        return ""

    def advance(self, dt: float, delivered: float) -> None:
        """Add elapsed time and delivered volume; end a dose that is delivered or has expired.

        Args:
            dt: elapsed time on a steady clock (s).
            delivered: volume delivered in that time (m3).
        """
        dose = self.last
        if dose is None:
            return
        dose.age += dt
        if dose.over:
            self.last = dose if dose.age <= _REPORTED_S else None
            return
        dose.delivered += delivered
        if dose.delivered >= dose.volume:
            self.end("all of it was delivered", "done")
        elif not dose.begun and dose.age > EXPIRES_S:
            self.end(f"it could not be started within {EXPIRES_S:g} s: {dose.why}")

    def end(self, why: str, over: str = "ended") -> None:
        """End the current dose, if there is one, for a reason in words."""
        if (dose := self.present) is not None:
            dose.over, dose.why, dose.age = over, why, 0.0


# A measured flow above this multiple of the maximum flow is implausible.
_MAX_FLOW = 1.5
_FULL = "the roof is at its target"
# After a longer time (s), only this much counts as a silence of the drive, which nobody has read.
_READ_EVERY_S = 1.0
AFTERFLOW_S = 12.0
"""time for which a meter may show a flow after its end (s); sensor_file allows 10 s"""


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
        self.doses = Doses(site, time.time())
        self._request: float | None = None
        # For how long the pump may still be turning while its drive does not respond (s).
        self._may_turn_for = drive_stops_after
        self.discard_evidence()

    def discard_evidence(self) -> None:
        """Discard the evidence that led to a fault, since the fault has been cleared."""
        self._delivery = DeliveryCheck(self._site, self._settings)
        self._following = Following(self._settings.follow_tolerance)
        self._flowed_for = 0.0

    def step(self, dt: float, observed: Observation) -> Decision:
        """Determine the state and the speed of the pump for this step.

        Args:
            dt: time since the last step (s); 0 at the first step.
            observed: present observations; without any, nobody watched the pump since the last
                step, and what it may have pumped meanwhile counts.
        """
        speed = observed.speed
        turning = speed is not None and abs(speed) > STANDSTILL
        rests = self._request is None and speed is not None and not turning
        level = self._site.z_o if observed.cistern_level is None else observed.cistern_level
        computed = None
        if speed is not None and observed.cistern_level is not None:
            computed = flow_at(self._site, max(0.0, speed), level)
        # A meter's offset does not count while the pump stands, nor an implausible value.
        plausible = _MAX_FLOW * flow_at(self._site, 1.0, level)
        measured = observed.flow
        flow = computed if measured is None or measured > plausible else measured
        if rests and not self._flowed_for:
            flow = 0.0
        # A meter may show no flow while the pump runs, if a valve is closed or the meter is broken.
        least = dt * max(flow or 0.0, computed or 0.0)
        most = least
        if speed is not None or self._request is not None:
            self._may_turn_for = 0.0 if rests else self._drive_stops_after
        if speed is None:
            seconds = min(dt, self._may_turn_for)
            self._may_turn_for -= min(seconds, _READ_EVERY_S)
            most = max(least, seconds * flow_at(self._site, 1.0, level))
        self._state_file.count(dt, most)
        self.doses.advance(dt, most)
        self._pulses.count(dt * (flow or 0.0), dt)
        undelivered = self._delivery.step(dt, observed, least, most)
        on = self._request is not None and speed is not None
        active = evaluate(self._state_file, [
            *self._limits.reasons(observed, on), *self._faults(dt, observed, level, rests),
            *filter(None, (undelivered,)), *observed.reasons,
        ])
        full = observed.roof_level is not None and observed.roof_level >= self._site.z_veg
        state, why = state_of(active) if active else ("off", _FULL if full else "")
        self.doses.inhibited = why
        if why:
            self.doses.end(why)
        if active:
            request = None
            self._pulses.clear()
        else:
            assert observed.command is not None
            self.doses.minimum = self._pulses.min_pulse(level)
            request, why = self._follow(min(1.0, observed.command), level, full)
            state = "off" if request is None else "running"
        if (request is None) != (self._request is None):
            self._limits.switch(request is not None)
            if request is None:  # a drive that is told to stop has its time again
                self._following.error_for = 0.0
        self._request = request

        at_rest = request is None and not turning and self._flowed_for <= AFTERFLOW_S
        if speed is None:
            at_rest = self._may_turn_for <= 0
            if not at_rest:
                why += "; it is unknown whether the pump has stopped"
                state = "unknown" if state == "off" else state
        elif request is not None and abs(speed - request) > self._settings.follow_tolerance:
            state = "starting"
        elif turning and state == "off":
            state = "stopping"
        elif turning and active:
            why += "; the pump is still turning: look again in some seconds"
        if at_rest and flow is None:
            flow = 0.0
        return Decision(active, state, why, at_rest, speed, flow, request)

    def _faults(
        self, dt: float, observed: Observation, level: float, rests: bool
    ) -> Iterator[Diagnosis]:
        """Yield the faults of a pump that does not do what the drive reports or is told."""
        speed, request = observed.speed, self._request or 0.0
        # A drive knows the state of its motor, and a relay its last command; neither detects a
        # welded contact.
        minimum = self._settings.min_flow * flow_at(self._site, 1.0, level)
        measured = observed.flow or 0.0
        self._flowed_for = self._flowed_for + dt if rests and measured > minimum else 0.0
        if self._flowed_for > AFTERFLOW_S:
            yield Diagnosis.of("runs_on", "flow", flow=measured, time=self._flowed_for)
        if speed is not None:  # a short silence does not reset the timer
            self._following.update(dt, speed, request)
        if self._following.error_for > self._settings.follow_time:
            yield Diagnosis.of(
                "runs_on" if self._request is None else "speed_not_followed", "speed",
                speed=speed or 0.0, requested=request, time=self._following.error_for,
            )

    def _follow(self, command: float, level: float, full: bool) -> tuple[float | None, str]:
        """Return the speed for a command or a dose (None for off), and the reason.

        Args:
            command: share of the maximum flow, 0 to 1.
            level: level of the cistern (m).
            full: whether the roof is at its target.
        """
        pulses, on = self._pulses, self._request is not None
        minimum, dose, why = pulses.min_share(level), self.doses.present, "as commanded"
        if dose is not None:  # without pulses
            command = min(1.0, max(minimum, dose.flow / flow_at(self._site, 1.0, level)))
            why = f"a dose of {litres(dose.volume)}"
        command = 0.0 if full else command
        share = pulses.update(command, level, on)
        if command < minimum:
            why = "in pulses, since the command is below the minimum flow"
        if on and share == 0 and self._state_file.state.since_start < self._settings.min_on:
            share, why = minimum, f"it must stay on for at least {self._settings.min_on:g} s"
        wait, why_wait = self._limits.wait()
        if share == 0 and command == 0:
            return None, _FULL if full else "the command is 0"
        if share == 0:
            due_in = math.ceil(max(wait, pulses.due_in))
            return None, f"the next pulse is due in {duration(due_in)}"
        if not on and wait > 0:
            request, why = None, f"it may start in {duration(math.ceil(wait))}: {why_wait}"
        else:
            speed = speed_for(self._site, share, level)
            request = min(1.0, max(self._settings.min_speed, speed))
        if dose is not None:
            dose.why, dose.begun = why, dose.begun or request is not None
        return request, why
