"""Design storms, and the depths of rain by duration and return period on which they rest.

A YAML file describes where they come from, in one of three ways. A table, such as those of KOSTRA,
NOAA Atlas 14 or Environment and Climate Change Canada, has a row for each duration::

    file: atlas_14.csv
    after: PRECIPITATION FREQUENCY ESTIMATES
    return_periods: [1, 2, 5, 10, 25, 50, 100, 200, 500, 1000]
    unit: in

A formula has the parameters a, b and c of each return period, and gives the intensity
a / (minutes + b)^c (mm/h)::

    parameters: {2: [732.951, 6.199, 0.810], 100: [1735.688, 6.014, 0.820]}

A record is a weather file with years of rain::

    record: [rain_gauge.csv]
    return_periods: [2, 5, 10]

Between durations, tables are interpolated linearly in the logarithms of duration and depth. Between
return periods, depths are interpolated linearly in the logarithm of the return period. The depths
of the entries are exact.

A storm has one of three forms:

- **block**: constant rain.
- **euler**: Euler's type II (DWA-A 118, 2006, section 5.2.2.1). The increments of the depth in the
  steps of the storm are sorted. The largest begins at 0.3 of the duration, rounded down to a step.
  The next smaller ones are before it, up to the beginning of the storm, and the others after it.
- **chicago**: Keifer and Chu (1957). Every part of the storm that contains the peak, and of which
  the share ``peak`` is before it, has the depth of its own duration. The default is 0.375, which
  they found for Chicago. The peak is in the step in which the share ``peak`` of the duration ends,
  as in programs of practice, so the wettest step has the depth of its duration.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.stats import gumbel_r

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import YamlMapping, read_lines
from greenroof_ros.base.parameter import entry, read_record
from greenroof_ros.base.ranges import Range
from greenroof_ros.site.site import Place
from greenroof_ros.weather.quantities import PRECIPITATION, find_unit
from greenroof_ros.weather.read import find_files, read_measured
from greenroof_ros.weather.records import Records

Values = NDArray[np.float64]

# A line that begins with a duration, in minutes unless it has another unit.
_ROW = re.compile(r'[\s"]*(\d+(?:\.\d+)?)[ -]*(min|m?|h|d)[a-z]*\b(.*)', re.IGNORECASE)
_MINUTES = {"h": 60.0, "d": 1440.0}
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
# Durations for which a formula and a record are evaluated (min). The latter are those of
# Environment and Climate Change Canada.
_EVERY_MINUTE, _DURATIONS = np.arange(1.0, 1441.0), (5, 10, 15, 30, 60, 120, 360, 720, 1440)
# Minimum share of a year for which rain must be known, and minimum number of such years [assumed].
_ENOUGH, _MIN_YEARS = 0.9, 5

KINDS = BLOCK, EULER, CHICAGO = "block", "euler", "chicago"
PEAKS = {BLOCK: 0.5, EULER: 0.3, CHICAGO: 0.375}
"""default position of the peak, as a share of the duration"""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class DepthFile:
    """What a file of depths contains."""

    file: str = entry("the file with the table, beside this file", default="")
    after: str = entry("text in a line above the table, if the file contains more", default="")
    return_periods: tuple[float, ...] = entry(
        "return periods of the first columns, or those for which a record is evaluated", 1.0, 1e5,
        unit="years", default=(),
    )
    unit: str = entry("unit of the table", choices=("mm", "in", "mm/h", "in/h"), default="")
    decimal: str = entry("decimal mark of the table", choices=(".", ","), default=".")
    parameters: dict[float, tuple[float, ...]] = entry(
        "a, b and c of each return period in years", 0.0, 1e6, factory=dict,
    )
    record: tuple[str, ...] = entry("weather files, beside this file", default=())


@dataclass(frozen=True)
class Depths:
    """Depths of rain by duration and return period.

    Attributes:
        periods: return periods (years), in ascending order.
        durations: durations (min), in ascending order, shape (durations,).
        table: depths (mm), shape (durations, periods).
        note: sentence about the source.
    """

    periods: Sequence[float]
    durations: Values
    table: Values
    note: str

    def depth(self, minutes: Values, period: float) -> Values:
        """Return the depths (mm) of some durations (min).

        Durations outside the table continue its outermost segments.

        Raises:
            ConfigurationError: if the return period (years) is outside those of the table.
        """
        allowed = Range(self.periods[0], self.periods[-1], "years")
        place, logs = np.log(allowed.read(period, key="return_periods")), np.log(self.periods)
        shares = [np.interp(place, logs, one) for one in np.eye(len(logs))]
        line = make_interp_spline(np.log(self.durations), np.log(self.table), k=1)
        return np.asarray(np.exp(line(np.log(minutes))) @ shares)


def make_storm(
    depths: Depths, period: float, kind: str, duration: int, step: int, peak: float | None = None
) -> Values:
    """Return the rain in each step of a storm (mm), whose sum is the depth of its duration.

    Args:
        depths: depths by duration and return period.
        period: return period (years).
        kind: one of :data:`KINDS`.
        duration: duration of the storm (min).
        step: duration of a step (min).
        peak: position of the peak as a share of the duration; None for that of :data:`PEAKS`.

    Raises:
        ConfigurationError: if a value is invalid; its key is that of the value.
    """
    low, high = depths.durations[[0, -1]].tolist()
    if kind not in KINDS:
        raise ConfigurationError(f"must be one of {', '.join(KINDS)}", key="kind", value=kind)
    if not step or 60 % step or (kind != BLOCK and step < low):
        expected = f"must divide an hour; the shortest duration of the table is {low:g} min"
        raise ConfigurationError(expected, key="step", value=step)
    if duration % step or not low <= duration <= high:
        expected = f"must be a multiple of the step, {step} min, from {low:g} to {high:g} min"
        raise ConfigurationError(expected, key="duration", value=duration)
    share, count = Range(0.01, 0.99).read(peak or PEAKS[kind], key="peak"), duration // step
    whole = depths.depth(np.array([float(duration)]), period)
    if kind == BLOCK or count == 1:
        return np.repeat(whole / count, count)
    if kind == EULER:
        increments = np.diff(depths.depth(step * np.arange(1.0, count + 1), period), prepend=0.0)
        rain, before = np.sort(increments)[::-1], math.floor(share * count + _ROUNDING)
        return np.concatenate((rain[before::-1], rain[before + 1:]))
    before = math.ceil(share * count - _ROUNDING) - 1
    earlier = step * (np.arange(before + 1) / share + 1)
    later = step * (np.arange(count - before) / (1 - share) + 1)
    rising, falling = (depths.depth(each, period) for each in (earlier, later))
    # Both begin with the wettest step. The others are scaled, by a thousandth, to the whole depth.
    others = np.concatenate((share * np.diff(rising)[::-1], (1 - share) * np.diff(falling)))
    scaled = others * (whole - rising[0]) / others.sum()
    return np.insert(scaled, before, rising[0])


def read_depths(path: Path) -> Depths:
    """Read a file of depths.

    Raises:
        ConfigurationError: if a file is invalid; the message names the line and the key or value.
    """
    stated = read_record(DepthFile, path, _find_mistakes)
    if stated.parameters:
        periods, each = sorted(stated.parameters), _EVERY_MINUTE[:, None]
        a, b, c = np.array([stated.parameters[period] for period in periods]).T
        note = f"{path.name}: intensity a / (minutes + b)^c"
        return Depths(periods, _EVERY_MINUTE, a / (each + b) ** c * each / 60, note)
    if stated.record:
        files = find_files([str(path.parent / name) for name in stated.record], "record")
        return fit_record(read_measured(files, Place()), stated.return_periods)
    return _read_table(path.parent / stated.file, stated)


def _find_mistakes(stated: DepthFile, _: YamlMapping) -> Iterator[tuple[str, str]]:
    """Yield the key and the correction of every mistake."""
    if [*map(bool, (stated.file, stated.parameters, stated.record))].count(True) != 1:
        yield "file", "must be stated, or else parameters or record, but only one of these three"
    periods = [*stated.return_periods, *sorted(stated.parameters)]
    if not periods or periods != sorted({*periods}) or (stated.record and periods[0] <= 1):
        yield "return_periods", "must be stated, in ascending order, and above 1 for a record"
    if any(len(abc) != 3 for abc in stated.parameters.values()):
        yield "parameters", "must contain a, b and c for each return period"
    if stated.file and not stated.unit:
        yield "unit", "must be stated: mm or in for depths, mm/h or in/h for intensities"


def _read_table(file: Path, stated: DepthFile) -> Depths:
    """Read the lines that begin with a duration, for as long as it increases."""
    lines, count = enumerate(read_lines(file), start=1), len(stated.return_periods)
    if stated.after and not any(stated.after in text for _, text in lines):
        raise ConfigurationError("must occur in a line", file=file, key="after", value=stated.after)
    rows = [[1e-9] * (count + 1)]
    for number, text in lines:
        if not (match := _ROW.match(text.replace(stated.decimal, "."))):
            continue
        minutes = float(match[1]) * _MINUTES.get(match[2].lower(), 1.0)
        if minutes <= rows[-1][0]:
            break
        per_ours = find_unit(PRECIPITATION, stated.unit, minutes / 60, 1.0).per_ours
        cells = _NUMBER.findall(match[3])[:count]
        row = [minutes, *(minutes / 60 * float(cell) / per_ours for cell in cells)]
        if not np.greater_equal(row, rows[-1][: len(row)]).all() or len(cells) < count:
            expected = f"must have {count} values in {stated.unit}, and depths must not decrease"
            raise ConfigurationError(expected, file=file, line=number, value=text.strip())
        rows.append(row)
    if len(rows) < 3:
        raise ConfigurationError("must have two or more lines that begin with a duration", file=file)
    table = np.array(rows[1:])
    note = f"{file}: table of {len(table)} durations in {stated.unit}"
    return Depths(stated.return_periods, table[:, 0], table[:, 1:], note)


def fit_record(records: Records, periods: Sequence[float]) -> Depths:
    """Fit Gumbel's distribution to the annual maxima of each duration.

    Args:
        records: a record of rain.
        periods: return periods (years).

    Raises:
        ConfigurationError: if the record has fewer than five years.
    """
    rain = records.finest_rain
    size = 60 // rain.shape[1]
    changes = np.flatnonzero(np.diff(np.nan_to_num(rain, nan=-1.0), axis=1).any(axis=0))
    step = size * math.gcd(rain.shape[1], *(1 + changes).tolist())
    first = np.datetime64(records.first.replace(tzinfo=None), "h")
    years = (first + np.arange(records.hours)).astype("datetime64[Y]")
    known = [
        year for year in np.unique(years)
        if np.count_nonzero(~np.isnan(rain[years == year])) >= _ENOUGH * 8760 * rain.shape[1]
    ]
    if (count := len(known)) < _MIN_YEARS:
        raise ConfigurationError(
            f"has {count} years with rain for {_ENOUGH:.0%} of the time; at least {_MIN_YEARS} are "
            "needed", file=records.source,
        )
    total = np.append(0.0, np.cumsum(np.nan_to_num(rain) * size / 60))
    durations, of_sum = [each for each in _DURATIONS if each >= step], np.repeat(years, 60 // size)
    maxima = np.array([[
        (total[width:] - total[:-width])[of_sum[: len(total) - width] == year].max()
        for year in known
    ] for width in np.array(durations) // size])
    return Depths(periods, np.array(durations, float), fit_gumbel(maxima, periods), (
        f"{records.source}: Gumbel's distribution, fitted by moments to the annual maxima of "
        f"{count} years, {known[0]} to {known[-1]}, in steps of {step} min. By Weibull's plotting "
        f"position, m / ({count} + 1), the largest has a return period of {count + 1} years; longer "
        f"ones are extrapolated. Sums over {step} min begin at fixed times, and are lower than "
        "those that begin at any time, by about an eighth"
    ))


def fit_gumbel(maxima: Values, periods: Sequence[float]) -> Values:
    """Return the depths of return periods by the method of moments, as used in Canada's tables.

    Args:
        maxima: annual maxima, shape (durations, years).
        periods: return periods (years).

    Returns:
        Depths, shape (durations, periods).
    """
    scale = maxima.std(axis=1, ddof=1, keepdims=True) * math.sqrt(6) / math.pi
    place = maxima.mean(axis=1, keepdims=True) - np.euler_gamma * scale
    return np.asarray(gumbel_r.isf(1 / np.array(periods), place, scale))
