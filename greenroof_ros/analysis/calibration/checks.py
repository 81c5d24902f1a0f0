"""Checks of a record before the fit, and checks of the fit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.scores import FitScores
from greenroof_ros.analysis.calibration.step_record import (
    DAY_S,
    HOUR_S,
    StepRecord,
    Steps,
    find_storms,
    name_time,
    prolong_steps,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.site import Site
from greenroof_ros.weather.records import find_gaps

# The minimum for a fit: number of values in every column, and water (mm).
_MIN_VALUES, _MIN_WATER = 100, 20.0


def check_record(record: StepRecord, site: Site) -> list[str]:
    """Return a warning for each implausible finding in a record.

    Args:
        record: the measurements in the steps used for the fit or the validation.
        site: site with the roof and its location.

    Raises:
        ConfigurationError: if a rule rejects the record, or if the record is too short for a fit.
    """
    for column, values in {"rain": record.rain, **record.measured}.items():
        there = int(np.count_nonzero(~np.isnan(values)))
        if there < _MIN_VALUES:
            raise ConfigurationError(
                f"has {there} values; a fit needs at least {_MIN_VALUES}", file=record.source,
                key=column,
            )
    water = float(record.water.sum())
    if water < _MIN_WATER:
        raise ConfigurationError(
            f"is {water:.3g} mm in total, including pumped water, but a fit needs at least "
            f"{_MIN_WATER:g} mm. Is the unit of the column right?", file=record.source, key="rain",
        )
    return [sentence for find in RULES for sentence in find(record, site)]


# --- what is wrong with a record ------------------------------------------------------------------
#
# The bounds separate the records of two roofs (Neubrandenburg 2014 and 2015, Berlin 2019, April to
# October, in windows of 30 to 100 days) from the same records with a shifted clock or a defective
# sensor. The bounds for levels separate simulated levels of these roofs in the same way.

# The largest excess of runoff over water, summed over storms, as a share of their runoff: up to
# 0.13 for both roofs; with a wrong unit at least 0.21, usually 0.4. A few drops (mm) do not count.
_MAX_EXCESS, _DROPS = 0.25, 5.0
# A roof retains no more of a storm than the soil's volume and this (mm).
_EXTRA_STORAGE = 20.0
# Runoff of a record as a share of its water, if there is any: at least 0.0025 in windows of 30 days
# or more; with runoff in m instead of mm, no more than 0.0007.
_MIN_SHARE = 0.001


def find_imbalance(record: StepRecord, site: Site) -> Iterator[str]:
    """Compare runoff with rain and pumped water, in total and for every storm."""
    if record.runoff is None:
        return
    total = float(np.nansum(record.runoff))
    inflow = float(np.sum(record.water[~np.isnan(record.runoff)]))
    # A watered roof may retain all of it.
    if 0 < total < _MIN_SHARE * inflow and not np.any(record.pumped > 0):
        yield (
            f"runoff is only {total:.2g} mm for {inflow:.4g} mm of rain: is the unit of the "
            "column right?"
        )
    water = record.rain + record.pumped
    sums = np.array([
        (np.sum(water[storm]), np.sum(record.runoff[storm])) for storm in find_storms(record)
    ]).reshape(-1, 2)
    came, gone = sums[~np.isnan(sums).any(axis=1)].T
    excess = float(np.sum(np.maximum(gone - came, 0.0)))
    if excess > max(_DROPS, _MAX_EXCESS * float(np.sum(gone))):
        yield (
            f"runoff is {excess:.3g} mm more than the rain and pumped water that caused it: are "
            "the units and a2 right?"
        )
    kept = float(np.max(came - gone, initial=0.0))
    if kept > 1000 * site.z_soil + _EXTRA_STORAGE:
        yield (
            f"rain exceeds runoff by {kept:.3g} mm in one storm, which is more than the soil can "
            "hold: are the units and z_soil right?"
        )


# --- clocks ---------------------------------------------------------------------------------------

# Water reaches a level sensor within minutes and leaves a roof within hours; a longer delay means a
# shifted clock. So does a response more than this many steps before the rain, or two hours: clocks
# can differ by minutes, and a level's rises are between half-hour means.
_MAX_DELAY_S, _MAX_SHIFT_S = 4 * HOUR_S, 26 * HOUR_S
_EARLY_STEPS, _EARLY_S = {"runoff": 1, "level": 2}, 2 * HOUR_S
# The minimum correlation that counts, and the minimum ratio of the best correlation to the one
# without a shift. An early response is always wrong: in 64 windows of 30 and 60 days of the two
# roofs this ratio is no more than 1.03; with a clock an hour early it is above 1.1 in 47 of them.
_CLEAR, _EARLY_BETTER, _LATE_BETTER = 0.1, 1.1, 1.5


def find_shifted_clock(record: StepRecord, _site: Site) -> Iterator[str]:
    """Find a roof that responds before the rain, or many hours after it.

    Only the rises of runoff or level are used, since the duration of runoff after rain contains no
    information about clocks. The rise of a level is the difference between two half-hour means,
    which reduces the sensor's noise.
    """
    if not record.measured:
        return
    column, series = next(iter(record.measured.items()))
    if column == "runoff":
        rises = np.diff(series, prepend=np.nan)
    else:
        count = max(1, round(1800 / record.step_s))
        weights = np.repeat([1.0, -1.0], count) / count
        rises = np.convolve(np.nan_to_num(series), weights)[count:len(series)]
        rises = np.append(rises, np.zeros(count))
    usual_s = (
        -min(_EARLY_STEPS[column] * record.step_s, _EARLY_S), max(_MAX_DELAY_S, record.step_s),
    )
    # Square roots reduce the weight of one large storm.
    inflow, answers = (
        roots - roots.mean()
        for roots in (np.sqrt(record.water), np.sqrt(np.maximum(np.nan_to_num(rises), 0.0)))
    )
    scale = np.sqrt(np.sum(inflow**2) * np.sum(answers**2))
    if scale == 0:
        return
    reach = int(_MAX_SHIFT_S // record.step_s)
    lags = record.step_s * np.arange(-reach, reach + 1)
    correlations = np.correlate(np.pad(answers, reach), inflow, "valid") / scale
    lag, best = float(lags[np.argmax(correlations)]), float(correlations.max())
    usual = float(correlations[(lags >= usual_s[0]) & (lags <= usual_s[1])].max())
    early = lag < usual_s[0]
    better = _EARLY_BETTER if early else _LATE_BETTER
    if (early or lag > usual_s[1]) and best > _CLEAR and best > better * usual:
        yield (
            f"{column} responds to the rain {name_time(abs(lag))} "
            f"{'before' if early else 'after'} the rain falls (correlation {best:.2f}, but "
            f"{usual:.2f} without a shift): is a clock wrong, or set to a different time zone?"
        )


# --- sensors --------------------------------------------------------------------------------------

# A sensor is stuck if its reading stays the same for this long (s) while this much rain falls (mm),
# and in this many steps: with steps of a day, a roof can have the same level on two wet days.
_STUCK_S, _STUCK_RAIN, _SAME_STEPS = DAY_S, 10.0, 6
# Rain is stuck above 0 for a day, or for this long (s) in this many steps. In eleven years at
# Toronto it was the same for 9 hours; in models with steps of 3 or 6 hours, for 12.
_RAIN_STUCK_S, _SAME_RAIN_STEPS = 6 * HOUR_S, 24
# More water than this (mm) must cause some runoff if it also exceeds what the soil can hold.
# Neither roof had runoff from 44 mm in four weeks.
_LEAVES_SOME = 80.0
# A watered roof evaporates at the full rate, which is up to 1.3 times the rate of the reference
# grass (FAO-56, Eq. 72: 1.05 to 1.3). The two roofs are not watered, and dry out.
_FULL_RATE = 1.3
# More runoff than this (mm), this long (s) or longer after rain, has no explanation.
_UNEXPLAINED, _DRY_S = 5.0, 3 * DAY_S


def find_stuck_sensor(record: StepRecord, site: Site) -> Iterator[str]:
    """Find sensors that report a constant value, apart from gaps, when the value must change.

    The runoff must change from 0 if more water arrives in any period than the soil can hold. For a
    roof with a pump, evapotranspiration is subtracted at its full rate, because a good controller
    does not pump more than this, and pumps nothing while it rains often enough.
    """
    rate = max(_FULL_RATE, site.crop_coefficient) * bool(np.nansum(record.pumped) > 0)
    gained = record.water - rate * record.reference
    holds = max(_LEAVES_SOME, 1000 * site.z_soil)
    for column, values in {**record.measured, "rain": record.rain}.items():
        known = np.flatnonzero(~np.isnan(values))
        for low, high in find_gaps(np.diff(values[known]) == 0):
            same, value = known[low:high + 1], values[known[low]]
            same_s = len(same) * record.step_s
            if column == "rain":
                long = same_s >= DAY_S or len(same) >= _SAME_RAIN_STEPS
                stuck = value > 0 and same_s >= _RAIN_STUCK_S and long
            elif column == "runoff" and value == 0:
                sums = np.append(0.0, np.cumsum(gained[same]))
                stuck = float(np.max(sums - np.minimum.accumulate(sums))) > holds
            else:
                stuck = same_s >= _STUCK_S and float(np.nansum(record.rain[same])) >= _STUCK_RAIN
            if stuck and len(same) >= _SAME_STEPS:
                yield (
                    f"{column} is {value:g} {'m' if column == 'level' else 'mm'} for "
                    f"{same_s / HOUR_S:.0f} h from {record.time(int(same[0]))}, although "
                    f"{np.sum(record.water[same]):.3g} mm of water arrived: is the sensor stuck "
                    "or defective? Leave these cells empty"
                )
                break


def find_blocked_gauge(record: StepRecord, _site: Site) -> Iterator[str]:
    """Find runoff without rain or pumped water."""
    if record.runoff is None:
        return
    wet: Steps = (record.water > 0) | np.isnan(record.rain) | np.isnan(record.pumped)
    since = math.ceil(_DRY_S / record.step_s)
    for low, high in find_gaps(~prolong_steps(wet, since)):
        outflow = float(np.nansum(record.runoff[low:high]))
        if low > 0 and outflow > _UNEXPLAINED:
            yield (
                f"rain is 0 for {(high - low + since - 1) * record.step_s / DAY_S:.0f} days before "
                f"{record.time(high)}, although runoff is {outflow:.3g} mm: is the gauge blocked "
                "or stuck, or is the runoff snowmelt? Leave these cells empty"
            )
            return


RULES = find_imbalance, find_shifted_clock, find_stuck_sensor, find_blocked_gauge
"""the rules, each of which yields one sentence per finding"""

# --- what is wrong with a fit ---------------------------------------------------------------------

# If the volume of runoff is wrong by more than this share, the fit is poor.
_VOLUME_OFF = 0.5


def check_fit(scores: Sequence[FitScores], source: Path) -> list[str]:
    """Return warnings about a fit.

    There is a warning if, in the validation, the daily NSE is below 0 (or the NSE of hours or
    longer steps, if there are too few days), or if the volume of runoff is off by more than half.

    Args:
        scores: scores of every series, for the fit and for the validation.
        source: path of the record.

    Raises:
        ConfigurationError: if every NSE is below 0, for hours (or longer steps) and for days, in
            the fit and in the validation, and for every series.
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
            f"no roof fits this record: the best NSE is {best}, whereas the mean of the "
            f"measurements alone would achieve an NSE of 0. {advice}", file=source,
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
        f"in the half that was not used for the fit, {' and '.join(why)}: do not use this fit. "
        f"{advice}"
    ] if why else []
