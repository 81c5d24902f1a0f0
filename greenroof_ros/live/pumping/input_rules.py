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
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.soil import percolation, retained_share
from greenroof_ros.site.site import MAX_EVAPOTRANSPIRATION, MUCH_RAIN, Site

# Real water levels may change faster than the site file implies, by up to this factor.
_MARGIN = 1.5
# Above the world records of hourly rain and of daily evapotranspiration (m/s).
_MAX_RAIN = MUCH_RAIN / 1000 / 3600
_MAX_LOSS = MAX_EVAPOTRANSPIRATION / 1000 / 86400
# Movements that a pump need not exceed: the maximum evapotranspiration of an hour from the roof,
# and drift of a sensor and unmeasured inflow in the cistern (m/s).
_LOSS, _DRIFT = 1e-3 / 3600, 5e-3 / 86400

AWAITED = "input_waiting", "input_recovering"
"""Codes of inputs that break no rule, but are awaited or not used yet."""


class LevelBounds(NamedTuple):
    """Maximum rates of change of a tank's level, and its maximum plausible value.

    Attributes:
        rise: maximum rate of rise (m/s, not negative).
        fall: function that returns the maximum rate of fall at a level in m (m/s, not negative).
        max: maximum plausible level (m).
    """

    rise: float
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
    return LevelBounds(rise, fall, site.max_cistern_level)


def roof_bounds(site: Site) -> LevelBounds:
    """Return the bounds of the roof, given by rain, pumps, evapotranspiration and drainage."""
    p = plant_parameters(site)
    pump = maximum_pump_flow(p, site.cistern_volume(site.z_o)) / site.a2

    def fall(level: float) -> float:
        drainage = percolation(p, site.roof_volume(level), 0.0, p.tau) / site.a2
        return _MARGIN * (_MAX_LOSS + drainage)

    return LevelBounds(_MARGIN * (_MAX_RAIN + pump), fall, site.max_roof_level)


def expected_movements(
    site: Site, flow: float, cistern_level: float, roof_level: float, error: float
) -> tuple[float, float]:
    """Return how fast a flow surely lowers the cistern and raises the roof (m/s).

    Negative values stand for a movement that is not sure: mains water may replace what the pump
    takes, evapotranspiration what it brings, and a full roof does not rise.

    Args:
        site: the site.
        flow: flow from the cistern to the roof (m3/s).
        cistern_level: level of the cistern (m).
        roof_level: level of the roof (m).
        error: how far the true levels may be from these values (m).
    """
    refilled = site.mains_level is not None and cistern_level - error < site.mains_level
    mains = (site.mains_flow or 0.0) * refilled
    highest = roof_level + error
    kept = retained_share(plant_parameters(site), site.roof_volume(highest))
    rise = flow / site.a2 * kept * (highest < site.z_soil)
    return (flow - mains) / site.a1 - _DRIFT, rise - _LOSS


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
        displacement: total displacement of the readings by jumps (m).
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
        self._bounds, self._tolerance = bounds, jump_tolerance
        self._frozen_movement = frozen_movement
        self._value, self._at = 0.0, 0.0
        self._low, self._high = -math.inf, math.inf
        self._moved = 0.0  # how far the pump has surely moved the level since its reading changed

    def expect(self, movement: float) -> None:
        """Add a movement (m, see :func:`expected_movements`) that the level must have made."""
        if self.check_frozen() is None:
            self._moved = max(0.0, self._moved + movement)

    def check(self, now: float, value: float) -> Diagnosis | None:
        """Check a new value (m); return a diagnosis if water cannot have reached it, or None.

        The returned diagnosis does not contain the topic yet.
        """
        if value > self._bounds.max:
            return Diagnosis.of("input_refused", "absurd", value=value, max=self._bounds.max)
        before, passed = self._value, now - self._at
        self._value, self._at = value, now
        if value != before:
            self._moved = 0.0
        half = self._tolerance / 2
        low = self._low - self._bounds.fall(before) * passed
        high = self._high + self._bounds.rise * passed
        self._low, self._high = max(low, value - half), min(high, value + half)
        if self._low <= self._high:
            return None
        self._low, self._high = value - half, value + half
        self.displacement += value - before
        return Diagnosis.of("input_jump", **{
            "from": before, "value": value, "time": passed, "tolerance": half,
            "expected": max(0.0, high if value > high else low),
        })

    def check_frozen(self) -> Diagnosis | None:
        """Return a diagnosis if the reading is unchanged although the level must have moved."""
        if self._moved <= self._frozen_movement:
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
            limit: maximum age (s), also of a first value since the start.
            recovery: time for which all rules must have been satisfied (s).
            topic: full name of the topic, for messages.
            limit_name: name of the limit's parameter, for messages.
            level: an additional rule, if the input is a level.
        """
        self.level = level
        self._limit, self._limit_name = limit, limit_name
        self._recovery, self._topic = recovery, topic
        # What is wrong with the newest value, when that was received, and what to recover from.
        self._newest: Diagnosis | None = Diagnosis.of("input_waiting", topic=topic)
        self._received_at, self._broken = now, self._newest
        self._good_since: float | None = None

    def receive(self, now: float, value: object, refused: Diagnosis | None = None) -> None:
        """Receive a value, which the next check judges.

        Args:
            now: time of a steady clock (s).
            value: the value; None if there is none.
            refused: why the value must not be used, without its topic; None if it may be used.
        """
        self.check(now)  # the input may have been silent until now
        self._received_at, self._newest = now, refused
        if refused is None and self.level is not None and isinstance(value, float):
            self._newest = self.level.check(now, value)

    def check(self, now: float, publishers: str = "") -> Diagnosis | None:
        """Return the diagnosis of an input that must not be used; None if it may be used.

        Args:
            now: time of a steady clock (s).
            publishers: problem with the publishers; empty if there is only one publisher.
        """
        broken = self._newest
        if publishers:
            broken = Diagnosis.of("input_publishers", problem=publishers)
        elif now - self._received_at > self._limit:
            broken = Diagnosis.of("input_silent", limit=self._limit, parameter=self._limit_name)
        elif broken is None and self.level is not None:
            broken = self.level.check_frozen()
        if broken is not None:
            self._good_since = None
            self._broken = replace(broken, values={**broken.values, "topic": self._topic})
            return self._broken
        if self._good_since is None:
            self._good_since = now
        if now - self._good_since >= self._recovery:
            return None
        return Diagnosis.of(
            "input_recovering", topic=self._topic, time=self._recovery, before=self._broken
        )
