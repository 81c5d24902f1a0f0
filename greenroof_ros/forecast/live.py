"""The forecasts of a live site: from a file that is replaced regularly, or from Open-Meteo.

The service has two interfaces for the same variables: *forecast*, with one series for each
variable, and *ensemble*, with one series for each member (``precipitation``,
``precipitation_member01``, ...). A response does not state which model run it comes from.
A forecast is assumed to be issued in the hour of its arrival, and to be available from its arrival
on, so that no information is used too early. Open-Meteo's data are licensed under CC BY 4.0.

The service allows 600 requests a minute and 10,000 a day; a request for an ensemble of many
variables counts as several requests. One request an hour is far below these limits. The wait before
a new attempt doubles with every failure, from a minute to at most an hour; a status such as 429 can
request a longer wait (``Retry-After``).
"""

from __future__ import annotations

import bisect
import math
import re
import threading
import time
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import replace_text
from greenroof_ros.base.http import ServiceError, check_url, name_url, request
from greenroof_ros.base.times import duration, to_people
from greenroof_ros.forecast.issue import (
    IssuedForecast,
    mend_forecast,
    read_forecasts,
    read_rain,
    write_forecasts,
)
from greenroof_ros.forecast.steps import HourForecast, Outlook
from greenroof_ros.site.site import Site
from greenroof_ros.weather.open_meteo import make_parameters, read_answer, read_weather_rows
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, PRECIPITATION, TEMPERATURE
from greenroof_ros.weather.read import complete_records, drop_empty, fill_long_gaps
from greenroof_ros.weather.records import HOUR, Array, make_hours

_HOUR_S = 3600.0


class NoForecastError(Exception):
    """Error raised if no forecast covers the current time; the message states the reason."""


class ForecastFile:
    """A forecast file that is read again when it is replaced; an invalid file is ignored.

    Attributes:
        issues: forecasts in the latest file that could be read; empty before the first file.
        problem: description of the fault in the current file; empty without a fault.
    """

    def __init__(self, path: Path) -> None:
        """Set the path, without reading the file yet.

        Args:
            path: path of the file; see :func:`greenroof_ros.forecast.issue.read_forecasts`. The
                file must have an evapotranspiration column.
        """
        self.issues: list[IssuedForecast] = []
        self.problem = ""
        self._path = path
        self._file_status: tuple[int, ...] = ()

    def update(self) -> None:
        """Read the file if it has changed."""
        try:
            status = self._path.stat()
            before = self._file_status
            self._file_status = status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size
            if self._file_status == before:
                return
            issues = read_forecasts(self._path)
            if EVAPOTRANSPIRATION not in issues[0].values:
                raise ConfigurationError(
                    f"must have a column '{EVAPOTRANSPIRATION} [mm/day]', because a live site has "
                    "no other source of evapotranspiration", file=self._path,
                )
        except OSError as error:
            self._file_status = ()
            self.problem = f"{self._path} cannot be read: {error.strerror}"
        except ConfigurationError as error:
            self.problem = str(error)
        else:
            self.issues, self.problem = issues, ""


