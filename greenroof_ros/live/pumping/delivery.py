"""The delivery check, which compares the pumped volume with the change of both levels.

The check maintains three balances of water (m3) for which the levels do not account:

- *missing on the roof*: half of the pumped volume (the measured volume, or what the speed should
  deliver if that is more, since a meter shows no flow behind a closed valve), minus the rise of the
  roof, minus 1 mm/h for evapotranspiration. This balance grows if the pump is running but the
  roof's level does not rise, because a pipe has burst or a valve is closed. Rain can only lower
  this balance.
- *lost from the cistern*: the fall of the cistern, minus twice the pumped volume and twice the
  volume that a low outlet may have drawn, minus 1 mm/h for a drifting sensor. This balance grows if
  water leaves while the pump is stopped, because of a leak or a stuck contactor. Rain can only
  lower this balance. The upper outlet does not matter, since the cistern's volume counts only up to
  that outlet. While the level is above a low outlet, or unknown, any other loss is detected only if
  it exceeds the flow of that outlet. Such a loss may be detected only after the level has fallen,
  and with it the outlet's flow. A clogged low outlet is not a fault.
- *not from the cistern*: half of the pumped volume, minus the fall of the cistern, minus 1 mm/h for
  a drifting sensor, minus the mains water that may have entered while the reading was below the
  level of the mains valve, or unknown. This balance grows if the pump is running but the cistern's
  level does not fall: the level sensor is stuck (perhaps with some noise) or drifts upward, so the
  pump would eventually run dry. The balance is at most half of the pumped volume, so rain while the
  pump is stopped does not cause a fault. While the pump is running, rain accounts for ``a_in / a2``
  times the roof's rise beyond that half, as if all the rain ran off, because a storm's runoff
  coefficient may be above the mean. If a_in is at least a2, rain can account for so much water that
  only the first balance remains effective.

Water is counted even while a level is unknown, and the balances resume when the level is known
again. A sensor that is silent intermittently, or shows a spike, therefore hides no loss. If a level
has jumped meanwhile, though, by more than the tolerance and as no water can, either the readings
before or those after it are wrong, and all the balances begin anew.

On a field-capacity soil, only the share of the pumped volume that the soil retains at the target
counts; the rest percolates. This share is smallest at the target: at all other levels at which the
roof is watered, the soil retains at least as much. To infer rain, the third balance instead uses
the share that the soil retains at its current moisture content: a drier roof retains more of the
pumped water, and this excess must not be mistaken for rain.

Levels and volumes are averaged over the same minute, so neither lags the other. A balance that
rises by more than ``level_tolerance`` times the area above its minimum so far is a fault (Page's
test, E. S. Page, Biometrika 41, 1954: fault-free operation in the past does not mask a current
fault). On the roof, the counted share of the volume pumped since then must be at least as large, so
a heat wave does not look like a burst pipe. The roof's level counts only up to its target plus
``level_offset``, and the cistern's only up to its outlet minus ``level_offset``, which is the
largest permissible systematic error of a sensor.

A level that does not change at all needs no averaging, and all the pumped volume counts. An
unchanged roof level is a fault once ``level_tolerance`` times its area has been pumped since it
last changed. Two unchanged levels are a fault once the tolerance times the cistern's area has been
pumped. Both volumes are net of 1 mm/h. Without this test, the frozen-level rule, which clears
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
from greenroof_ros.live.pumping.limits import Observation, PumpSettings
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.soil import retained_share
from greenroof_ros.site.site import Site

AVERAGING_S = 60.0
"""averaging time of the levels and volumes (s)"""
MIN_DELIVERY = 0.5
"""share of the pumped volume that must reach the roof; the cistern may lose at most the pumped
volume divided by this share"""
MAX_LOSS = 1e-3 / 3600
"""movement of a level that evapotranspiration or the drift of a sensor may cause (m/s)"""


class _Sums(NamedTuple):
    """Totals since the check began, or changes in these totals."""

    elapsed: float = 0.0
    """s"""
    min_pumped: float = 0.0
    """m3"""
    max_pumped: float = 0.0
    """m3"""
    cistern: float = 0.0
    """volume (m3)"""
    cistern_to_outlet: float = 0.0
    """volume, counted up to the outlet (m3)"""
    roof: float = 0.0
    """volume, counted up to the target (m3)"""
    retained: float = 0.0
    """part of ``min_pumped`` that the roof's soil retains at its present wetness (m3)"""
    mains: float = 0.0
    """what the mains may have let in (m3)"""
    drained: float = 0.0
    """what the low outlet may have drawn, unless its valve is closed (m3)"""

    def add(self, other: _Sums, share: float = 1.0) -> _Sums:
        return _Sums(*(mine + share * added for mine, added in zip(self, other, strict=True)))


