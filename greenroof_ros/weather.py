"""Hourly weather records, and what a run sees of them tick by tick."""

from __future__ import annotations

import csv
import math
import re
from array import array
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.errors import ConfigurationError
from greenroof_ros.files import read_text
from greenroof_ros.site import Site

_HOUR = timedelta(hours=1)
_FIRST_YEAR, _LAST_YEAR = 1971, 2037
_HOUR_NS = 3_600_000_000_000
_EVAPOTRANSPIRATION = "evapotranspiration"

# Quantity: unit, least and largest believable value. More than the world's record of an hour's
# rain, or of a day's evapotranspiration, is a wrong unit and not weather.
_COLUMNS = {
    "precipitation": ("mm/h", 0.0, 500.0),
    _EVAPOTRANSPIRATION: ("mm/day", 0.0, 50.0),
    "temperature": ("degC", -90.0, 60.0),
    "dew point": ("degC", -90.0, 60.0),
    "wind speed": ("km/h", 0.0, 500.0),
    "station pressure": ("kPa", 50.0, 110.0),
}


@dataclass(frozen=True)
class Weather:
    """Hourly records without a gap; each holds for the hour that starts at its time.

    Attributes:
        file: where the records come from.
        first: start of the first hour, with its offset from UTC.
        precipitation: depth of rain in each hour (mm/h), shape (hours,).
        evapotranspiration: depth over the vegetation bed (mm/day), shape (hours,).
        variant: how the evapotranspiration was made, as the file's header names it.
    """

    file: Path
    first: datetime
    precipitation: NDArray[np.float64]
    evapotranspiration: NDArray[np.float64]
    variant: str

    @property
    def end(self) -> datetime:
        """End of the last hour."""
        return self.first + len(self.precipitation) * _HOUR


def parse_time(text: str) -> datetime:
    """Read an ISO 8601 time; a final ``Z`` stands for UTC.

    Raises:
        ValueError: it is not one, or outside the years that ROS 2 and bag time stamps hold.
    """
    time = datetime.fromisoformat(re.sub(r"[zZ]$", "+00:00", text.strip()))
    if not _FIRST_YEAR <= time.year <= _LAST_YEAR:
        raise ValueError
    return time


def _read_header(path: Path, line: int, header: list[str]) -> tuple[dict[str, int], str]:
    """Return the column of each quantity and the variant of evapotranspiration."""

    def refuse(expected: str, value: object = None) -> ConfigurationError:
        return ConfigurationError(expected, file=path, line=line, value=value)

    columns: dict[str, int] = {}
    variant = ""
    if header[0].strip() != "time":
        raise refuse("the first column must be 'time'", header[0])
    for index, cell in enumerate(header[1:], start=1):
        match = re.fullmatch(r"\s*([^\[\]]+?)\s*\[([^\[\]]*)\]\s*", cell)
        if not match:
            raise refuse("a column must be named like 'precipitation [mm/h]'", cell)
        name, unit = match.groups()
        quantity = _EVAPOTRANSPIRATION if name.endswith(_EVAPOTRANSPIRATION) else name
        if quantity not in _COLUMNS:
            known = ", ".join(f"{key} [{value[0]}]" for key, value in _COLUMNS.items())
            raise refuse(f"is not a known column; they are {known}", cell)
        if unit != _COLUMNS[quantity][0]:
            raise refuse(f"the unit of {name} must be [{_COLUMNS[quantity][0]}]", cell)
        if quantity in columns:
            raise refuse(f"there is a column of {quantity} before this one", cell)
        columns[quantity] = index
        if quantity == _EVAPOTRANSPIRATION:
            variant = name.removesuffix(_EVAPOTRANSPIRATION).strip() or "unnamed"
    for quantity in ("precipitation", _EVAPOTRANSPIRATION):
        if quantity not in columns:
            raise refuse(f"there must be a column '{quantity} [{_COLUMNS[quantity][0]}]'")
    return columns, variant


def _cells(path: Path, line: int, text: str) -> list[str]:
    """Split a line of CSV; a quoted cell ends in its line."""
    try:
        return next(csv.reader([text], strict=True))
    except csv.Error as error:
        raise ConfigurationError(f"is not valid CSV: {error}", file=path, line=line) from error


