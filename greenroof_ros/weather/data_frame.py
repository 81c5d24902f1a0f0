"""Weather in a polars or pandas data frame, with the columns of this project's CSV format."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import tzinfo
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import TextInMemory
from greenroof_ros.base.processes import refuse_forked_polars
from greenroof_ros.formats.hourly import Records
from greenroof_ros.site.site import Place
from greenroof_ros.weather.reading import read_measured

_NAME = "the data frame"


def is_frame(value: Any) -> bool:
    """Return whether a value is a polars or pandas data frame."""
    return hasattr(value, "columns") and (
        hasattr(value, "write_csv") or hasattr(value, "to_csv")
    )


def read_frame(frame: Any, site: Place) -> Records:
    """Return the records in a data frame, which is read like a file with the same columns.

    Args:
        frame: data frame with a column ``time`` or, in pandas, an index of times.
        site: site whose clock applies to times without an offset.

    Raises:
        ConfigurationError: if a column or a value is invalid; the message states the row, counted
            from 0.
    """
    file = TextInMemory(_NAME)
    file.text = _write_csv(frame)
    try:
        return replace(read_measured([file], site), files=(Path(_NAME),))
    except ConfigurationError as error:
        raise ConfigurationError(re.sub(
            rf"(?<=^{_NAME}), line (\d+)",
            lambda match: f", row {int(match[1]) - 2}" if int(match[1]) > 1 else "", str(error),
        )) from error


def find_zone(frame: Any) -> tzinfo | None:
    """Return the time zone of a data frame's times; None if they have no zone or are text."""
    times = frame["time"] if "time" in frame.columns else getattr(frame, "index", ())
    zone: Any = getattr(next(iter(times), None), "tzinfo", None)
    return ZoneInfo(zone.zone) if hasattr(zone, "zone") else zone  # from pytz, as in older pandas


def _write_csv(frame: Any) -> str:
    text: str
    if hasattr(frame, "to_csv") and "time" not in frame.columns and (
        "int" not in str(frame.index.dtype)  # row numbers
    ):
        frame = frame.rename_axis("time").reset_index()
    frame = frame[sorted(frame.columns, key=lambda name: name != "time")]
    if hasattr(frame, "write_csv"):
        refuse_forked_polars()
        import polars

        known = frame.with_columns(polars.selectors.float().fill_nan(None))
        text = known.write_csv(datetime_format="%Y-%m-%dT%H:%M:%S%.f%:z" if any(
            getattr(kind, "time_zone", None) for kind in frame.dtypes
        ) else None)
        return text
    text = frame.to_csv(index=False)
    return text
