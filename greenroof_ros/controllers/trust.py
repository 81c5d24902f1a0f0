"""How far forecasts of rain are trusted: by the recent record of roofs that trusted them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.order_up_to import OrderUpTo
from greenroof_ros.model.site import Site

Array = NDArray[np.float64]

_DAY_S = 86_400.0
# Interval at which the shadow roofs are updated (s).
_STEP_S = 600.0
# Two roofs hold the same if they differ by less than this (share of the target).
_ALIKE = 1e-3
# Another shadow is followed if it has cost less by more than this (days of an empty roof). Less is
# luck: GEM at Budva gained 0.5 days over ten months of 2024, and was behind by 0.2 within them.
_LESS = 0.2

TRUST_MEMORY = Parameter(
    "trust_memory", 30.0, "days", 0.0, 3650.0,
    "how long it remembers the gains and losses of trusting the forecast; 0: always trust it",
)

SHARES: Array = np.arange(4) / 3
"""Shares of the room for forecast rain that the shadow roofs leave; 0 leaves none."""


class Trust:
    r"""Shadow roofs that trust the forecast to various degrees; the real one follows the best one.

    A plan fills the roof to a volume y below the target x*, and leaves x* - y for the coming rain.
    Beside the real roof, four shadow roofs are simulated in the rain that really falls. One is
    filled to the target, as without a forecast; the others leave a third, two thirds, and all of
    the room that the plan asks for. The cost of each, in days of an empty roof, is

        L <- exp(-d / ``trust_memory``) L + d |x2 - x2*| / x2*,   d the step (days).

    The real roof is filled like the shadow that it follows, at first the one with full trust. It
    switches to the shadow with the least L if this is less by a margin, and if both shadows hold
    the same volume and are to be filled to the same volume. Then no wait for rain is under way
    whose outcome is unknown, and switching costs nothing. A rule that judged each hour by itself
    would give up a wait half-way, and lose twice. If rain is always forecast and never comes, there
    is no such moment. The cost of this, and of forecasts that are right and wrong by turns, is
    limited by :class:`~greenroof_ros.controllers.regret_budget.RegretBudget`.

    All shadows have the real cistern. Ticks without a decision do not count.

    Attributes:
        roofs: volume on each shadow roof (m3), shape (shadows,).
        losses: L of each (days of an empty roof), shape (shadows,).
        share: of the room for forecast rain that is left (1).
    """

    def __init__(self, site: Site, program: OrderUpTo, memory: float) -> None:
        """Take the site, the simulator of roofs, and the memory (days); 0: trust without end."""
        self._target = site.x2_star
        self._program = program
        self._tau = site.tau
        self._memory = memory
        self._seconds = self._rain = self._evaporated = 0.0  # since the last step (s, m, m3)
        self._followed = len(SHARES) - 1
        self.roofs: Array = np.full(len(SHARES), math.nan)
        self.losses: Array = np.zeros(len(SHARES))

    @property
    def share(self) -> float:
        """Share of the room for forecast rain that is left (1)."""
        return float(SHARES[self._followed])

    @property
    def learned(self) -> dict[str, float]:
        """L of each shadow, and the share that is left."""
        names = (f"loss_at_trust_{share:.2f}_days" for share in SHARES)
        return {**dict(zip(names, self.losses.tolist(), strict=True)), "trust": self.share}

    @learned.setter
    def learned(self, values: Mapping[str, float]) -> None:
        *losses, share = (values[name] for name in self.learned)
        self.losses = np.array(losses)
        self._followed = int(np.abs(SHARES - share).argmin())

    def pass_tick(self, x2: float, rain: float, evapotranspiration: float) -> bool:
        """Count a tick, and return whether :meth:`move` is due.

        Args:
            x2: on the real roof (m3).
            rain: in the tick (m/s).
            evapotranspiration: off the whole bed (m3/s).
        """
        if not self._memory:
            return False
        tau = self._tau
        self._seconds += tau
        self._rain += rain * tau
        self._evaporated += evapotranspiration * tau
        if math.isnan(self.roofs[0]):
            self.roofs = np.full(len(SHARES), x2)
        return self._seconds >= _STEP_S - tau / 2

    def move(self, flow: float, levels: Callable[[Array, Array], Array]) -> None:
        """Move the shadows on by a step, and follow another one if it has done better.

        Args:
            flow: largest pump flow (m3/s).
            levels: returns the volumes (m3) that roofs with these volumes (m3) are filled to or
                held at if they leave these shares of the room; an array of the same shape.
        """
        seconds = self._seconds
        targets = levels(self.roofs, SHARES)
        self.roofs, _ = self._program.move(
            targets, self.roofs, self._rain / seconds, self._evaporated / seconds, flow, seconds
        )
        days = seconds / _DAY_S
        self.losses *= math.exp(-days / self._memory)
        self.losses += days * np.abs(self.roofs - self._target) / self._target
        best, followed = int(self.losses.argmin()), self._followed
        more = self.losses[followed] - self.losses[best]
        apart = max(abs(volumes[best] - volumes[followed]) for volumes in (self.roofs, targets))
        if more > _LESS and apart < _ALIKE * self._target:
            self._followed = best
        self._seconds = self._rain = self._evaporated = 0.0
