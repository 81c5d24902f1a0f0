"""Weather in a polars or pandas data frame, with the columns of this project's own form."""

from __future__ import annotations

import itertools
from datetime import date, tzinfo
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.site import Place
from greenroof_ros.weather.description import TIME, Description
from greenroof_ros.weather.quantities import WEATHER
from greenroof_ros.weather.records import Records, make_hours
from greenroof_ros.weather.table import Row, Table, arrange

_NAME = Path("the data frame")


def is_frame(value: Any) -> bool:
    """Return whether a value is a polars or pandas data frame."""
    return hasattr(value, "columns") and hasattr(value, "to_numpy")


def read_frame(frame: Any, site: Place) -> Records:
    """Return the records in a data frame.

    Args:
        frame: data frame with a column ``time`` or, in pandas, an index of times.
        site: site whose clock applies to times without an offset.

    Raises:
        ConfigurationError: if a column or a value is invalid; the message states the row, counted
            from 0.
    """
    if not len(frame):
        raise ConfigurationError("must have rows", file=_NAME)
    names = [*map(str, frame.columns)]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError("is the name of more than one column", file=_NAME, key=twice[0])
    times = _list_times(frame)
    if not times or not isinstance(times[0], (str, date)):
        expected = "must be a column of the data frame, or its index must consist of times"
        raise ConfigurationError(expected, file=_NAME, key=TIME)
    if hasattr(frame, "notna"):  # pandas has several values that stand for a missing one
        frame = frame.astype(object).where(frame.notna(), None)
    series = {str(name): [*frame[name]] for name in frame.columns} | {TIME: times}
    rows = [*map(Row, itertools.count(), zip(*series.values(), strict=True))]
    table = Table(_NAME, [*series], None, rows)
    return make_hours([arrange(table, Description(name="data frame"), site, WEATHER)])


def find_zone(frame: Any) -> tzinfo | None:
    """Return the time zone of a data frame's times; None if they have no zone or are text."""
    zone: Any = getattr(next(iter(_list_times(frame)), None), "tzinfo", None)
    return ZoneInfo(zone.zone) if hasattr(zone, "zone") else zone  # from pytz, as in older pandas


def _list_times(frame: Any) -> list[Any]:
    return [*(frame[TIME] if TIME in frame.columns else getattr(frame, "index", ()))]
