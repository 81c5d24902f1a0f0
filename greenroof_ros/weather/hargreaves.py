"""Evapotranspiration from a day's least and greatest temperature, where nothing else was measured.

Allen, Pereira, Raes and Smith, *Crop evapotranspiration*, FAO Irrigation and Drainage Paper 56,
Rome 1998; the extraterrestrial radiation is that of the package ``eto``.
"""

from __future__ import annotations

import math

import numpy as np
from eto import ETo
from numpy.typing import NDArray

Values = NDArray[np.float64]
Days = NDArray[np.datetime64]

_MM_PER_MJ = 0.408  # per m2, FAO-56 Eq. 20
_DAY_S = 86400
_PART_S = 300


def day_of_year(days: Days) -> NDArray[np.int64]:
    """Return the number of each day in its year, from 1."""
    since = (days - days.astype("datetime64[Y]")).astype("timedelta64[D]")
    return np.asarray(since.astype(np.int64) + 1)


def extraterrestrial_radiation(latitude: float, days: Days) -> Values:
    """Ra (MJ/m2 and day) at a latitude (degrees, north positive), FAO-56 Eq. 21, shape (days,)."""
    zero = np.zeros(len(days))
    model = ETo(
        {"T_min": zero, "T_max": zero}, freq="D", day_of_year=day_of_year(days), z_msl=0.0,
        lat=latitude, validate=False,
    )
    return np.asarray(model.ts_param["R_a"], dtype=np.float64)


def evaporable(radiation: Values) -> Values:
    """Depth of water (mm) that radiation (MJ/m2) could evaporate, FAO-56 Eq. 20."""
    return _MM_PER_MJ * radiation


def hargreaves(latitude: float, days: Days, least: Values, greatest: Values) -> Values:
    """Reference evapotranspiration of whole days (mm/day), FAO-56 Eq. 52, shape (days,).

    ET0 = 0.0023 (Tmean + 17.8) sqrt(Tmax - Tmin) Ra with Ra in mm/day and Tmean the mean of the
    extremes; below 0 it is 0. It needs no humidity, wind or radiation, and is the less certain: FAO
    would have it checked against Eq. 6 where that can be computed.

    Args:
        latitude: degrees, north positive.
        days: dates, shape (days,).
        least: temperature of each day (degC).
        greatest: the same.
    """
    radiation = evaporable(extraterrestrial_radiation(latitude, days))
    warmth = (least + greatest) / 2 + 17.8
    return np.asarray(np.maximum(0.0, 0.0023 * warmth * np.sqrt(greatest - least) * radiation))


def sun_height(latitude: float, seconds: NDArray[np.int64], east_of_meridian: float) -> Values:
    """Sine of the sun's height, 0 at night, FAO-56 Eqs. 24, 31 and 32-33.

    Args:
        latitude: degrees, north positive.
        seconds: since 1970-01-01 on a clock of local standard time.
        east_of_meridian: how far east of the clock's meridian the place is (degrees).
    """
    days = seconds.astype("datetime64[s]").astype("datetime64[D]")
    number = day_of_year(days)
    declination = 0.409 * np.sin(2 * np.pi * number / 365 - 1.39)
    b = 2 * np.pi * (number - 81) / 364
    equation_of_time = 0.1645 * np.sin(2 * b) - 0.1255 * np.cos(b) - 0.025 * np.sin(b)  # h
    solar = (seconds % _DAY_S) / 3600 + east_of_meridian / 15 + equation_of_time
    angle = np.pi / 12 * (solar - 12)
    phi = np.radians(latitude)
    height = np.sin(phi) * np.sin(declination) + np.cos(phi) * np.cos(declination) * np.cos(angle)
    return np.asarray(np.maximum(0.0, height))


def over_the_day(
    daily: Values, latitude: float, seconds: NDArray[np.int64], day: NDArray[np.int64],
    step_s: float, east_of_meridian: float,
) -> Values:
    """Spread days' evapotranspiration over steps as the sun stands; each whole day keeps its sum.

    A step that goes on past midnight has the evapotranspiration of the day that it begins in.

    Args:
        daily: of each day (mm), shape (days,).
        latitude: degrees, north positive.
        seconds: start of each step, on a clock of local standard time, shape (steps,).
        day: index of each step's day in ``daily``.
        step_s: duration of a step (s).
        east_of_meridian: how far east of the clock's meridian the place is (degrees).

    Returns:
        Of each step (mm), shape (steps,).
    """
    # The sun's mean height in a step is that of its parts, of five minutes at most.
    parts = math.ceil(step_s / _PART_S)
    middles = np.round((np.arange(parts) + 0.5) * step_s / parts).astype(np.int64)
    inside = (seconds[:, None] + middles[None, :]).ravel()
    shares = sun_height(latitude, inside, east_of_meridian).reshape(-1, parts).mean(axis=1)
    # What a whole day would have: at the ends of a record there are parts of one.
    of_a_day = (np.arange(0, _DAY_S, _PART_S) + _PART_S // 2)[None, :]
    first = (seconds // _DAY_S * _DAY_S)[np.searchsorted(day, np.arange(len(daily)))]
    whole = sun_height(latitude, (first[:, None] + of_a_day).ravel(), east_of_meridian)
    totals = whole.reshape(len(daily), -1).sum(axis=1) * _PART_S
    return np.asarray(daily[day] * shares * step_s / totals[day])
