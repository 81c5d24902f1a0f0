"""Checks of a record and of its fit: units, clocks, stuck sensors, blocked gauges, the fit.

A record is refused if a fit to it is worthless: amounts that no roof has, or no roof that fits.
What else is wrong is a warning.

The bounds separate the records of two roofs (Neubrandenburg 2014 and 2015, Berlin 2019, April to
October, in windows of 30 to 100 days) from the same records with a wrong unit, a shifted clock or a
broken sensor. Bounds for levels do so with simulated levels of these roofs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.record import (
    DAY_S,
    HOUR_S,
    RoofRecord,
    Steps,
    prolonged,
    storms,
    time_name,
)
from greenroof_ros.analysis.calibration.scores import FitScores
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.site import Site

_FEWEST_VALUES = 100


def check_record(record: RoofRecord, site: Site) -> list[str]:
    """Return warnings about the sensors, units and clocks of a record.

    Args:
        record: the measurements in the steps that count.
        site: its roof and place.

    Raises:
        ConfigurationError: a column has fewer than 100 values, or amounts that no roof has.
    """
    for column, values in {"rain": record.rain, **record.measured}.items():
        there = int(np.count_nonzero(~np.isnan(values)))
        if there < _FEWEST_VALUES:
            raise ConfigurationError(
                f"has {there} values; it must have at least {_FEWEST_VALUES}", file=record.source,
                key=column,
            )
    _check_units(record, site)
    return [
        *_balance(record, site), *_clock(record), *_stuck(record, site), *_blocked(record)
    ]


# --- units ----------------------------------------------------------------------------------------

# The minimum water for a fit (mm), and more than falls anywhere on earth in weeks (mm a day).
_MIN_WATER, _MOST_A_DAY = 20.0, 60.0
# More evapotranspiration than any day has (mm). Alfalfa, with 1.15 times the evapotranspiration of
# grass, had 14 mm, weighed, on the windiest days of four years in Texas (Evett, Howell, Todd,
# Schneider and Tolk, Alfalfa reference ET measurement and prediction, 4th Decennial National
# Irrigation Symposium, 2000).
_MOST_EVAPORATED = 20.0
# Less movement of a level (m) than any roof has in 20 mm of water.
_MIN_MOVEMENT = 0.002
# The largest excess of runoff over water, summed over storms, as a share of their runoff: at most
# 0.13 for both roofs; with a wrong unit at least 0.21, mostly 0.4. A few drops (mm) do not count.
_MOST_EXCESS, _DROPS = 0.25, 5.0
# A roof keeps at most the soil's volume and this much more of a storm (mm).
_EXTRA_STORAGE = 20.0


def _check_units(record: RoofRecord, site: Site) -> None:
    """Refuse amounts and levels that no roof can have."""
    water = float(record.water.sum())
    days = float(np.count_nonzero(~np.isnan(record.rain))) * record.step_s / DAY_S
    most_water = _MOST_A_DAY * max(days, 7)
    amounts = [("rain", "mm in all, with pumped water", water, _MIN_WATER, most_water)]
    if record.reference_column:
        _, day = np.unique(record.seconds // DAY_S, return_inverse=True)
        most = float(np.bincount(day, record.reference).max())
        amounts.append((record.reference_column, "mm in a day", most, 0.0, _MOST_EVAPORATED))
    if record.level is not None:
        highest, lowest = float(np.nanmax(record.level)), float(np.nanmin(record.level))
        amounts += [
            ("level", "m at its highest", highest, -math.inf, site.max_roof_level),
            ("level", "m from lowest to highest", highest - lowest, _MIN_MOVEMENT, math.inf),
        ]
    for column, what, value, low, high in amounts:
        if not low <= value <= high:
            bound = f"at most {high:.4g}" if value > high else f"at least {low:.4g}"
            raise ConfigurationError(
                f"is {value:.3g} {what}; it must be {bound}: is the unit of the column right, and "
                "those of the others?", file=record.source, key=column,
            )


def _balance(record: RoofRecord, site: Site) -> Iterator[str]:
    """Compare runoff with water, in each storm and the day after it."""
    if record.runoff is None:
        return
    water = record.rain + record.pumped
    sums = np.array([
        (np.sum(water[storm]), np.sum(record.runoff[storm])) for storm in storms(record)
    ]).reshape(-1, 2)
    came, gone = sums[~np.isnan(sums).any(axis=1)].T
    excess = float(np.sum(np.maximum(gone - came, 0.0)))
    if excess > max(_DROPS, _MOST_EXCESS * float(np.sum(gone))):
        yield (
            f"runoff is {excess:.3g} mm more than the water of its storms: are the units right, "
            "and a2?"
        )
    kept = float(np.max(came - gone, initial=0.0))
    if kept > 1000 * site.z_soil + _EXTRA_STORAGE:
        yield (
            f"rain is {kept:.3g} mm more than the runoff of a storm, and the soil cannot hold it: "
            "are the units right, and z_soil?"
        )


# --- clocks ---------------------------------------------------------------------------------------

# Water reaches a level sensor within minutes and leaves a roof within hours; a longer delay means a
# shifted clock. So does a response before the rain by more than this many steps, or by two hours:
# clocks can differ by minutes, and a level's rises are between means of half an hour.
_LONGEST_DELAY_S, _MOST_SHIFT_S = 4 * HOUR_S, 26 * HOUR_S
_EARLY_STEPS, _EARLY_S = {"runoff": 1, "level": 2}, 2 * HOUR_S
# The minimum correlation that counts, and the minimum ratio of the best correlation to the one
# without a shift. An early response is always wrong: in 64 windows of 30 and 60 days of the two
# roofs this ratio is at most 1.03; with a clock an hour early it is above 1.1 in 47 of
# them.
_CLEAR, _EARLY_BETTER, _LATE_BETTER = 0.1, 1.1, 1.5


def _clock(record: RoofRecord) -> Iterator[str]:
    """Find a roof that responds before the rain, or hours after it.

    Only rises of runoff or level count: how long runoff continues after rain indicates nothing
    about clocks. A level's rise is between two means of half an hour, to reduce a sensor's noise.
    """
    column, series = next(iter(record.measured.items()))
    if column == "runoff":
        rises = np.diff(series, prepend=np.nan)
    else:
        count = max(1, round(1800 / record.step_s))
        weights = np.repeat([1.0, -1.0], count) / count
        rises = np.convolve(np.nan_to_num(series), weights)[count:len(series)]
        rises = np.append(rises, np.zeros(count))
    usual_s = (
        -min(_EARLY_STEPS[column] * record.step_s, _EARLY_S), max(_LONGEST_DELAY_S, record.step_s),
    )
    # Square roots reduce the weight of one large storm.
    inflow, answers = (
        roots - roots.mean()
        for roots in (np.sqrt(record.water), np.sqrt(np.maximum(np.nan_to_num(rises), 0.0)))
    )
    scale = np.sqrt(np.sum(inflow**2) * np.sum(answers**2))
    if scale == 0:
        return
    most = int(_MOST_SHIFT_S // record.step_s)
    lags = record.step_s * np.arange(-most, most + 1)
    correlations = np.correlate(np.pad(answers, most), inflow, "valid") / scale
    lag, best = float(lags[np.argmax(correlations)]), float(correlations.max())
    usual = float(correlations[(lags >= usual_s[0]) & (lags <= usual_s[1])].max())
    early = lag < usual_s[0]
    better = _EARLY_BETTER if early else _LATE_BETTER
    if (early or lag > usual_s[1]) and best > _CLEAR and best > better * usual:
        yield (
            f"{column} follows the rain best {time_name(abs(lag))} "
            f"{'before' if early else 'after'} it falls (correlation {best:.2f}, {usual:.2f} as it "
            "stands): is a clock shifted, or in another time zone?"
        )


# --- sensors --------------------------------------------------------------------------------------

# A sensor is stuck if its reading stays the same for this long (s) while this much rain falls (mm),
# and in this many steps: with steps of a day, a roof can have equal levels on two wet days.
_STUCK_S, _STUCK_RAIN, _RAIN_STUCK_S, _SAME_STEPS = DAY_S, 10.0, 6 * HOUR_S, 6
# More water than this (mm) must cause some runoff if it also exceeds what the soil can hold. Both
# roofs had no runoff from 44 mm in four weeks.
_LEAVES_SOME = 80.0
# A watered roof evaporates at the full rate, at most 1.3 times the rate of the reference grass
# (FAO-56, Eq. 72: 1.05 to 1.3). The two roofs are not watered, and dry out.
_FULL_RATE = 1.3
# More runoff than this (mm), after this long (s) without rain, has no explanation.
_UNEXPLAINED, _DRY_S = 5.0, 3 * DAY_S


def _stuck(record: RoofRecord, site: Site) -> Iterator[str]:
    """Find sensors that show one value, apart from gaps, while it must change.

    A flow meter must change from 0 if more water comes than the soil can hold. From a roof with a
    pump, evapotranspiration is subtracted at its full rate, because a good controller pumps no more
    than that, and nothing while it rains often enough.
    """
    rate = max(_FULL_RATE, site.crop_coefficient) * bool(np.nansum(record.pumped) > 0)
    gained = record.water - rate * record.reference
    holds = max(_LEAVES_SOME, 1000 * site.z_soil)
    for column, values in {**record.measured, "rain": record.rain}.items():
        known = np.flatnonzero(~np.isnan(values))
        for low, high in gaps(np.diff(values[known]) == 0):
            same, value = known[low:high + 1], values[known[low]]
            same_s = len(same) * record.step_s
            if column == "rain":
                stuck = value > 0 and same_s >= _RAIN_STUCK_S
            elif column == "runoff" and value == 0:
                stuck = float(np.sum(gained[same])) > holds
            else:
                stuck = same_s >= _STUCK_S and float(np.nansum(record.rain[same])) >= _STUCK_RAIN
            if stuck and len(same) >= _SAME_STEPS:
                yield (
                    f"{column} is {value:g} {'m' if column == 'level' else 'mm'} for "
                    f"{same_s / HOUR_S:.0f} h from {record.time(int(same[0]))}, in which "
                    f"{np.sum(record.water[same]):.3g} mm of water came: is the sensor stuck or "
                    "dead? Leave these cells empty"
                )
                break


def _blocked(record: RoofRecord) -> Iterator[str]:
    """Find runoff without rain."""
    if record.runoff is None:
        return
    wet: Steps = (record.water > 0) | np.isnan(record.rain) | np.isnan(record.pumped)
    since = math.ceil(_DRY_S / record.step_s)
    for low, high in gaps(~prolonged(wet, since)):
        outflow = float(np.nansum(record.runoff[low:high]))
        if low > 0 and outflow > _UNEXPLAINED:
            yield (
                f"rain is 0 for {(high - low + since - 1) * record.step_s / DAY_S:.0f} days before "
                f"{record.time(high)}, while {outflow:.3g} mm run off: is the gauge blocked or "
                "stuck, or is it melted snow? Leave the cells empty there"
            )
            return


# --- fits -----------------------------------------------------------------------------------------

# If the volume of runoff is wrong by more than this share, the fit is poor.
_VOLUME_OFF = 0.5


def check_fit(scores: Sequence[FitScores], source: Path) -> list[str]:
    """Return warnings about a fit.

    There is one if, in the validation, the NSE of days is below 0 (of hours or longer steps if
    there are too few days), or the volume of runoff is wrong by more than half.

    Args:
        scores: of each series, in the fit and in the validation.
        source: the record.

    Raises:
        ConfigurationError: every NSE is below 0, of hours (or of longer steps) and of days, in the
            fit and in the validation, and of every series.
    """
    nses = [
        (row, [nse for span_s, nse in row.nse.items() if span_s >= HOUR_S and not math.isnan(nse)])
        for row in scores
    ]
    advice = "Check the units, the clocks, the sensors, and the site's a2 and z_soil."
    if all(nse < 0 for _, of_row in nses for nse in of_row):
        best = ", ".join(
            f"{row.quantity} in {row.part} {max(of_row):.2f}" for row, of_row in nses if of_row
        )
        raise ConfigurationError(
            f"no roof fits this record: the best NSE of {best}, and the mean of what was measured "
            f"has 0. {advice}", file=source,
        )
    why = [
        f"the NSE of {row.quantity} is {of_row[-1]:.2f}" for row, of_row in nses
        if row.part == "validation" and of_row and of_row[-1] < 0
    ] + [
        f"the volume of runoff is off by {100 * row.volume_error:+.0f} %" for row, _ in nses
        if (row.part, row.quantity) == ("validation", "runoff")
        and abs(row.volume_error) > _VOLUME_OFF
    ]
    return [
        f"in the half that the fit has not seen {' and '.join(why)}: do not use it. {advice}"
    ] if why else []
