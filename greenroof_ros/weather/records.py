"""Hourly records of a weather station, with what is missing in them and how it was filled."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HOUR = timedelta(hours=1)
PRECIPITATION = "precipitation"
EVAPOTRANSPIRATION = "evapotranspiration"

# Quantity: unit, least and largest believable value. More than the world's record of an hour's
# rain, or of a day's evapotranspiration, is a wrong unit and not weather.
QUANTITIES = {
    PRECIPITATION: ("mm/h", 0.0, 500.0),
    EVAPOTRANSPIRATION: ("mm/day", 0.0, 50.0),
    "temperature": ("degC", -90.0, 60.0),
    "dew point": ("degC", -90.0, 60.0),
    "wind speed": ("km/h", 0.0, 500.0),
    "station pressure": ("kPa", 50.0, 110.0),
    "solar radiation": ("W/m2", 0.0, 1500.0),
}

# What evapotranspiration is computed of, where it is not given.
FOR_EVAPOTRANSPIRATION = ("temperature", "dew point", "wind speed", "station pressure")

# The longest gap that is filled, by a straight line between the hours before and after it (h).
# Temperature and wind follow the sun, so half a day must be left to see it by; dew point and
# pressure follow the air mass, which changes within days. Rain is never guessed.
LONGEST_GAP = {"temperature": 6, "wind speed": 6, "dew point": 24, "station pressure": 24}


@dataclass(frozen=True)
class Records:
    """Hour after hour, each record for the hour that starts at its time.

    Attributes:
        file: where they come from.
        first: start of the first hour, with its offset from UTC.
        values: of each quantity of :data:`QUANTITIES` that the file has, in its unit there,
            shape (hours,); NaN where missing.
        method: how the evapotranspiration among them was made; empty if there is none.
        filled: for each quantity, whether an hour was missing and filled, shape (hours,).
    """

    file: Path
    first: datetime
    values: dict[str, NDArray[np.float64]]
    method: str = ""
    filled: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def hours(self) -> int:
        """How many there are."""
        return len(self.values[PRECIPITATION])


def gaps(missing: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return where values are missing, as (first, one past the last) of each gap."""
    padded = np.concatenate(([False], missing, [False])).astype(np.int8)
    edges = np.flatnonzero(np.diff(padded))
    return [(int(low), int(high)) for low, high in zip(edges[::2], edges[1::2], strict=True)]


def fill_gaps(records: Records) -> Records:
    """Fill the gaps of at most :data:`LONGEST_GAP` hours that have records on both sides."""
    values, filled = dict(records.values), dict(records.filled)
    for quantity, longest in LONGEST_GAP.items():
        if quantity not in values:
            continue
        series = values[quantity].copy()
        missing = np.isnan(series)
        for low, high in gaps(missing):
            if high - low <= longest and low > 0 and high < len(series):
                series[low:high] = np.interp(
                    np.arange(low, high), [low - 1, high], [series[low - 1], series[high]]
                )
        values[quantity] = series
        filled[quantity] = missing & ~np.isnan(series)
    return Records(records.file, records.first, values, records.method, filled)


def name_hours(first: datetime, hours: Iterable[int]) -> list[str]:
    """Name hours by the spans that they form.

    Args:
        first: start of hour 0.
        hours: indices.

    Returns:
        One text a span: ``2021-07-20T13:00-05:00``, or from the first to the last hour of it with
        their number.
    """
    indices: Sequence[int] = sorted(hours)
    if not indices:
        return []
    marks = np.zeros(indices[-1] + 1, dtype=np.bool_)
    marks[list(indices)] = True
    spans = []
    for low, high in gaps(marks):
        text = (first + low * HOUR).isoformat(timespec="minutes")
        if high - low > 1:
            last = (first + (high - 1) * HOUR).isoformat(timespec="minutes")
            text += f" to {last} ({high - low} hours)"
        spans.append(text)
    return spans
