"""What a weather record contains, so that a person sees a wrong unit or a wrong clock at once.

The summary neither changes nor refuses a value. ``config/plausible.yaml`` contains limits of
climates; a record beyond a limit leads to a note that names the likely mistake.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any

import numpy as np

from greenroof_ros.base.files import parse_yaml, read_text, shared_directory
from greenroof_ros.base.times import to_people
from greenroof_ros.site.site import Place
from greenroof_ros.weather import quantities
from greenroof_ros.weather.evapotranspiration import saturation_vapour_pressure, sun_height
from greenroof_ros.weather.quantities import DEW_POINT, PRECIPITATION, RADIATION, TEMPERATURE, WIND
from greenroof_ros.weather.records import HOUR, Array, Records, find_gaps

_MONTHS = "Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"
# Rain that ends a dry spell (mm a day).
_DRY_DAY = 0.2
# Hours needed for the statistics of a day's course, of the air, and of a year.
_COURSE, _AIR, _YEAR = 5 * 24, 10 * 24, 300 * 24
# Radiation outside the atmosphere on a level facing the sun (W/m2), FAO-56 Eq. 21, and the lowest
# sine of the sun's elevation at which the clearness of an hour is judged.
_SOLAR_CONSTANT, _HIGH_SUN = 1367.0, 0.3


def summarize(records: Records, site: Place, hours: range | None = None) -> dict[str, Any]:
    """Return the contents of records, for a table, ``summary.json`` and a page.

    Args:
        records: hourly records; values that were filled count as missing.
        site: site with its clock and location, unless the records state a position.
        hours: the hours that matter; by default, all.

    Returns:
        ``applied``: what was applied to the rows of the files; ``quantities``: unit, minimum, mean,
        maximum and missing hours of each quantity; ``rain``: total, wet hours, wettest hour and
        day, and the rain of months and years (mm); ``course``: the local hours with the highest
        radiation and temperature; ``statistics`` and ``notes``, by ``plausible.yaml``.
    """
    part = slice(0, records.hours) if hours is None else slice(hours.start, hours.stop)
    values = {
        name: np.where(records.filled.get(name, False), np.nan, series)[part]
        for name, series in records.values.items()
    }
    known = Counter({name: np.count_nonzero(~np.isnan(series)) for name, series in values.items()})
    has_clock = site.time_zone is not None or site.utc_offset is not None
    first = (records.first + part.start * HOUR).astimezone(
        site.zone if has_clock else records.first.tzinfo
    )
    rain = _describe_rain(values[PRECIPITATION], first)
    rates = records.minutes if records.minutes is not None else records.values[PRECIPITATION]
    position = next(iter(records.places.values()), (site.latitude, site.longitude))
    statistics = {"heaviest rain": float(np.nanmax(rates[part], initial=0.0))}
    for name, value in _find_statistics(values, known, rain, first, position):
        if math.isfinite(value):
            statistics[name] = float(value)
    return {
        "applied": list(records.applied), "from": to_people(first),
        "hours": len(values[PRECIPITATION]), "quantities": {
            name: {"unit": quantities.QUANTITIES[name].unit, **_describe(series)}
            for name, series in values.items() if name in quantities.QUANTITIES
        }, "rain": rain, "course": {
            name: (first + _find_peak(values[name]) * HOUR).hour
            for name in (RADIATION, TEMPERATURE) if known[name] >= _COURSE
        }, "statistics": statistics, "notes": [*_note(statistics)],
    }


def as_lines(summary: Mapping[str, Any]) -> list[str]:
    """Return a summary in three lines, followed by one line for each note."""
    rain = summary["rain"]
    sums = rain["months"] if len(rain["months"]) <= len(_MONTHS) else rain["years"]
    parts = ", ".join(
        f"{_MONTHS[int(name[5:]) - 1] if name[4:] else name} {amount:.4g}"
        for name, amount in sums.items()
    )
    contents = dict(summary["quantities"])
    missing = {name: about["missing"] for name, about in contents.items() if about["missing"]}
    days = round(summary["hours"] / 24, 3)
    lines = [
        f"rain {rain['total']:.4g} mm in {days:g} days from {summary['from']} "
        f"({parts}); {rain['wet_hours']} wet hours; wettest hour {rain['wettest_hour']:.3g} mm, "
        f"{rain['wettest_hour_at']}; wettest day {rain['wettest_day']:.3g} mm, "
        f"{rain['wettest_day_at']}",
        "; ".join(
            f"{name} {about['minimum']:.3g} to {about['maximum']:.3g} {about['unit']}, mean "
            f"{about['mean']:.3g}" + (
                f", highest at {summary['course'][name]} h" if name in summary["course"] else ""
            )
            for name, about in contents.items()
            if name != PRECIPITATION and about["mean"] is not None
        ) or "no other quantity",
        "missing: " + (", ".join(f"{name} {hours} h" for name, hours in missing.items()) or "none")
        + "".join(f"; read as {text}" for text in summary["applied"]),
    ]
    return [*lines, *summary["notes"]]


def _describe(series: Array) -> dict[str, Any]:
    known = series[~np.isnan(series)]
    about = {
        name: float(f"{find(known):.6g}") if known.size else None
        for name, find in (("minimum", np.min), ("mean", np.mean), ("maximum", np.max))
    }
    return {**about, "missing": int(series.size - known.size)}


def _describe_rain(series: Array, first: datetime) -> dict[str, Any]:
    rain = np.nan_to_num(series)
    local = np.datetime64(first.replace(tzinfo=None), "h") + np.arange(len(rain))
    days, of_day = np.unique(local.astype("datetime64[D]"), return_inverse=True)
    by_day = np.bincount(of_day, rain)
    dry = (by_day < _DRY_DAY) & (np.bincount(of_day, ~np.isnan(series)) > 0)
    sums = dict[str, dict[str, float]]()
    for name, unit in (("months", "M"), ("years", "Y")):
        spans, of_span = np.unique(local.astype(f"datetime64[{unit}]"), return_inverse=True)
        sums[name] = dict(zip(map(str, spans), np.bincount(of_span, rain).tolist(), strict=True))
    hour, day = int(rain.argmax()), int(by_day.argmax())
    return {
        "total": float(rain.sum()), "wet_hours": int(np.count_nonzero(rain > 0)),
        "wettest_hour": float(rain[hour]), "wettest_hour_at": to_people(first + hour * HOUR),
        "wettest_day": float(by_day[day]), "wettest_day_at": str(days[day]),
        "longest_dry_days": max((end - start for start, end in find_gaps(dry)), default=0),
        **sums,
    }


def _find_peak(series: Array) -> int:
    """Return the hour of the day, counted from the first hour, with the highest mean."""
    days = np.pad(series, (0, -len(series) % 24), constant_values=np.nan).reshape(-1, 24)
    known = np.count_nonzero(~np.isnan(days), axis=0)
    means = np.nansum(days, axis=0) / np.maximum(known, 1)
    return int(np.argmax(np.where(known > 0, means, -math.inf)))


# --- climates -------------------------------------------------------------------------------------


def _note(statistics: Mapping[str, float]) -> Iterator[str]:
    """Yield one sentence about each statistic beyond its limits."""
    path = shared_directory() / "config" / "plausible.yaml"
    for row in parse_yaml(read_text(path), path):
        low, high = row.get("low", -math.inf), row.get("high", math.inf)
        value = statistics.get(row["statistic"], low)
        if not low <= value <= high:
            bound = f"less than {low:g}" if value < low else f"more than {high:g}"
            yield (
                f"{row['statistic']}: {value:.3g} {row['unit']}; {bound} is rare. Check "
                f"{row['mistake']}"
            )


def _find_statistics(
    values: Mapping[str, Array], known: Mapping[str, int], rain: Mapping[str, Any],
    first: datetime, position: tuple[float | None, float | None],
) -> Iterator[tuple[str, float]]:
    """Yield each statistic for which enough hours are known; it may be infinite or NaN."""
    yield "wettest day", rain["wettest_day"]
    yield "wettest hour", rain["wettest_hour"]
    if known[PRECIPITATION] >= _AIR:
        yield "longest dry spell", rain["longest_dry_days"]
        yield "wet hours", 100 * rain["wet_hours"] / known[PRECIPITATION]
        yield "mean of wet hours", rain["total"] / (rain["wet_hours"] or math.nan)
    if known[PRECIPITATION] >= _YEAR:
        yield "rain in a year", rain["total"] * 8766 / known[PRECIPITATION]
    air = {name: values.get(name, np.full(1, np.nan)) for name in (TEMPERATURE, DEW_POINT, WIND)}
    yield "longest constant value", max((
        end - start + 1 for series in air.values() for start, end in find_gaps(np.diff(series) == 0)
    ), default=0)
    for name, what in ((TEMPERATURE, "temperature"), (WIND, "wind")):
        if known[name] >= _AIR:
            yield f"mean {what}", float(np.nanmean(air[name]))
    both = ~np.isnan(air[DEW_POINT] + air[TEMPERATURE])
    if np.count_nonzero(both) >= _AIR:
        dew, warmth = air[DEW_POINT][both], air[TEMPERATURE][both]
        share = saturation_vapour_pressure(dew) / saturation_vapour_pressure(warmth)
        yield "highest relative humidity", 100 * np.max(share)
        yield "dew point above temperature", 100 * np.mean(dew - warmth > 1)
    latitude, longitude = position
    if latitude is None or longitude is None:
        return
    middles = round(first.timestamp()) + 1800 + 3600 * np.arange(len(values[PRECIPITATION]))
    # The sun on the clock of the meridian of Greenwich, and mean solar time relative to noon (h).
    sun = sun_height(latitude, middles, longitude)
    noon = (middles / 3600 + longitude / 15) % 24 - 12
    if known[RADIATION] >= _COURSE and np.nansum(values[RADIATION]):
        radiation, high = np.nan_to_num(values[RADIATION]), sun > _HIGH_SUN
        outside = _SOLAR_CONSTANT * sun[high]
        yield "clearest hour", 100 * np.max(radiation[high] / outside, initial=0.0)
        yield "radiation at night", 100 * radiation[sun == 0].sum() / radiation.sum()
        by_sun, by_radiation = (np.average(noon, weights=each) for each in (sun, radiation))
        yield "middle of the sun", by_radiation - by_sun
    if known[TEMPERATURE] >= _AIR:
        yield "warmest hour", np.floor(noon[_find_peak(values[TEMPERATURE])]) + 0.5
