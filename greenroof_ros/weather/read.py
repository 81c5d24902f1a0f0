"""Functions that find weather files and join them into one set of records.

A polars or pandas data frame has the columns of this project's own form.
"""

from __future__ import annotations

import glob
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import date, tzinfo
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import find_shipped, shared_directory
from greenroof_ros.site.site import Place
from greenroof_ros.weather import evapotranspiration, open_meteo, quantities
from greenroof_ros.weather.climate import RECORDED, Climate, change_climate
from greenroof_ros.weather.description import TIME, TIPS, Description, read_description
from greenroof_ros.weather.evapotranspiration import FAO56, HARGREAVES
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, TEMPERATURE, WEATHER
from greenroof_ros.weather.records import Array, Records, bridge_gaps, make_hours, write_records
from greenroof_ros.weather.series import FILL, REFUSE, Weather
from greenroof_ros.weather.table import Row, Rows, Table, arrange, read_rows

# The longest gap (h) that is filled, by linear interpolation between the hours before and after.
# Temperature, wind and evapotranspiration follow the sun, so half a day must remain to show their
# course; dew point and pressure follow the air mass, which changes within days. Rain is not filled
# here.
MAX_GAP_H = {
    "temperature": 6, "wind speed": 6, EVAPOTRANSPIRATION: 6, "dew point": 24,
    "station pressure": 24,
}

_SUFFIXES = ".csv", ".gz", ".txt", ".json"
# Offsets from a missing hour to the hours at the same time of day whose mean replaces it.
_SAME_TIME_OF_DAY = 24 * np.array([-3, -2, -1, 1, 2, 3])


def default_weather() -> Path:
    """Return the path of the paper's weather, which is the default."""
    return shared_directory() / "config" / "weather" / "toronto_2021-07.csv"


def read_file(file: Path, site: Place, described: Description | None = None) -> list[Rows]:
    """Return the rows of a weather file; see :func:`.table.read_rows`.

    JSON is read as an answer of Open-Meteo, whose rain has rows of its own.

    Raises:
        ConfigurationError: if the file does not conform to its description.
    """
    if file.suffix != ".json":
        return [read_rows(file, site, quantities.WEATHER, described)]
    if described is not None:
        described.check_unused("JSON of Open-Meteo", file)
    return open_meteo.read_weather_rows(file, site)


def read_measured(files: Sequence[Path], site: Place) -> Records:
    """Read weather files, which may have different formats, and join them without filling gaps.

    Args:
        files: one or more weather files, or descriptions of weather files.
        site: site with its location and clock.

    Raises:
        ConfigurationError: if a file cannot be parsed, or if two files overlap.
    """
    joined = make_hours([
        rows for file, own in expand(files) for rows in read_file(file, site, own)
    ])
    if PRECIPITATION not in joined.values:
        raise ConfigurationError(
            f"contains no {PRECIPITATION}, such as a column 'precipitation [mm/h]' or 'rain [mm]'; "
            "add the file that contains the precipitation", file=joined.source,
        )
    return drop_empty(_drop_partial_hours(joined))


def read_weather(
    files: Sequence[Path], site: Place, method: str | None = None, gaps: str = REFUSE,
    climate: Climate = RECORDED,
) -> Weather:
    """Read weather files as :func:`read_measured` does, and add evapotranspiration.

    Gaps of up to :data:`MAX_GAP_H` hours, within a file or between two files, are filled and noted
    in the records. :class:`greenroof_ros.weather.series.WeatherSeries` rejects a run that needs an
    hour in a longer gap, unless long gaps are also filled.

    Args:
        files: one or more files.
        site: site with its location, which evapotranspiration and some file formats require.
        method: method for evapotranspiration: one of :data:`.evapotranspiration.COMPUTED`, or the
            method of the column in the files. By default, the column in the files is used if there
            is one, and otherwise the most accurate method that the files allow. An empty text
            leaves evapotranspiration unknown (NaN), because a rain gauge does not measure it.
        gaps: treatment of longer gaps, one of :data:`greenroof_ros.weather.series.GAPS`.
        climate: how the climate differs from that of the record.

    Raises:
        ConfigurationError: if a file cannot be parsed, if two files contradict each other, or if
            the method cannot be applied to the files.
    """
    return complete_records(read_measured(files, site), site, method, gaps, climate)