class _Balance:
    """A balance of unexplained water, measured relative to its minimum so far."""

    def __init__(self) -> None:
        self.rise = 0.0
        """m3"""
        self.since_min = _Sums()
        """change of the sums since that minimum"""

    def add(self, unaccounted: float, change: _Sums, most: float = math.inf) -> None:
        """Add unexplained water (m3), and the change in the sums.

        The balance is at most the given share of the volume that was pumped since its minimum.
        """
        self.rise, self.since_min = self.rise + unaccounted, self.since_min.add(change)
        if most < math.inf:
            self.rise = min(self.rise, most * self.since_min.min_pumped)
        if self.rise <= 0:
            self.rise, self.since_min = 0.0, _Sums()


class DeliveryCheck:
    """Delivery check, which updates the three balances at every step."""

    def __init__(self, site: Site, settings: PumpSettings) -> None:
        self._site, self._p = site, plant_parameters(site)
        self._tolerance, self._offset = settings.level_tolerance, settings.level_offset
        self._share_at_target = retained_share(self._p, site.x2_star)
        self._share_on_roof = MIN_DELIVERY * self._share_at_target
        self._retained_share = self._share_at_target  # share retained at the last known wetness
        self._displaced = 0.0, 0.0  # by jumps until the last reading of both levels (m)
        self._begin()

    def _begin(self) -> None:
        self._sums = _Sums()
        self._missing, self._lost, self._not_drawn = _Balance(), _Balance(), _Balance()
        # For cistern and roof: the newest level (m), and the sums when it last changed.
        self._last_change = [(math.nan, _Sums()), (math.nan, _Sums())]
        self._mean = _Sums()
        self._watched = 0.0
        self._rain_on_roof = 0.0  # most since the minimum of the third balance (m3)

    def step(
        self, dt: float, observed: Observation, min_pumped: float, max_pumped: float
    ) -> Diagnosis | None:
        """Update the balances with the sensors' readings, and return the fault, or None.

        Args:
            dt: time since the last step (s).
            observed: the levels, and the displacements of their readings by jumps.
            min_pumped: volume that was or should have been pumped since the last step (m3).
            max_pumped: maximum volume that can have been pumped (m3), which is the worst case if
                the speed was unknown.
        """
        site, cistern_level, roof_level = self._site, observed.cistern_level, observed.roof_level
        if roof_level is not None:
            self._retained_share = retained_share(self._p, site.roof_volume(roof_level))
        highest = site.z_o if cistern_level is None else cistern_level + self._offset
        open_below = site.mains_level or -math.inf
        may_refill = cistern_level is None or cistern_level < open_below + self._offset
        self._sums = self._sums.add(_Sums(
            dt, min_pumped, max_pumped, retained=self._retained_share * min_pumped,
            mains=(site.mains_flow or 0.0) * dt * may_refill,
            drained=low_outlet_flow(self._p, site.cistern_volume(highest)) * dt
                * (not observed.outlet_closed),
        ))
        if cistern_level is None or roof_level is None:
            return None
        before, self._displaced = self._displaced, observed.displacements
        if math.dist(before, self._displaced) > self._tolerance:
            self._begin()
        present = self._sums._replace(
            cistern=cistern_level * site.a1,
            cistern_to_outlet=min(cistern_level, site.z_o - self._offset) * site.a1,
            roof=min(roof_level, site.z_veg + self._offset) * site.a2,
        )
        for tank, level in enumerate((cistern_level, roof_level)):
            if level != self._last_change[tank][0]:
                self._last_change[tank] = level, present
        return self._check_unchanged(present) or self._check_balances(self._average(dt, present))

    def _average(self, dt: float, present: _Sums) -> _Sums:
        """Return the change in the moving mean.

        Until there are enough readings, the mean of all readings is used, and its changes do not
        count.
        """
        before, watched = self._mean, self._watched
        self._watched += dt
        weight = dt / min(max(AVERAGING_S, dt), self._watched) if watched else 1.0
        self._mean = before.add(present.add(before, -1.0), weight)
        return self._mean.add(before, -1.0) if watched >= AVERAGING_S else _Sums()

    def _check_balances(self, change: _Sums) -> Diagnosis | None:
        """Add a change of the mean to the balances, and return the fault, or None."""
        site, on_roof, in_cistern = self._site, self._site.a2, self._site.a1
        on_roof_loss, in_cistern_loss = (
            MAX_LOSS * area * change.elapsed for area in (on_roof, in_cistern)
        )
        self._missing.add(
            self._share_on_roof * change.min_pumped - change.roof - on_roof_loss, change
        )
        self._lost.add(
            -change.cistern_to_outlet - (change.max_pumped + change.drained) / MIN_DELIVERY
            - in_cistern_loss, change,
        )
        self._not_drawn.add(
            MIN_DELIVERY * change.min_pumped + change.cistern - in_cistern_loss - change.mains,
            change, MIN_DELIVERY,
        )
        since = self._missing.since_min
        rise = min(self._missing.rise, self._share_on_roof * since.min_pumped)
        if rise > self._tolerance * on_roof:
            return _missing_on_roof(since)
        since = self._lost.since_min
        if self._lost.rise > self._tolerance * in_cistern:
            fell, values = -since.cistern_to_outlet, {
                "minutes": since.elapsed / 60, "pumped": since.max_pumped,
            }
            more = since.roof > fell / 2
            if more and since.max_pumped < fell / 2:
                return Diagnosis.of("runs_on", "levels", cistern=fell, **values)
            cause = "more" if more else "leak"
            return Diagnosis.of("delivery", "cistern", cause, cistern=fell, **values)
        since = self._not_drawn.since_min
        rain_on_roof = since.roof - MIN_DELIVERY * since.retained
        rain_on_roof += MAX_LOSS * on_roof * since.elapsed
        # Rain stays in the cistern even after it has drained off the roof.
        self._rain_on_roof = max(self._rain_on_roof, rain_on_roof) if self._not_drawn.rise else 0.0
        if not self._retained_share:
            return None  # a soil that retains nothing does not show how much it rains
        rain = site.a_in / on_roof / self._retained_share * self._rain_on_roof
        if self._not_drawn.rise - rain <= self._tolerance * in_cistern:
            return None
        if since.roof < self._share_on_roof * since.min_pumped:
            return _missing_on_roof(since)
        return Diagnosis.of(
            "delivery", "cistern_stuck", pumped=since.min_pumped, minutes=since.elapsed / 60,
            change=1000 * since.cistern / in_cistern,
        )

    def _check_unchanged(self, now: _Sums) -> Diagnosis | None:
        """Return a fault if the roof's level, or both levels, did not change during pumping."""
        (_, cistern), (_, roof) = self._last_change
        longer = max(roof, cistern, key=lambda sums: sums.elapsed)
        for since, area, share in (
            (roof, self._site.a2, self._share_at_target), (longer, self._site.a1, 1.0),
        ):
            unseen = share * (now.min_pumped - since.min_pumped)
            unseen -= MAX_LOSS * area * (now.elapsed - since.elapsed)
            if unseen > self._tolerance * area:
                return _missing_on_roof(now.add(since, -1.0))
        return None


def _missing_on_roof(since: _Sums) -> Diagnosis:
    fell = max(0.0, -since.cistern_to_outlet)
    cause = "burst" if fell - since.drained > since.min_pumped / 2 else "closed"
    return Diagnosis.of(
        "delivery", "roof", cause, pumped=since.min_pumped, minutes=since.elapsed / 60,
        roof=since.roof, cistern=fell,
    )
