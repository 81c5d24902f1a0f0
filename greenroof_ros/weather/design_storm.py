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

Gumbel's distribution is fitted to the annual maxima of a record by the method of moments, as in the
tables of Environment and Climate Change Canada.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.stats import gumbel_r

from greenroof_ros.base.errors import ConfigurationError, describe_choices
from greenroof_ros.base.files import YamlMapping, read_lines
from greenroof_ros.base.parameter import entry, read_record
from greenroof_ros.base.ranges import Range
from greenroof_ros.site.site import Place
from greenroof_ros.weather.quantities import PRECIPITATION, find_unit
from greenroof_ros.weather.read import find_files, read_measured
from greenroof_ros.weather.records import Array, Records

# Durations (min), those of Environment and Climate Change Canada.
_DURATIONS = 5, 10, 15, 30, 60, 120, 360, 720, 1440
# Minimum share of a year for which rain must be known, and minimum number of such years [assumed].
_ENOUGH, _MIN_YEARS = 0.9, 5


def fit_record(records: Records, periods: Sequence[float]) -> tuple[Array, Array, str]:
    """Return durations (min), depths (mm) of shape (durations, periods), and a note on their fit.

    Args:
        records: a record of rain.
        periods: return periods (years).

    Raises:
        ConfigurationError: if rain is known in fewer than five years.
    """
    rain = records.finest_rain
    size = 60 // rain.shape[1]
    changes = np.flatnonzero(np.diff(np.nan_to_num(rain, nan=-1.0), axis=1).any(axis=0))
    step = size * math.gcd(rain.shape[1], *(1 + changes).tolist())
    first = np.datetime64(records.first.replace(tzinfo=None), "h")
    years = (first + np.arange(records.hours)).astype("datetime64[Y]")
    least = _ENOUGH * 8760 * rain.shape[1]
    there = {year: (~np.isnan(rain[years == year])).sum() for year in np.unique(years)}
    known = [year for year in there if there[year] >= least]
    if (count := len(known)) < _MIN_YEARS:
        expected = f"must have {_MIN_YEARS} years with rain for {_ENOUGH:.0%} of the time"
        raise ConfigurationError(f"{expected}, but has {count}", file=records.source)
    total = np.append(0.0, np.cumsum(np.nan_to_num(rain) * size / 60))
    durations, of_sum = [each for each in _DURATIONS if each >= step], np.repeat(years, 60 // size)
    maxima = np.array([[
        (total[width:] - total[:-width])[of_sum[: len(total) - width] == year].max()
        for year in known
    ] for width in np.array(durations) // size])
    return np.array(durations, float), fit_gumbel(maxima, periods), (
        f"{records.source}: Gumbel's distribution, fitted by moments to the annual maxima of "
        f"{count} years, {known[0]} to {known[-1]}, in steps of {step} min. The largest sum over "
        f"{durations[0]} min is {maxima[0].max():.1f} mm. By Weibull's plotting position, "
        f"m / ({count} + 1), it has a return period of {count + 1} years; longer ones are "
        f"extrapolated. Sums over {step} min begin at fixed times, and are lower "
        "than those that begin at any time, by about an eighth"
    )


def fit_gumbel(maxima: Array, periods: Sequence[float]) -> Array:
    """Return the depths of return periods, shape (durations, periods).

    Args:
        maxima: annual maxima, shape (durations, years).
        periods: return periods (years).
    """
    scale = maxima.std(axis=1, ddof=1, keepdims=True) * math.sqrt(6) / math.pi
    place = maxima.mean(axis=1, keepdims=True) - np.euler_gamma * scale
    return np.asarray(gumbel_r.isf(1 / np.array(periods), place, scale))


# A line that begins with a duration, in minutes unless it has another unit.
_ROW = re.compile(r'[\s"]*(\d+(?:\.\d+)?)[ -]*(min|h|d|)[a-z]*\b(.*)', re.IGNORECASE)
_MINUTES = {"h": 60.0, "d": 1440.0}
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
# Durations for which a formula is evaluated (min).
_EVERY_MINUTE = np.arange(1.0, 1441.0)

PEAKS = {"block": 0.5, "euler": 0.3, "chicago": 0.375}
"""default position of the peak of each kind of storm, as a share of the duration"""
_TINY = 1e-9


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
    durations: Array
    table: Array
    note: str

    def depth(self, minutes: Array, period: float) -> Array:
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
) -> Array:
    """Return the rain in each step of a storm (mm), whose sum is the depth of its duration.

    Args:
        depths: depths by duration and return period.
        period: return period (years).
        kind: one of :data:`PEAKS`.
        duration: duration of the storm (min).
        step: duration of a step (min).
        peak: position of the peak as a share of the duration; None for that of :data:`PEAKS`.

    Raises:
        ConfigurationError: if a value is invalid; its key is that of the value.
    """
    low, high = depths.durations[[0, -1]].tolist()
    if kind not in PEAKS:
        raise ConfigurationError(describe_choices(PEAKS, kind), key="kind", value=kind)
    if not low <= step <= duration <= high or 60 % step or duration % step:
        raise ConfigurationError(
            f"must be a multiple of step ({step} min), which must divide an hour; both must be "
            f"from {low:g} to {high:g} min, as in the table", key="duration", value=duration,
        )
    share, count = Range(0.01, 0.99).read(
        PEAKS[kind] if peak is None else peak, key="peak"
    ), duration // step
    sums = depths.depth(step * np.arange(1.0, count + 1), period)
    if kind == "block" or count == 1:
        return np.repeat(sums[-1] / count, count)
    if kind == "euler":
        rain, before = np.sort(np.diff(sums, prepend=0.0))[::-1], math.floor(share * count + _TINY)
        return np.concatenate((rain[before::-1], rain[before + 1:]))
    before = math.ceil(share * count - _TINY) - 1
    earlier = step * (np.arange(before + 1) / share + 1)
    later = step * (np.arange(count - before) / (1 - share) + 1)
    rising, falling = (np.diff(depths.depth(each, period)) for each in (earlier, later))
    # The other steps than the wettest are scaled, by a thousandth, to the whole depth.
    others = np.concatenate((share * rising[::-1], (1 - share) * falling))
    return np.insert(others * (sums[-1] - sums[0]) / others.sum(), before, sums[0])


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
        table = a / (each + b) ** c * each / 60
        if not (np.diff(table, axis=0) > 0).all() or not (table > 0).all():
            raise ConfigurationError(
                "must be a, b and c of depths that grow with the duration", file=path,
                key="parameters", value=stated.parameters,
            )
        return Depths(periods, _EVERY_MINUTE, table, note)
    if stated.record:
        files = find_files([str(path.parent / name) for name in stated.record], "record")
        wanted = stated.return_periods
        return Depths(wanted, *fit_record(read_measured(files, Place()), wanted))
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
    """Read the lines that begin with a duration, up to the first empty line after them."""
    lines, count = enumerate(read_lines(file), start=1), len(stated.return_periods)
    if stated.after and not any(stated.after in text for _, text in lines):
        raise ConfigurationError("must occur in a line", file=file, key="after", value=stated.after)
    rows, columns = [[1e-9] * (count + 1)], 0  # of the first row
    for number, text in lines:
        if not (match := _ROW.match(text.replace(stated.decimal, "."))):
            if len(rows) > 1 and not text.strip():
                break
            continue
        minutes = float(match[1]) * _MINUTES.get(match[2].lower(), 1.0)
        if minutes <= rows[-1][0]:
            raise ConfigurationError(
                "durations must increase from line to line", file=file, line=number,
                value=text.strip(),
            )
        per_ours = find_unit(PRECIPITATION, stated.unit, minutes / 60, 1.0).per_ours
        cells = _NUMBER.findall(match[3])
        columns, cells = columns or len(cells), cells[:count] if len(cells) >= columns else []
        row = [minutes, *(minutes / 60 * float(cell) / per_ours for cell in cells)]
        grows = np.greater_equal(row, rows[-1][: len(row)]).all() and (np.diff(row[1:]) >= 0).all()
        if len(cells) < count or not grows:
            expected = f"must have {count} values in {stated.unit}, and depths must not decrease"
            raise ConfigurationError(expected, file=file, line=number, value=text.strip())
        rows.append(row)
    if len(rows) < 3:
        raise ConfigurationError("must have lines that begin with a duration", file=file)
    table = np.array(rows[1:])
    note = f"{file}: table of {len(table)} durations ({stated.unit})"
    return Depths(stated.return_periods, table[:, 0], table[:, 1:], note)
