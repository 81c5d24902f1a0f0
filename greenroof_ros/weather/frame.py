"""Weather in a polars or pandas data frame, with the columns of this project's own form."""

from __future__ import annotations

from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from greenroof_ros.site.site import Place
from greenroof_ros.weather.description import TIME, Description
from greenroof_ros.weather.hours import make_hours
from greenroof_ros.weather.quantities import ROOF
from greenroof_ros.weather.records import Records
from greenroof_ros.weather.table import Table, arrange, find_columns, find_times

_NAME = Path("the data frame")


def is_frame(value: Any) -> bool:
    """Return whether a value is a polars or pandas data frame."""
    return hasattr(value, "columns") and (
        hasattr(value, "write_csv") or hasattr(value, "to_csv")
    )


def read_frame(frame: Any, site: Place) -> Records:
    """Return the records in a data frame.

    Args:
        frame: data frame with a column ``time`` or, in pandas, an index of times.
        site: site whose clock applies to times without an offset.

    Raises:
        ConfigurationError: if a column or a value is invalid; the message states the row, counted
            from 0.
    """
    described = Description(name="data frame")
    names = [*map(str, frame.columns)]
    table = Table(_NAME, names, None, iter(()))
    columns, method = find_columns(table, described)
    numbers = {}
    for quantity in columns.keys() - {*ROOF}:
        series = frame[columns[quantity][0]].to_numpy()
        try:
            numbers[quantity] = series.astype(float)
        except (TypeError, ValueError):
            row = next(row for row, value in enumerate(series) if not _is_number(value))
            raise table.refuse_at(
                "must be a number", row, columns[quantity][0], series[row]
            ) from None
        infinite = np.flatnonzero(np.isinf(numbers[quantity]))
        if infinite.size:
            raise table.refuse_at(
                "must be a finite number", int(infinite[0]), columns[quantity][0],
                float(numbers[quantity][infinite[0]]),
            )
    listed = _list_times(frame)
    times = find_times(table, site, described, range(len(listed)), listed)
    return make_hours(_NAME, arrange(table, described, site, columns, method, times, numbers))


def find_zone(frame: Any) -> tzinfo | None:
    """Return the time zone of a data frame's times; None if they have no zone or are text."""
    zone: Any = getattr(next(iter(_list_times(frame)), None), "tzinfo", None)
    return ZoneInfo(zone.zone) if hasattr(zone, "zone") else zone  # from pytz, as in older pandas


def _list_times(frame: Any) -> list[str | datetime]:
    times: Any = frame[TIME] if TIME in frame.columns else getattr(frame, "index", ())
    return [*times]


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True
