"""A dose: a volume requested by an operator, delivered once instead of the controller's command.

Anything that would stop the pump ends the dose, and a restart of the node discards it; the operator
must then request another dose. No dose therefore starts later than expected or continues
unattended.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
