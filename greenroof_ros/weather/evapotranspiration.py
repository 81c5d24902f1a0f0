"""Evapotranspiration according to FAO-56: hourly (Penman-Monteith) or daily (Hargreaves).

The equation numbers are those of Allen, Pereira, Raes and Smith, *Crop evapotranspiration*, FAO
Irrigation and Drainage Paper 56, Rome 1998. The package ``eto`` implements the Penman-Monteith
equation (``fao56``). Hargreaves' equation requires only a day's minimum and maximum temperature.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace
from datetime import datetime

import numpy as np
from eto import ETo
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.ranges import Range
from greenroof_ros.site.site import Place
from greenroof_ros.weather.quantities import (
    DEW_POINT,
    FOR_EVAPOTRANSPIRATION,
    PRESSURE,
    RADIATION,
    TEMPERATURE,
    WIND,
)
from greenroof_ros.weather.records import HOUR, Array, Records, find_gaps

Days = NDArray[np.datetime64]

FAO56, HARGREAVES, MONTHLY = "fao56", "hargreaves", "monthly"
COMPUTED = (FAO56, HARGREAVES, MONTHLY)
"""methods for records without evapotranspiration, in descending order of accuracy"""
_MJ_PER_M2_AND_HOUR = 3600e-6  # per W/m2
_LATITUDES = Range(-66.0, 66.0, "degrees")  # between the polar circles
_METRES_PER_SECOND = 1 / 3.6  # per km/h
_MM_PER_MJ = 0.408  # water that solar radiation could evaporate (mm per MJ/m2), Eq. 20
_DAY_S, _PART_S = 86400, 300
# Hours of a day with temperatures for its extremes to be known, and how far away they may be (d).
_ENOUGH_H, _MAX_GAP_DAYS = 18, 3


def saturation_vapour_pressure(temperature: Array) -> Array:
    """Return e0 (kPa) at a temperature (degC), Eq. 11; at the dew point, the vapour pressure."""
    return 0.6108 * np.exp(17.27 * temperature / (temperature + 237.3))


def compute_hourly(site: Place, first: datetime, values: dict[str, Array]) -> Array:
    """Return the reference evapotranspiration of consecutive hours, Eq. 53 (mm/h), shape (hours,).

    Net radiation is computed with Eqs. 37-40 from solar radiation. If solar radiation was not
    measured, it is computed with Eq. 50, ``k_Rs sqrt(Tmax - Tmin) Ra``, from the temperature
    extremes of the day, and distributed over the hours in proportion to the extraterrestrial
    radiation Ra. At night, the ratio Rs/Rso, a measure of cloudiness, keeps the value that it had
    two to three hours before sunset. Negative results (dew) are set to 0. Where FAO-56 leaves a
    choice, this function follows the package ``eto``: Rs/Rso is at least 0.3 (ASCE-EWRI 2005), only
    the sunlit part of an hour with sunrise or sunset counts, and the soil heat flux is 0.1 Rn
    (daytime) if Rn > 0, and otherwise 0.5 Rn (nighttime).

    Args:
        site: site with its location, elevation, UTC offset, albedo, k_Rs and height of the wind
            sensor.
        first: start of the first hour, in any time zone.
        values: temperature and dew point (degC), wind speed (km/h), station pressure (kPa) and
            either solar radiation (W/m2) or ``Tmin`` and ``Tmax`` of the day (degC).
    """
    seconds = _find_local_seconds(first, len(values[TEMPERATURE]), site)
    hour, of_year = seconds % _DAY_S / 3600, _number_days(seconds)
    data = {
        "T_mean": values[TEMPERATURE], "e_a": saturation_vapour_pressure(values[DEW_POINT]),
        "U_z": values[WIND] * _METRES_PER_SECOND, "P": values[PRESSURE],
    }
    if RADIATION in values:
        data["R_s"] = np.maximum(values[RADIATION], 0.0) * _MJ_PER_M2_AND_HOUR  # a sensor's offset
    else:
        data["T_min"], data["T_max"] = values["Tmin"], values["Tmax"]

    def model(hours: int, ratio: float) -> ETo:
        return ETo(
            {key: series[:hours] for key, series in data.items()},
            freq="h", day_of_year=of_year[:hours], hour=hour[:hours], z_msl=site.elevation,
            lat=site.latitude, lon=site.longitude, TZ_lon=15 * site.clock_offset,
            z_u=site.wind_height, K_rs=site.k_Rs, alb=site.albedo, validate=False,
            rs_rso_init=ratio,
        )

    # For the night before the first evening: Rs/Rso of the first 24 hours.
    day = model(24, 1.0).ts_param
    clear = float(day["R_so"].sum())
    night_ratio = float(day["R_s"].sum()) / clear if clear > 0 else 1.0
    # The package's default would round to 0.01 mm, and drop values that it considers too large.
    return np.asarray(model(len(hour), night_ratio).eto_fao(max_ETo=None, decimals=None))


def compute_fao56(records: Records, site: Place) -> Array:
    """Return the evapotranspiration of the vegetation in every hour (mm/day), shape (hours,).

    The result is the site's crop coefficient times the reference evapotranspiration; it is NaN for
    hours without records. If solar radiation was not measured in an hour, the records must cover
    the whole day, 0 to 24 h of local standard time. The height of the wind sensor is taken from the
    records if they state it, and otherwise from the site.

    Raises:
        ConfigurationError: if the file lacks a required quantity, if the site file lacks the
            location, or if the site is beyond a polar circle.
    """
    site = _prepare(site, records, FAO56, FOR_EVAPOTRANSPIRATION)
    site = replace(site, wind_height=records.wind_height or site.wind_height)
    values = {name: records.values[name] for name in FOR_EVAPOTRANSPIRATION}
    seconds = _find_local_seconds(records.first, records.hours, site)
    _, day = np.unique(seconds // _DAY_S, return_inverse=True)
    minimum, maximum = find_extremes(day, values[TEMPERATURE], values[TEMPERATURE], 24)[:, day]
    result = _compute_stretches(site, records, {**values, "Tmin": minimum, "Tmax": maximum})
    if RADIATION in records.values:
        values[RADIATION] = records.values[RADIATION]
        measured = _compute_stretches(site, records, values)
        result = np.where(np.isnan(measured), result, measured)
    return result * 24 * site.crop_coefficient


def _compute_stretches(site: Place, records: Records, values: dict[str, Array]) -> Array:
    """Apply :func:`compute_hourly` to every period without gaps; the result is NaN in gaps.

    Each period is computed separately, because the cloudiness at night is that of the previous
    evening.
    """
    unknown = np.isnan(sum(values.values()))  # a sum that includes a NaN is NaN
    result = np.full(records.hours, np.nan)
    for low, high in find_gaps(~unknown):
        stretch = {name: series[low:high] for name, series in values.items()}
        result[low:high] = compute_hourly(site, records.first + low * HOUR, stretch)
    return result


def check_place(site: Place, method: str) -> None:
    """Reject a site whose location is incomplete or beyond a polar circle.

    Raises:
        ConfigurationError: if the site lacks a coordinate, or is beyond a polar circle.
    """
    lacking = [name for name in ("latitude", "longitude") if getattr(site, name) is None]
    if lacking:
        raise ConfigurationError(
            f"{method} requires {', '.join(lacking)} in the site file (see config/site.yaml)"
        )
    if is_polar(site):
        raise ConfigurationError(
            f"{_LATITUDES.expected()} to compute evapotranspiration with FAO-56, which splits the "
            "day at sunrise and sunset; provide an evapotranspiration column, or set "
            "monthly_evapotranspiration in the site file",
            key="latitude", value=site.latitude,
        )


def _prepare(site: Place, records: Records, method: str, needed: Collection[str]) -> Place:
    """Return a site with an elevation, derived from the mean pressure if unknown (Eq. 7).

    Raises:
        ConfigurationError: if the records or the site lack what the method requires.
    """
    lacking = [name for name in needed if name not in records.values]
    if lacking:
        raise ConfigurationError(
            f"has no column 'evapotranspiration [mm/day]', and lacks {', '.join(lacking)}, which "
            f"{method} requires", file=records.source,
        )
    check_place(site, method)
    if site.elevation is not None or PRESSURE not in records.values:
        return site
    mean = float(np.nanmean(records.values[PRESSURE]))
    return replace(site, elevation=293 / 0.0065 * (1 - (mean / 101.3) ** (1 / 5.26)))


def is_polar(site: Place) -> bool:
    """Return whether a site is beyond a polar circle, where some days have no sunrise."""
    return (site.latitude or 0.0) not in _LATITUDES


def repeat_monthly(records: Records, site: Place) -> Array | None:
    """Return the site's monthly mean evapotranspiration (mm/day) for every hour, if known."""
    if site.monthly_evapotranspiration is None:
        return None
    first = np.datetime64(records.first.replace(tzinfo=None), "h")
    months = (first + np.arange(records.hours)).astype("datetime64[M]").astype(np.int64) % 12
    return site.crop_coefficient * np.array(site.monthly_evapotranspiration)[months]


