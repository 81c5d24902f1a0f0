"""What is wrong with records: gaps, and hours of rain that are hard to believe.

Of the gaps the short ones are filled, and the long ones if asked; rain is said, and left as it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import to_minutes
from greenroof_ros.formats.records import HOUR, PRECIPITATION, TEMPERATURE, Records, gaps

REFUSE, FILL = "refuse", "fill"
GAPS = (REFUSE, FILL)
"""What is done about an hour that a run needs and that no short gap has: the first by default."""

# The longest gap that is filled, by a straight line between the hours before and after it (h).
# Temperature and wind follow the sun, so half a day must be left to see it by; dew point and
# pressure follow the air mass, which changes within days. Rain is never guessed.
LONGEST_GAP = {"temperature": 6, "wind speed": 6, "dew point": 24, "station pressure": 24}

# Hours from a missing one to those of the same time of day whose mean stands for it.
_SAME_TIME_OF_DAY = 24 * np.array([-3, -2, -1, 1, 2, 3])


def fill_short_gaps(records: Records) -> Records:
    """Fill the gaps of at most :data:`LONGEST_GAP` hours that have records on both sides."""
    values, filled = dict(records.values), dict(records.filled)
    for quantity, longest in LONGEST_GAP.items():
        if quantity not in values:
            continue
        series = values[quantity].copy()
        missing = np.isnan(series)
        for low, high in gaps(missing):
            if high - low <= longest and low > 0 and high < len(series):
                series[low:high] = np.interp(
                    np.arange(low, high), [low - 1, high], [series[low - 1], series[high]]
                )
        values[quantity] = series
        filled[quantity] = missing & ~np.isnan(series)
    return replace(records, values=values, filled=filled)


def fill_long_gaps(records: Records) -> Records:
    """Fill what is still missing: rain with none, all else with the mean of the days about it.

    That is the mean at the same time of day over the three days before and the three days after,
    of those hours that are known, be it by a short gap. Where none of them is, the hour stays
    missing. Years are worth more with a few hours guessed than cut into pieces; but rain that was
    not measured is lost, so that this must be asked for.
    """
    values, filled = {}, {}
    for quantity, series in records.values.items():
        missing = np.isnan(series)
        values[quantity] = series.copy()
        values[quantity][missing] = 0.0 if quantity == PRECIPITATION else _about(series, missing)
        short = records.filled.get(quantity, np.zeros_like(missing))
        filled[quantity] = short | missing & ~np.isnan(values[quantity])
    return replace(records, values=values, filled=filled)


def _about(series: NDArray[np.float64], missing: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return for each missing hour the mean of the days about it; NaN where none is known."""
    padded = np.pad(series, -_SAME_TIME_OF_DAY[0], constant_values=np.nan)
    hours = np.flatnonzero(missing) - _SAME_TIME_OF_DAY[0]
    near = padded[hours[:, None] + _SAME_TIME_OF_DAY]
    known = np.count_nonzero(~np.isnan(near), axis=1)
    return np.where(known > 0, np.nansum(near, axis=1) / np.maximum(known, 1), np.nan)


_PERCENTILE = 95
# So many times the percentile is too much, and so many below 0 degC.
_FACTOR, _FROST_FACTOR = 9.0, 5.0
# Of the year, to either side of the hour's own; with fewer wet hours in them nothing is said.
_DAYS, _LEAST_WET = 14, 20
_YEAR = 366


def suspicious_rain(records: Records, hours: range) -> list[str]:
    """Name the hours with more rain than the station's own records make believable.

    That is 9 times the 95th percentile of the wet hours within 14 days of the hour's day of the
    year, in all years of the records, or 5 times below 0 degC. Fewer than 20 wet hours say nothing.
    It is the climatological outlier check for daily precipitation of GHCN-Daily (Durre, Menne,
    Gleason, Houston and Vose 2010, J. Appl. Meteor. Climatol. 49:1615, doi:10.1175/
    2010JAMC2375.1), applied to hours.

    Args:
        records: all there are: the more years, the better.
        hours: indices of those to look at.

    Returns:
        A text for each such hour, with its rain (mm), time and percentile.
    """
    rain = records.values[PRECIPITATION]
    wet = np.flatnonzero(rain > 0)
    days = _days_of_year(records, wet)
    temperature = records.values.get(TEMPERATURE, np.full_like(rain, np.nan))
    there = (wet >= hours.start) & (wet < hours.stop)
    found = []
    for day in np.unique(days[there]):
        apart = np.abs(days - day)
        near = rain[wet[np.minimum(apart, _YEAR - apart) <= _DAYS]]
        if len(near) < _LEAST_WET:
            continue
        usual = float(np.percentile(near, _PERCENTILE))
        for hour in wet[there & (days == day)]:
            factor = _FROST_FACTOR if temperature[hour] < 0 else _FACTOR
            if rain[hour] >= factor * usual:
                found.append((int(hour), usual))
    return [
        f"{rain[hour]:g} mm at {to_minutes(records.first + hour * HOUR)}, "
        f"{rain[hour] / usual:.1f} times what 95 % of the wet hours at that time of the year "
        f"have at most, {usual:.3g} mm"
        for hour, usual in sorted(found)
    ]


def _days_of_year(records: Records, hours: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the day of the year of each of these hours, from 0, by the records' own clock."""
    first = np.datetime64(records.first.replace(tzinfo=None), "h")
    dates = (first + hours).astype("datetime64[D]")
    days: NDArray[np.int64] = (dates - dates.astype("datetime64[Y]")).astype(np.int64)
    return days
