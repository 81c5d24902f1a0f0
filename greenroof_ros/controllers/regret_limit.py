"""A limit to what trust in a forecast may cost."""

from __future__ import annotations

import logging
import math

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.model.plant import maximum_pump_flow, pump_flow, soil_losses
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import kept_share

_log = logging.getLogger(__name__)

# Gains and losses fade with this time (s): a week.
_FADING_S = 604_800.0

MAX_WAITING_LOSS = Parameter(
    "max_waiting_loss", 1.0, "h", 0.0, 1e6,
    "what waiting for rain may cost beside plain on/off, as the time with an empty roof that costs "
    "as much; beyond it forecasts of rain do not count for days",
)


class RegretLimit:
    """Counts what waiting for rain has cost beside plain on/off, and ends the waiting at a limit.

    A controller that leaves room for rain which does not come is worse off than the on/off
    controller, which has filled the roof. No rule can avoid that: while it waits, the true forecast
    and the false one are the same. What can be had is a limit. This class follows what on/off, Eq.
    (12), would have on the roof now - only the difference, so that errors of model and sensor are
    in both - and adds up

        loss = sum of tau (|x2 - x2*| - |x2_onoff - x2*|).

    A gain by waiting counts as negative. Where the loss, with what it will cost to fill the roof as
    on/off has, exceeds ``max_waiting_loss``, forecasts of rain no longer count, and the controller
    fills the roof as on/off does. That lasts until the loss has faded to half of the limit, with a
    time constant of a week. So trust costs at most the limit at once and as much again each week,
    whatever the forecasts say; a controller that has gained may lose the gain first. In frost
    nothing may be pumped, and the loss goes on.

    While a controller waits, a low outlet of the cistern may take what it would fill the roof with.
    What on/off has on the roof beyond all that stays in the cistern costs as much as if it were
    missing until a loss has faded.

    The difference rests on pumps that do what is commanded. With minimum times on and off, or
    another flow than the site file's, the count is wrong by what they pump beside the command.

    Attributes:
        loss: so far (m3 s); negative is a gain.
        exhausted: whether forecasts of rain do not count.
    """

    def __init__(self, site: Site, max_waiting_loss: float) -> None:
        """Take the site and the limit, as the time (h) with an empty roof that costs as much."""
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
        drained = self._drained(x1, x2)
        cost = self.loss + self._filling(x1, x2, fraction) + drained
        if self.exhausted:
            self.exhausted = cost >= self._max_waiting_loss / 2
        elif cost > self._max_waiting_loss:
            self.exhausted = True
            if self._max_waiting_loss > 0 and not drained:
                _log.warning(
                    "waiting for rain has cost %.0f m3 s more than plain on/off; forecasts of rain "
                    "do not count until that has faded to half of max_waiting_loss", self.loss,
                )
        return self.exhausted

    def skip(self) -> None:
        """Let a tick pass in which nothing was pumped and nothing was asked."""
        self._unseen += 1

    def move(
        self, x1: float, x2: float, fraction: float, pumped: float,
        precipitation: float = 0.0, evapotranspiration: float = 0.0,
    ) -> None:
        """Move on by one tick.

        Args:
            x1: in the cistern (m3).
            x2: on the roof (m3).
            fraction: as for :meth:`judge`.
            pumped: what is pumped in truth (m3/s).
            precipitation: rain in the tick (m/s); only of a measured roof it matters.
            evapotranspiration: off the whole bed (m3/s), likewise.
        """
        site = self._site
        onoff = x2 + self._more
        rain = precipitation * site.a2
        flow = pump_flow(site, x1, onoff, fraction)
        theirs = soil_losses(site, onoff, rain + flow, evapotranspiration)
        ours = soil_losses(site, x2, rain + pumped, evapotranspiration)
        drained = theirs.drained - ours.drained + (theirs.evaporated - ours.evaporated)
        self._more += site.tau * (flow - pumped - drained)

    def _filling(self, x1: float, x2: float, fraction: float) -> float:
        """Return what it costs (m3 s) to follow on/off to the target, behind it all the way."""
        kept = kept_share(self._site, x2)
        flow = fraction * kept * maximum_pump_flow(self._site, x1)
        if self._more <= 0 or flow <= 0:
            return 0.0
        missing = max(0.0, self._site.x2_star - x2 - self._more)  # to on/off
        return self._more * (missing + self._more / 2) / flow

    def _drained(self, x1: float, x2: float) -> float:
        """Return what it costs (m3 s) that a low outlet takes what on/off has on the roof."""
        site = self._site
        if site.low_outlet_level is None:
            return 0.0
        stays = min(x1, site.cistern_volume(site.low_outlet_level))
        usable = max(0.0, stays - site.cistern_volume(site.suction_level))
        return max(0.0, self._more - kept_share(site, x2) * usable) * _FADING_S
