"""The delivery check: what was pumped against what the levels did.

Three balances are kept, each of water (m3) that the levels do not account for:

- *missing on the roof*: a share ``least_delivery`` of the pumped volume (as measured, or as the
  speed should deliver it where that is more: a closed valve has no flow), less the rise of the
  roof, less ``greatest_loss`` for evapotranspiration. It grows where a pump runs and the roof does
  not rise: burst pipe, closed valve. Rain only lets it fall.
- *lost from the cistern*: the fall of the cistern, less the pumped volume and what a low outlet may
  have taken over ``least_delivery``, less ``greatest_loss`` for a drifting sensor. It grows where
  water leaves and the pump stands: leak, stuck contactor. Rain only lets it fall, and what the
  outlet takes does not count, since the cistern counts up to the outlet only. While the level is
  above a low outlet, or unknown, what leaves beside must be more than that outlet takes, or it is
  not seen: not before the level has fallen to where the outlet takes less. That a low outlet is
  clogged is no fault.
- *not from the cistern*: a share ``least_delivery`` of the pumped volume, less the fall of the
  cistern, less ``greatest_loss`` for a drifting sensor, and less what the mains may have let in
  while the reading was below the level of their valve, or unknown. It grows where a pump runs and
  the cistern does not fall: its sensor is stuck, with some noise perhaps, or drifts up, and the
  pump would run dry. It is never more than that share of what was pumped, so that rain on a pump
  that stands is no fault; rain meanwhile explains ``a_in / a2`` of what the roof rose beyond that
  share, as if all of it ran off: a storm's runoff coefficient may be above the mean. Where a_in
  is not less than a2 that is so much that only the first balance is left.

Water is counted while a level is unknown, too, and the balances go on when it is known again: a
sensor that is silent now and then hides nothing. By how much a level has jumped, as no water can,
does not count; but a jump down of the cistern is a fall to the third balance, so that a drift that
is over by a jump back is no fault later.

Of a measured roof the pumped volume counts in what its soil keeps of it at the target, the least
share that it keeps while anything is pumped: the rest percolates. What is rain to the third balance
is counted with the share that the soil keeps as wet as it is: a drier roof keeps more of what was
pumped, and that is no rain.

Each is averaged over ``averaging_time``, levels and volumes alike, so that no lag comes between
them. A balance that rises by more than ``level_tolerance`` times the area above the least that it
ever was is a fault (Page's test, E. S. Page, Biometrika 41, 1954: nothing that went well before
hides what goes wrong now); on the roof only if the share of what was pumped since is as much, so
that no heat wave is a burst pipe. A level counts up to the roof's target and the cistern's outlet
only, plus or less ``level_offset``, by which a sensor may be wrong for good.

A level that does not change at all needs no averaging and no share: a quiet sensor's roof is a
fault once ``level_tolerance`` times its area was pumped since it last changed, and roof and cistern
that both stand still are one once the tolerance times the cistern's area was. Otherwise the rule
that a level is frozen, which heals, would stop the pump before the balance does, again and again.

Why it is no false alarm: readings each second with independent errors of 5 mm (standard deviation)
have, averaged over 60 s, one of 5 mm / sqrt(2 60) = 0.46 mm. A false alarm needs two means that are
6 mm apart the wrong way, 9 standard deviations of their difference: less than 1e-19 for a pair, and
a year has some 1e8 pairs that are near enough in time to count. Ticks of 10 s have means with three
times the error: there the tolerance must be three times as large.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from greenroof_ros.model.plant import low_outlet_flow
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of
from greenroof_ros.pumping.limits import PumpSettings

_M_PER_S = 1e-3 / 3600
"""of a mm/h"""


class _Sums(NamedTuple):
    """Since the check began, or what was added to that."""

    elapsed: float = 0.0
    """s"""
    least_pumped: float = 0.0
    """m3"""
    most_pumped: float = 0.0
    """m3"""
    cistern: float = 0.0
    """what it holds (m3)"""
    roof: float = 0.0
    """what it holds (m3)"""
    overfull_cistern: float = 0.0
    """what it holds, above its outlet too, less what jumps up have added (m3)"""
    kept: float = 0.0
    """of what was pumped at least, what the roof's soil keeps as wet as it is (m3)"""
    mains: float = 0.0
    """what the mains may have let in (m3)"""
    drained: float = 0.0
    """what the low outlet may have taken, by the site file (m3)"""

    def plus(self, other: _Sums, share: float = 1.0) -> _Sums:
        return _Sums(*(mine + share * added for mine, added in zip(self, other, strict=True)))


