"""The trajectory of a run, sample by sample, and its files, which are exact to the bit."""

from __future__ import annotations

import io
from dataclasses import dataclass, field, fields
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError, in_extra
from greenroof_ros.common.times import epoch_ns

if TYPE_CHECKING:
    import polars

Samples = NDArray[np.float64]

TRAJECTORY, CSV = "trajectory.parquet", "trajectory.csv"
"""The file's name in the directory of a run: of a study or of Python, and of the command."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """The trajectory of a run, sample by sample; each array has shape (n,).

    Attributes:
        start: time of the first sample, with its offset from UTC.
        time: since the start (s).
        cistern: water volume x1 (m3).
        roof: water volume x2 (m3).
        precipitation: rain (m/s).
        evapotranspiration: from the whole bed (m3/s), not yet limited to the water on the roof.
        command: share of the pumps' maximum flow (1).
        pump_flow: from the cistern to the roof (m3/s).
        outflow: from the cistern to the sewer (m3/s).
        drainage: from the roof (m3/s).
        frost: 1 in frost, else 0.
    """

    start: datetime
    time: Samples = field(metadata={"column": "time_s"})
    cistern: Samples = field(metadata={"column": "cistern_m3"})
    roof: Samples = field(metadata={"column": "roof_m3"})
    precipitation: Samples = field(metadata={"column": "precipitation_m_per_s"})
    evapotranspiration: Samples = field(metadata={"column": "evapotranspiration_m3_per_s"})
    command: Samples = field(metadata={"column": "command"})
    pump_flow: Samples = field(metadata={"column": "pump_flow_m3_per_s"})
    outflow: Samples = field(metadata={"column": "outflow_m3_per_s"})
    drainage: Samples = field(metadata={"column": "drainage_m3_per_s"})
    frost: Samples = field(metadata={"column": "frost"})

    def to_frame(self) -> polars.DataFrame:
        """Return it as a table: the time with its zone, to the microsecond, and each array.

        The zone is from ``start``, or UTC if its offset is not of whole hours: others have no name.

        Raises:
            ConfigurationError: polars is not installed.
        """
        with in_extra("study"):
            import polars
        since_1970 = epoch_ns(self.start) // 1000 + np.rint(1e6 * self.time).astype(np.int64)
        time = polars.Series(since_1970).cast(polars.Datetime("us", "UTC"))
        return polars.DataFrame({
            "time": time.dt.convert_time_zone(_zone_name(self.start)),
            **{column: getattr(self, name) for name, column in _COLUMNS.items()},
        })

    def to_parquet(self) -> bytes:
        """Return the content of a file for :func:`read_trajectory`.

        Raises:
            ConfigurationError: polars is not installed.
        """
        stream = io.BytesIO()
        self.to_frame().write_parquet(
            stream, compression="zstd", metadata={"start": self.start.isoformat()}
        )
        return stream.getvalue()


# Attribute: column of the file.
_COLUMNS: dict[str, str] = {
    column.name: column.metadata["column"] for column in fields(Trajectory) if column.metadata
}


def _zone_name(time: datetime) -> str:
    """Return the name of a time's zone, such as Etc/GMT+5 for an offset of -05:00."""
    if isinstance(time.tzinfo, ZoneInfo):
        return time.tzinfo.key
    hours = (time.utcoffset() or timedelta()) / timedelta(hours=1)
    return f"Etc/GMT{-hours:+g}" if hours and hours.is_integer() else "UTC"


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory, a parquet file or the command's CSV.

    Raises:
        ConfigurationError: the file cannot be read, is damaged or is not a trajectory, or polars is
            not installed.
    """
    with in_extra("study"):
        import polars
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error.strerror}", file=path) from error
    columns = list(_COLUMNS.values())
    try:
        if path.suffix == ".csv":
            numbers = dict.fromkeys(columns, polars.Float64)
            table = polars.read_csv(
                content, columns=["time", *columns], schema_overrides=numbers
            )
            start = datetime.fromisoformat(table["time"][0])
        else:
            start = datetime.fromisoformat(
                polars.read_parquet_metadata(io.BytesIO(content))["start"]
            )
            table = polars.read_parquet(io.BytesIO(content), columns=columns)
        table = table.select(columns)
        if (
            start.utcoffset() is None or table.is_empty()
            or set(table.dtypes) != {polars.Float64} or any(table.null_count().row(0))
        ):
            raise ValueError
    except (
        polars.exceptions.PolarsError, polars.exceptions.PanicException, KeyError, IndexError,
        TypeError, ValueError,
    ) as error:
        raise ConfigurationError(
            "is empty, truncated or not a trajectory; repeat the run", file=path
        ) from error
    return Trajectory(
        start=start, **{name: table[column].to_numpy() for name, column in _COLUMNS.items()}
    )
