"""The forecasts of a live site: a file that is replaced repeatedly, and a dressing that learns."""

from __future__ import annotations

import bisect
import math
from datetime import datetime, timedelta
from io import FileIO
from pathlib import Path

import numpy as np

from greenroof_ros.common.disk import Kept
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.processes import LockedError, take_lock
from greenroof_ros.common.times import hours_since_1970, to_people
from greenroof_ros.forecast.dressing import dress_issue, dressing_text, read_dressing
from greenroof_ros.forecast.resampling import Known, Outlook, look_ahead_ends
from greenroof_ros.formats.own_csv import read_forecasts
from greenroof_ros.formats.records import EVAPOTRANSPIRATION, HOUR, Issue
from greenroof_ros.model.site import Site

_HOUR_S = 3600.0


class NoForecastError(Exception):
    """There is no forecast for now; the message says why."""


class ForecastFile:
    """A file of forecasts, read again when it is replaced; an invalid file is ignored.

    Attributes:
        issues: of the newest file that could be read; empty before the first.
        problem: what is wrong with the present file; empty if nothing is.
        count: how many files were read.
    """

    def __init__(self, path: Path) -> None:
        """Prepare; nothing is read yet.

        Args:
            path: of the file; see :func:`greenroof_ros.formats.own_csv.read_forecasts`. It must
                have a column of evapotranspiration.
        """
        self.issues: list[Issue] = []
        self.problem = ""
        self.count = 0
        self._path = path
        self._seen: tuple[int, ...] | None = None

    def look(self) -> bool:
        """Read the file if it has changed; return whether a new one was read."""
        try:
            status = self._path.stat()
            seen = (status.st_dev, status.st_ino, status.st_mtime_ns, status.st_size)
            if seen == self._seen:
                return False
            self._seen = seen
            issues = read_forecasts(self._path)
            if issues[0].evapotranspiration is None:
                raise ConfigurationError(
                    f"must have a column '{EVAPOTRANSPIRATION} [mm/day]': a live site has no other "
                    "source of it",
                    file=self._path,
                )
        except OSError as error:
            self.problem, self._seen = f"{self._path}: cannot be read: {error.strerror}", None
            return False
        except ConfigurationError as error:
            self.problem = str(error)
            return False
        self.issues, self.problem = issues, ""
        self.count += 1
        return True


class LiveForecast:
    """Forecasts of the look-ahead at any time, from the newest issue of a file.

    Attributes:
        file: where the forecasts come from.
    """

    def __init__(
        self, file: ForecastFile, site: Site, horizon: float, limit: float, all_members: bool,
        dressing: LiveDressing | None = None,
    ) -> None:
        """Prepare.

        Args:
            file: of forecasts.
            site: tick, look-ahead, and the bed's area, to convert depths to volumes.
            horizon: 0 for the next M ticks one by one; otherwise hours, in steps that grow.
            limit: largest age of the newest issue (s).
            all_members: whether to return rain of all members of an ensemble, or of the first.
            dressing: makes an ensemble of each issue; None for forecasts as they are issued.
        """
        self.file = file
        self._dressing = dressing
        self._area = site.a2
        self._ends = look_ahead_ends(site, horizon)
        self._limit = timedelta(seconds=limit)
        self._all_members = all_members

    def at(self, now: datetime, observed_rain: float | None = None) -> Outlook:
        """Return the outlook at a time.

        Args:
            now: the time.
            observed_rain: rain of the present hour from a gauge (m/s); None if there is none.

        Raises:
            NoForecastError: no issue is new enough and covers the look-ahead.
        """
        issue = self._newest(now)
        if self._dressing is not None:
            issue = self._dressing.dress(issue)
        return self._outlook(issue, now, observed_rain)

    def of_record(
        self, now: datetime, evapotranspiration: float | None, observed_rain: float | None = None
    ) -> Outlook | None:
        """Return an outlook without a forecast: an ensemble of rain from the record.

        None if nothing is dressed, if the controller uses only one member, or if the record is too
        short or the usual evapotranspiration (m3/s) unknown.
        """
        if self._dressing is None or not self._all_members or evapotranspiration is None:
            return None
        try:
            issue = self._dressing.climate(now, evapotranspiration / self._area * 1000 * 86400)
            return self._outlook(issue, now, observed_rain)
        except (ConfigurationError, NoForecastError):
            return None

    def _outlook(self, issue: Issue, now: datetime, observed_rain: float | None) -> Outlook:
        """Return the outlook at a time, from an issue.

        Raises:
            NoForecastError: it ends before the look-ahead does.
        """
        assert issue.evapotranspiration is not None  # a file without it is refused
        end = issue.issued + issue.hours * HOUR
        if now + timedelta(seconds=float(self._ends[-1])) > end:
            raise NoForecastError(
                f"the newest forecast, issued at {to_people(issue.issued)}, ends at "
                f"{to_people(end)}, before the {self._ends[-1] / _HOUR_S:.3g} h look-ahead does; "
                f"a horizon of at most {(end - now) // HOUR} h would work now"
            )
        present = (now - issue.issued) // HOUR
        known = Known(
            issue.issued, issue.rain[:, present:], issue.evapotranspiration[present:], self._area,
            self._ends, observed_rain,
            math.nan if issue.temperature is None else float(issue.temperature[present]),
        )
        return known.at((now - issue.issued).total_seconds() % _HOUR_S, self._all_members)

    def _newest(self, now: datetime) -> Issue:
        """Return the newest issue at a time.

        Raises:
            NoForecastError: the newest issue is too old, or there is none.
        """
        issues = self.file.issues
        if not issues:
            raise NoForecastError("there is no forecast")
        number = bisect.bisect_right([issue.issued for issue in issues], now)
        if not number:
            raise NoForecastError(
                f"the time of the first forecast, {to_people(issues[0].issued)}, is in the future"
            )
        issue = issues[number - 1]
        if now - issue.issued > self._limit:
            raise NoForecastError(
                f"the newest forecast, issued at {to_people(issue.issued)}, is older than "
                f"{self._limit / HOUR:g} h"
            )
        return issue


