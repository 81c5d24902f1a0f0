"""Whether a live input may be acted on: its age, its publishers, and what water cannot do.

Who calls gives the time, in s of a steady clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from greenroof_ros.formats.records import EVAPOTRANSPIRATION, PRECIPITATION, QUANTITIES
from greenroof_ros.model.plant import (
    low_outlet_flow,
    mains_flow,
    maximum_pump_flow,
    outlet_flow,
)
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of

# For how long an input that has not come since the start is only awaited (s).
_START_S = 10.0
# Pumps, rain and pipes of a site differ from its file; its water may be faster by this factor.
_MARGIN = 1.5
# A jump's way back counts for so long as the interval of the time before it is no wider than so
# many tolerances: some minutes.
_SPIKE = 4.0
# More than the world's record of an hour's rain, and of a day's evapotranspiration (m/s).
_MOST_RAIN = QUANTITIES[PRECIPITATION][2] / 1000 / 3600
_MOST_EVAPOTRANSPIRATION = QUANTITIES[EVAPOTRANSPIRATION][2] / 1000 / 86400

_WAITING, _RECOVERING = "input_waiting", "input_recovering"


class Verdict(NamedTuple):
    """What is wrong with an input.

    Attributes:
        code: names the rule that it breaks, in :mod:`greenroof_ros.common.interface`; empty where
            it is good.
        why: what it does, for a sentence that begins with its name.
    """

    code: str = ""
    why: str = ""

    @property
    def good(self) -> bool:
        """Whether it may be acted on."""
        return not self.code

    @property
    def alarming(self) -> bool:
        """Whether it breaks a rule now, and is not only awaited."""
        return self.code not in ("", _WAITING, _RECOVERING)


class Reach(NamedTuple):
    """What the water in a tank can do.

    Attributes:
        rise: how fast it can rise at most, at a level (m): m/s, not negative.
        fall: how fast it can fall at most.
        highest: level (m).
    """

    rise: Callable[[float], float]
    fall: Callable[[float], float]
    highest: float


def cistern_reach(site: Site) -> Reach:
    """Return the reach of the cistern: rain and mains into it, and pumps and outlets out of it.

    All rain on the catchment counts, since a storm's runoff coefficient may be above the mean.
    """

    def fall(level: float) -> float:
        volume = site.cistern_volume(level)
        return _MARGIN * (maximum_pump_flow(site, volume) + outlet_flow(site, volume)) / site.a1

    rise = _MARGIN * (_MOST_RAIN * site.a_in + (site.mains_flow or 0.0)) / site.a1
    return Reach(lambda level: rise, fall, site.highest_cistern_level)


def roof_reach(site: Site) -> Reach:
    """Return the reach of the roof: rain and full pumps, and evapotranspiration and drainage."""
    pump, soil = maximum_pump_flow(site, site.cistern_volume(site.z_o)) / site.a2, soil_of(site)

    def fall(level: float) -> float:
        return _MARGIN * (_MOST_EVAPOTRANSPIRATION + soil.fastest_fall(level))

    return Reach(lambda level: _MARGIN * (_MOST_RAIN + pump), fall, site.highest_roof_level)


def expected_rise(
    site: Site, flow: float, rain: float, cistern_level: float, roof_level: float
) -> tuple[float, float]:
    """Return how fast the levels must be rising (m/s), negative where they must fall.

    A tank that spills is expected to do nothing, since what enters it leaves it: the cistern at its
    outlet, the roof at the depth of its soil, a measured one where that keeps nothing more. What
    enters the cistern above its low outlet may leave by it; what that takes beside is not expected,
    since a narrow outlet clogs.

    Args:
        site: with the tanks.
        flow: from the cistern to the roof (m3/s).
        rain: m/s.
        cistern_level: m.
        roof_level: m.
    """
    volume = site.cistern_volume(cistern_level)
    water = rain * site.effective_catchment + mains_flow(site, volume) - flow
    if water > 0:
        water = max(0.0, water - _MARGIN * low_outlet_flow(site, volume))
    cistern = water / site.a1 if cistern_level < site.z_o else 0.0
    roof = rain + flow / site.a2 if roof_level < site.z_soil else 0.0
    return cistern, roof * soil_of(site).kept_share(site.roof_volume(roof_level))


class LevelRule:
    """What a level cannot do: stand still while its tank is filled or emptied, jump, or be absurd.

    A value above the highest is refused, and else counts for nothing: its unit is wrong.

    For the jump it keeps the interval in which the true level must be: it widens as fast as water
    can rise and fall, and each value narrows it to within half the tolerance of that value. Where
    nothing is left of it the value has jumped, and the interval begins again with it. So neither
    one step nor many small ones, however quickly they come, go unseen; noise within half the
    tolerance is never a jump.

    Attributes:
        displacement: by how much jumps have moved the readings (m). What comes back to where water
            can be since before a jump was a spike, and moved nothing.
    """

    def __init__(self, reach: Reach, frozen_movement: float, jump_tolerance: float) -> None:
        """Know no value yet.

        Args:
            reach: of the tank's water.
            frozen_movement: how far the level must have moved to be called frozen (m), if it does
                not; more than the sensor resolves.
            jump_tolerance: how far two values may be apart beyond what water can do (m).
        """
        self.displacement = 0.0
        self._reach = reach
        self._frozen_movement = frozen_movement
        self._tolerance = jump_tolerance
        self._value = math.nan
        self._low = self._high = math.nan
        # The same interval without the last jump, and the displacement then.
        self._old_low = self._old_high = math.nan
        self._old_displacement = 0.0
        self._at = 0.0
        self._expected = 0.0
        self._frozen = False

    def expect(self, rise: float) -> None:
        """Note that the level must have risen (m; negative: fallen) since this was last said."""
        self._expected += rise
        self._frozen = self._frozen or abs(self._expected) > self._frozen_movement

    def came(self, now: float, value: float) -> Verdict:
        """Take a value (m), and say whether water can have moved to it."""
        if value > self._reach.highest:
            return Verdict(
                "input_refused", f"is {value:.4g} m, and here no level is above "
                f"{self._reach.highest:g} m: is its unit wrong?",
            )
        if value != self._value:
            self._expected = 0.0
            self._frozen = False
        before, self._value = self._value, value
        half = self._tolerance / 2
        passed, self._at = now - self._at, now
        if math.isnan(before):
            self._low, self._high = value - half, value + half
            return Verdict()
        fall, rise = self._reach.fall(before) * passed, self._reach.rise(before) * passed
        low, high = self._low - fall, self._high + rise
        self._old_low, self._old_high = self._old_low - fall, self._old_high + rise
        self._low, self._high = max(low, value - half), min(high, value + half)
        if self._low <= self._high:
            return self.stands()
        self._low, self._high = value - half, value + half
        narrow = self._old_high - self._old_low < _SPIKE * self._tolerance
        if narrow and self._old_low - half <= value <= self._old_high + half:
            self.displacement, self._old_displacement = self._old_displacement, self.displacement
        else:
            self._old_displacement = self.displacement
            self.displacement += value - before
        self._old_low, self._old_high = low, high
        end = high if value > high else low
        return Verdict(
            "input_jump", f"jumped: {before:.4g} m, and {passed:.3g} s later {value:.4g} m, where "
            f"water can be at {max(end, 0.0):.4g} m, give or take {half:g} m (jump_tolerance)",
        )

    def stands(self) -> Verdict:
        """Say whether the level stands still though it must have moved."""
        if not self._frozen:
            return Verdict()
        return Verdict(
            "input_frozen", "is frozen: not one change while pump and rain must have moved it by "
            f"more than {self._frozen_movement:g} m (frozen_movement)",
        )


class InputRules:
    """The rules of one input; it is good again once it has kept them for a time."""

    def __init__(
        self, now: float, limit: float, recovery: float, *, limit_name: str = "limit",
        level: LevelRule | None = None,
    ) -> None:
        """Wait for its first value.

        Args:
            now: s.
            limit: its greatest age (s).
            recovery: for how long it must have kept all rules (s).
            limit_name: of the parameter that is the limit, for messages.
            level: the rule that a level must keep besides.
        """
        self._limit = limit
        self._limit_name = limit_name
        self._recovery = recovery
        self.level = level
        self._begun = now
        self._came: float | None = None
        # Of the newest value, or why there is none; and what it must recover from.
        self._newest = self._broken = Verdict(_WAITING, "has not come yet")
        self._good_since: float | None = None

    def came(self, now: float, value: object, refused: str = "") -> Verdict:
        """Take a value.

        Args:
            now: s.
            value: that came.
            refused: why it counts for nothing; empty where it counts.
        """
        self.judge(now)  # it may have been silent
        self._came = now
        if refused:
            self._newest = Verdict("input_refused", refused)
        elif self.level is not None and isinstance(value, float):
            self._newest = self.level.came(now, value)
        else:
            self._newest = Verdict()
        return self.judge(now)

    def refuse(self, now: float, why: str) -> Verdict:
        """Refuse the newest value: who acts on it cannot."""
        self._newest = Verdict("input_refused", why)
        return self.judge(now)

    def paused(self, seconds: float) -> None:
        """Forget what came: the process itself stood still for so long (s)."""
        if self._came is not None:
            self._came = None
            self._newest = Verdict(
                "input_paused", f"is unknown: this node itself stood still for {seconds:.0f} s"
            )

    def judge(self, now: float, publishers: str = "") -> Verdict:
        """Say whether the input may be acted on.

        Args:
            now: s.
            publishers: what is wrong with them; empty where there is but one.
        """
        verdict = self._present(now, publishers)
        if not verdict.good:
            self._broken, self._good_since = verdict, None
            return verdict
        if self._good_since is None:
            self._good_since = now
        if now - self._good_since < self._recovery:
            return Verdict(
                _RECOVERING, f"{self._broken.why}; now it is good, and counts after "
                f"{self._recovery:g} s of that (recovery_time)",
            )
        return verdict

    def _present(self, now: float, publishers: str) -> Verdict:
        """Return the first rule that is broken now."""
        if publishers:
            return Verdict("input_publishers", publishers)
        if self._came is None:
            if self._newest.code == _WAITING and now - self._begun > _START_S:
                return Verdict("input_silent", self._newest.why)
            return self._newest
        if now - self._came > self._limit:
            why = f"is older than {self._limit:g} s ({self._limit_name})"
            return Verdict("input_silent", why)
        if self._newest.good and self.level is not None:
            return self.level.stands()
        return self._newest
