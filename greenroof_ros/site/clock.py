"""Quiet hours: times of day on the local clock during which the pump must stay off."""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from datetime import datetime, timedelta, tzinfo
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

_SECOND_NS = 1_000_000_000
_MINUTE_NS = 60 * _SECOND_NS
_DAY_S, _DAY_MINUTES = 86_400, 1440
# Number of days kept: more than a look-ahead with the days after its forecast.
_MAX_DAYS = 60
# 24:00 can only be an end.
_INTERVAL = re.compile(
    r"([01][0-9]|2[0-3]):([0-5][0-9])-([01][0-9]|2[0-3]|24(?=:00)):([0-5][0-9])"
)


class QuietHours:
    """Intervals of the day in a time zone, with daylight saving time taken into account.

    A minute is quiet if the local clock shows a time within an interval. Therefore an interval in
    the hour that the clock skips in spring does not occur on that day, and an interval in the hour
    that the clock repeats in autumn occurs twice.
    """

    def __init__(self, intervals: Sequence[str], zone: tzinfo) -> None:
        """Read the intervals.

        Args:
            intervals: intervals such as ``22:00-06:00``, which includes 22:00 but not 06:00.
            zone: time zone of the clock.

        Raises:
            ValueError: if an interval is invalid, or if the intervals leave no time for pumping.
        """
        self._zone = zone
        self._by_clock = np.zeros(_DAY_MINUTES, dtype=bool)
        clock = np.arange(_DAY_MINUTES)
        for interval in intervals:
            match = _INTERVAL.fullmatch(interval)
            if match is None:
                raise ValueError(f"{interval} is not an interval")
            hour, minute, last_hour, last_minute = map(int, match.groups())
            begin, end = 60 * hour + minute, 60 * last_hour + last_minute
            quiet = (begin <= clock, clock < end)
            self._by_clock |= np.logical_and(*quiet) if begin < end else np.logical_or(*quiet)
        if self._by_clock.all():
            raise ValueError("the intervals leave no time for pumping")

    def quiet_at(self, time_ns: int) -> bool:
        """Return whether a time (ns since 1970) is within the quiet hours."""
        day, minute = divmod(time_ns // _MINUTE_NS, _DAY_MINUTES)
        return bool(self._by_clock[_clock(day, self._zone)[minute]])

    def quiet_ticks(self, start_ns: int, tick_ns: int, ticks: int) -> NDArray[np.bool_]:
        """Return whether each tick of a run is within the quiet hours, shape (ticks,).

        Args:
            start_ns: time of the first tick (ns since 1970).
            tick_ns: duration of a tick (ns).
            ticks: number of ticks.
        """
        minutes = (start_ns + tick_ns * np.arange(ticks)) // _MINUTE_NS
        first = int(minutes[0] // _DAY_MINUTES)
        days = range(first, int(minutes[-1] // _DAY_MINUTES) + 1)
        quiet = np.concatenate([self._day(day) for day in days])
        return np.asarray(quiet[minutes - first * _DAY_MINUTES])

    def end_after(self, time_ns: int) -> datetime:
        """Return the local end of the quiet hours that contain a time (ns since 1970)."""
        day, minute = divmod(time_ns // _MINUTE_NS, _DAY_MINUTES)
        while self._day(day)[minute:].all():
            day, minute = day + 1, 0
        minute += int(self._day(day)[minute:].argmin())
        return datetime.fromtimestamp(day * _DAY_S + minute * 60, self._zone)

    def pumping_shares(self, time_ns: int, edges: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of every step during which the pump may run (1).

        Args:
            time_ns: start of the first step (ns since 1970).
            edges: boundaries of the steps (s from ``time_ns``), starting with 0, shape (n + 1,).
        """
        first, since_midnight = divmod(time_ns, _DAY_S * _SECOND_NS)
        ends = since_midnight / _SECOND_NS + edges
        days = range(first, first + int(ends[-1] // _DAY_S) + 1)
        may_pump = np.concatenate([~self._day(day) for day in days])
        seconds = 60.0 * np.concatenate(([0], may_pump.cumsum()))
        pumped = np.interp(ends, 60.0 * np.arange(len(seconds)), seconds)
        return np.minimum(np.diff(pumped) / np.diff(edges), 1.0)

    def _day(self, day: int) -> NDArray[np.bool_]:
        """Return a mask of the quiet minutes of a UTC day (counted in days since 1970)."""
        return self._by_clock[_clock(day, self._zone)]


@functools.cache
def standard_offset(zone: str) -> float:
    """Return the current UTC offset of a time zone's standard time (h).

    In Ireland, summer time is the standard time by law, but winter time counts as standard here.
    """
    offsets = (datetime(2026, month, 15, tzinfo=ZoneInfo(zone)).utcoffset() for month in (1, 7))
    return min(offset or timedelta() for offset in offsets) / timedelta(hours=1)


@functools.lru_cache(_MAX_DAYS)
def _clock(day: int, zone: tzinfo) -> NDArray[np.intp]:
    """Return the local time of every minute of a UTC day, in minutes since midnight."""
    times = (
        datetime.fromtimestamp(day * _DAY_S + 60 * minute, zone) for minute in range(_DAY_MINUTES)
    )
    return np.array([60 * time.hour + time.minute for time in times])
