"""When a model's forecasts are issued, and which records it may use.

A forecast is issued every 6 hours, at 00, 06, 12 and 18 UTC. It is known from its time of issue on,
or so many hours later as a service takes to compute it, and is the newest until the next is. Where
records do not begin on a whole hour of UTC, an issue counts from the first hour of the records that
begins after it. The issue that is the newest where the records begin was made before them: it keeps
its own time, and the first record stands for the hours before it.
"""

from __future__ import annotations

from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.formats.issue import ISSUE_HOURS as ISSUE_HOURS
from greenroof_ros.formats.records import name_hours
from greenroof_ros.weather.series import Weather


def newest_issue(first: datetime, hour: int) -> tuple[int, int]:
    """Return when the newest forecast in an hour of the records was made.

    Args:
        first: start of hour 0.
        hour: index of the hour.

    Returns:
        Hours since 1970, and the index of the first hour of the records from then on, which is
        negative for one made before them.
    """
    since_1970 = hours_since_1970(first)
    issue = (since_1970 + hour) // ISSUE_HOURS * ISSUE_HOURS
    return issue, issue - since_1970


def records_at(
    weather: Weather, quantity: str, hours: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return records; the first stands for those before it, and the last for those after it.

    Raises:
        ConfigurationError: one of them is missing.
    """
    series: NDArray[np.float64] = getattr(weather, quantity)
    index = np.clip(hours, 0, len(series) - 1)
    values = series[index]
    if np.isnan(values).any():
        missing = np.unique(index[np.isnan(values)])
        raise ConfigurationError(
            f"{quantity} is missing at {', '.join(name_hours(weather.first, missing))}, of which "
            "the run's forecasts are made; choose another window or another kind of forecast",
            file=weather.source,
        )
    return values
