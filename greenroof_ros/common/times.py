"""Times: reading them, and as nanoseconds."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, tzinfo

from greenroof_ros.common.errors import ConfigurationError

FIRST_YEAR, LAST_YEAR = 1971, 2037

_EPOCH = datetime.fromisoformat("1970-01-01T00:00+00:00")


def parse_time(text: str) -> datetime:
    """Read an ISO 8601 time; a final ``Z`` stands for UTC.

    Raises:
        ValueError: it is not one, or outside the years that ROS 2 and bag time stamps hold.
    """
    time = datetime.fromisoformat(re.sub(r"[zZ]$", "+00:00", text.strip()))
    if not FIRST_YEAR <= time.year <= LAST_YEAR:
        raise ValueError
    return time


def epoch_ns(time: datetime) -> int:
    """Nanoseconds since 1970-01-01 UTC, without a rounding on the way."""
    return (time - _EPOCH) // timedelta(microseconds=1) * 1000


def from_epoch_ns(nanoseconds: int) -> datetime:
    """Return the time in UTC that is so many nanoseconds after 1970-01-01, to the microsecond."""
    return _EPOCH + timedelta(microseconds=nanoseconds // 1000)


def read_start(text: str, zone: tzinfo | None = None) -> datetime:
    """Read a start time; without an offset from UTC it is in the given zone.

    Raises:
        ConfigurationError: it is not an ISO 8601 time, or has no offset where there is no zone.
    """
    try:
        start = parse_time(text)
    except ValueError:
        raise ConfigurationError(
            "must be a time such as 2021-07-07T02:00-05:00, from 1971 to 2037",
            key="start", value=text,
        ) from None
    if start.utcoffset() is not None:
        return start
    if zone is None:
        raise ConfigurationError(
            "must say its offset from UTC, as in 2021-07-07T02:00-05:00", key="start", value=text
        )
    return start.replace(tzinfo=zone)
