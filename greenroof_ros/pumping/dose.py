"""A dose: a volume that a person asks for, delivered once in place of the controller's command.

It is given up for any reason that would stop the pump, and forgotten with the node: who asked asks
again. So no dose begins later than somebody expects it, and none goes on that nobody watches.
"""

from __future__ import annotations

from dataclasses import dataclass

from greenroof_ros.model.site import Site

EXPIRES_S = 60.0
"""A request counts for so long (s): until it comes here, and until its dose begins."""
# So far may the asker's clock be ahead of this machine's (s).
_AHEAD_S = 5.0
# The flow falls with what is left, so that this would take so long (s), and the end is exact.
_SLOWS_S = 30.0
# For how long an end is said (s).
_SAID_S = 60.0

DONE, EXPIRED, FULL, INTERLOCK, UNSEEN = "done", "expired", "full", "interlock", "unseen"
"""How a dose ends, for programs."""


@dataclass
class Dose:
    """One dose.

    Attributes:
        id: when it was asked for, by the system clock of who did (s since 1970).
        volume: that was asked for (m3).
        age: since it was asked for, and once it is over since then (s).
        delivered: so far (m3).
        begun: whether the pump has run for it.
        over: how it ended, a word for programs; empty while it has not.
        why: what the pump does for it, or why it waits, or ended.
        cause: the code of the interlock that ended it.
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
    def said(self) -> str:
        """How it is, as a sentence."""
        progress = f"{self.delivered:.3f} of {self.volume:g} m3"
        if not self.over:
            return f"a dose: {progress}; {self.why}" if self.begun else f"a dose waits: {self.why}"
        if self.over == DONE:
            return f"the dose of {self.volume:g} m3 was delivered"
        return f"the dose ended early, at {progress}: {self.why}"


class Doses:
    """Takes requests, and follows the dose of the last one.

    A request is known by the time at which it was made, and each must be newer than the one before
    and than this object: so none is carried out twice, whoever repeats it, and none after a
    restart.

    Attributes:
        last: the last one, for a while after its end; None without one.
    """

    def __init__(self, site: Site, now: float) -> None:
        """Begin without one.

        Args:
            site: which says whether there are doses, and how large.
            now: by the system clock (s since 1970).
        """
        self._most = site.greatest_dose
        self._newest = now
        self.last: Dose | None = None

    @property
    def present(self) -> Dose | None:
        """The dose that waits or runs; None without one."""
        return None if self.last is None or self.last.over else self.last

    def refusal(self, against: str) -> str:
        """Return why any request would be refused; empty where none would.

        Args:
            against: why the pump may not run now; empty where it may.
        """
        if self._most is None:
            return "the site file allows no dose (greatest_dose)"
        if (present := self.present) is not None:
            return f"another dose is under way: {present.said}"
        return against and f"the pump may not run: {against}"

    def ask(self, request: float, volume: float, now: float, least: float, against: str) -> str:
        """Take a request, or return why it is refused.

        Args:
            request: when it was made (s since 1970), which is its id.
            volume: that is asked for (m3).
            now: by the system clock (s since 1970).
            least: volume that can be delivered (m3).
            against: why the pump may not run now; empty where it may.
        """
        if self._most is None:
            return self.refusal(against)
        if not 0 < volume <= self._most:  # nor a NaN
            return f"a dose must be above 0 and at most {self._most:g} m3 (greatest_dose)"
        age = now - request
        if not -_AHEAD_S <= age <= EXPIRES_S:
            return (
                f"the request is {age:.0f} s old and must be at most {EXPIRES_S:g} s: ask again, "
                "or set the clocks"
            )
        if request <= self._newest:
            return "the request was made before the last one, or before the pump node was started"
        self._newest = request  # whether it is carried out or not
        if refusal := self.refusal(against):
            return refusal
        if volume < least:
            return f"a dose must be at least {least:.3f} m3, what the pump delivers once it is on"
        self.last = Dose(request, volume, max(0.0, age))
        return ""

    def pass_time(self, dt: float, delivered: float) -> None:
        """Count what passed.

        Args:
            dt: by a clock that nobody sets (s).
            delivered: in it (m3).
        """
        dose = self.last
        if dose is None:
            return
        dose.age += dt
        if dose.over:
            if dose.age > _SAID_S:
                self.last = None
            return
        dose.delivered += delivered
        if dose.delivered >= dose.volume:
            self.end(DONE)
        elif not dose.begun and dose.age > EXPIRES_S:
            self.end(EXPIRED, f"it could not begin within {EXPIRES_S:g} s: {dose.why}")

    def share(self, greatest_flow: float) -> float:
        """Return the share of the greatest flow (m3/s) that the present dose asks for."""
        dose = self.present
        assert dose is not None
        return min(1.0, (dose.volume - dose.delivered) / (_SLOWS_S * greatest_flow))

    def end(self, how: str, why: str = "", cause: str = "") -> None:
        """End the present dose, if there is one.

        Args:
            how: a word of this module.
            why: a clause.
            cause: code of the interlock that ended it.
        """
        if (dose := self.present) is not None:
            dose.over, dose.why, dose.cause, dose.age = how, why, cause, 0.0
