"""Rules for the use of live inputs, based on age, publishers, and the movement of water.

The caller supplies the time of a steady clock (s).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.physics.cistern import low_outlet_flow, overflow
from greenroof_ros.physics.parameters import PlantParameters, plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.soil import retained_share
from greenroof_ros.site.site import Site
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, MUCH_RAIN, QUANTITIES

# An input that has not arrived since the start is treated as silent after this time (s).
_START_S = 10.0
# Real water levels may change faster than the site file implies, by up to this factor.
_MARGIN = 1.5
# A jump back is recognised while the interval from before the jump, which widens with time, is
# narrower than this many tolerances. This takes some minutes.
_SPIKE = 4.0
# Above the world records of hourly rain and of daily evapotranspiration (m/s).
_MAX_RAIN = MUCH_RAIN / 1000 / 3600
_MAX_EVAPOTRANSPIRATION = QUANTITIES[EVAPOTRANSPIRATION].high / 1000 / 86400
# Maximum evapotranspiration of an hour (m/s), like max_loss of the delivery check; and the slowest
# movement of a cistern that exceeds drift and unmeasured inflow, so that it counts: 5 mm/day.
_LOSS, _DRIFT = 1e-3 / 3600, 5e-3 / 86400
# Rain that a roof holds back before any runs off (m): in the depressions of a flat roof (2.5 mm,
# SWMM Reference Manual I, Table 3-5) and in a first-flush diverter (2 mm).
_WETTING = 5e-3

_WAITING, _RECOVERING = AWAITED = "input_waiting", "input_recovering"
"""Codes of inputs that break no rule, but are awaited or not used yet."""


class LevelBounds(NamedTuple):
    """Maximum rates of change of a tank's level, and its maximum plausible value.

    Attributes:
        rise: function that returns the maximum rate of rise at a level in m (m/s, not negative).
        fall: function that returns the maximum rate of fall at a level in m (m/s, not negative).
        max: maximum plausible level (m).
    """

    rise: Callable[[float], float]
    fall: Callable[[float], float]
    max: float


def cistern_bounds(site: Site) -> LevelBounds:
    """Return the bounds of the cistern, filled by rain and mains, emptied by pumps and outlets.

    All the rain on the catchment counts, since a storm's runoff coefficient may be above the mean.
    """
    p = plant_parameters(site)

    def fall(level: float) -> float:
        volume = site.cistern_volume(level)
        let_out = overflow(p, volume) + low_outlet_flow(p, volume)
        return _MARGIN * (maximum_pump_flow(p, volume) + let_out) / site.a1

    rise = _MARGIN * (_MAX_RAIN * site.a_in + (site.mains_flow or 0.0)) / site.a1
    return LevelBounds(lambda level: rise, fall, site.max_cistern_level)


def roof_bounds(site: Site) -> LevelBounds:
    """Return the bounds of the roof, given by rain, pumps, evapotranspiration and drainage."""
    p = plant_parameters(site)
    pump = maximum_pump_flow(p, site.cistern_volume(site.z_o)) / site.a2

    def fall(level: float) -> float:
        return _MARGIN * (_MAX_EVAPOTRANSPIRATION + _find_max_fall(p, level))

    return LevelBounds(lambda level: _MARGIN * (_MAX_RAIN + pump), fall, site.max_roof_level)


def _find_max_fall(p: PlantParameters, level: float) -> float:
    """Return the maximum rate (m/s) at which drainage lowers the water from a level (m).

    On the paper's soil, the rate is that of Eq. (4), even below the capacity. On a field-capacity
    soil, the rate removes the excess within a tick.
    """
    if p.has_field_capacity:
        return max(0.0, level - p.z_cap / p.a2) / p.tau
    return p.K * (level + p.z_soil) / p.z_soil


class Movement(NamedTuple):
    """Bounds on the rate at which a level must rise.

    Attributes:
        min: minimum rate of rise (m/s).
        max: maximum rate of rise (m/s), negative if the level must fall.
    """

    min: float
    max: float


class Wetting:
    """Rain that wets surfaces, fills depressions or evaporates instead of running off."""

    def __init__(self) -> None:
        """Initialize with dry surfaces."""
        self._retained = 0.0  # m

    def excess(self, rain: float, passed: float) -> float:
        """Return the rain in excess of the amount that the surfaces may retain (m/s).

        Args:
            rain: rain rate (m/s).
            passed: duration of the rain at this rate (s).
        """
        retained = max(0.0, self._retained + (rain - _LOSS) * passed)
        self._retained = min(retained, _WETTING)
        return (retained - self._retained) / passed


def expected_movement(
    site: Site, flow: float, rain: float, running_off: float, cistern_level: float,
    roof_level: float, frozen_movement: float = 0.0,
) -> tuple[Movement, Movement]:
    """Return the changes that the levels of the cistern and the roof must undergo.

    A rise is reduced by all possible losses: evapotranspiration from the roof, the flow of a low
    outlet, a closed mains valve, and rain that surfaces retain. A fall is reduced by all the rain
    on the catchment, and by the mains. Rises and falls are also reduced by the drift of a sensor,
    so that small amounts do not accumulate over days.

    A tank that overflows is not expected to move, since its inflow leaves it again. This applies to
    the cistern at its outlet, the roof at the depth of its soil, and a field-capacity soil once it
    retains no more water. No fall through the low outlet is expected, since a narrow outlet can
    clog. A coarse sensor may be off by half of `frozen_movement`, so a tank is treated as
    overflowing, and the mains valve as open, as soon as this is possible within that error.

    Args:
        site: the site.
        flow: flow from the cistern to the roof (m3/s).
        rain: rain rate (m/s).
        running_off: rain in excess of the amount that surfaces may retain (m/s).
        cistern_level: level of the cistern (m).
        roof_level: level of the roof (m).
        frozen_movement: movement as in `LevelRule` (m); 0 if the levels are exact.
    """
    p, off = plant_parameters(site), frozen_movement / 2
    high = site.cistern_volume(cistern_level + off)
    low = site.cistern_volume(max(0.0, cistern_level - off))
    minimum = maximum = -flow / site.a1
    minimum += (
        running_off * site.effective_catchment - _MARGIN * low_outlet_flow(p, high)
    ) / site.a1
    mains = (site.mains_flow or 0.0) * (low / site.a1 < (site.mains_level or 0.0))
    maximum += (rain * site.a_in + mains) / site.a1
    if cistern_level + off >= site.z_o:
        minimum = 0.0
    if cistern_level >= site.z_o:
        maximum = 0.0
    roof = running_off + flow / site.a2 if roof_level + off < site.z_soil else 0.0
    roof *= retained_share(p, site.roof_volume(roof_level + off))
    return Movement(minimum - _DRIFT, maximum + _DRIFT), Movement(roof - _LOSS, math.inf)


class LevelRule:
    """Rule that rejects impossible levels: frozen, jumping, or above any plausible level.

    A value above the maximum plausible level is rejected and otherwise ignored, since it must be in
    the wrong unit.

    To detect jumps, the rule tracks the interval that must contain the true level. The interval
    widens as fast as water can rise and fall, and each value narrows it to within half the
    tolerance of that value. If the interval becomes empty, the value has jumped, and the interval
    restarts from it. The rule detects a single step as well as many small, rapid ones; noise within
    half the tolerance is never a jump.

    Attributes:
        displacement: total displacement of the readings by jumps (m). If a value returns to the
            interval from before a jump, that jump was a spike and its displacement is undone.
    """

    def __init__(self, bounds: LevelBounds, frozen_movement: float, jump_tolerance: float) -> None:
        """Initialize without a value.

        Args:
            bounds: bounds of the tank.
            frozen_movement: expected change in level (m) beyond which an unchanged reading is
                considered frozen; must exceed the sensor's resolution.
            jump_tolerance: maximum difference between two values in excess of the change that water
                can cause (m).
        """
        self.displacement = 0.0
        self._bounds = bounds
        self._frozen_movement = frozen_movement
        self._tolerance = jump_tolerance
        self._value = math.nan
        self._low = self._high = math.nan
        # The interval as if the last jump had not happened, and the displacement before that jump.
        self._old_low = self._old_high = math.nan
        self._old_displacement = 0.0
        self._at = 0.0
        # How far the level must have risen above its minimum since the reading last changed, and
        # fallen below its maximum (m).
        self._risen = self._fallen = 0.0
        self._frozen = False

    def expect(self, movement: Movement, passed: float) -> None:
        """Add the movement over a time (s) to the distance that the level must have moved."""
        self._risen = max(0.0, self._risen + movement.min * passed)
        self._fallen = max(0.0, self._fallen - movement.max * passed)
        moved = max(self._risen, self._fallen)
        self._frozen = self._frozen or moved > self._frozen_movement

    def check(self, now: float, value: float) -> Diagnosis | None:
        """Check a new value (m); return a diagnosis if water cannot have reached it, or None.

        The returned diagnosis does not contain the topic yet.
        """
        if value > self._bounds.max:
            maximum = self._bounds.max
            return Diagnosis.of("input_refused", "absurd", value=value, max=maximum)
        if value != self._value:
            self._risen = self._fallen = 0.0
            self._frozen = False
        before, self._value = self._value, value
        half = self._tolerance / 2
        passed, self._at = now - self._at, now
        if math.isnan(before):
            self._low, self._high = value - half, value + half
            return None
        fall, rise = self._bounds.fall(before) * passed, self._bounds.rise(before) * passed
        low, high = self._low - fall, self._high + rise
        self._old_low, self._old_high = self._old_low - fall, self._old_high + rise
        self._low, self._high = max(low, value - half), min(high, value + half)
        if self._low <= self._high:
            return self.check_frozen()
        self._low, self._high = value - half, value + half
        narrow = self._old_high - self._old_low < _SPIKE * self._tolerance
        if narrow and self._old_low - half <= value <= self._old_high + half:
            self.displacement, self._old_displacement = self._old_displacement, self.displacement
        else:
            self._old_displacement = self.displacement
            self.displacement += value - before
        self._old_low, self._old_high = low, high
        end = high if value > high else low
        return Diagnosis.of("input_jump", **{
            "from": before, "value": value, "time": passed, "expected": max(end, 0.0),
            "tolerance": half,
        })

    def check_frozen(self) -> Diagnosis | None:
        """Return a diagnosis if the reading is unchanged although the level must have moved."""
        if not self._frozen:
            return None
        return Diagnosis.of("input_frozen", movement=self._frozen_movement)


class InputRules:
    """Rules of a single input, which is valid again after it has satisfied all rules for a time."""

    def __init__(
        self, now: float, limit: float, recovery: float, *, topic: str = "",
        limit_name: str = "limit", level: LevelRule | None = None,
    ) -> None:
        """Start waiting for the first value.

        Args:
            now: time of a steady clock (s).
            limit: maximum age (s).
            recovery: time for which all rules must have been satisfied (s).
            topic: full name of the topic, for messages.
            limit_name: name of the limit's parameter, for messages.
            level: an additional rule, if the input is a level.
        """
        self._limit = limit
        self._topic, self._limit_name = topic, limit_name
        self._recovery = recovery
        self.level = level
        self._started_at = now
        self._received_at: float | None = None
        # What is wrong with the newest value, or why there is none; and what to recover from.
        self._newest: Diagnosis | None
        self._newest = self._broken = Diagnosis.of(_WAITING, topic=topic)
        self._good_since: float | None = None

    def receive(
        self, now: float, value: object, refused: Diagnosis | None = None
    ) -> Diagnosis | None:
        """Receive a value, and check it.

        Args:
            now: time of a steady clock (s).
            value: the value.
            refused: diagnosis of a value that is rejected; None if the value is accepted.
        """
        self.check(now)  # the input may have been silent until now
        self._received_at = now
        if refused is not None:
            self._newest = refused
        elif self.level is not None and isinstance(value, float):
            self._newest = self.level.check(now, value)
        else:
            self._newest = None
        return self.check(now)

    def refuse(self, now: float, why: str) -> Diagnosis | None:
        """Reject the latest value, because its recipient cannot use it."""
        self._newest = Diagnosis.of("input_refused", "refused", why=why)
        return self.check(now)

    def clear(self, seconds: float) -> None:
        """Discard all values, because this process itself was paused for the given time (s)."""
        if self._received_at is not None:
            self._received_at = None
            self._newest = Diagnosis.of("input_paused", time=seconds)

    def check(self, now: float, publishers: str = "") -> Diagnosis | None:
        """Return the diagnosis of an input that must not be used; None if it may be used.

        Args:
            now: time of a steady clock (s).
            publishers: problem with the publishers; empty if there is only one publisher.
        """
        diagnosis = self._broken_rule(now, publishers)
        if diagnosis is not None:
            self._good_since = None
            self._broken = replace(diagnosis, values={**diagnosis.values, "topic": self._topic})
            return self._broken
        if self._good_since is None:
            self._good_since = now
        if now - self._good_since >= self._recovery:
            return None
        if self._broken.code == _WAITING:
            return Diagnosis.of(_RECOVERING, "first", topic=self._topic, time=self._recovery)
        return Diagnosis.of(
            _RECOVERING, "again", topic=self._topic, time=self._recovery, before=self._broken
        )

    def _broken_rule(self, now: float, publishers: str) -> Diagnosis | None:
        """Return the diagnosis of the first violated rule, regardless of the recovery time."""
        if publishers:
            return Diagnosis.of("input_publishers", problem=publishers)
        if self._received_at is None:
            waiting = self._newest is not None and self._newest.code == _WAITING
            if waiting and now - self._started_at > _START_S:
                return Diagnosis.of("input_silent", "never")
            return self._newest
        if now - self._received_at > self._limit:
            return Diagnosis.of(
                "input_silent", "old", limit=self._limit, parameter=self._limit_name
            )
        if self._newest is None and self.level is not None:
            return self.level.check_frozen()
        return self._newest
