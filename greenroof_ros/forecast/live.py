"""The forecasts of a live site, from a file that is replaced regularly or from a service."""

from __future__ import annotations

import bisect
import math
from datetime import datetime, timedelta
from pathlib import Path

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import duration, to_people
from greenroof_ros.forecast.issue import IssuedForecast, read_forecasts
from greenroof_ros.forecast.steps import HourForecast, Outlook
from greenroof_ros.site.site import Site
from greenroof_ros.weather.quantities import EVAPOTRANSPIRATION, TEMPERATURE
from greenroof_ros.weather.records import HOUR, Array

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