# An hour is measured if the gauge was good in this share of its ticks (1).
_MEASURED = 0.9


class LiveDressing:
    """The file of a dressing, to which forecasts and the hours that the gauge measures are added.

    Attributes:
        few: why the newest issue is used as it was issued; empty if it is dressed.

    An issue can be an analog once all its hours have passed. The file is written after each hour
    by the disk thread. Only one process adds to a file; others use it as they read it.
    """

    def __init__(self, file: Path, tick_s: float) -> None:
        """Read the file.

        Args:
            file: made by ``greenroof verify --dress``.
            tick_s: time between two readings of the gauge (s).

        Raises:
            ConfigurationError: the file is missing or invalid.
        """
        self._dressing = read_dressing(file)
        self._kept = Kept(file)
        self._ticks_an_hour = 3600.0 / tick_s
        self._hour: int | None = None
        self._sum, self._measured = 0.0, 0  # rain (m/s) and ticks of this hour
        self._newest: tuple[Issue, Issue] | None = None  # as issued, and dressed
        self.few = self._locked = ""
        try:
            self._only: FileIO | None = take_lock(file.with_name(file.name + ".lock"))
        except (LockedError, OSError) as error:
            self._only, self._locked = None, f"nothing is added to it: {error}"

    @property
    def problem(self) -> str:
        """Why the file is not kept up to date; empty if it is."""
        return self._locked or self._kept.problem

    def measure(self, now: datetime, rain: float | None) -> None:
        """Take the gauge's reading in a tick (m/s); None if it has none."""
        hour = hours_since_1970(now)
        if hour != self._hour:
            if self._hour is not None:
                self._end_hour(self._hour)
            self._hour, self._sum, self._measured = hour, 0.0, 0
        if rain is not None:
            self._sum += rain
            self._measured += 1

    def _end_hour(self, hour: int) -> None:
        known = self._measured >= _MEASURED * self._ticks_an_hour
        fell = 3.6e6 * self._sum / self._measured if known else math.nan
        dressing = self._dressing.with_hour(hour, fell)
        if not dressing.issued.size:
            return  # a file must have an issue
        self._dressing = dressing
        if self._only is not None:
            self._kept.write_text(lambda: dressing_text(dressing))

    def dress(self, issue: Issue) -> Issue:
        """Return an issue as the ensemble of its analogs, and add it to the past issues.

        If there are too few analogs, the issue is returned as it was issued.
        """
        if self._newest is None or issue is not self._newest[0]:
            self._dressing = self._dressing.with_issue(issue)
            try:
                dressed, self.few = dress_issue(issue, self._dressing), ""
            except ConfigurationError as error:
                dressed, self.few = issue, str(error)
            self._newest = (issue, dressed)
        return self._newest[1]

    def climate(self, now: datetime, evapotranspiration: float) -> Issue:
        """Return rain from the record as an issue of this hour; the same draw for a whole day.

        Args:
            now: the time.
            evapotranspiration: mm/day.

        Raises:
            ConfigurationError: the record is too short.
        """
        hour = now.replace(minute=0, second=0, microsecond=0)
        day = hours_since_1970(now.replace(hour=0))
        return Issue(
            hour, Path(self._dressing.source), None,
            self._dressing.members(day, np.empty((1, 0))),
            np.full(self._dressing.hours, evapotranspiration),
        )

    def close(self) -> None:
        """Wait at most two seconds for what is being written, and release the file."""
        self._kept.close()
        if self._only is not None:
            self._only.close()
