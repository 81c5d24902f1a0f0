"""Weather in a data frame of polars or pandas, with the columns of a file in our own format."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.processes import refuse_forked_polars
from greenroof_ros.formats.hourly import Records
from greenroof_ros.model.site import Site
from greenroof_ros.weather.reading import read_measured

_NAME = "weather.csv"


def is_frame(value: Any) -> bool:
    """Whether a value is a data frame of polars or pandas."""
    return hasattr(value, "columns") and (
        hasattr(value, "write_csv") or hasattr(value, "to_csv")
    )


def read_frame(frame: Any, site: Site) -> Records:
    """Return the records of a data frame, as of a file with the same columns.

    Args:
        frame: with a column ``time``, or in pandas an index of times.
        site: its clock is the one of times without an offset.

    Raises:
        ConfigurationError: a column or a value is wrong.
    """
    with TemporaryDirectory(prefix="greenroof-") as directory:
        file = Path(directory, _NAME)
        file.write_text(_write_csv(frame), encoding="utf-8")
        try:
            records = read_measured([file], site)
        except ConfigurationError as error:
            text = str(error).replace(str(file), "the data frame")
            raise ConfigurationError(text) from error
    return replace(records, files=(Path(_NAME),))


def _write_csv(frame: Any) -> str:
    text: str
    if hasattr(frame, "write_csv"):
        refuse_forked_polars()
        import polars

        known = frame.with_columns(polars.selectors.float().fill_nan(None))
        text = known.write_csv(datetime_format="%Y-%m-%dT%H:%M:%S%.f%:z" if any(
            getattr(kind, "time_zone", None) for kind in frame.dtypes
        ) else None)
        return text
    if "time" not in frame.columns:
        frame = frame.rename_axis("time").reset_index()
    text = frame.to_csv(index=False)
    return text
