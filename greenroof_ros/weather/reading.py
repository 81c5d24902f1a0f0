"""Weather files: which are meant, and the weather that they give."""

from __future__ import annotations

import glob
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.formats.reading import read_records
from greenroof_ros.formats.records import (
    EVAPOTRANSPIRATION,
    HOUR,
    PRECIPITATION,
    Records,
    join,
)
from greenroof_ros.model.site import Site
from greenroof_ros.weather.evapotranspiration import FAO56, fao56
from greenroof_ros.weather.filling import FILL, REFUSE, fill_long_gaps, fill_short_gaps
from greenroof_ros.weather.series import Weather

# At and below this temperature there is frost: nothing is pumped (degC).
_FREEZING = 0.0


def default_weather() -> Path:
    """Return the weather of the paper, which is used unless another is given."""
    return shared_directory() / "config" / "weather" / "toronto_2021-07.csv"


def read_weather(
    files: Sequence[Path], site: Site, method: str | None = None, gaps: str = REFUSE, *,
    rain_only: bool = False,
) -> Weather:
    """Read weather files, each of one of the formats, and join them.

    Gaps of at most :data:`greenroof_ros.weather.filling.LONGEST_GAP` hours, within a file or
    between two, are filled and noted in the records; a run that needs an hour of a longer one is
    refused by :class:`greenroof_ros.weather.series.WeatherSeries`, unless they are filled, too.

    Args:
        files: one or more.
        site: its place on earth, where evapotranspiration is computed or a format needs it.
        method: of the evapotranspiration: ``fao56``, or the files' own column. The
            latter if there is one and otherwise ``fao56``, unless given.
        gaps: one of :data:`greenroof_ros.weather.filling.GAPS`: what is done about longer ones.
        rain_only: leave evapotranspiration unknown (NaN): a rain gauge does not measure it.

    Raises:
        ConfigurationError: a file is broken, two contradict each other, or they cannot give the
            method.
    """
    records = fill_short_gaps(_whole_hours(join([read_records(file, site) for file in files])))
    if gaps == FILL:
        records = fill_long_gaps(records)
    frost = None
    if "temperature" in records.values:
        frost = records.values["temperature"] <= _FREEZING
    if rain_only:
        evapotranspiration, method = np.full(records.hours, np.nan), ""
    elif EVAPOTRANSPIRATION in records.values and method in (None, records.method):
        evapotranspiration, method = records.values[EVAPOTRANSPIRATION], records.method
    elif method in (None, FAO56):
        evapotranspiration, method = fao56(records, site), FAO56
    else:
        own = f", or {records.method} from its own column" if records.method else ""
        raise ConfigurationError(
            f"must be {FAO56}{own}: {records.source} has no evapotranspiration of another name",
            key="evapotranspiration", value=method,
        )
    return Weather(
        records, records.values[PRECIPITATION], evapotranspiration, method, frost, gaps
    )


def _whole_hours(records: Records) -> Records:
    """Leave out the first and last hour where a shift has left each with a part of its quantities.

    This comes after joining: the last hour of one file is completed by the first of the next.
    """
    if not records.shifted:
        return records
    return replace(
        records,
        first=records.first + HOUR,
        values={quantity: series[1:-1] for quantity, series in records.values.items()},
    )


def find_files(names: Iterable[str], key: str, directory: Path = Path()) -> list[Path]:
    """Return the files that names and patterns (``data/2021_*.csv``) stand for, each once.

    A name that no file has is a pattern where it has ``*``, ``?`` or ``[``.

    Args:
        names: of files, relative to the directory.
        key: option or parameter that has them, for messages.
        directory: from which they are seen.

    Raises:
        ConfigurationError: a pattern matches no file, or there are no names.
    """
    found: list[Path] = []
    for name in names:
        path = directory / name
        matches = [path]
        if not path.exists() and glob.has_magic(name):
            matches = [Path(match) for match in sorted(glob.glob(str(path)))]  # noqa: PTH207
            if not matches:
                raise ConfigurationError("matches no file", key=key, value=name)
        found += [match for match in matches if match not in found]
    if not found:
        raise ConfigurationError("must name at least one file", key=key)
    return found