class _Balance:
    """Water that is unaccounted for, above the least that it ever was."""

    def __init__(self) -> None:
        self.rise = 0.0
        """m3"""
        self.over = _Sums()
        """what was added to the sums since it was least"""

    def add(self, unaccounted: float, change: _Sums, share: float | None = None) -> float:
        """Add what cannot be accounted for (m3) of a change, and return the rise.

        Args:
            unaccounted: of the change (m3).
            change: of the sums.
            share: of what was pumped, beyond which the balance cannot rise.
        """
        self.rise, self.over = self.rise + unaccounted, self.over.plus(change)
        if share is not None:
            self.rise = min(self.rise, share * self.over.least_pumped)
        if self.rise <= 0:
            self.rise, self.over = 0.0, _Sums()
        return self.rise


class DeliveryCheck:
    """Keeps the balances, step by step."""

    def __init__(self, site: Site, settings: PumpSettings) -> None:
        self._site, self._soil = site, soil_of(site)
        self._settings = settings
        self._loss = settings.greatest_loss * _M_PER_S
        self._kept_share = self._soil.kept_share(site.x2_star)
        self._share_on_roof = settings.least_delivery * self._kept_share
        self._keeps = self._kept_share  # the soil, as wet as it was last known
        self._sums = _Sums()
        self._missing, self._lost, self._kept = _Balance(), _Balance(), _Balance()
        # Of cistern and roof the newest level (m), and the sums when it last changed.
        self._still = [(math.nan, _Sums()), (math.nan, _Sums())]
        self._mean: _Sums | None = None
        self._watched = 0.0
        self._displaced: tuple[float, float] | None = None  # at the first reading (m)
        # By jumps of the cistern's reading: so far, and up (m).
        self._jumped = self._raised = 0.0
        self._rain_on_roof = 0.0  # the most that it showed since the third balance was least (m3)

    @property
    def watches(self) -> bool:
        """Whether there are enough readings for a mean."""
        return self._watched >= self._settings.averaging_time

    def step(
        self,
        dt: float,
        cistern_level: float | None,
        roof_level: float | None,
        least_pumped: float,
        most_pumped: float,
        displacements: tuple[float, float] = (0.0, 0.0),
    ) -> str:
        """Take what the sensors read, and return the fault, empty where there is none.

        Args:
            dt: time since the last step (s).
            cistern_level: m; None is unknown.
            roof_level: m; None is unknown.
            least_pumped: what was pumped since the last step, or should have been (m3).
            most_pumped: the same at most; more only where the speed was unknown.
            displacements: by how much jumps have moved the readings of cistern and roof so far (m).
        """
        site, settings = self._site, self._settings
        if roof_level is not None:
            self._keeps = self._soil.kept_share(site.roof_volume(roof_level))
        mains = drained = 0.0
        if site.mains_level is not None and site.mains_flow is not None and (
            cistern_level is None or cistern_level < site.mains_level + settings.level_offset
        ):
            mains = site.mains_flow * dt
        if site.low_outlet_level is not None:
            highest = site.z_o if cistern_level is None else cistern_level + settings.level_offset
            drained = low_outlet_flow(site, site.cistern_volume(highest)) * dt
        self._sums = self._sums.plus(_Sums(
            dt, least_pumped, most_pumped, kept=self._keeps * least_pumped, mains=mains,
            drained=drained,
        ))
        if cistern_level is None or roof_level is None:
            return ""
        self._watched += dt
        if self._displaced is None:
            self._displaced, self._jumped = displacements, displacements[0]
        self._raised = max(0.0, self._raised + displacements[0] - self._jumped)
        self._jumped = displacements[0]
        cistern = cistern_level - displacements[0] + self._displaced[0]
        roof = roof_level - displacements[1] + self._displaced[1]
        present = self._sums._replace(
            cistern=min(cistern, site.z_o - settings.level_offset) * site.a1,
            roof=min(roof, site.z_veg + settings.level_offset) * site.a2,
            overfull_cistern=(cistern_level - self._raised) * site.a1,
        )
        for tank, level in enumerate((cistern_level, roof_level)):
            if level != self._still[tank][0]:
                self._still[tank] = level, present
        still = self._stands_still(present)
        if still:
            return still
        change = self._change_of_mean(dt, present)
        share = settings.least_delivery
        missing = self._share_on_roof * change.least_pumped - change.roof
        missing -= self._loss * site.a2 * change.elapsed
        lost = -change.cistern - (change.most_pumped + change.drained) / share
        lost -= self._loss * site.a1 * change.elapsed
        tolerance = settings.level_tolerance * site.a2
        rise = self._missing.add(missing, change)
        if min(rise, self._share_on_roof * self._missing.over.least_pumped) > tolerance:
            return _missing_on_roof(self._missing.over)
        if self._lost.add(lost, change) > settings.level_tolerance * site.a1:
            return _lost_from_cistern(self._lost.over)
        return self._kept_in_cistern(change)

    def _kept_in_cistern(self, change: _Sums) -> str:
        """Return the fault of a cistern that does not fall though water is pumped out of it."""
        site, share = self._site, self._settings.least_delivery
        kept = share * change.least_pumped + change.overfull_cistern
        kept -= self._loss * site.a1 * change.elapsed + change.mains
        rise = self._kept.add(kept, change, share)
        over = self._kept.over
        rain_on_roof = over.roof - share * over.kept
        rain_on_roof += self._loss * site.a2 * over.elapsed
        # What fell stays in the cistern when it has drained off the roof.
        self._rain_on_roof = max(self._rain_on_roof, rain_on_roof) if rise else 0.0
        if not self._keeps:
            return ""  # a soil that keeps nothing does not show how much it rains
        rise -= site.a_in / site.a2 / self._keeps * self._rain_on_roof
        if rise <= self._settings.level_tolerance * site.a1:
            return ""
        if over.roof < self._share_on_roof * over.least_pumped:
            return _missing_on_roof(over)
        return (
            f"delivery: {over.least_pumped:.2f} m3 were pumped in {over.elapsed / 60:.1f} min and "
            f"came to the roof, but the cistern's level changed by "
            f"{1000 * over.overfull_cistern / site.a1:+.0f} mm: perhaps its sensor is stuck or "
            "drifts, so that the pump would run dry; or water flows into the cistern"
        )

    def _change_of_mean(self, dt: float, present: _Sums) -> _Sums:
        """Return by how much the moving mean changes.

        Until there are enough readings for it, it is the plain one, and its changes do not count.
        """
        before, averaging = self._mean, self._settings.averaging_time
        if before is None or self._watched == 0:
            self._mean = present
            return _Sums()
        weight = dt / min(max(averaging, dt), self._watched)
        self._mean = before.plus(present.plus(before, -1.0), weight)
        return self._mean.plus(before, -1.0) if self._watched > averaging else _Sums()

    def _stands_still(self, now: _Sums) -> str:
        """Return the fault of a roof, or of both tanks, that did not change while water came."""
        site = self._site
        (_, cistern), (_, roof) = self._still
        longer = roof if roof.elapsed > cistern.elapsed else cistern
        for since, area, share, stuck in (
            (roof, site.a2, self._kept_share, "the roof's sensor is stuck"),
            (longer, site.a1, 1.0, "both sensors are stuck"),
        ):
            unseen = share * (now.least_pumped - since.least_pumped)
            unseen -= self._loss * area * (now.elapsed - since.elapsed)
            if unseen > self._settings.level_tolerance * area:
                return f"{_missing_on_roof(now.plus(since, -1.0))}, or {stuck}"
        return ""


def _missing_on_roof(over: _Sums) -> str:
    fell = max(0.0, -over.cistern)
    cause = (
        "a burst pipe or a leak behind the pump" if fell - over.drained > over.least_pumped / 2
        else "a closed valve, a blocked pump, an empty pipe or an empty cistern"
    )
    return (
        f"delivery: {over.least_pumped:.2f} m3 were pumped in {over.elapsed / 60:.1f} min, but the "
        f"roof rose by {over.roof:.2f} m3 and the cistern fell by {fell:.2f} m3: perhaps {cause}"
    )


def _lost_from_cistern(over: _Sums) -> str:
    fell = -over.cistern
    cause = (
        "the pump runs although it should stand (a stuck contactor), or its flow is more than "
        "is measured" if over.roof > fell / 2
        else "a leak, or somebody else takes water"
    )
    by_outlet = f" and {over.drained:.2f} m3 by its low outlet" if over.drained else ""
    return (
        f"delivery: the cistern fell by {fell:.2f} m3 in {over.elapsed / 60:.1f} min, but only "
        f"{over.most_pumped:.2f} m3 were pumped{by_outlet}: perhaps {cause}"
    )
