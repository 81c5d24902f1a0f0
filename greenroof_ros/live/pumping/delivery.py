"""The delivery check, which compares the pumped volume with the change of both levels.

The check maintains three balances of water (m3) for which the levels do not account:

- *missing on the roof*: a share ``min_delivery`` of the pumped volume (the measured volume, or what
  the speed should deliver if that is more, since a meter shows no flow behind a closed valve),
  minus the rise of the roof, minus ``max_loss`` for evapotranspiration. This balance grows if the
  pump is running but the roof's level does not rise, because a pipe has burst or a valve is closed.
  Rain can only lower this balance.
- *lost from the cistern*: the fall of the cistern, minus the pumped volume and the volume that a
  low outlet may have drawn, both divided by ``min_delivery``, minus ``max_loss`` for a drifting
  sensor. This balance grows if water leaves while the pump is stopped, because of a leak or a stuck
  contactor. Rain can only lower this balance. The upper outlet does not matter, since the cistern's
  volume counts only up to that outlet. While the level is above a low outlet, or unknown, any other
  loss is detected only if it exceeds the flow of that outlet. Such a loss may be detected only
  after the level has fallen, and with it the outlet's flow. A clogged low outlet is not a fault.
- *not from the cistern*: a share ``min_delivery`` of the pumped volume, minus the fall of the
  cistern, minus ``max_loss`` for a drifting sensor, minus the mains water that may have entered
  while the reading was below the level of the mains valve, or unknown. This balance grows if the
  pump is running but the cistern's level does not fall: the level sensor is stuck (perhaps with
  some noise) or drifts upward, so the pump would eventually run dry. The balance is at most that
  share of the pumped volume, so rain while the pump is stopped does not cause a fault. While the
  pump is running, rain accounts for ``a_in / a2`` times the roof's rise beyond that share, as if
  all the rain ran off, because a storm's runoff coefficient may be above the mean. If a_in is at
  least a2, rain can account for so much water that only the first balance remains effective.

Water is counted even while a level is unknown, and the balances resume when the level is known
again. A sensor that is silent intermittently therefore hides no loss. Jumps of a level that water
cannot cause do not count, except that the third balance treats a downward jump of the cistern as a
fall. A drift that ends with a jump back therefore does not become a fault later.

On a field-capacity soil, only the share of the pumped volume that the soil retains at the target
counts; the rest percolates. This share is smallest at the target: at all other levels at which the
roof is watered, the soil retains at least as much. To infer rain, the third balance instead uses
the share that the soil retains at its current moisture content: a drier roof retains more of the
pumped water, and this excess must not be mistaken for rain.

Levels and volumes are averaged over the same ``averaging_time``, so neither lags the other. A
balance that rises by more than ``level_tolerance`` times the area above its minimum so far is a
fault (Page's test, E. S. Page, Biometrika 41, 1954: fault-free operation in the past does not mask
a current fault). On the roof, the counted share of the volume pumped since then must be at least as
large, so a heat wave does not look like a burst pipe. The roof's level counts only up to its target
plus ``level_offset``, and the cistern's only up to its outlet minus ``level_offset``, which is the
largest permissible systematic error of a sensor.

A level that does not change at all needs no averaging and no ``min_delivery``. An unchanged roof
level is a fault once ``level_tolerance`` times its area has been pumped since it last changed. Two
unchanged levels are a fault once the tolerance times the cistern's area has been pumped. Both
volumes are net of ``max_loss``. Without this test, the frozen-level rule, which clears
automatically, would repeatedly stop the pump before a balance reported the fault.

False alarms are practically impossible: if a reading arrives every second with an independent error
of 5 mm (standard deviation), the mean over 60 s has an error of 5 mm / sqrt(2 60) = 0.46 mm. A
false alarm needs two means 6 mm apart in the wrong direction, which is 9 standard deviations of
their difference. The probability is less than 1e-19 per pair of means, and some 1e8 pairs per year
are close enough in time to count. With a reading every 10 s, the error of the means is three times
as large, so the tolerance must be three times as large as well.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.limits import PumpSettings
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.soil import retained_share
from greenroof_ros.site.site import Site

_M_PER_S = 1e-3 / 3600
"""m/s per mm/h"""


class _Sums(NamedTuple):
    """Totals since the check began, or changes in these totals."""

    elapsed: float = 0.0
    """s"""
    min_pumped: float = 0.0
    """m3"""
    max_pumped: float = 0.0
    """m3"""
    cistern: float = 0.0
    """volume, counted up to the outlet (m3)"""
    roof: float = 0.0
    """volume, counted up to the target (m3)"""
    overfull_cistern: float = 0.0
    """volume, including that above the outlet, less what upward jumps have added (m3)"""
    retained: float = 0.0
    """part of ``min_pumped`` that the roof's soil retains at its present wetness (m3)"""
    mains: float = 0.0
    """what the mains may have let in (m3)"""
    drained: float = 0.0
    """what the low outlet may have drawn, according to the site file (m3)"""

    def add(self, other: _Sums, share: float = 1.0) -> _Sums:
        return _Sums(*(mine + share * added for mine, added in zip(self, other, strict=True)))