def complete_records(
    measured: Records, site: Place, method: str | None = None, gaps: str = REFUSE,
    climate: Climate = RECORDED,
) -> Weather:
    """Fill gaps in records and add evapotranspiration, as :func:`read_weather` does."""
    measured = change_climate(measured, climate)
    values = {
        quantity: bridge_gaps(series, MAX_GAP_H.get(quantity, 0))
        for quantity, series in measured.values.items()
    }
    minutes = measured.minutes
    if gaps == FILL:
        values = fill_long_gaps(values)
        if minutes is not None:  # the known part of an hour counts
            lost = np.isnan(measured.values[PRECIPITATION])
            minutes = np.where(lost[:, None], np.nan_to_num(minutes), minutes)
            values[PRECIPITATION][lost] = minutes[lost].mean(axis=1)
    records = replace(measured, values=values, minutes=minutes, filled={
        quantity: np.isnan(measured.values[quantity]) & ~np.isnan(series)
        for quantity, series in values.items()
    })
    notes = [*records.left_out]
    if method != "" and TEMPERATURE not in values:
        notes.append(
            "the weather contains no temperature, so no frost is assumed; during frost, nothing "
            "would be pumped"
        )
    if method == "":
        values[EVAPOTRANSPIRATION] = np.full(records.hours, np.nan)
    elif EVAPOTRANSPIRATION in values and method in (None, records.method):
        method = records.method
    elif method is None or method in evapotranspiration.COMPUTED:
        values[EVAPOTRANSPIRATION], method, more = compute_evapotranspiration(records, site, method)
        notes += more
    else:
        own = f", or {records.method} from the column of the file" if records.method else ""
        raise ConfigurationError(
            f"must be one of {', '.join(evapotranspiration.COMPUTED)}{own}: {records.source} "
            "contains no other evapotranspiration", key="evapotranspiration", value=method,
        )
    if climate.temperature_change and method not in (FAO56, HARGREAVES):
        notes.append(
            f"temperature_change changes only the frost: {method or 'no'} evapotranspiration does "
            "not depend on it"
        )
    about = {**vars(records), "method": method, "left_out": (*notes,)}
    return Weather(**about, gaps=gaps, climate=climate)


def drop_empty(records: Records) -> Records:
    """Remove quantities without values from records, and add a note about each quantity.

    Raises:
        ConfigurationError: if precipitation has no values.
    """
    empty = [name for name, series in records.values.items() if np.isnan(series).all()]
    if PRECIPITATION in empty:
        raise ConfigurationError(
            "has no precipitation: every value is missing, or no hour has 45 minutes of values; "
            f"{TIPS}", file=records.source,
        )
    notes = [f"{records.source} contains no values of {name}" for name in empty]
    return replace(
        records,
        values={name: series for name, series in records.values.items() if name not in empty},
        method="" if EVAPOTRANSPIRATION in empty else records.method,
        left_out=(*records.left_out, *notes),
    )


