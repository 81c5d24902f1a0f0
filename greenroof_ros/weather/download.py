"""Download of past weather from a service, in blocks that are checked, stored and joined.

**Open-Meteo**'s Historical Weather API provides reanalyses (ERA5, ECMWF IFS) for any location, from
1940 to a few days ago. The service answers one request at a time, and allows 600 requests per
minute, 5,000 per hour and 10,000 per day; a request for more than two weeks counts as more than one
request. If the service rejects a request, the required wait is stated only in the text of the
response, not in a header. The data are licensed under CC BY 4.0, and the service is free for
non-commercial use.

**ECCC**, the climate archive of Environment and Climate Change Canada, provides bulk files with the
observations of a station, one file per month. The files also contain rows for hours without
observations; for a month in which the station did not exist, the file contains only a header. The
data are licensed under the Open Government Licence - Canada.

Complete blocks are stored unchanged, and are not requested again. The name of a block's file
contains a digest of the request, so that no block of a different request is used.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from greenroof_ros.base.console import ProgressBar
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.http import ServiceError, check_url, name_url, request
from greenroof_ros.base.times import FIRST_YEAR, duration, to_minutes
from greenroof_ros.site.site import Place
from greenroof_ros.weather.description import find_service
from greenroof_ros.weather.open_meteo import VARIABLES, make_parameters
from greenroof_ros.weather.quantities import PRECIPITATION
from greenroof_ros.weather.read import read_file, read_measured
from greenroof_ros.weather.records import HOUR, Records, make_hours

_OPEN_METEO_URL = "https://archive-api.open-meteo.com/v1/archive"
_ECCC_URL = "https://climate.weather.gc.ca/climate_data/bulk_data_e.html"
# The reanalysis does not include the most recent days yet.
_DELAY = timedelta(days=6)
# Wait after the first failure, as a multiple of the usual pause (every further failure doubles it);
# and the number of attempts.
_WAIT_PAUSES, _ATTEMPTS = 5, 8
# Longest wait that a service may ask for (s); if it asks for more, the command ends.
_MAX_WAIT_S = 3700.0
# Waits for which Open-Meteo asks when it turns a request down (s), by its words.
_ASKED_S = {"in one minute": 60.0, "in the next hour": 3600.0, "tomorrow": 86_400.0}


class Block(NamedTuple):
    """The part of the period that a single request returns."""

    first: date
    """first day of the block"""
    last: date
    """last day of the block"""
    parameters: dict[str, str | float]
    """parameters of the request"""
    is_over: bool = True
    """whether all hours have been observed; False in the present month"""

    def __str__(self) -> str:
        """Return the days of the block."""
        return f"{self.first} to {self.last}"


class Source(NamedTuple):
    """A weather service, and the requests sent to it."""

    about: str
    """description and licence of the data, as lines for the head of a file"""
    url: str
    """URL of the API; its query string may contain a key"""
    blocks: Sequence[Block]
    """blocks to request, in chronological order"""
    pause_s: float
    """pause between a response and the next request (s)"""
    quantities: Collection[str] = ()
    """quantities that every block contains; a station may have none"""

    def files(self, directory: Path) -> list[Path]:
        """Return the files of all blocks in a directory."""
        suffix = "json" if self.quantities else "csv"
        asked = (f"{self.url} {block.parameters}".encode() for block in self.blocks)
        digests = (hashlib.sha256(text).hexdigest()[:12] for text in asked)  # it may contain a key
        return [
            directory / f"{block.first}_{block.last}_{digest}.{suffix}"
            for block, digest in zip(self.blocks, digests, strict=True)
        ]


def open_meteo_archive(site: Place, years: range, today: date, url: str = "") -> Source:
    """Return Open-Meteo's archive as a source for a site, with one block per year.

    Years follow the site's clock, but blocks are in UTC, so the blocks include an additional day at
    each end.

    Args:
        site: site with a latitude and a longitude.
        years: years to fetch, on the site's clock.
        today: today's date.
        url: URL of the API; if empty, the service's own URL.

    Raises:
        ConfigurationError: if the location is missing from the site file, if the years extend into
            the future, or if the URL is not a web address.
    """
    newest, last = today - _DELAY, years[-1]
    if newest.year < last:
        raise ConfigurationError(
            f"must end with {newest.year} or earlier, because the archive ends {_DELAY.days} "
            "days before today", key="years", value=last,
        )
    starts = [date(year, 1, 1) for year in (*years, last + 1)]
    starts[0] = max(starts[0] - timedelta(days=1), date(FIRST_YEAR, 1, 1))
    ends = [start - timedelta(days=1) for start in starts[1:-1]]
    ends.append(min(starts[-1], newest))
    blocks = [
        Block(start, end, make_parameters(site, start_date=f"{start}", end_date=f"{end}"))
        for start, end in zip(starts, ends, strict=False)
    ]
    return Source(
        "Reanalysis weather from Open-Meteo.com, Historical Weather API (ERA5, ECMWF IFS): "
        "https://open-meteo.com\n"
        "Licence: CC BY 4.0 (credit the source). The service is free for non-commercial use.",
        check_url(url or _OPEN_METEO_URL), blocks, 3.0, tuple(VARIABLES),
    )


def eccc_station(station: int, years: range, today: date, url: str = "") -> Source:
    """Return the bulk files of a station as a source, with one block per month.

    Args:
        station: ``stationID`` of the station, which differs from its climate identifier.
        years: years of the files.
        today: today's date.
        url: URL of the API; if empty, the service's own URL.

    Raises:
        ConfigurationError: if a year is in the future, or if the URL is not a web address.
    """
    if today.year < years[-1]:
        raise ConfigurationError("is in the future", key="years", value=years[-1])
    blocks = []
    for first in (date(year, month, 1) for year in years for month in range(1, 13)):
        last = min((first + timedelta(days=31)).replace(day=1) - timedelta(days=1), today)
        if first <= today:
            blocks.append(Block(first, last, {
                "format": "csv", "stationID": station, "Day": 14, "timeframe": 1,
                "Year": first.year, "Month": first.month,
            }, last < today))
    return Source(
        "Observations from Environment and Climate Change Canada, Historical Data, hourly bulk "
        f"files of stationID {station}: https://climate.weather.gc.ca\n"
        "Licence: Open Government Licence - Canada (credit the source).",
        check_url(url or _ECCC_URL), blocks, 1.0,
    )


def fetch(source: Source, site: Place, directory: Path, progress: ProgressBar) -> list[Path]:
    """Fetch the blocks that are not in a directory yet, and return the files of all blocks.

    Args:
        source: service and blocks to fetch.
        site: site, whose location and clock are used to read the responses.
        directory: directory of the blocks, which is created if it does not exist.
        progress: progress bar that shows the current block, and the reasons for repeated requests.

    Raises:
        ServiceError: if a block could not be fetched in eight attempts, or if another attempt would
            be pointless.
        ConfigurationError: if a response does not match the site.
        OSError: if a block cannot be stored.
    """
    wait = 0.0
    directory.mkdir(exist_ok=True)
    files = source.files(directory)
    for number, (block, file) in enumerate(zip(source.blocks, files, strict=True)):
        with suppress(ServiceError):  # a power cut, for instance, can damage a stored block
            _check(file, source, block, site)
            continue
        for attempt in range(_ATTEMPTS):
            progress.show(f"{block}", number / len(files))
            time.sleep(wait)
            try:
                body = request(source.url, block.parameters)
                answer = file.with_name(f"answer{file.suffix}")
                answer.write_bytes(body)
                _check(answer, source, block, site)
                answer.replace(file)
                wait = source.pause_s
                break
            except ServiceError as error:
                wait = max(source.pause_s * _WAIT_PAUSES * 2**attempt, _find_wait(error))
                if error.is_final or attempt == _ATTEMPTS - 1 or wait > _MAX_WAIT_S:
                    raise ServiceError(f"{block}: {error}") from error
                progress.print_line(f"{error}; next attempt in {duration(wait)}")
    return files


def _check(file: Path, source: Source, block: Block, site: Place) -> None:
    """Check that a response is for the site and contains the whole block.

    Raises:
        ServiceError: if the response cannot be read, or is not complete.
        ConfigurationError: if the site does not match the response, or lacks what its form needs.
    """
    if _is_empty(file):
        return
    url = name_url(source.url)
    try:
        records = make_hours(read_file(file, site))
    except ConfigurationError as error:
        if error.key in ("latitude", "longitude", "elevation", "utc_offset"):
            raise
        raise ServiceError(f"{url}: {error}") from error
    first, end = records.first, records.first + records.hours * HOUR
    begin, due = (
        datetime.combine(day, datetime.min.time(), first.tzinfo)
        for day in (block.first, block.last + timedelta(days=1))
    )
    if not first <= begin < end or (block.is_over and end < due):
        raise ServiceError(
            f"{url}: sent {to_minutes(first)} to {to_minutes(end)} instead of "
            f"{to_minutes(begin)} to {to_minutes(due)}"
        )
    for quantity in source.quantities:
        series = records.values.get(quantity)
        if series is None or (quantity == PRECIPITATION and np.isnan(series).all()):
            raise ServiceError(f"{url}: sent no {quantity} values", is_final=True)


def _find_wait(error: ServiceError) -> float:
    """Return the waiting time requested by a service (s); 0 if it requests none."""
    return max([error.wait, *(wait for words, wait in _ASKED_S.items() if words in str(error))])


def _is_empty(file: Path) -> bool:
    """Return whether a block contains no hours, as in a month before the station existed."""
    lines = file.read_bytes().splitlines() if file.exists() else []
    return len(lines) == 1 and file.suffix == ".csv" and find_service(
        lines[0].decode("utf-8-sig", "replace")
    ) is not None


def join_blocks(files: Sequence[Path], site: Place, years: range) -> Records:
    """Join blocks, and return the hours that belong to the years on the site's clock.

    Args:
        files: files of the blocks.
        site: the site.
        years: years on the site's clock.

    Raises:
        ConfigurationError: if the blocks contain no precipitation.
    """
    parts = [file for file in files if not _is_empty(file)]
    if not parts:
        raise ConfigurationError("the service has no hourly records for these years")
    records = read_measured(parts, site)
    offset = timedelta(hours=site.clock_offset)
    clock = timezone.utc if offset % HOUR else timezone(offset)  # the service's hours stay whole
    first = records.first.astimezone(clock)
    begin, end = (
        min(max((datetime(year, 1, 1, tzinfo=clock) - first) // HOUR, 0), records.hours)
        for year in (years[0], years[-1] + 1)
    )
    return replace(records, first=first).cut(begin, end)
