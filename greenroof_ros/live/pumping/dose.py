"""A dose: a volume requested by an operator, delivered once instead of the controller's command.

Anything that would stop the pump ends the dose, and a restart of the node discards it; the operator
must then request another dose. No dose therefore starts later than expected or continues
unattended.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.site.site import Site

EXPIRES_S = 60.0
"""A request expires at this age (s), both on arrival and while its dose waits to begin."""
# The requester's clock may be ahead of this machine's by at most this (s).
_AHEAD_S = 5.0
# Near its end, a dose flows at its remaining volume divided by this time (s), so it ends exactly.
_SLOWS_S = 30.0
# How long a dose is still reported after its end (s).
_REPORTED_S = 60.0

DONE, EXPIRED, FULL, INTERLOCK, UNSEEN = "done", "expired", "full", "interlock", "unseen"
"""How a dose ends, as machine-readable words."""


@dataclass
class Dose:
    """One dose.

    Attributes:
        id: time of the request, according to the requester's system clock (s since 1970).
        volume: requested volume (m3).
        age: time since the request, or, once the dose is over, since its end (s).
        delivered: volume delivered so far (m3).
        begun: whether the pump has run for the dose.
        over: outcome of the dose, as a machine-readable word; empty until the dose ends.
        why: what the pump is doing for the dose, or the reason why the dose is waiting or has
            ended.
        cause: code of the interlock that ended the dose.
    """

    id: float
    volume: float
    age: float
    delivered: float = 0.0
    begun: bool = False
    over: str = ""
    why: str = ""
    cause: str = ""

    @property
    def sentence(self) -> str:
        """State of the dose, as a sentence."""
        progress = f"{self.delivered:.3f} of {self.volume:g} m3"
        if not self.over:
            if self.begun:
                return f"a dose: {progress}; {self.why}"
            return f"a dose is waiting: {self.why}"
        if self.over == DONE:
            return f"the dose of {self.volume:g} m3 was delivered"
        return self.ended_early.sentence

    @property
    def ended_early(self) -> Diagnosis:
        """Diagnosis of a dose that ended before all of its volume was delivered."""
        return Diagnosis.of(
            "dose_ended_early", volume=self.volume, delivered=self.delivered, why=self.why
        )


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
        if self._largest is None:
            return self.refusal
        if not 0 < volume <= self._largest:  # nor a NaN
            return f"a dose must be above 0 and at most {self._largest:g} m3 (max_dose)"
        age = now - requested_at
        if not -_AHEAD_S <= age <= EXPIRES_S:
            return (
                f"the request was made {age:.0f} s ago; the limit is {EXPIRES_S:g} s: repeat the "
                "request, or synchronize the clocks"
            )
        if requested_at <= self._newest:
            self._newest = min(self._newest, now + _AHEAD_S)  # this machine's clock was ahead
            return (
                "the request was made before the previous request, or before the pump node was "
                "started: repeat the request"
            )
        self._newest = requested_at  # even if it is refused below
        if refusal := self.refusal:
            return refusal
        if volume < self.minimum:
            return f"a dose must be at least {self.minimum:.3f} m3, the pump's minimum pulse"
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
            if dose.age > _REPORTED_S:
                self.last = None
            return
        dose.delivered += delivered
        if dose.delivered >= dose.volume:
            self.end(DONE)
        elif not dose.begun and dose.age > EXPIRES_S:
            self.end(EXPIRED, f"the dose could not be started within {EXPIRES_S:g} s: {dose.why}")

    def share(self, max_flow: float) -> float:
        """Return the share of the maximum flow (m3/s) that the current dose requires."""
        dose = self.present
        assert dose is not None
        return min(1.0, (dose.volume - dose.delivered) / (_SLOWS_S * max_flow))

    def end(self, how: str, why: str = "", cause: str = "") -> None:
        """End the current dose, if there is one.

        Args:
            how: outcome of the dose, one of this module's constants such as ``DONE``.
            why: the reason, as a clause.
            cause: code of the interlock that ended the dose.
        """
        if (dose := self.present) is not None:
            dose.over, dose.why, dose.cause, dose.age = how, why, cause, 0.0