class LiveForecast:
    """Forecasts for the look-ahead at any time, from the latest forecast issued.

    Attributes:
        issues: the known forecasts, in order of their time of issue, all with evapotranspiration.
    """

    def __init__(self, site: Site, ends: Array, limit: float, all_members: bool) -> None:
        """Set the site and the look-ahead, without any forecast yet.

        Args:
            site: site, which provides the tick, the look-ahead, and the bed area used to convert
                depths to volumes.
            ends: boundaries of the steps (s from now), starting at 0; see
                :func:`greenroof_ros.site.horizon.look_ahead_ends`.
            limit: maximum age of the latest forecast (s).
            all_members: whether to return the rain of all members of an ensemble or only of the
                first member.
        """
        self.issues: list[IssuedForecast] = []
        self._site = site
        self._ends = ends
        self._limit = timedelta(seconds=limit)
        self._all_members = all_members

    def at(self, now: datetime, observed_rain: float | None = None) -> Outlook:
        """Return the current weather and the forecast at a given time.

        After the end of the forecast, rain is assumed to be 0, and the evapotranspiration of the
        last day is repeated, as in a simulation.

        Args:
            now: the time.
            observed_rain: current rain from a gauge (m/s); None if there is no gauge.

        Raises:
            NoForecastError: if there is no forecast that is recent enough and covers the current
                hour.
        """
        issue = self._newest(now)
        present = (now - issue.issued) // HOUR
        since = (now - issue.issued).total_seconds() % _HOUR_S
        hours = math.ceil((since + self._ends[-1]) / _HOUR_S)
        rain, evapotranspiration = issue.ahead(present, hours)
        assert evapotranspiration is not None  # an issue without it is rejected
        temperature = issue.values.get(TEMPERATURE)
        measured = () if observed_rain is None else (observed_rain,)
        forecast = HourForecast(
            issue.issued, rain, evapotranspiration, self._site, self._ends, bool(measured),
            math.nan if temperature is None else float(temperature[present]),
        )
        return forecast.at(since, self._all_members, measured)

    def shortage(self, now: datetime) -> str:
        """Return a note, with a remedy, if the latest forecast is too short; else an empty string.

        Raises:
            NoForecastError: if there is no forecast.
        """
        issue, due = self._newest(now), timedelta(seconds=float(self._ends[-1]))
        if now + due <= issue.end:
            return ""
        return (
            f"the forecast issued at {to_people(issue.issued)} ends at {to_people(issue.end)}, "
            f"before the look-ahead of {duration(due.total_seconds())} does; the hours after the "
            "forecast are treated as dry. To cover the look-ahead for as long as it is in use, a "
            f"forecast must be {math.ceil((due + self._limit) / HOUR)} h long, not {issue.hours} h"
        )

    def _newest(self, now: datetime) -> IssuedForecast:
        """Return the latest forecast at a given time.

        Raises:
            NoForecastError: if the latest forecast is too old or has ended, or if there is no
                forecast.
        """
        number = bisect.bisect_right([issue.issued for issue in self.issues], now)
        if not number:
            raise NoForecastError("there is no forecast" + ", only later ones" * bool(self.issues))
        issue, wrong = self.issues[number - 1], ""
        if now - issue.issued > self._limit:
            wrong = f"is older than {duration(self._limit.total_seconds())}"
        elif now >= issue.end:
            wrong = f"ended at {to_people(issue.end)}, after {issue.hours} h"
        if wrong:
            raise NoForecastError(
                f"the latest forecast, issued at {to_people(issue.issued)}, {wrong}"
            )
        return issue


# --- from Open-Meteo ------------------------------------------------------------------------------

OPEN_METEO = "open-meteo"
"""name of the service, given in place of a file of forecasts"""
MAX_DAYS = 16
"""range of the interface "forecast" (days)"""
ATTRIBUTION = "forecasts by Open-Meteo.com, CC BY 4.0"

_FORECAST_URL = "https://api.open-meteo.com/v1/forecast"
_ENSEMBLE_URL = "https://ensemble-api.open-meteo.com/v1/ensemble"
# First and longest wait after a failure (s), unless the service asks for a longer one.
_FIRST_WAIT_S, _LAST_WAIT_S = 60.0, 3600.0

_MEMBER = re.compile(r"precipitation(_member\d\d)?")

# The names of kept forecasts, and how much of them is kept (bytes): half a year of hourly ensembles
# of 50 members, or 20 years of single forecasts.
_STORED_NAME, _MAX_STORED = re.compile(r"\d{14}\.csv"), 2_000_000_000


class Service:
    """Client of the service, which requests one forecast after another."""

    def __init__(
        self, site: Site, *, ensemble: bool = False, model: str = "", days: int = 7, url: str = ""
    ) -> None:
        """Set up the requests, without sending any of them yet.

        Args:
            site: site, including its location.
            ensemble: whether to request all members of an ensemble, or only one series.
            model: name of the weather model in the service, such as ``icon_seamless``; if empty,
                the service chooses a model.
            days: length of the forecast (days), counted from the first hour of the current UTC day.
            url: URL of the interface; if empty, the service's own URL.

        Raises:
            ConfigurationError: if the site file lacks the location, or if the URL does not begin
                with http or https.
        """
        self._site = site
        more = {"models": model} if model else {}
        self._parameters = make_parameters(site, forecast_days=days, **more)
        default = _ENSEMBLE_URL if ensemble else _FORECAST_URL
        self._url = check_url(url or default)

    def fetch(self, now: datetime) -> IssuedForecast:
        """Return the latest forecast, issued in the current hour, with evapotranspiration.

        Args:
            now: the current time, with its offset from UTC.

        Raises:
            ServiceError: if there is no usable forecast.
        """
        hour = now.astimezone(timezone.utc).replace(minute=0, second=0, microsecond=0)
        began = time.monotonic()
        body = request(self._url, self._parameters)
        arrived = now + timedelta(seconds=time.monotonic() - began)
        try:
            return _read_issue(body, self._site, hour, arrived)
        except ConfigurationError as error:
            raise ServiceError(f"{name_url(self._url)}: its response {error.wrong}") from error