def compute_evapotranspiration(
    records: Records, site: Place, method: str | None = None
) -> tuple[Array, str, list[str]]:
    """Return the evapotranspiration in every hour (mm/day; NaN if missing), its method, and notes.

    Args:
        records: records from which quantities without values have been removed.
        site: site with its location and its monthly means.
        method: one of :data:`.evapotranspiration.COMPUTED`. The default is ``fao56``, or
            ``hargreaves`` if the records contain temperature but lack other quantities that
            ``fao56`` requires. The default is ``monthly`` if the records contain no temperature or
            no complete day of temperatures, or if the site is beyond a polar circle.

    Raises:
        ConfigurationError: if the records or the site lack data that the method requires.
    """
    lacking = [name for name in quantities.FOR_EVAPOTRANSPIRATION if name not in records.values]
    means = evapotranspiration.repeat_monthly(records, site)
    if method is None:
        method = evapotranspiration.HARGREAVES if lacking else evapotranspiration.FAO56
        if TEMPERATURE in lacking:
            method, lacking = evapotranspiration.MONTHLY, [TEMPERATURE]
        elif means is not None and evapotranspiration.is_polar(site):
            method, lacking = evapotranspiration.MONTHLY, ["sunrise each day"]
        elif lacking and means is not None and np.isnan(
            evapotranspiration.compute_hargreaves(records, site)
        ).all():
            method, lacking = evapotranspiration.MONTHLY, ["a day with 18 hours of temperature"]
    for_want = f", for lack of {', '.join(lacking)}" if lacking else ""
    if method == evapotranspiration.MONTHLY:
        if means is None:
            raise ConfigurationError(
                "has no temperature, from which evapotranspiration is computed, and no column "
                "'evapotranspiration [mm/day]'; set monthly_evapotranspiration in the site file to "
                "use monthly means", file=records.source,
            )
        note = f"evapotranspiration is taken from the site's monthly means{for_want}"
        return means, method, [note]
    if method == evapotranspiration.HARGREAVES:
        return evapotranspiration.compute_hargreaves(records, site), method, [
            "evapotranspiration is computed from each day's minimum and maximum temperature "
            f"(hargreaves, FAO-56 Eq. 52){for_want}"
        ]
    series = evapotranspiration.compute_fao56(records, site)
    computed = np.isnan(records.values.get(quantities.RADIATION, series)) & ~np.isnan(series)
    return series, method, [
        f"solar radiation is missing for {np.count_nonzero(computed)} hours, for which it is "
        "computed from the day's temperatures (FAO-56 Eq. 50)"
    ] * bool(computed.any())


def _drop_partial_hours(records: Records) -> Records:
    """Drop the first or last hour if it is incomplete due to partial rain or shifted quantities.

    Hours must be dropped after joining, because a file may complete the last hour of the previous
    file. Notes state the rain that is dropped, and the rain that is added by hours known in part.
    """
    moved = np.array([name in records.shifted for name in records.values])
    known = ~np.isnan([series[[0, -1]] for series in records.values.values()])
    rain, partial = list(records.values).index(PRECIPITATION), np.zeros(2, dtype=bool)
    notes = list[str]()
    if records.minutes is not None:
        unknown, hourly = np.isnan(records.minutes), records.values[PRECIPITATION]
        partial = ~unknown[[0, -1]].all(axis=1) & ~known[rain]
        if lost := np.nansum(records.minutes[[0, -1]][partial]) / 60:
            notes.append(
                f"{lost:.3g} mm of rain in the first or last hour are left out, because less than "
                "45 min of the hour are known"
            )
        if added := np.nansum(hourly * unknown.mean(axis=1)):
            notes.append(
                f"{added:.3g} mm of rain are added, because up to 15 min of an hour that are "
                "missing count as the mean of its other minutes"
            )
    if moved.any() and not moved.all():
        partial |= ~known[~moved, 0].any(), ~known[moved, 1].any()
    begin, end = int(partial[0]), records.hours - int(partial[1])
    records = replace(records, left_out=(*records.left_out, *notes))
    return records.cut(begin, end) if end > begin else records


def write_plain(files: Sequence[Path], site: Place) -> str | None:
    """Return files that have a description as one text in this project's own form, or else None.

    A copy of a weather file in another directory would no longer have its description.
    """
    if not any(described is not None for _, described in expand(files)):
        return None
    return write_records(read_measured(files, site), "Written from files with a description.")


def find_files(names: Iterable[str], key: str) -> list[Path]:
    """Find the files with given names or patterns (``data/2021_*.csv``), without duplicates.

    A name that contains ``*``, ``?`` or ``[`` is a pattern, unless a file with this name exists. A
    directory stands for all CSV and JSON files in it.

    Args:
        names: names of files, or patterns.
        key: option or parameter that contains the names, for messages.

    Raises:
        ConfigurationError: if a pattern or directory matches no file, or no names are given.
    """
    files = dict[Path, None]()
    for name in names:
        path = Path(name)
        if path.is_dir():
            matches = sorted(file for file in path.iterdir() if file.suffix in _SUFFIXES)
        elif path.exists() or not glob.has_magic(name):
            matches = [find_shipped(path)]
        else:
            matches = sorted(map(Path, glob.glob(name)))  # noqa: PTH207
        if not matches:
            raise ConfigurationError(
                f"matches no file (of a directory, {', '.join(_SUFFIXES)} are read)", key=key,
                value=name,
            )
        files |= dict.fromkeys(matches)
    if not files:
        raise ConfigurationError("must name at least one file", key=key)
    return [*files]