class _Balance:
    """A balance of unexplained water, measured relative to its minimum so far."""

    def __init__(self) -> None:
        self.rise = 0.0
        """m3"""
        self.since_min = _Sums()
        """change of the sums since that minimum"""

    def add(self, unaccounted: float, change: _Sums, share: float | None = None) -> float:
        """Add unexplained water, and return the rise above the minimum (m3).

        Args:
            unaccounted: unexplained part of the change (m3).
            change: change in the sums.
            share: share of the pumped volume that limits the rise of the balance.
        """
        self.rise, self.since_min = self.rise + unaccounted, self.since_min.add(change)
        if share is not None:
            self.rise = min(self.rise, share * self.since_min.min_pumped)
        if self.rise <= 0:
            self.rise, self.since_min = 0.0, _Sums()
        return self.rise


class DeliveryCheck:
    """Delivery check, which updates the three balances at every step."""

    def __init__(self, site: Site, settings: PumpSettings) -> None:
        self._site, self._p = site, plant_parameters(site)
        self._settings = settings
        self._loss = settings.max_loss * _M_PER_S
        self._share_at_target = retained_share(self._p, site.x2_star)
        self._share_on_roof = settings.min_delivery * self._share_at_target
        self._retained_share = self._share_at_target  # share retained at the last known wetness
        self._sums = _Sums()
        self._missing, self._lost, self._not_drawn = _Balance(), _Balance(), _Balance()
        # For cistern and roof: the newest level (m), and the sums when it last changed.
        self._last_change = [(math.nan, _Sums()), (math.nan, _Sums())]
        self._mean: _Sums | None = None
        self._watched = 0.0
        self._displaced: tuple[float, float] | None = None  # by jumps, at the first reading (m)
        # Displacement of the cistern's reading by all jumps so far, and upward only (m).
        self._jumped = self._raised = 0.0
        self._rain_on_roof = 0.0  # most since the minimum of the third balance (m3)

    @property
    def has_mean(self) -> bool:
        """Whether enough readings have arrived for a mean."""
        return self._watched >= self._settings.averaging_time

    def step(
        self,
        dt: float,
        cistern_level: float | None,
        roof_level: float | None,
        min_pumped: float,
        max_pumped: float,
        displacements: tuple[float, float] = (0.0, 0.0),
    ) -> Diagnosis | None:
        """Update the balances with the sensors' readings, and return the fault, or None.

        Args:
            dt: time since the last step (s).
            cistern_level: level of the cistern (m); None if unknown.
            roof_level: level of the roof (m); None if unknown.
            min_pumped: volume that was or should have been pumped since the last step (m3).
            max_pumped: maximum volume that can have been pumped (m3), which is the worst case if
                the speed was unknown.
            displacements: total displacements of the cistern's and the roof's readings by jumps so
                far (m).
        """
        site, settings = self._site, self._settings
        if roof_level is not None:
            self._retained_share = retained_share(self._p, site.roof_volume(roof_level))
        mains = drained = 0.0
        if site.mains_level is not None and site.mains_flow is not None and (
            cistern_level is None or cistern_level < site.mains_level + settings.level_offset
        ):
            mains = site.mains_flow * dt
        if site.low_outlet_level is not None:
            high = site.z_o if cistern_level is None else cistern_level + settings.level_offset
            drained = low_outlet_flow(self._p, site.cistern_volume(high)) * dt
        self._sums = self._sums.add(_Sums(
            dt, min_pumped, max_pumped, retained=self._retained_share * min_pumped,
            mains=mains, drained=drained,
        ))
        if cistern_level is None or roof_level is None:
            return None
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
            if level != self._last_change[tank][0]:
                self._last_change[tank] = level, present
        unchanged = self._check_unchanged(present)
        if unchanged:
            return unchanged
        change = self._change_of_mean(dt, present)
        share = settings.min_delivery
        missing = self._share_on_roof * change.min_pumped - change.roof
        missing -= self._loss * site.a2 * change.elapsed
        lost = -change.cistern - (change.max_pumped + change.drained) / share
        lost -= self._loss * site.a1 * change.elapsed
        tolerance = settings.level_tolerance * site.a2
        rise = self._missing.add(missing, change)
        if min(rise, self._share_on_roof * self._missing.since_min.min_pumped) > tolerance:
            return _missing_on_roof(self._missing.since_min)
        if self._lost.add(lost, change) > settings.level_tolerance * site.a1:
            return _lost_from_cistern(self._lost.since_min)
        return self._check_cistern_falls(change)

    def _check_cistern_falls(self, change: _Sums) -> Diagnosis | None:
        """Return a fault if the cistern's level does not fall although water is pumped out."""
        site, share = self._site, self._settings.min_delivery
        not_drawn = share * change.min_pumped + change.overfull_cistern
        not_drawn -= self._loss * site.a1 * change.elapsed + change.mains
        rise = self._not_drawn.add(not_drawn, change, share)
        since = self._not_drawn.since_min
        rain_on_roof = since.roof - share * since.retained
        rain_on_roof += self._loss * site.a2 * since.elapsed
        # Rain stays in the cistern even after it has drained off the roof.
        self._rain_on_roof = max(self._rain_on_roof, rain_on_roof) if rise else 0.0
        if not self._retained_share:
            return None  # a soil that retains nothing does not show how much it rains
        rise -= site.a_in / site.a2 / self._retained_share * self._rain_on_roof
        if rise <= self._settings.level_tolerance * site.a1:
            return None
        if since.roof < self._share_on_roof * since.min_pumped:
            return _missing_on_roof(since)
        return Diagnosis.of(
            "delivery", "cistern_stuck", pumped=since.min_pumped, minutes=since.elapsed / 60,
            change=1000 * since.overfull_cistern / site.a1,
        )

    def _change_of_mean(self, dt: float, present: _Sums) -> _Sums:
        """Return the change in the moving mean.

        Until there are enough readings, the mean of all readings is used, and its changes do not
        count.
        """
        before, averaging = self._mean, self._settings.averaging_time
        if before is None or self._watched == 0:
            self._mean = present
            return _Sums()
        weight = dt / min(max(averaging, dt), self._watched)
        self._mean = before.add(present.add(before, -1.0), weight)
        return self._mean.add(before, -1.0) if self._watched > averaging else _Sums()

    def _check_unchanged(self, now: _Sums) -> Diagnosis | None:
        """Return a fault if the roof's level, or both levels, did not change during pumping."""
        site = self._site
        (_, cistern), (_, roof) = self._last_change
        longer = roof if roof.elapsed > cistern.elapsed else cistern
        for since, area, share, stuck in (
            (roof, site.a2, self._share_at_target, "roof_stuck"),
            (longer, site.a1, 1.0, "both_stuck"),
        ):
            unseen = share * (now.min_pumped - since.min_pumped)
            unseen -= self._loss * area * (now.elapsed - since.elapsed)
            if unseen > self._settings.level_tolerance * area:
                return _missing_on_roof(now.add(since, -1.0), stuck)
        return None


def _missing_on_roof(since: _Sums, *stuck: str) -> Diagnosis:
    fell = max(0.0, -since.cistern)
    cause = "burst" if fell - since.drained > since.min_pumped / 2 else "closed"
    return Diagnosis.of(
        "delivery", "roof", cause, *stuck, pumped=since.min_pumped, minutes=since.elapsed / 60,
        roof=since.roof, cistern=fell,
    )


def _lost_from_cistern(since: _Sums) -> Diagnosis:
    fell = -since.cistern
    by_outlet = ["outlet"] if since.drained else []
    return Diagnosis.of(
        "delivery", "cistern", *by_outlet, "contactor" if since.roof > fell / 2 else "leak",
        cistern=fell, minutes=since.elapsed / 60, pumped=since.max_pumped, drained=since.drained,
    )