def _find_local_seconds(first: datetime, hours: int, site: Place) -> NDArray[np.int64]:
    """Return the start of every hour in local standard time (s since 1970 on this clock)."""
    return round(first.timestamp() + 3600 * site.clock_offset) + 3600 * np.arange(hours)


def _number_days(seconds: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the day of the year of every time (s since 1970 on its clock), from 1."""
    days = (seconds // _DAY_S).astype("datetime64[D]")
    return np.asarray((days - days.astype("datetime64[Y]")).astype(np.int64) + 1)


def hargreaves(latitude: float, days: Days, minimum: Array, maximum: Array) -> Array:
    """Return each day's reference evapotranspiration (mm/day), FAO-56 Eq. 52, shape (days,).

    ET0 = 0.0023 (Tmean + 17.8) sqrt(Tmax - Tmin) Ra, where Ra is in mm/day and Tmean is the mean of
    the extremes; negative results are set to 0. The equation requires no humidity, wind or
    radiation, but is less accurate than Eq. 6, against which FAO recommends checking it where
    possible.

    Args:
        latitude: latitude (degrees, north positive).
        days: dates, shape (days,).
        minimum: lowest temperature of every day (degC).
        maximum: highest temperature of every day (degC).
    """
    model = ETo(
        {"T_min": minimum, "T_max": maximum}, freq="D", z_msl=0.0, lat=latitude, validate=False,
        day_of_year=_number_days(days.astype("datetime64[s]").astype(np.int64)),
    ).ts_param
    reference = 0.0023 * (model["T_mean"] + 17.8) * np.sqrt(maximum - minimum)
    return np.asarray(np.maximum(0.0, reference * (_MM_PER_MJ * model["R_a"])))


def sun_height(latitude: float, seconds: NDArray[np.int64], east_of_meridian: float) -> Array:
    """Return the sine of the sun's elevation, 0 at night, FAO-56 Eqs. 24 and 31-33.

    Args:
        latitude: latitude (degrees, north positive).
        seconds: times in local standard time (s since 1970-01-01).
        east_of_meridian: longitude relative to the meridian of the clock (degrees, east positive).
    """
    number = _number_days(seconds)
    declination = 0.409 * np.sin(2 * np.pi * number / 365 - 1.39)
    b = 2 * np.pi * (number - 81) / 364
    equation_of_time = 0.1645 * np.sin(2 * b) - 0.1255 * np.cos(b) - 0.025 * np.sin(b)  # h
    solar = (seconds % _DAY_S) / 3600 + east_of_meridian / 15 + equation_of_time
    angle = np.pi / 12 * (solar - 12)
    phi = np.radians(latitude)
    height = np.sin(phi) * np.sin(declination) + np.cos(phi) * np.cos(declination) * np.cos(angle)
    return np.asarray(np.maximum(0.0, height))


def spread_over_day(daily: Array, site: Place, seconds: NDArray[np.int64], step_s: float) -> Array:
    """Distribute daily evapotranspiration over steps in proportion to the sun's elevation.

    The daily totals are preserved. A step that spans midnight belongs to the day in which it
    begins.

    Args:
        daily: evapotranspiration of every day in which a step begins (mm), shape (days,).
        site: site with its location, and the UTC offset of the clock of the steps.
        seconds: start of every step, in local standard time, shape (steps,).
        step_s: duration of a step (s).

    Returns:
        Evapotranspiration in every step (mm), shape (steps,).
    """
    latitude, east = site.latitude or 0.0, (site.longitude or 0.0) - 15 * site.clock_offset
    # The sun's mean height in a step is the mean over parts of no more than five minutes.
    parts = math.ceil(step_s / _PART_S)
    middles = np.round((np.arange(parts) + 0.5) * step_s / parts).astype(np.int64)
    inside = (seconds[:, None] + middles[None, :]).ravel()
    shares = sun_height(latitude, inside, east).reshape(-1, parts).mean(axis=1)
    # Totals of whole days: at the ends of a record, a day may be incomplete.
    days, day = np.unique(seconds // _DAY_S, return_inverse=True)
    of_a_day = np.arange(0, _DAY_S, _PART_S) + _PART_S // 2
    whole = sun_height(latitude, (days[:, None] * _DAY_S + of_a_day).ravel(), east)
    totals = whole.reshape(len(days), -1).sum(axis=1) * _PART_S
    return np.asarray(daily[day] * shares * step_s / totals[day])


def find_extremes(day: NDArray[np.intp], minimum: Array, maximum: Array, needed: float) -> Array:
    """Return the minimum and maximum temperature of every day (degC), shape (2, days).

    Args:
        day: index of the day of every value.
        minimum: temperatures that include the minimum of every day; NaN if missing.
        maximum: temperatures that include every day's maximum; NaN if missing.
        needed: number of values that a day needs; its extremes are NaN if fewer are known.
    """
    extremes = np.full((2, day.max() + 1), np.nan)
    for of_days, extreme, values in zip(
        extremes, (np.fmin, np.fmax), (minimum, maximum), strict=True
    ):
        extreme.at(of_days, day, values)
        of_days[np.bincount(day, ~np.isnan(values)) < needed] = np.nan
    return extremes


def spread_hargreaves(
    site: Place, dates: Days, extremes: Array, seconds: NDArray[np.int64], step_s: float
) -> Array:
    """Return each step's reference evapotranspiration (mm) by Hargreaves' method, shape (steps,).

    Every step receives a share of the evapotranspiration of the day in which it begins. On days
    without extremes, the extremes are interpolated. The result is NaN on a day that is more than
    three days from any day with extremes.

    Args:
        site: site with its location, and the UTC offset of the clock of the steps.
        dates: dates of days, in chronological order.
        extremes: minimum and maximum temperatures of these days (degC), shape (2, days); NaN if
            unknown.
        seconds: start of every step, in local standard time, shape (steps,).
        step_s: duration of a step (s).
    """
    days, day = np.unique(seconds // _DAY_S, return_inverse=True)
    at, unknown = dates.astype(np.int64), np.isnan(extremes)
    if unknown.all():
        return np.full(len(seconds), np.nan)
    minimum, maximum = (
        np.interp(days, at[~missing], values[~missing])
        for values, missing in zip(extremes, unknown, strict=True)
    )
    daily = hargreaves(site.latitude or 0.0, days.astype("datetime64[D]"), minimum, maximum)
    far = np.abs(days[:, None] - at[~unknown.any(axis=0)]).min(axis=1) > _MAX_GAP_DAYS
    return np.where(far[day], np.nan, spread_over_day(daily, site, seconds, step_s))


def compute_hargreaves(records: Records, site: Place) -> Array:
    """Return the vegetation's hourly evapotranspiration by Hargreaves' method (mm/day).

    The result, shape (hours,), is the site's crop coefficient times the reference
    evapotranspiration, computed from the minimum and maximum temperature of every day in local
    standard time. The result is NaN on a day that is more than three days from a day with at least
    18 hours of temperature data.

    Raises:
        ConfigurationError: if the file contains no temperature, if the site file lacks the
            location, or if the site is beyond a polar circle.
    """
    site = _prepare(site, records, HARGREAVES, [TEMPERATURE])
    temperature = records.values[TEMPERATURE]
    seconds = _find_local_seconds(records.first, records.hours, site)
    days, day = np.unique(seconds // _DAY_S, return_inverse=True)
    extremes = find_extremes(day, temperature, temperature, _ENOUGH_H)
    depths = spread_hargreaves(site, days.astype("datetime64[D]"), extremes, seconds, 3600)
    return depths * 24 * site.crop_coefficient