def read_weather(path: Path) -> Weather:
    """Read a weather file of this project's form.

    Lines that start with ``#`` are comments. The first other line names the columns with their
    units: ``time``, ``precipitation [mm/h]`` and one ``... evapotranspiration [mm/day]``, whose
    first words name its variant; ``temperature [degC]``, ``dew point [degC]``,
    ``wind speed [km/h]`` and ``station pressure [kPa]`` may follow. Each further line is the hour
    that starts at its ``time`` (ISO 8601 with the offset from UTC), hour after hour.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    lines = read_text(path).splitlines()
    numbered = [
        (number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    rows = [_cells(path, line, text) for line, text in numbered]
    if not rows:
        raise ConfigurationError("holds comments only; a header and records must follow", file=path)
    columns, variant = _read_header(path, numbered[0][0], rows[0])
    first: datetime | None = None
    values: dict[str, list[float]] = {quantity: [] for quantity in columns}
    for (line, _), row in zip(numbered[1:], rows[1:], strict=True):
        if len(row) != len(rows[0]):
            raise ConfigurationError(
                f"must have {len(rows[0])} cells as the header has, not {len(row)}",
                file=path, line=line,
            )
        try:
            time = parse_time(row[0])
        except ValueError:
            raise ConfigurationError(
                f"must be a time such as 2021-07-07T02:00-05:00, {_FIRST_YEAR} to {_LAST_YEAR}",
                file=path, line=line, key="time", value=row[0],
            ) from None
        if time.utcoffset() is None:
            raise ConfigurationError(
                "must say its offset from UTC, as in 2021-07-07T02:00-05:00",
                file=path, line=line, key="time", value=row[0],
            )
        if first is None:
            first = time
        due = first + len(values["precipitation"]) * _HOUR
        if time != due:
            expected = due.astimezone(time.tzinfo).isoformat(timespec="minutes")
            raise ConfigurationError(
                f"must be {expected}: the records must be hour after hour, "
                "without gap or repetition",
                file=path, line=line, key="time", value=row[0],
            )
        for quantity, column in columns.items():
            unit, least, largest = _COLUMNS[quantity]
            try:
                value = float(row[column])
            except ValueError:
                value = math.nan
            if not least <= value <= largest:
                raise ConfigurationError(
                    f"must be a number from {least:g} to {largest:g} {unit}",
                    file=path, line=line, key=rows[0][column].strip(), value=row[column],
                )
            values[quantity].append(value)
    if first is None:
        raise ConfigurationError("has a header but no records", file=path)
    return Weather(
        file=path,
        first=first,
        precipitation=np.array(values["precipitation"]),
        evapotranspiration=np.array(values[_EVAPOTRANSPIRATION]),
        variant=variant,
    )


class WeatherSeries:
    """A run's weather in SI units, tick by tick, with a perfect forecast.

    Attributes:
        repeats_from: the time from which on the last record is repeated, because some tick's
            forecast window reaches past the end of the file; None if none does.
        largest_precipitation: of the run (m/s).
        largest_evapotranspiration: of the run (m3/s).
    """

    def __init__(self, weather: Weather, site: Site, start: datetime, steps: int) -> None:
        """Lay the hours out over the ticks 0..steps and the last tick's window.

        Args:
            weather: hourly records that cover the run.
            site: gives tick, look-ahead and the bed's area, over which a depth is a volume.
            start: time of tick 0.
            steps: N; tick N is the last.

        Raises:
            ConfigurationError: the records do not cover the run.
        """
        tick_ns = round(site.tau * 1e9)
        before = (weather.end - start).total_seconds()
        if start < weather.first or steps * site.tau > before:
            raise ConfigurationError(
                f"holds {weather.first.isoformat(timespec='minutes')} to "
                f"{weather.end.isoformat(timespec='minutes')}, but the run is from "
                f"{start.isoformat(timespec='minutes')} on for {steps * site.tau / 3600:g} hours",
                file=weather.file,
            )
        self._window = site.M
        ticks = steps + site.M
        offset_ns = round((start - weather.first) / timedelta(microseconds=1)) * 1000
        elapsed_ns: NDArray[np.int64] = offset_ns + np.arange(ticks, dtype=np.int64) * tick_ns
        hour = elapsed_ns // _HOUR_NS
        last = len(weather.precipitation) - 1
        self.repeats_from = weather.end if hour[-1] > last else None
        hour = np.minimum(hour, last)
        metres_per_second = weather.precipitation / 1000 / 3600
        cubic_metres_per_second = weather.evapotranspiration / 1000 / 86400 * site.a2
        self.largest_precipitation = float(metres_per_second[hour].max())
        self.largest_evapotranspiration = float(cubic_metres_per_second[hour].max())
        self._precipitation = array("d", metres_per_second[hour].tobytes())
        self._evapotranspiration = array("d", cubic_metres_per_second[hour].tobytes())

    def precipitation(self, tick: int) -> array[float]:
        """Rain over the look-ahead from a tick on (m/s), shape (M,), first entry = now."""
        return self._precipitation[tick : tick + self._window]

    def evapotranspiration(self, tick: int) -> array[float]:
        """Evapotranspiration over the look-ahead (m3/s), shape (M,), first entry = now."""
        return self._evapotranspiration[tick : tick + self._window]
