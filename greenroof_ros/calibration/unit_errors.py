"""Sums and levels that no roof has, as those in a wrong unit are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.calibration.storms import storms
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site

_DAY_S = 86400
# Least rain from which anything can be said (mm), and what is no rain of weeks (mm a day).
_LEAST_RAIN, _MOST_RAIN_A_DAY = 20.0, 60.0

# The bounds below part the two measured roofs (Neubrandenburg 2014 and 2015, Berlin 2019, April to
# October, in windows of 100 days) from the same with rain or runoff 10 or 12 times as much, or a
# tenth or a twelfth of it; those of levels with the levels that these roofs would have.

# More than a storm's water runs off in it: as a share of all runoff in storms at most 0.13 there,
# and with a wrong unit 0.21 and more, mostly 0.4. And in mm, which a few drops never are.
_MOST_EXCESS, _LEAST_EXCESS = 0.25, 5.0
# The greatest share of a storm of 5 mm or more that runs off: 0.13 there at least, and with a wrong
# unit 0.08 at most; of three such storms in 90 days. A shorter record may be of a dry month.
_LEAST_SHARE, _LARGE, _FEWEST_LARGE, _LONG_DAYS = 0.1, 5.0, 3, 90
# What runs off of a storm that is more than the soil's volume comes but for this (mm).
_HELD_BESIDES = 20.0
# How much levels rise in storms of 1 mm and more, as a share of their water: 0.4 to 1.1 there, and
# with a wrong unit 0.09 at most or 6 at least; of three such storms.
_LEAST_RISE, _MOST_RISE, _COUNTS, _FEWEST_STORMS = 0.1, 2.0, 1.0, 3
# Means so long before and after a storm, in which a sensor's noise is less (s).
_BESIDE_S = 1800


class _Answer(NamedTuple):
    """What a storm brought, and what followed (mm)."""

    first: int
    came: float
    followed: float


def refuse_wrong_units(record: Record, site: Site) -> None:
    """Refuse sums and levels that no roof has.

    Raises:
        ConfigurationError: there are such; the message says which, beside what a roof has.
    """
    _rain(record)
    if record.level is not None:
        _level(record, record.level, site)
    if record.runoff is not None:
        _runoff(record, record.runoff, site)


def _error(record: Record, column: str, text: str) -> ConfigurationError:
    return ConfigurationError(text, file=record.source, key=column)


def _when(record: Record, step: int) -> str:
    return str(record.times[step]).replace("T", " ")


def _days(record: Record) -> float:
    """Return of how many days the rain is known."""
    return float(np.count_nonzero(~np.isnan(record.rain))) * record.step_s / _DAY_S


def _rain(record: Record) -> None:
    rain, pumped = float(np.nansum(record.rain)), float(np.nansum(record.pumped))
    days = _days(record)
    if rain + pumped < _LEAST_RAIN:
        raise _error(
            record, "rain",
            f"is {rain:.3g} mm in {days:.0f} days; from less than {_LEAST_RAIN:g} mm nothing can "
            "be fitted: is the unit right, or the gauge blocked?",
        )
    if days > 7 and rain / days > _MOST_RAIN_A_DAY:
        raise _error(
            record, "rain",
            f"is {rain:.4g} mm in {days:.0f} days, more than anywhere on earth: is the unit right?",
        )


def _level(record: Record, level: Values, site: Site) -> None:
    highest = float(np.nanmax(level))
    if highest > site.highest_roof_level:
        raise _error(
            record, "level",
            f"rises to {highest:g} m, more than twice the soil's depth of {site.z_soil:g} m "
            f"({_when(record, int(np.nanargmax(level)))}): is the unit right?",
        )
    answers = _rises(record, level)
    came = sum(one.came for one in answers)
    risen = sum(one.followed for one in answers)
    if len(answers) >= _FEWEST_STORMS and not _LEAST_RISE < risen / came < _MOST_RISE:
        raise _error(
            record, "level",
            f"rises by {risen:.2g} mm in storms that bring {came:.4g} mm, what is pumped included: "
            f"is the unit right? It should be {_LEAST_RISE:g} to {_MOST_RISE:g} times that",
        )


def _rises(record: Record, level: Values) -> list[_Answer]:
    """Return by how much the level rises in each storm: from before its first rain to its last."""
    beside = max(1, round(_BESIDE_S / record.step_s))
    water = record.rain + record.pumped
    answers = []
    for storm in storms(record):
        wet = np.flatnonzero(np.nan_to_num(record.rain[storm.first:storm.end]) > 0)
        last = storm.first + int(wet[-1]) + 1
        if storm.first < beside or last + beside > record.steps:
            continue
        came = float(np.sum(water[storm.first - beside:last + beside]))
        # Levels are of the beginnings of steps: the storm's first is before its rain.
        before = level[storm.first + 1 - beside:storm.first + 1]
        after = level[last:last + beside]
        rise = 1000 * float(np.mean(after) - np.mean(before))
        if came >= _COUNTS and not np.isnan(rise):
            answers.append(_Answer(storm.first, came, rise))
    return answers


def _runoff(record: Record, runoff: Values, site: Site) -> None:
    both = ~np.isnan(runoff) & ~np.isnan(record.rain)
    came = float(np.sum(record.rain[both])) + float(np.nansum(record.pumped[both]))
    gone = float(np.sum(runoff[both]))
    held = 1000 * site.z_soil
    if gone > came + held:
        raise _error(
            record, "runoff",
            f"is {gone:.4g} mm where {came:.4g} mm came, and the soil holds {held:g} mm at most: "
            "is its unit right, and a2 of the site?",
        )
    if gone < 0.001 * came:
        raise _error(
            record, "runoff",
            f"is {gone:.2g} mm in all, of {came:.4g} mm that came: is its unit right, or the "
            "sensor dead?",
        )
    answers = _storm_runoff(record, runoff)
    _too_much(record, answers)
    _too_little(record, answers, held)


def _storm_runoff(record: Record, runoff: Values) -> list[_Answer]:
    """Return what ran off in each storm and the day after it; storms with gaps are left out."""
    water = record.rain + record.pumped
    answers = []
    for storm in storms(record):
        came, gone = (float(np.sum(one[storm.first:storm.end])) for one in (water, runoff))
        if not np.isnan(came + gone):
            answers.append(_Answer(storm.first, came, gone))
    return answers


def _too_much(record: Record, answers: list[_Answer]) -> None:
    gone = sum(one.followed for one in answers)
    excess = sum(max(0.0, one.followed - one.came) for one in answers)
    if excess > max(_LEAST_EXCESS, _MOST_EXCESS * gone):
        worst = max(answers, key=lambda one: one.followed - one.came)
        raise _error(
            record, "runoff",
            f"is more than what came, storm by storm: {worst.followed:.3g} mm of the "
            f"{worst.came:.3g} mm from {_when(record, worst.first)}, and {excess:.3g} mm too much "
            f"in {len(answers)} storms: are the units of rain and runoff right, and a2 of the "
            "site?",
        )


def _too_little(record: Record, answers: list[_Answer], held: float) -> None:
    for one in answers:
        if one.followed < one.came - held - _HELD_BESIDES:
            raise _error(
                record, "runoff",
                f"is {one.followed:.3g} mm of the {one.came:.3g} mm from "
                f"{_when(record, one.first)}, and the soil holds {held:g} mm at most: are the "
                "units of rain and runoff right?",
            )
    large = [one for one in answers if one.came >= _LARGE]
    if len(large) < _FEWEST_LARGE or _days(record) < _LONG_DAYS:
        return
    most = max(large, key=lambda one: one.followed / one.came)
    if most.followed < _LEAST_SHARE * most.came:
        raise _error(
            record, "runoff",
            f"is never more than {100 * most.followed / most.came:.2g} % of a storm, of "
            f"{len(large)} with {_LARGE:g} mm and more: are the units of rain and runoff right? If "
            "they are, nothing can be fitted to so little: record a wetter season",
        )
