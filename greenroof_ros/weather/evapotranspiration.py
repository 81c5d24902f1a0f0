"""Evapotranspiration by FAO-56 Penman-Monteith, hour by hour: the method ``fao56``.

Allen, Pereira, Raes and Smith, *Crop evapotranspiration*, FAO Irrigation and Drainage Paper 56,
Rome 1998; the equations are those of the package ``eto``, the numbers here are its equations'.
"""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

import numpy as np
from eto import ETo
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import (
    EVAPOTRANSPIRATION,
    FOR_EVAPOTRANSPIRATION,
    HOUR,
    QUANTITIES,
    RADIATION,
    Records,
    gaps,
    name_hours,
)

FAO56 = "fao56"
_PLACE = ("latitude", "longitude", "elevation", "utc_offset")
_MJ_PER_M2_AND_HOUR = 3600e-6  # per W/m2
_METRES_PER_SECOND = 1 / 3.6  # per km/h


def saturation_vapour_pressure(temperature: NDArray[np.float64]) -> NDArray[np.float64]:
    """e0 (kPa) at a temperature (degC), Eq. 11; at the dew point it is the actual one, Eq. 14."""
    return 0.6108 * np.exp(17.27 * temperature / (temperature + 237.3))


def hourly(
    site: Site,
    first: datetime,
    values: dict[str, NDArray[np.float64]],
    night_ratio: float | None = None,
) -> NDArray[np.float64]:
    """Reference evapotranspiration of consecutive hours, Eq. 53 (mm/h), shape (hours,).

    Net radiation is that of Eqs. 37-40 from shortwave radiation: measured, or Eq. 50's
    ``k_Rs sqrt(Tmax - Tmin) Ra`` with the day's extremes, spread over the hours as the
    extraterrestrial radiation Ra. At night the ratio Rs/Rso that stands for the clouds is that of
    two to three hours before sunset. Below 0 (dew) it is 0.

    Where FAO-56 leaves a choice the package takes: Rs/Rso is at least 0.3 (ASCE-EWRI 2005), hours
    at sunrise and sunset count with their sunlit part, and the soil heat flux is that of the day,
    0.1 Rn, where Rn > 0 and that of the night, 0.5 Rn, elsewhere.

    Args:
        site: latitude, longitude, elevation, offset from UTC, albedo, k_Rs, height of the wind.
        first: start of the first hour, in any time zone.
        values: temperature and dew point (degC), wind speed (km/h), station pressure (kPa) and
            either solar radiation (W/m2) or ``Tmin`` and ``Tmax`` of the day (degC).
        night_ratio: Rs/Rso of the evening before; that of the first 24 hours if not given.
    """
    hours = len(values["temperature"])
    assert site.utc_offset is not None
    utc_offset = site.utc_offset
    local = first.astimezone(timezone(timedelta(hours=utc_offset)))
    since_midnight = local.hour + local.minute / 60 + np.arange(hours)
    hour = since_midnight % 24
    days = (since_midnight // 24).astype("timedelta64[D]")
    dates = np.datetime64(local.date(), "D") + days
    day_of_year = (dates - dates.astype("datetime64[Y]")).astype(int) + 1
    data = {
        "T_mean": values["temperature"],
        "e_a": saturation_vapour_pressure(values["dew point"]),
        "U_z": values["wind speed"] * _METRES_PER_SECOND,
        "P": values["station pressure"],
    }
    if RADIATION in values:
        data["R_s"] = values[RADIATION] * _MJ_PER_M2_AND_HOUR
    else:
        data["T_min"], data["T_max"] = values["Tmin"], values["Tmax"]

    def model(hours: int, ratio: float) -> ETo:
        return ETo(
            {key: series[:hours] for key, series in data.items()},
            freq="h", day_of_year=day_of_year[:hours], hour=hour[:hours], z_msl=site.elevation,
            lat=site.latitude, lon=site.longitude, TZ_lon=15 * utc_offset,
            z_u=site.wind_height, K_rs=site.k_Rs, alb=site.albedo, validate=False,
            rs_rso_init=ratio,
        )

    if night_ratio is None:
        day = model(min(hours, 24), 1.0).ts_param
        clear = float(day["R_so"].sum())
        night_ratio = float(day["R_s"].sum()) / clear if clear > 0 else 1.0
    # The package's default would round to 0.01 mm and drop what it finds too large.
    result: NDArray[np.float64] = model(hours, night_ratio).eto_fao(max_ETo=None, decimals=None)
    return result


def fao56(records: Records, site: Site) -> NDArray[np.float64]:
    """Evapotranspiration of the vegetation (mm/day) in each hour, shape (hours,).

    It is the site's crop coefficient times the reference evapotranspiration, and NaN where records
    are missing. Without measured solar radiation it needs the whole day, 0 to 24 h of local
    standard time.

    Raises:
        ConfigurationError: the file lacks a quantity, or the site its place on earth.
    """
    lacking = [name for name in FOR_EVAPOTRANSPIRATION if name not in records.values]
    if lacking:
        raise ConfigurationError(
            f"has no column '{EVAPOTRANSPIRATION} [{QUANTITIES[EVAPOTRANSPIRATION][0]}]', and no "
            f"{', '.join(lacking)}, from which {FAO56} is computed", file=records.source,
        )
    lacking = [name for name in _PLACE if getattr(site, name) is None]
    if lacking:
        raise ConfigurationError(
            f"{FAO56} needs {', '.join(lacking)} in the site file (see config/site.yaml)"
        )
    values = {name: records.values[name] for name in FOR_EVAPOTRANSPIRATION}
    measured = records.values.get(RADIATION)
    if measured is not None:
        values[RADIATION] = measured
    else:
        values["Tmin"], values["Tmax"] = _daily_extremes(records, site)
    unknown = np.isnan(sum(values.values()))  # a sum with a NaN is one
    result = np.full(records.hours, np.nan)
    # One gap-free stretch after the other: the clouds of a night are those of the evening before.
    for low, high in gaps(~unknown):
        stretch = {name: series[low:high] for name, series in values.items()}
        result[low:high] = hourly(site, records.first + low * HOUR, stretch)
    return result * 24 * site.crop_coefficient


def _daily_extremes(
    records: Records, site: Site
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and largest temperature (degC) of each hour's day; NaN for a day that is not whole."""
    assert site.utc_offset is not None
    temperature = records.values["temperature"]
    since_midnight = (records.first.timestamp() / 3600 + site.utc_offset) % 24
    day = np.floor((since_midnight + np.arange(records.hours)) / 24).astype(int)
    _, begins, hours = np.unique(day, return_index=True, return_counts=True)
    least, largest = (
        np.repeat(np.where(hours == 24, extreme.reduceat(temperature, begins), np.nan), hours)
        for extreme in (np.minimum, np.maximum)
    )
    return least, largest


def why_missing(records: Records, hours: NDArray[np.int64]) -> str:
    """Say why :func:`fao56` has no value in some hours.

    Args:
        records: the same.
        hours: indices of hours of the run in which it is NaN.
    """
    reasons = []
    near = range(max(0, int(hours.min()) - 24), min(records.hours, int(hours.max()) + 25))
    for name in (*FOR_EVAPOTRANSPIRATION, RADIATION):
        if name not in records.values:
            continue
        missing = [hour for hour in near if np.isnan(records.values[name][hour])]
        if missing:
            reasons.append(f"{name} at {', '.join(name_hours(records.first, missing))}")
    if not reasons:
        return "their day is not whole in the file (0 to 24 h of local standard time)"
    return "missing are " + "; ".join(reasons)