def expand(paths: Iterable[Path]) -> Iterator[tuple[Path, Description | None]]:
    """Yield the weather files among the paths, with their own descriptions if they have one."""
    for path in paths:
        if path.suffix not in (".yaml", ".yml"):
            yield path, None
            continue
        described = read_description(path)
        if not described.file:
            raise ConfigurationError(
                "must name a weather file beside this description, or a pattern", file=path,
                key="file",
            )
        for file in find_files([str(path.parent / described.file)], f"file in {path}"):
            yield file, described


def fill_long_gaps(values: Mapping[str, Array]) -> dict[str, Array]:
    """Fill missing values: rain with 0, other quantities with the mean of the adjacent days.

    The mean is taken over the known or interpolated values at the same time of day on the three
    days before and the three days after. If none of these values is known, the hour remains
    missing. Years with a few estimated hours are more useful than fragments of years, but rain that
    was not measured is lost, so gaps are filled only at the user's request.
    """
    return {
        quantity: np.where(
            np.isnan(series),
            0.0 if quantity == PRECIPITATION else _average_days_around(series), series,
        )
        for quantity, series in values.items()
    }


def _average_days_around(series: Array) -> Array:
    """Return the mean of the adjacent days for every hour; NaN if no value is known."""
    edge = _SAME_TIME_OF_DAY[-1]
    hours = np.arange(len(series)) + edge
    near = np.pad(series, edge, constant_values=np.nan)[hours + _SAME_TIME_OF_DAY[:, None]]
    known = np.count_nonzero(~np.isnan(near), axis=0)
    return np.where(known > 0, np.nansum(near, axis=0) / np.maximum(known, 1), np.nan)


_NAME = Path("the data frame")


def is_frame(value: Any) -> bool:
    """Return whether a value is a polars or pandas data frame."""
    return hasattr(value, "columns") and hasattr(value, "to_numpy")


def read_frame(frame: Any, site: Place) -> Records:
    """Return the records in a data frame.

    Args:
        frame: data frame with a column ``time`` or, in pandas, an index of times.
        site: site whose clock applies to times without an offset.

    Raises:
        ConfigurationError: if a column or a value is invalid; the message states the row, counted
            from 0.
    """
    if not len(frame):
        raise ConfigurationError("must have rows", file=_NAME)
    names = [*map(str, frame.columns)]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError("is the name of more than one column", file=_NAME, key=twice[0])
    times = _list_times(frame)
    if not times or not isinstance(times[0], (str, date)):
        expected = "must be a column of the data frame, or its index must consist of times"
        raise ConfigurationError(expected, file=_NAME, key=TIME)
    if hasattr(frame, "notna"):  # pandas has several values that stand for a missing one
        frame = frame.astype(object).where(frame.notna(), None)
    series = {str(name): [*frame[name]] for name in frame.columns} | {TIME: times}
    rows = [*map(Row, itertools.count(), zip(*series.values(), strict=True))]
    table = Table(_NAME, [*series], None, rows)
    return make_hours([arrange(table, Description(name="data frame"), site, WEATHER)])


def find_zone(frame: Any) -> tzinfo | None:
    """Return the time zone of a data frame's times; None if they have no zone or are text."""
    zone: Any = getattr(next(iter(_list_times(frame)), None), "tzinfo", None)
    return ZoneInfo(zone.zone) if hasattr(zone, "zone") else zone  # from pytz, as in older pandas


def _list_times(frame: Any) -> list[Any]:
    return [*(frame[TIME] if TIME in frame.columns else getattr(frame, "index", ()))]
