"""Reading, writing and converting times, and the clock of the machine since it started."""

from __future__ import annotations

import functools
import re
import time
from datetime import datetime, timedelta, timezone, tzinfo
from pathlib import Path

from greenroof_ros.base.errors import ConfigurationError

# The years that the time stamps of ROS 2 and of bags cover in full.
FIRST_YEAR, LAST_YEAR = 1971, 2037

# The start of the paper's window, which is also the example time in messages.
DEFAULT_START = "2021-07-07T02:00-05:00"
_EPOCH = datetime.fromisoformat("1970-01-01T00:00+00:00")

# A date and a time of day, without other forms that Python reads, such as a separator of any kind.
_ISO = re.compile(r"([0-9-]{8,10})(?:[Tt ](.+))?")


@functools.lru_cache(10_000)
def parse_time(text: str, zone: tzinfo | None = None) -> datetime:
    """Read an ISO 8601 time, in the given zone if it has no offset; a final ``Z`` means UTC.

    Fractions of a second are truncated to microseconds; 24:00 is the end of the day.

    Raises:
        ValueError: if the text is not a time from :data:`FIRST_YEAR` to :data:`LAST_YEAR`.
    """
    match = _ISO.fullmatch(text.strip())
    if match is None:
        raise ValueError
    clock = (match[2] or "00:00").replace(" ", "").upper()
    ends_day = clock.startswith("24")
    time = datetime.fromisoformat(f"{match[1]}T{'00' + clock[2:] if ends_day else clock}")
    if ends_day:
        if (time.hour, time.minute, time.second, time.microsecond) != (0, 0, 0, 0):
            raise ValueError
        time += timedelta(days=1)
    if not FIRST_YEAR <= time.year <= LAST_YEAR:
        raise ValueError
    return time if time.tzinfo else time.replace(tzinfo=zone)


def to_minutes(time: datetime) -> str:
    """Format a time in minutes with its offset from UTC, such as ``2021-07-07T02:00-05:00``."""
    return time.isoformat(timespec="minutes")


def to_people(time: datetime) -> str:
    """Format a time for headings, such as ``2021-07-07 02:00-05:00``; omit zero seconds."""
    return time.isoformat(" ", "seconds" if time.second else "minutes")


def clock_time(time: datetime, now: datetime) -> str:
    """Format a time as people say it, such as ``14:01``, with the date unless that is today."""
    return time.strftime("%H:%M" if time.date() == now.date() else "%d %b %H:%M")


def iso(seconds: float) -> str:
    """Format a time (s since 1970) in UTC according to ISO 8601, with milliseconds."""
    return datetime.fromtimestamp(seconds, timezone.utc).isoformat(timespec="milliseconds")


def hours_minutes_seconds(seconds: float) -> str:
    """Format a time since the start of a run in whole seconds, such as ``00:20:34``."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60:02}:{minutes % 60:02}:{rest:02}"


def duration(seconds: float) -> str:
    """Format a duration in a readable form, such as ``40 s``, ``1.5 min``, ``2 h`` or ``120 h``."""
    if seconds < 90:
        return f"{seconds:.3g} s"
    size, unit = (60, "min") if seconds < 5400 else (3600, "h")
    return f"{seconds / size:.1f}".removesuffix(".0") + f" {unit}"


def epoch_ns(time: datetime) -> int:
    """Convert a time to nanoseconds since 1970-01-01 UTC, without intermediate rounding."""
    return (time - _EPOCH) // timedelta(microseconds=1) * 1000


def hours_since_1970(time: datetime) -> int:
    """Convert a time to hours since 1970-01-01 UTC, rounded down."""
    return (time - _EPOCH) // timedelta(hours=1)


def from_epoch_ns(nanoseconds: int) -> datetime:
    """Convert nanoseconds since 1970-01-01 UTC to a time in UTC, with microseconds."""
    return _EPOCH + timedelta(microseconds=nanoseconds // 1000)


def is_skipped(local: datetime) -> bool:
    """Return True if clocks in the time's zone skip the time, as when they go forward in spring."""
    shown = local.astimezone(timezone.utc).astimezone(local.tzinfo)
    return shown.replace(tzinfo=None) != local.replace(tzinfo=None)


def read_start(text: str, zone: tzinfo | None = None) -> datetime:
    """Read a start time, in the given zone if it has no offset from UTC.

    A time in the hour that clocks show twice is interpreted as the first occurrence. The result has
    a fixed offset, because adding durations in a zone with daylight saving time would follow the
    wall clock.

    Args:
        text: the start time.
        zone: time zone of a time without an offset; None if an offset is required.

    Raises:
        ConfigurationError: if the text is not an ISO 8601 time, has no offset although no zone is
            given, or is in an hour that the zone's clocks skip.
    """
    try:
        start = parse_time(text, zone)
    except ValueError:
        raise ConfigurationError(
            f"must be a time such as {DEFAULT_START}, from {FIRST_YEAR} to {LAST_YEAR}",
            key="start", value=text,
        ) from None
    if start.utcoffset() is None:
        raise ConfigurationError(
            f"must include its offset from UTC, as in {DEFAULT_START}", key="start", value=text
        )
    if is_skipped(start):
        raise ConfigurationError(
            f"is a time that the clocks in {start.tzinfo} skip", key="start", value=text
        )
    return start.replace(tzinfo=timezone(start.utcoffset() or timedelta()))


def boot_time() -> float:
    """Return the time since the machine started (s), including time spent suspended.

    ``time.monotonic()`` stops during a suspend, so values measured before a suspend would still
    seem new after it.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@functools.cache
def boot_id() -> str:
    """Return an identifier of the machine's current boot."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


def suspended_time() -> float:
    """Return the total time for which the machine has been suspended since it started (s)."""
    return boot_time() - time.monotonic()
