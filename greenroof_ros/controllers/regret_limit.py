"""A limit to what trust in a forecast may cost."""

from __future__ import annotations

import logging
import math

from greenroof_ros.model.plant import drainage_flow, maximum_pump_flow, pump_flow
from greenroof_ros.model.site import Site

_log = logging.getLogger(__name__)

# Gains and losses fade with this time (s): a week.
_FADING_S = 604_800.0


class RegretLimit:
    """Counts what waiting for rain has cost beside plain on/off, and ends it at a limit.

    Who leaves room for rain that does not come is worse off than the on/off controller, which has
    filled the roof, and no rule can avoid that: at the time of waiting the true forecast and the
    false one are the same. What can be had is a limit to it. This follows what on/off, Eq. (12),
    would have on the roof now - only the difference, so that errors of model and sensor are in
    both - and adds up

        loss = sum of tau (|x2 - x2*| - |x2_onoff - x2*|),

    what has been gained by waiting counting as negative. Where the loss, with what it will cost to
    fill the roof as on/off has, exceeds the max_waiting_loss, forecasts of rain no longer count, which
    makes the controller fill the roof as on/off does, until the loss has faded to half of the
    max_waiting_loss, with a time of a week. So trust costs at most the max_waiting_loss at once and as much again
    each week, whatever the forecasts say; and who has gained may lose that first. Only in frost can
    nobody fill the roof, and the loss goes on.

    The difference rests on pumps that do what is commanded. With minimum times on and off, or
    another flow than the site file's, the count is wrong by what they pump beside that.

    Attributes:
        loss: so far (m3 s); negative is a gain.
        exhausted: whether forecasts of rain do not count.
    """

    def __init__(self, site: Site, max_waiting_loss: float) -> None:
        """Take the site and the max_waiting_loss, as the hours (h) of an empty roof that cost as much."""
        self._site = site
        self._max_waiting_loss = max_waiting_loss * 3600 * site.x2_star  # m3 s
        self._more = 0.0  # what on/off would have on the roof beside what is there (m3)
        self._kept = math.exp(-site.tau / _FADING_S)
        self._unseen = 0
        self.loss = 0.0
        self.exhausted = False

    def judge(self, x1: float, x2: float, fraction: float, *, counts: bool = True) -> bool:
        """Count the present tick and return whether forecasts of rain do not count in it.

        Args:
            x1: in the cistern (m3).
            x2: on the roof (m3).
            fraction: v, the command of on/off when it pumps (share of the maximum flow).
            counts: whether a loss in this tick is for waiting, and for no other reason such as a
                price of energy; a gain always counts.
        """
        site = self._site
        more = abs(x2 - site.x2_star) - abs(x2 + self._more - site.x2_star)
        ticks, self._unseen = 1 + self._unseen, 0
        self.loss *= self._kept**ticks
        if counts or more < 0:
            self.loss += ticks * site.tau * more
        cost = self.loss + self._filling(x1, x2, fraction)
        if self.exhausted:
            self.exhausted = cost >= self._max_waiting_loss / 2
        elif cost > self._max_waiting_loss:
            self.exhausted = True
            if self._max_waiting_loss > 0:
                _log.warning(
                    "waiting for rain has cost %.0f m3 s more than plain on/off; forecasts of rain "
                    "do not count until that has faded to half of the max_waiting_loss", self.loss,
                )
        return self.exhausted

    def skip(self) -> None:
        """Let a tick pass in which nothing was pumped and nobody asked."""
        self._unseen += 1

    def move(self, x1: float, x2: float, fraction: float, pumped: float) -> None:
        """Move on by one tick.

        Args:
            x1: in the cistern (m3).
            x2: on the roof (m3).
            fraction: as for :meth:`judge`.
            pumped: what is pumped in truth (m3/s).
        """
        site = self._site
        onoff = x2 + self._more
        drained = drainage_flow(site, onoff) - drainage_flow(site, x2)
        self._more += site.tau * (pump_flow(site, x1, onoff, fraction) - pumped - drained)

    def _filling(self, x1: float, x2: float, fraction: float) -> float:
        """Return what it costs (m3 s) to follow on/off to the target, behind it all the way."""
        flow = fraction * maximum_pump_flow(self._site, x1)
        if self._more <= 0 or flow <= 0:
            return 0.0
        missing = max(0.0, self._site.x2_star - x2 - self._more)  # to on/off
        return self._more * (missing + self._more / 2) / flow
