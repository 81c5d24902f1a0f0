"""Records that cannot be true: a stuck sensor, a wrong unit, a shifted clock. None is fitted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.calibration.scores import time_name
from greenroof_ros.calibration.unit_errors import refuse_wrong_units
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.site import Site

_HOUR_S, _DAY_S = 3600, 86400
# Water reaches a level sensor within minutes and leaves a roof within hours; more is a clock. So is
# an answer that comes before the rain by more than so many steps, and two hours at most: clocks
# differ by minutes, and the rises of a level are those of half an hour's means.
_LONGEST_DELAY_S = 4 * _HOUR_S
_EARLY_STEPS, _EARLY_S = {"runoff": 1, "level": 2}, 2 * _HOUR_S
_MOST_SHIFT_S = 26 * _HOUR_S
_FEWEST_VALUES = 100
# A correlation that says something, and how many times that without a shift it must be. A roof that
# answers early is wrong for certain: in 64 windows of 30 and 60 days of the two measured roofs the
# best is at most 1.03 times that without a shift; with a clock an hour early it is more than 1.1
# times that in 47 of them.
_CLEAR, _EARLY_BETTER, _LATE_BETTER = 0.1, 1.1, 1.5
# A reading that is the same for so long (s) while so much rain fell (mm), and in so many steps: on
# two days in a row a roof can be as full, be it wet.
_STUCK_S, _STUCK_RAIN = _DAY_S, 10.0
_RAIN_STUCK_S = 6 * _HOUR_S
_SAME_STEPS = 6
# Water that comes from a roof without any rain on it for so long (mm, s).
_UNEXPLAINED, _DRY_S = 5.0, 3 * _DAY_S
# A level that rises without rain: the means of so long before and after (s), and of so many values
# at least, apart by so much (mm), and by so many times more than it ever falls so, with none for a
# day before. Noise of 2 mm makes 2 mm of it; a sensor that feels the sun rises and falls alike.
_RISE_S, _RISE_VALUES, _RISE, _RISE_TO_FALL = 6 * _HOUR_S, 6, 5.0, 3.0
# So much water leaves some runoff behind (mm), be it in many storms; and so does all that the soil
# could hold. The measured roofs let nothing run off of 44 mm in four weeks.
_LEAVES_SOME = 80.0


def refuse_wrong(record: Record, site: Site) -> None:
    """Refuse a record in which a sensor, a unit or a clock is wrong.

    Raises:
        ConfigurationError: it is; the message says what was found, when, and what to look for.
    """
    _empty(record)
    _sparse(record)
    _stuck(record)
    _clock(record)
    refuse_wrong_units(record, site)
    _runoff_that_is_missing(record, site)
    _rain_that_is_missing(record)


def _error(record: Record, column: str, text: str) -> ConfigurationError:
    return ConfigurationError(text, file=record.source, key=column)


def _when(record: Record, step: int) -> str:
    return str(record.times[min(step, record.steps - 1)]).replace("T", " ")


def _empty(record: Record) -> None:
    """Refuse a column without enough values to say anything."""
    for column, values in {"rain": record.rain, **record.measured}.items():
        there = int(np.count_nonzero(~np.isnan(values)))
        if there < _FEWEST_VALUES:
            raise _error(
                record, column, f"has {there} values; it must have {_FEWEST_VALUES} at least"
            )


def _sparse(record: Record) -> None:
    """Refuse a sensor that is read less often than there are rows: between, all would be gaps."""
    for column, values in {"rain": record.rain, **record.measured}.items():
        apart = np.diff(np.flatnonzero(~np.isnan(values)))
        often = float(np.median(apart))
        if often > 1:
            seen, step = (time_name(round(time)) for time in (often * record.step_s, record.step_s))
            raise _error(
                record, column,
                f"has a value every {seen}, and there is a row every {step}: every row must have "
                f"one. Write a row every {seen}, with the sums of rain and runoff between",
            )


def _smooth_rises(level: Values, step_s: float) -> Values:
    """Return by how much the mean of half an hour from each step on is above that before."""
    count = max(1, round(1800 / step_s))
    totals = np.concatenate((np.zeros(count), np.cumsum(np.nan_to_num(level))))
    means = (totals[count:] - totals[:-count]) / count  # of the steps up to each
    return np.append(means[count:] - means[:-count], np.full(count, np.nan))


def _stuck(record: Record) -> None:
    """Refuse a sensor that shows one value while it must change."""
    for column, values, least_s, zero_too in (
        ("level", record.level, _STUCK_S, True),
        ("runoff", record.runoff, _STUCK_S, False),
        ("rain", record.rain, _RAIN_STUCK_S, False),
    ):
        if values is None:
            continue
        fallen = np.concatenate(([0.0], np.cumsum(np.nan_to_num(record.rain))))
        for low, high in gaps(np.diff(values) == 0):
            same = high - low + 1
            long = same >= _SAME_STEPS and same * record.step_s >= least_s
            told = values[low] != 0 or zero_too
            wet = column == "rain" or fallen[high + 1] - fallen[low] >= _STUCK_RAIN
            if long and told and wet:
                hours = same * record.step_s / _HOUR_S
                raise _error(
                    record, column,
                    f"is {values[low]:g} {'m' if column == 'level' else 'mm a step'} for "
                    f"{hours:.0f} h from {_when(record, low)}, in which "
                    f"{fallen[high + 1] - fallen[low]:.3g} mm of rain fell: the sensor is stuck; "
                    "leave these cells empty",
                )


def _runoff_that_is_missing(record: Record, site: Site) -> None:
    """Refuse a flow meter that shows none for more rain than the soil could hold."""
    if record.runoff is None:
        return
    came = np.nan_to_num(record.rain) + np.nan_to_num(record.pumped)
    fallen = np.concatenate(([0.0], np.cumsum(came)))
    most = max(_LEAVES_SOME, 1000 * site.z_soil)
    for low, high in gaps(record.runoff == 0):
        if fallen[high] - fallen[low] > most:
            raise _error(
                record, "runoff",
                f"is 0 for {(high - low) * record.step_s / _DAY_S:.0f} days from "
                f"{_when(record, low)}, in which {fallen[high] - fallen[low]:.3g} mm came, more "
                f"than {most:g} mm: is the sensor dead? Leave the cells empty there",
            )


def _rain_that_is_missing(record: Record) -> None:
    """Refuse a rain gauge that shows none while water comes to the roof, or from it."""
    wet = np.nan_to_num(record.rain) + np.nan_to_num(record.pumped) > 0
    wet |= np.isnan(record.rain) | np.isnan(record.pumped)
    if record.runoff is not None:
        _runoff_without_rain(record, record.runoff, wet)
    if record.level is not None:
        _rise_without_rain(record, record.level, wet)


def _runoff_without_rain(record: Record, runoff: Values, wet: NDArray[np.bool_]) -> None:
    since = math.ceil(_DRY_S / record.step_s)
    recent = np.convolve(wet, np.ones(since), "full")[: record.steps] > 0
    for low, high in gaps(~recent):
        gone = float(np.nansum(runoff[low:high]))
        if low > 0 and gone > _UNEXPLAINED:
            raise _error(
                record, "rain",
                f"is 0 for {(high - low + since - 1) * record.step_s / _DAY_S:.0f} days before "
                f"{_when(record, high)}, while {gone:.3g} mm run off: is the gauge blocked or "
                "stuck, or is it melted snow? Leave the cells empty there",
            )


def _rise_without_rain(record: Record, level: Values, wet: NDArray[np.bool_]) -> None:
    count = max(_RISE_VALUES, round(_RISE_S / record.step_s))
    before = max(count, round(_DAY_S / record.step_s))
    if record.steps <= before + count:
        return
    at = np.arange(before, record.steps - count)
    there = np.concatenate(([0], np.cumsum(~np.isnan(level))))
    total = np.concatenate(([0.0], np.cumsum(np.nan_to_num(level))))
    rained = np.concatenate(([0], np.cumsum(wet)))
    known = (there[at + count] - there[at - count] == 2 * count)
    dry = known & (rained[at + count] == rained[at - before])
    rise = 1000 * (total[at + count] - 2 * total[at] + total[at - count]) / count
    most = int(np.argmax(np.where(dry, rise, 0.0)))
    fall = float(np.max(np.where(dry, -rise, 0.0)))
    if dry[most] and rise[most] > max(_RISE, _RISE_TO_FALL * fall):
        raise _error(
            record, "rain",
            f"is 0 for {time_name(round(before * record.step_s))} and more when at "
            f"{_when(record, int(at[most]))} the level rises by {rise[most]:.3g} mm: is the gauge "
            "blocked or stuck, or is it melted snow? Leave the cells empty there",
        )


def _clock(record: Record) -> None:
    """Refuse a record whose roof answers before it rains, or hours after."""
    came = np.nan_to_num(record.rain) + np.nan_to_num(record.pumped)
    column, series = next(iter(record.measured.items()))
    # Its rises: how long a roof goes on after the rain says nothing about clocks. Those of a level
    # are of half an hour's mean over the one before, in which a sensor's noise is less.
    rises = (
        np.diff(series, prepend=np.nan) if column == "runoff"
        else _smooth_rises(series, record.step_s)
    )
    answers = np.maximum(np.nan_to_num(rises), 0.0)
    usual_s = (
        -min(_EARLY_STEPS[column] * record.step_s, _EARLY_S),
        max(_LONGEST_DELAY_S, record.step_s),
    )
    lag, best, none = _lag(came, answers, record.step_s, usual_s)
    early, late = lag < usual_s[0], lag > usual_s[1]
    better = _EARLY_BETTER if early else _LATE_BETTER
    if (early or late) and best > _CLEAR and best > better * none:
        minutes = abs(lag) / 60
        span = f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
        raise _error(
            record, column,
            f"follows the rain best {span} {'before' if early else 'after'} it falls "
            f"(correlation {best:.2f}, {none:.2f} as it stands): is a clock shifted, or in another "
            "time zone?",
        )


def _lag(
    came: Values, answers: Values, step_s: float, usual_s: tuple[float, float]
) -> tuple[float, float, float]:
    """Return by how much answers lag (s), their correlation then, and the best of usual lags.

    Roots make one great storm less heavy among the others.
    """
    one, other = (np.sqrt(series) - np.mean(np.sqrt(series)) for series in (came, answers))
    scale = np.sqrt(np.sum(one**2) * np.sum(other**2))
    if scale == 0:
        return 0.0, 0.0, 0.0
    from scipy.signal import correlate, correlation_lags  # as long to import as all else

    lags = correlation_lags(len(other), len(one)) * step_s
    correlations = correlate(other, one, method="fft") / scale
    near: NDArray[np.bool_] = np.abs(lags) <= _MOST_SHIFT_S
    lags, correlations = lags[near], correlations[near]
    best = int(np.argmax(correlations))
    usual = (lags >= usual_s[0]) & (lags <= usual_s[1])
    return float(lags[best]), float(correlations[best]), float(correlations[usual].max())
