"""Dressed forecasts at a live site, which adds to what it knows of its forecasts as it runs."""

from __future__ import annotations

import math
from datetime import datetime
from io import FileIO
from pathlib import Path

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.kept import Kept
from greenroof_ros.common.processes import LockedError, take_lock
from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.dressing import dress_issue, dressing_text, read_dressing
from greenroof_ros.formats.issue import Issue

# An hour is measured where the gauge was good in this share of its ticks (1).
_MEASURED = 0.9


class LiveDressing:
    """The file of a dressing; forecasts and the hours that the gauge measures are added to it.

    A forecast counts as an analog once all its hours have passed. The file is written after each
    hour by the disk's thread. One process adds to a file; another one uses it as it finds it.
    """

    def __init__(self, file: Path, tick_s: float) -> None:
        """Read the file.

        Args:
            file: that ``greenroof verify --dress`` has made.
            tick_s: time between two readings of the gauge (s).

        Raises:
            ConfigurationError: there is none, or it is not understood.
        """
        self._dressing = read_dressing(file)
        self._kept = Kept(file)
        self._ticks_an_hour = 3600.0 / tick_s
        self._hour: int | None = None
        self._sum, self._measured = 0.0, 0  # rain (m/s) and ticks of this hour
        self._dressed: Issue | None = None
        self._from: Issue | None = None
        self._few = self._locked = ""
        try:
            self._only: FileIO | None = take_lock(file.with_name(file.name + ".lock"))
        except (LockedError, OSError) as error:
            self._only, self._locked = None, f"nothing is added to it: {error}"

    @property
    def hours(self) -> int:
        """Of a dressed forecast."""
        return self._dressing.hours

    @property
    def few(self) -> str:
        """Why the newest issue is used as it was issued; empty where it is dressed."""
        return self._few

    @property
    def problem(self) -> str:
        """Why what falls is not kept; empty where it is."""
        return self._locked or self._kept.problem

    def measure(self, now: datetime, rain: float | None) -> None:
        """Take what the gauge says in a tick (m/s); None where it says nothing."""
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
        """Return an issue as what fell after those like it, and note it as one to learn from.

        Where too few are known it is returned as it was issued.
        """
        if self._dressed is None or issue is not self._from:
            self._dressing = self._dressing.with_issue(issue)
            try:
                self._dressed, self._few = dress_issue(issue, self._dressing), ""
            except ConfigurationError as error:
                self._dressed, self._few = issue, str(error)
            self._from = issue
        return self._dressed

    def climate(self, now: datetime, evapotranspiration: float) -> Issue:
        """Return a draw from the record, which stays the same for a day, as an issue of this hour.

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
            np.full(self.hours, evapotranspiration),
        )

    def close(self) -> None:
        """Wait two seconds at most for what is being written, and let go of the file."""
        self._kept.close()
        if self._only is not None:
            self._only.close()
