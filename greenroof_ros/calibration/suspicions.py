"""Records that cannot be true: a stuck sensor, a wrong unit, a shifted clock. None is fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate, correlation_lags

from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import gaps

_HOUR_S, _DAY_S = 3600, 86400
# Water reaches a level sensor within minutes and leaves a roof within hours; more is a clock.
_LONGEST_DELAY_S = 4 * _HOUR_S
_MOST_SHIFT_S = 26 * _HOUR_S
_FEWEST_VALUES = 100
# A correlation that says something, and how many times that without a shift it must be.
_CLEAR, _BETTER = 0.1, 1.5
# A reading that is the same for so long (s) while so much rain fell (mm).
_STUCK_S, _STUCK_RAIN = _DAY_S, 10.0
_RAIN_STUCK_S = 6 * _HOUR_S
# Water that comes from a roof without any rain on it for so long (mm, s).
_UNEXPLAINED, _DRY_S = 5.0, 3 * _DAY_S
# Least rain from which anything can be said (mm), and what is no rain of weeks (mm a day).
_LEAST_RAIN, _MOST_RAIN_A_DAY = 20.0, 60.0


def refuse_wrong(record: Record, site: Site) -> None:
    """Refuse a record in which a sensor, a unit or a clock is wrong.

    Raises:
        ConfigurationError: it is; the message says what was found, when, and what to look for.
    """
    _empty(record)
    _stuck(record)
    _units(record, site)
    _rain_that_is_missing(record)
    _clock(record)


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


def _units(record: Record, site: Site) -> None:
    """Refuse sums and levels that no roof has, as those in a wrong unit are."""
    rain, pumped = float(np.nansum(record.rain)), float(np.nansum(record.pumped))
    days = record.steps * record.step_s / _DAY_S
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
    if record.level is not None:
        highest = float(np.nanmax(record.level))
        if highest > site.highest_roof_level:
            raise _error(
                record, "level",
                f"rises to {highest:g} m, more than twice the soil's depth of {site.z_soil:g} m "
                f"({_when(record, int(np.nanargmax(record.level)))}): is the unit right?",
            )
        rises = _rises(record.level)
        wet = ~np.isnan(record.rain) & (record.rain > 0)
        risen = 1000 * float(np.nansum(rises[wet]))
        if abs(risen) < 0.02 * rain and np.nanstd(record.level) > 0:
            raise _error(
                record, "level",
                f"rises by {risen:.2g} mm while {rain:.4g} mm of rain falls: is the unit right?",
            )
    if record.runoff is not None:
        both = ~np.isnan(record.runoff) & ~np.isnan(record.rain)
        came = float(np.sum(record.rain[both])) + float(np.nansum(record.pumped[both]))
        gone = float(np.sum(record.runoff[both]))
        held = 1000 * site.z_soil
        if gone > 1.2 * came + held:
            raise _error(
                record, "runoff",
                f"is {gone:.4g} mm where {came:.4g} mm came, and the soil holds {held:g} mm at "
                "most: is its unit right, and a2 of the site?",
            )
        if gone < 0.001 * came:
            raise _error(
                record, "runoff",
                f"is {gone:.2g} mm in all, of {came:.4g} mm that came: is its unit right, or the "
                "sensor dead?",
            )


def _rises(level: Values) -> Values:
    """Return by how much a level rises in each step; NaN in and after a gap."""
    return np.append(np.diff(level), np.nan)


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
            long = (high - low + 1) * record.step_s >= least_s
            told = values[low] != 0 or zero_too
            wet = column == "rain" or fallen[high + 1] - fallen[low] >= _STUCK_RAIN
            if long and told and wet:
                hours = (high - low + 1) * record.step_s / _HOUR_S
                raise _error(
                    record, column,
                    f"is {values[low]:g} {'m' if column == 'level' else 'mm a step'} for "
                    f"{hours:.0f} h from {_when(record, low)}, in which "
                    f"{fallen[high + 1] - fallen[low]:.3g} mm of rain fell: the sensor is stuck; "
                    "leave these cells empty",
                )


def _rain_that_is_missing(record: Record) -> None:
    """Refuse a rain gauge that shows none while water comes from the roof."""
    if record.runoff is None:
        return
    wet = np.nan_to_num(record.rain) + np.nan_to_num(record.pumped) > 0
    wet |= np.isnan(record.rain)
    since = round(_DRY_S / record.step_s)
    recent = np.convolve(wet, np.ones(since), "full")[: record.steps] > 0
    for low, high in gaps(~recent):
        gone = float(np.nansum(record.runoff[low:high]))
        if low > 0 and gone > _UNEXPLAINED:
            raise _error(
                record, "rain",
                f"is 0 for {(high - low) * record.step_s / _DAY_S + 3:.0f} days before "
                f"{_when(record, high)}, while {gone:.3g} mm run off: is the gauge blocked or "
                "stuck, or is it melted snow? Leave the cells empty there",
            )


def _clock(record: Record) -> None:
    """Refuse a record whose roof answers before it rains, or hours after."""
    came = np.nan_to_num(record.rain) + np.nan_to_num(record.pumped)
    column, series = next(iter(record.measured.items()))
    # Its rises: how long a roof goes on after the rain says nothing about clocks. Those of a level
    # are of half an hour's mean over the one before, in which a sensor's noise is less.
    rises = _rises(series) if column == "runoff" else _smooth_rises(series, record.step_s)
    answers = np.maximum(np.nan_to_num(rises), 0.0)
    lag, best, none = _lag(came, answers, record.step_s)
    early, late = lag < -2 * record.step_s, lag > _LONGEST_DELAY_S
    if (early or late) and best > _CLEAR and best > _BETTER * none:
        minutes = abs(lag) / 60
        span = f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
        raise _error(
            record, column,
            f"follows the rain best {span} {'before' if early else 'after'} it falls "
            f"(correlation {best:.2f}, {none:.2f} as it stands): is a clock shifted, or in another "
            "time zone?",
        )


def _lag(came: Values, answers: Values, step_s: float) -> tuple[float, float, float]:
    """Return by how much answers lag (s), their correlation then, and the best from 0 to 4 h.

    Roots make one great storm less heavy among the others.
    """
    one, other = (np.sqrt(series) - np.mean(np.sqrt(series)) for series in (came, answers))
    scale = np.sqrt(np.sum(one**2) * np.sum(other**2))
    if scale == 0:
        return 0.0, 0.0, 0.0
    lags = correlation_lags(len(other), len(one)) * step_s
    correlations = correlate(other, one, method="fft") / scale
    near: NDArray[np.bool_] = np.abs(lags) <= _MOST_SHIFT_S
    lags, correlations = lags[near], correlations[near]
    best = int(np.argmax(correlations))
    usual = (lags >= -2 * step_s) & (lags <= _LONGEST_DELAY_S)
    return float(lags[best]), float(correlations[best]), float(correlations[usual].max())