def _read_issue(answer: bytes, site: Site, hour: datetime, arrived: datetime) -> IssuedForecast:
    """Convert a response to a forecast that was issued in the hour in which it arrived.

    If evapotranspiration cannot be computed for an hour, it is set to the mean for that time of day
    over the surrounding days. The forecast ends before the first hour that lacks a value.

    Raises:
        ConfigurationError: if the response is not a forecast for the hour and the site.
    """
    file = Path("answer.json")
    measured = make_hours(read_weather_rows(file, site, answer))
    records = complete_records(drop_empty(measured), site)
    members = make_hours([read_rain(*read_answer(file, site, answer), _MEMBER, site)]).values
    start = (hour - records.first) // HOUR
    if not 0 <= start < records.hours:
        raise ConfigurationError(f"must contain the hour from {to_people(hour)} on", file=file)
    values = {
        name: records.values[name][start:]
        for name in (EVAPOTRANSPIRATION, TEMPERATURE) if name in records.values
    }
    values[EVAPOTRANSPIRATION] = fill_long_gaps(records.values)[EVAPOTRANSPIRATION][start:]
    # The series without a number is the control run, member 0.
    values[PRECIPITATION] = np.array([members[name][start:] for name in sorted(members)])
    return mend_forecast(IssuedForecast(hour, arrived, file, None, values, records.left_out))


class ForecastFiles:
    """Files in which forecasts are kept."""

    def __init__(self, newest: Path, archive: Path | None) -> None:
        """Set the files, without writing any of them yet.

        Args:
            newest: file of the latest forecast, which is replaced by every new forecast; any live
                site can read the file.
            archive: directory for all forecasts with new values, of which the latest 2 GB are kept;
                None for no archive.
        """
        self._newest, self._archive = newest, archive
        self._stored: IssuedForecast | None = None

    def write(self, issue: IssuedForecast) -> None:
        """Write a forecast.

        Raises:
            OSError: if the forecast cannot be written, for instance because the disk is full.
        """
        about = "".join(f"# {line}\n" for line in (ATTRIBUTION, *issue.notes))
        text = f"{about}{write_forecasts([issue])}"
        replace_text(self._newest, text, parents=True)
        if self._archive is not None and not (self._stored and issue.repeats(self._stored)):
            kept = self._archive / f"{issue.available:%Y%m%d%H%M%S}.csv"
            replace_text(kept, text, parents=True)
            self._stored = issue
            _remove_oldest(self._archive)


class Fetcher:
    """Fetches forecasts, one after another.

    Attributes:
        problem: reason why the last attempt failed; empty if the attempt succeeded.
        newest: last forecast received; None before the first forecast.
    """

    def __init__(
        self, service: Service, write: Callable[[IssuedForecast], object], every: float
    ) -> None:
        """Set the service and the output, without fetching a forecast yet.

        Args:
            service: service from which forecasts are requested.
            write: function that saves a forecast; if it raises an error, the attempt counts as
                failed.
            every: interval between forecasts (s).
        """
        self.problem = ""
        self.newest: IssuedForecast | None = None
        self._service, self._write, self._every = service, write, every
        self._wait = _FIRST_WAIT_S

    def fetch(self) -> float:
        """Fetch and write a forecast; return the time until the next attempt (s)."""
        try:
            self.newest = self._service.fetch(datetime.now(timezone.utc))
            self._write(self.newest)
        except Exception as error:  # whatever it is, the next forecast is still requested
            self.problem = str(error) or type(error).__name__
            wait = max(self._wait, error.wait if isinstance(error, ServiceError) else 0.0)
            self._wait = min(2 * self._wait, self._every, _LAST_WAIT_S)
            return wait
        self.problem, self._wait = "", _FIRST_WAIT_S
        return self._every

    def start(self) -> None:
        """Fetch forecasts repeatedly in a thread that ends with the process."""
        threading.Thread(target=self._run, name="forecast service", daemon=True).start()

    def _run(self) -> None:
        while True:
            time.sleep(self.fetch())


def _remove_oldest(archive: Path) -> None:
    """Remove the oldest archived forecasts beyond the limit, but never any other file."""
    stored = sorted(file for file in archive.iterdir() if _STORED_NAME.fullmatch(file.name))
    size = 0
    for file in reversed(stored):
        size += file.stat().st_size
        if size > _MAX_STORED:
            file.unlink()
