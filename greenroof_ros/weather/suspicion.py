"""Hours of rain that are hard to believe, by the records of other years: said, and left as is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.times import to_minutes
from greenroof_ros.weather.records import HOUR, PRECIPITATION, TEMPERATURE, Records

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
