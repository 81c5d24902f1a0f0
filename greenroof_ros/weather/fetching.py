"""Years of past weather over the internet, block by block: fetched, checked, kept, and joined.

**Open-Meteo**, Historical Weather API: reanalyses (ERA5, ECMWF IFS) for any place, from 1940 to
some days ago. One request at a time is answered; 600 a minute, 5,000 an hour and 10,000 a day are
allowed, and one for more than two weeks counts as several. How long a refusal asks to wait is in
its sentence, and in no header. Data are under CC BY 4.0, and the
service is free for non-commercial use.

**ECCC**, the bulk files of Environment and Climate Change Canada's climate archive: a station's
observations, a month in each file. Hours without observations have rows, too; a month in which
there was no station is a header. Data are under the Open Government Licence - Canada.

A block is kept as soon as it is complete, as the service sent it, and is not requested again.
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

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import replace_file, replace_text
from greenroof_ros.common.http_client import (
    ServiceError,
    check_url,
    name_url,
    read_reason,
    request,
)
from greenroof_ros.common.progress import ProgressBar
from greenroof_ros.common.times import FIRST_YEAR, duration
from greenroof_ros.formats import eccc
from greenroof_ros.formats.cells import HOUR
from greenroof_ros.formats.hourly import Records
from greenroof_ros.formats.open_meteo import VARIABLES
from greenroof_ros.formats.own_csv import write_records
from greenroof_ros.formats.reading import read_records
from greenroof_ros.model.site import Site
from greenroof_ros.weather.reading import read_measured

_OPEN_METEO_URL = "https://archive-api.open-meteo.com/v1/archive"
_ECCC_URL = "https://climate.weather.gc.ca/climate_data/bulk_data_e.html"
# The newest days of the reanalysis are not there yet.
_DELAY = timedelta(days=6)
# Wait after a first failure as a multiple of the usual pause; it doubles with each further one.
_WAIT_PAUSES, _ATTEMPTS = 5, 8
# The longest wait that a service can ask for (s): longer, and the command ends.
_MAX_WAIT_S = 3700.0
# What Open-Meteo's refusals ask for (s).
_ASKED_S = {"in one minute": 60.0, "in the next hour": 3600.0, "tomorrow": 86_400.0}
_REQUEST = "request.txt"


@dataclass(frozen=True)
class Block:
    """A part of the years that one request returns.

    Attributes:
        first: its first day.
        last: its last day.
        suffix: suffix of its file.
        parameters: parameters of the request, in addition to the source's.
    """

    first: date
    last: date
    suffix: str
    parameters: Mapping[str, str | float]

    @property
    def file(self) -> str:
        """Name of the file that keeps it."""
        return f"{self.first}_{self.last}{self.suffix}"

    @property
    def hours(self) -> int:
        """Number of its hours."""
        return 24 * ((self.last - self.first).days + 1)


@dataclass(frozen=True)
class Source:
    """A service and what is requested of it.

    Attributes:
        about: description and licence, in lines for the head of a file.
        url: address of the interface; its own query can have a key.
        parameters: parameters of each request.
        blocks: in order of time.
        pause_s: time from an answer to the next request (s).
        check: refuses an answer that is not the whole block; raises ServiceError.
    """

    about: str
    url: str
    parameters: Mapping[str, str | float]
    blocks: Sequence[Block]
    pause_s: float
    check: Callable[[bytes, Block], None]


def open_meteo_archive(site: Site, years: range, today: date, url: str = "") -> Source:
    """Return Open-Meteo's archive at a site: a block a year.

    Years are of the site's clock and blocks of UTC, so there is a day more at either end.

    Args:
        site: its place.
        years: years of the site's clock.
        today: the present day.
        url: address of the interface; if empty, the service's own.

    Raises:
        ConfigurationError: the site file lacks the place, the years are not over, or the URL is not
            of the web.
    """
    for name in ("latitude", "longitude"):
        if getattr(site, name) is None:
            raise ConfigurationError("must be in the site file: its weather is fetched", key=name)
    newest = today - _DELAY
    if newest.year < years[-1]:
        raise ConfigurationError(
            f"must end with {newest.year}: the archive ends {_DELAY.days} days before today",
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
        "Weather of a reanalysis from Open-Meteo.com, Historical Weather API (ERA5, ECMWF IFS): "
        "https://open-meteo.com\n"
        "Licence: CC BY 4.0, name the source. The service is free for non-commercial use.",
        check_url(url or _OPEN_METEO_URL, [*parameters, "start_date", "end_date"]), parameters, [
            Block(first, last, ".json", {"start_date": f"{first}", "end_date": f"{last}"})
            for first, last in zip(starts, ends, strict=True)
        ],
        3.0, _check_open_meteo,
    )


def eccc_station(
    station: int, site: Site, years: range, today: date, url: str = ""
) -> Source:
    """Return the bulk files of a station: a block a month.

    Args:
        station: its ``stationID``, which is not its climate identifier.
        site: near it; its offset from UTC is the files'.
        years: years of the files.
        today: the present day.
        url: address of the interface; if empty, the service's own.

    Raises:
        ConfigurationError: the site file lacks the offset from UTC, a year is in the future, or the
            URL is not of the web.
    """
    if site.utc_offset is None:
        raise ConfigurationError(
            "must be in the site file, as in 'utc_offset: -5.0': ECCC's files are in standard "
            "time", key="utc_offset"
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
        "Observations of Environment and Climate Change Canada, Historical Data, hourly bulk "
        f"files of stationID {station}: https://climate.weather.gc.ca\n"
        "Licence: Open Government Licence - Canada, name the source.",
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
        raise ServiceError(f"sent no JSON, or a part of it: {read_reason(body)}") from None
    hourly = content.get("hourly") if isinstance(content, dict) else None
    if not isinstance(hourly, dict):
        raise ServiceError(f"sent no hourly values: {read_reason(body)}")
    lacking = [name for name in VARIABLES.values() if name not in hourly]
    if lacking:
        raise ServiceError(f"sent no {', '.join(lacking)}", is_passing=False)
    times = hourly.get("time")
    if not isinstance(times, list) or len(times) != block.hours:
        hours = len(times) if isinstance(times, list) else 0
        raise ServiceError(f"sent {hours} hours of {block.hours}")
    if str(times[0])[:10] != str(block.first):
        raise ServiceError(f"sent hours from {times[0]} on, not from {block.first}")


def _check_eccc(body: bytes, block: Block, *, is_over: bool) -> None:
    if not eccc.recognises(body):
        raise ServiceError(f"sent no bulk file: {read_reason(body) or 'nothing'}")
    lines = body.splitlines()
    hours = len(lines) - 1
    is_cut = not body.endswith(b"\n") and lines[-1].count(b",") < lines[0].count(b",")
    if is_cut or (is_over and 0 < hours < block.hours):
        raise ServiceError(f"broke off after {hours} hours of {block.hours}")
    if hours and str(block.first).encode() not in lines[1]:
        raise ServiceError(f"sent another month: {read_reason(lines[1])}")


def prepare_directory(directory: Path, source: Source) -> None:
    """Make the directory that keeps the blocks of a source until all are there.

    Raises:
        ConfigurationError: if it keeps blocks of another request, for instance of another site.
    """
    asked = "".join(f"{key}: {value}\n" for key, value in source.parameters.items())
    if query := urlsplit(source.url).query:  # it can have a key
        asked += f"query: SHA-256 {hashlib.sha256(query.encode()).hexdigest()}\n"
    claim, asked = directory / _REQUEST, f"{name_url(source.url)}\n{asked}"
    directory.mkdir(exist_ok=True)
    kept = claim.read_text(encoding="utf-8", errors="replace") if claim.exists() else ""
    if any(directory.glob("*_*")) and kept != asked:
        raise ConfigurationError(
            f"keeps parts of another request ({_REQUEST}); remove it, or name another output",
            file=directory,
        )
    replace_text(claim, asked)


def fetch(
    source: Source, site: Site, directory: Path, pause_s: float | None,
    progress: ProgressBar,
) -> list[Path]:
    """Fetch the blocks that a directory lacks or has only in part; return all blocks' files.

    Args:
        source: the service, and the blocks.
        site: its place and clock, by which the answers are read.
        directory: keeps the blocks, prepared by :func:`prepare_directory`.
        pause_s: time between requests, instead of the source's (s).
        progress: shows the present block, and why one is requested again.

    Raises:
        ServiceError: a block could not be fetched, though it was tried eight times, unless trying
            again is of no use.
        ConfigurationError: an answer is not of the site.
        OSError: a block cannot be kept.
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
                if not error.is_passing or attempt == _ATTEMPTS or wait > _MAX_WAIT_S:
                    raise ServiceError(f"{block.first} to {block.last}: {error}") from error
                progress.print_line(f"{error}; next attempt in {duration(wait)}")
                time.sleep(wait)
    return files


