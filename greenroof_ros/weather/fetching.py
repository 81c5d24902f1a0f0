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

Complete blocks are stored unchanged, and are not requested again.
"""

from __future__ import annotations

import calendar
import hashlib
import itertools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta, timezone
from pathlib import Path
from urllib.parse import urlsplit

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import replace_file, replace_text
from greenroof_ros.base.http import (
    ServiceError,
    check_url,
    name_url,
    read_reason,
    request,
)
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.times import FIRST_YEAR, duration
from greenroof_ros.formats import eccc
from greenroof_ros.formats.cells import HOUR
from greenroof_ros.formats.hourly import Records
from greenroof_ros.formats.open_meteo import VARIABLES
from greenroof_ros.formats.own_csv import write_records
from greenroof_ros.formats.quantities import PRECIPITATION
from greenroof_ros.formats.reading import read_records
from greenroof_ros.site.site import Site
from greenroof_ros.weather.reading import read_measured

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
_REQUEST = "request.txt"


@dataclass(frozen=True)
class Block:
    """The part of the period that a single request returns.

    Attributes:
        first: first day of the block.
        last: last day of the block.
        suffix: suffix of the file in which the block is stored.
        parameters: parameters of the request, in addition to those of the source.
    """

    first: date
    last: date
    suffix: str
    parameters: Mapping[str, str | float]

    @property
    def file(self) -> str:
        """Name of the file in which the block is stored."""
        return f"{self.first}_{self.last}{self.suffix}"

    @property
    def hours(self) -> int:
        """Number of hours in the block."""
        return 24 * ((self.last - self.first).days + 1)


@dataclass(frozen=True)
class Source:
    """A weather service, and the requests sent to it.

    Attributes:
        about: description and licence of the data, as lines for the head of a file.
        url: URL of the API; its query string may contain a key.
        parameters: parameters of every request.
        blocks: blocks to request, in chronological order.
        pause_s: pause between a response and the next request (s).
        check: function that raises ServiceError if a response does not contain the whole block.
    """

    about: str
    url: str
    parameters: Mapping[str, str | float]
    blocks: Sequence[Block]
    pause_s: float
    check: Callable[[bytes, Block], None]


def open_meteo_archive(site: Site, years: range, today: date, url: str = "") -> Source:
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
    for name in ("latitude", "longitude"):
        if getattr(site, name) is None:
            raise ConfigurationError(
                "must be in the site file, because weather is fetched for the site's location",
                key=name,
            )
    newest = today - _DELAY
    if newest.year < years[-1]:
        raise ConfigurationError(
            f"must end with {newest.year} or earlier, because the archive ends {_DELAY.days} "
            "days before today",
            key="years", value=years[-1],
        )
    end = min(date(years[-1] + 1, 1, 1), newest)
    starts = [max(date(years[0], 1, 1) - timedelta(days=1), date(FIRST_YEAR, 1, 1))]
    starts += [date(year, 1, 1) for year in years[1:]]
    ends = [*(start - timedelta(days=1) for start in starts[1:]), end]
    parameters: dict[str, str | float] = {
        "latitude": float(site.latitude or 0), "longitude": float(site.longitude or 0),
        "hourly": ",".join(VARIABLES.values()), "timezone": "GMT",
    }
    return Source(
        "Reanalysis weather from Open-Meteo.com, Historical Weather API (ERA5, ECMWF IFS): "
        "https://open-meteo.com\n"
        "Licence: CC BY 4.0 (credit the source). The service is free for non-commercial use.",
        check_url(url or _OPEN_METEO_URL, [*parameters, "start_date", "end_date"]), parameters, [
            Block(first, last, ".json", {"start_date": f"{first}", "end_date": f"{last}"})
            for first, last in zip(starts, ends, strict=True)
        ],
        3.0, _check_open_meteo,
    )


def eccc_station(
    station: int, site: Site, years: range, today: date, url: str = ""
) -> Source:
    """Return the bulk files of a station as a source, with one block per month.

    Args:
        station: ``stationID`` of the station, which differs from its climate identifier.
        site: site near the station, whose UTC offset is used for the files.
        years: years of the files.
        today: today's date.
        url: URL of the API; if empty, the service's own URL.

    Raises:
        ConfigurationError: if the UTC offset is missing from the site file, if a year is in the
            future, or if the URL is not a web address.
    """
    if site.utc_offset is None:
        raise ConfigurationError(
            "must be in the site file, as in 'utc_offset: -5.0', because ECCC's files are in local "
            "standard time", key="utc_offset"
        )
    if today.year < years[-1]:
        raise ConfigurationError("is in the future", key="years", value=years[-1])
    months = [
        (year, month) for year in years for month in range(1, 13) if date(year, month, 1) <= today
    ]
    parameters: dict[str, str | float] = {
        "format": "csv", "stationID": station, "Day": 14, "timeframe": 1,
    }
    return Source(
        "Observations from Environment and Climate Change Canada, Historical Data, hourly bulk "
        f"files of stationID {station}: https://climate.weather.gc.ca\n"
        "Licence: Open Government Licence - Canada (credit the source).",
        check_url(url or _ECCC_URL, [*parameters, "Year", "Month"]), parameters, [
            Block(
                date(year, month, 1),
                min(date(year, month, calendar.monthrange(year, month)[1]), today), ".csv",
                {"Year": year, "Month": month},
            )
            for year, month in months
        ],
        1.0, lambda body, block: _check_eccc(body, block, is_over=block.last < today),
    )


def _check_open_meteo(body: bytes, block: Block) -> None:
    try:
        content = json.loads(body)
    except (ValueError, RecursionError):
        raise ServiceError(f"sent invalid or incomplete JSON: {read_reason(body)}") from None
    hourly = content.get("hourly") if isinstance(content, dict) else None
    if not isinstance(hourly, dict):
        raise ServiceError(f"sent no hourly values: {read_reason(body)}")
    lacking = [name for name in VARIABLES.values() if name not in hourly]
    if lacking:
        raise ServiceError(f"sent no {', '.join(lacking)}", is_final=True)
    times = hourly.get("time")
    if not isinstance(times, list) or len(times) != block.hours:
        hours = len(times) if isinstance(times, list) else 0
        raise ServiceError(f"sent {hours} hours instead of {block.hours}")
    if str(times[0])[:10] != str(block.first):
        raise ServiceError(f"sent hours that start at {times[0]} instead of {block.first}")
    rain = hourly[VARIABLES[PRECIPITATION]]
    if isinstance(rain, list) and all(value is None for value in rain):
        raise ServiceError("sent no precipitation values", is_final=True)


def _check_eccc(body: bytes, block: Block, *, is_over: bool) -> None:
    if not eccc.recognises(body):
        raise ServiceError(f"sent no bulk file: {read_reason(body) or 'nothing'}")
    lines = body.splitlines()
    hours = len(lines) - 1
    is_cut = not body.endswith(b"\n") and lines[-1].count(b",") < lines[0].count(b",")
    if is_cut or (is_over and 0 < hours < block.hours):
        raise ServiceError(f"broke off after {hours} of {block.hours} hours")
    if hours and str(block.first).encode() not in lines[1]:
        raise ServiceError(f"sent a different month: {read_reason(lines[1])}")


def prepare_directory(directory: Path, source: Source) -> None:
    """Create the directory that stores the blocks of a source until all blocks have arrived.

    Raises:
        ConfigurationError: if the directory contains blocks from a different request, for instance
            for a different site.
    """
    asked = "".join(f"{key}: {value}\n" for key, value in source.parameters.items())
    if query := urlsplit(source.url).query:  # it may contain a key
        asked += f"query: SHA-256 {hashlib.sha256(query.encode()).hexdigest()}\n"
    claim, asked = directory / _REQUEST, f"{name_url(source.url)}\n{asked}"
    directory.mkdir(exist_ok=True)
    kept = claim.read_text(encoding="utf-8", errors="replace") if claim.exists() else ""
    if any(directory.glob("*_*")) and kept != asked:
        raise ConfigurationError(
            f"contains parts from a different request ({_REQUEST}); remove this directory, or "
            "choose another output",
            file=directory,
        )
    replace_text(claim, asked)


def fetch(
    source: Source, site: Site, directory: Path, pause_s: float | None,
    progress: ProgressBar,
) -> list[Path]:
    """Fetch the blocks that are not in a directory yet, and return the files of all blocks.

    Args:
        source: service and blocks to fetch.
        site: site, whose location and clock are used to read the responses.
        directory: directory of the blocks, prepared by :func:`prepare_directory`.
        pause_s: pause between requests (s); None for the pause of the source.
        progress: progress bar that shows the current block, and the reasons for repeated requests.

    Raises:
        ServiceError: if a block could not be fetched in eight attempts, or if another attempt would
            be pointless.
        ConfigurationError: if a response does not match the site.
        OSError: if a block cannot be stored.
    """
    pause_s = source.pause_s if pause_s is None else pause_s
    files = [directory / block.file for block in source.blocks]
    due = [
        number for number, block in enumerate(source.blocks)
        if not _is_whole(files[number], source, block)
    ]
    for number in due:
        block, share = source.blocks[number], number / len(files)
        if number != due[0]:
            time.sleep(pause_s)
        for attempt in itertools.count(1):
            progress.show(f"{block.first} to {block.last}", share)
            try:
                _fetch_block(source, site, block, files[number])
                break
            except ServiceError as error:
                wait = max(pause_s * _WAIT_PAUSES * 2 ** (attempt - 1), _find_wait(error))
                if error.is_final or attempt == _ATTEMPTS or wait > _MAX_WAIT_S:
                    raise ServiceError(f"{block.first} to {block.last}: {error}") from error
                progress.print_line(f"{error}; next attempt in {duration(wait)}")
                time.sleep(wait)
    return files


def _is_whole(file: Path, source: Source, block: Block) -> bool:
    """Return whether a block is stored and undamaged; a power cut, for instance, can damage it."""
    try:
        source.check(file.read_bytes(), block)
    except (FileNotFoundError, ServiceError):
        return False
    return True


def _fetch_block(source: Source, site: Site, block: Block, file: Path) -> None:
    """Fetch a block, check it, and store it under the block's file name.

    Raises:
        ServiceError: if the service does not send the whole block.
        ConfigurationError: if the response does not match the site.
        OSError: if the block cannot be stored.
    """
    body = request(source.url, {**source.parameters, **block.parameters})[0]
    try:
        source.check(body, block)
    except ServiceError as error:
        name = name_url(source.url)
        raise ServiceError(f"{name}: {error}", is_final=error.is_final) from error
    answer = file.with_name(f"answer{block.suffix}")
    replace_file(answer, lambda stream: stream.write(body))
    if not _is_empty(answer):
        read_records(answer, site)
    answer.replace(file)


def _find_wait(error: ServiceError) -> float:
    """Return the waiting time requested by a service (s); 0 if it requests none."""
    asked = [seconds for words, seconds in _ASKED_S.items() if words in str(error)]
    return max([error.wait, *asked])


def _is_empty(file: Path) -> bool:
    """Return whether a block contains no hours, as in a month before the station existed."""
    return file.suffix == ".csv" and len(file.read_bytes().splitlines()) < 2


def join_blocks(files: Sequence[Path], site: Site, years: range) -> Records:
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
    return replace(
        records, first=first + begin * HOUR,
        values={name: series[begin:end] for name, series in records.values.items()},
    )


def write_weather(source: Source, records: Records, now: datetime) -> str:
    """Return fetched records as the text of a file in this project's format, with their source."""
    return write_records(
        records, f"{source.about}\nFetched on {now:%Y-%m-%d}; the time of an hour is its start, "
        f"UTC{records.first.isoformat()[-6:]}."
    )