def _is_whole(file: Path, source: Source, block: Block) -> bool:
    """Return whether a block is kept, and not damaged, as by a power cut."""
    try:
        source.check(file.read_bytes(), block)
    except (FileNotFoundError, ServiceError):
        return False
    return True


def _fetch_block(source: Source, site: Site, block: Block, file: Path) -> None:
    """Fetch a block, check it, and keep it under its name."""
    body = request(source.url, {**source.parameters, **block.parameters}).body
    try:
        source.check(body, block)
    except ServiceError as error:
        name = name_url(source.url)
        raise ServiceError(f"{name}: {error}", is_passing=error.is_passing) from error
    answer = file.with_name(f"answer{block.suffix}")
    replace_file(answer, lambda stream: stream.write(body))
    if not _is_empty(answer):
        read_records(answer, site)
    answer.replace(file)


def _find_wait(error: ServiceError) -> float:
    """Return how long a service asks to be left alone (s); 0 if it does not."""
    asked = [seconds for words, seconds in _ASKED_S.items() if words in str(error)]
    return max([error.wait or 0.0, *asked])


def _is_empty(file: Path) -> bool:
    """Return whether a block has no hours, as a month in which there was no station."""
    return file.suffix == ".csv" and len(file.read_bytes().splitlines()) < 2


def join_blocks(files: Sequence[Path], site: Site, years: range) -> Records:
    """Return the hours of the years that blocks hold, by the site's clock.

    Raises:
        ConfigurationError: they hold no precipitation.
    """
    parts = [file for file in files if not _is_empty(file)]
    if not parts:
        raise ConfigurationError("the service has no hourly records of these years")
    records = read_measured(parts, site)
    offset = timedelta(hours=site.clock_offset)
    clock = timezone.utc if offset % HOUR else timezone(offset)  # hours remain the service's
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
    """Return fetched records as a file in this project's format, which states their source."""
    return write_records(
        records, f"{source.about}\nFetched on {now:%Y-%m-%d}; hours begin at their time, "
        f"UTC{records.first.isoformat()[-6:]}."
    )
