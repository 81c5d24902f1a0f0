"""The trajectory of a run, sample by sample, its files, which are bit-exact, and its metrics."""

from __future__ import annotations

import io
import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.times import epoch_ns, read_start
from greenroof_ros.physics.cistern import mains_inflow
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.soil import flows_in_tick, layer_outflow
from greenroof_ros.results.metrics import Metrics
from greenroof_ros.results.table import refuse_forked_polars
from greenroof_ros.site.site import Site

if TYPE_CHECKING:
    import polars

Samples = NDArray[np.float64]
Time: TypeAlias = str | datetime | None

TRAJECTORY, CSV = "trajectory.parquet", "trajectory.csv"
"""name of the file in a run's directory: for a study or Python, and for the command"""


class Column(NamedTuple):
    """A quantity of a trajectory."""

    name: str
    """name in files and tables; it ends with the unit"""
    tick: str
    """attribute of a tick of a run in one process"""
    attribute: str = ""
    """attribute of a :class:`Trajectory`; empty if it is computed from the others and the site"""
    topic: str = ""
    """topic in a bag, in which the volumes are levels; empty if it is not recorded"""
    needs: str = ""
    """key of the sites that have it; empty if all have it"""


# The columns besides the times, in the order of files and tables.
COLUMNS = (
    Column("cistern_m3", "x1", "cistern", "/cistern/level"),
    Column("roof_m3", "x2", "roof", "/roof/level"),
    Column("cistern_level_m", "cistern_level"),
    Column("roof_level_m", "roof_level"),
    Column("precipitation_m_per_s", "precipitation", "precipitation", "/weather/precipitation"),
    Column(
        "evapotranspiration_m3_per_s", "evapotranspiration", "evapotranspiration",
        "/weather/evapotranspiration",
    ),
    Column("command", "command", "command", "/pump/command"),
    Column("pump_flow_m3_per_s", "flows.pump", "pump_flow", "/pump/flow"),
    Column("outflow_m3_per_s", "flows.outflow", "outflow", "/cistern/outflow"),
    Column("drainage_m3_per_s", "flows.drainage", "drainage", "/roof/drainage"),
    Column("frost", "frost", "frost", "/weather/frost"),
    Column("drainage_layer_m3", "layer", "layer", needs="drainage_storage"),
    Column("outlet_command", "outlet", "outlet", "/outlet/command", "low_outlet_valve"),
    Column(
        "low_outlet_flow_m3_per_s", "flows.low_outlet", "low_outlet", "/outlet/flow",
        "low_outlet_valve",
    ),
    Column(
        "other_flow_m3_per_s", "flows.other", "other", "/cistern/other_flow",
        "monthly_other_demand",
    ),
    Column(
        "other_demand_m3_per_s", "flows.other_demand", "other_demand", "/cistern/other_demand",
        "monthly_other_demand",
    ),
    Column("mains_flow_m3_per_s", "flows.mains", "mains", needs="mains_level"),
    Column("wet", "wet", "wet"),
)


def columns_of(site: Site) -> list[Column]:
    """Return the columns of a site's files and tables."""
    return [column for column in COLUMNS if not column.needs or getattr(site, column.needs)]


def recorded_columns(site: Site) -> list[Column]:
    """Return the columns of a :class:`Trajectory` that a bag of a site contains."""
    return [column for column in columns_of(site) if column.topic]


# Name of every column of a trajectory's file, by its attribute.
_NAMES = {
    "time": "time_s", **{column.attribute: column.name for column in COLUMNS if column.attribute},
}
_OPTIONAL = {column.name for column in COLUMNS if column.needs or not column.topic}


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """The trajectory of a run, sample by sample; every array has shape (n,).

    Attributes:
        start: time of the first sample, with its offset from UTC.
        time: time since ``start`` (s).
        cistern: water volume x1 in the cistern (m3).
        roof: water volume x2 on the roof (m3).
        precipitation: rain rate (m/s).
        evapotranspiration: evapotranspiration from the whole bed (m3/s), not yet limited to the
            water on the roof.
        command: command to the pump, as a share of the pumps' maximum flow (1).
        pump_flow: flow from the cistern to the roof (m3/s).
        outflow: flow from the cistern to the sewer (m3/s).
        drainage: drainage from the roof (m3/s).
        frost: 1 during frost, otherwise 0.
        outlet: command to the outlet valve, as a share of its full opening (1); None without a
            valve.
        low_outlet: the part of the outflow through the low outlet (m3/s); None without a valve.
        layer: water in the drainage layer (m3); None without one, or if it was not recorded.
        other: flow from the cistern to other uses than the roof (m3/s); None without any.
        other_demand: water that other uses need (m3/s); None without any.
        mains: flow of mains water into the cistern (m3/s); None without a mains supply, or if it
            was not recorded.
        wet: 1 in wet weather, otherwise 0; None if it was not recorded.
    """

    start: datetime
    time: Samples
    cistern: Samples
    roof: Samples
    precipitation: Samples
    evapotranspiration: Samples
    command: Samples
    pump_flow: Samples
    outflow: Samples
    drainage: Samples
    frost: Samples
    outlet: Samples | None = None
    low_outlet: Samples | None = None
    layer: Samples | None = None
    other: Samples | None = None
    other_demand: Samples | None = None
    mains: Samples | None = None
    wet: Samples | None = None

    def between(self, start: Time, end: Time) -> Trajectory:
        """Return the samples from one time to another; None stands for the first or last sample.

        Raises:
            ConfigurationError: if a time is invalid, or if there are fewer than two samples.
        """
        low, high = (
            extreme if time is None
            else (read_start(str(time), self.start.tzinfo) - self.start).total_seconds()
            for time, extreme in ((start, 0.0), (end, math.inf))
        )
        kept = (low <= self.time) & (self.time <= high)
        if kept.sum() < 2:
            raise ConfigurationError("must include two samples of the run", key="start and end")
        samples: dict[str, Any] = {
            name: values[kept] for name, values in vars(self).items()
            if isinstance(values, np.ndarray)
        }
        first = samples["time"][0]
        samples["time"] -= first
        return replace(self, start=self.start + timedelta(seconds=first), **samples)

    def to_frame(self) -> polars.DataFrame:
        """Return a table with the time in its zone, in microseconds, and all arrays.

        The zone is that of ``start``, or UTC if the offset is not in whole hours, because such an
        offset has no zone name.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        refuse_forked_polars()
        with require_extra("study"):
            import polars
        since_1970 = epoch_ns(self.start) // 1000 + np.rint(1e6 * self.time).astype(np.int64)
        time = polars.Series(since_1970).cast(polars.Datetime("us", "UTC"))
        return polars.DataFrame({
            "time": time.dt.convert_time_zone(zone_name(self.start)),
            **{
                name: getattr(self, attribute) for attribute, name in _NAMES.items()
                if getattr(self, attribute) is not None
            },
        })

    def to_parquet(self) -> bytes:
        """Return the content of a parquet file that :func:`read_trajectory` can read.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        stream = io.BytesIO()
        self.to_frame().write_parquet(
            stream, compression="zstd", metadata={"start": self.start.isoformat()}
        )
        return stream.getvalue()


def zone_name(time: datetime) -> str:
    """Return the name of a time's zone, such as Etc/GMT+5 for an offset of -05:00."""
    if isinstance(time.tzinfo, ZoneInfo):
        return time.tzinfo.key
    hours = (time.utcoffset() or timedelta()) / timedelta(hours=1)
    return f"Etc/GMT{-hours:+g}" if hours and hours.is_integer() else "UTC"


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory from a parquet file, or from the CSV file of ``greenroof simulate``.

    Raises:
        ConfigurationError: if the file cannot be read, is damaged or is not a trajectory, or if
            polars is not installed.
    """
    refuse_forked_polars()
    with require_extra("study"):
        import polars
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"cannot be read: {error.strerror}", file=path) from error
    try:
        if path.suffix == ".csv":
            numbers = dict.fromkeys(_NAMES.values(), polars.Float64)
            table = polars.read_csv(content, schema_overrides=numbers)
            start = datetime.fromisoformat(table["time"][0])
        else:
            about = polars.read_parquet_metadata(io.BytesIO(content))
            start = datetime.fromisoformat(about["start"])
            table = polars.read_parquet(io.BytesIO(content))
        columns = {
            attribute: table[name] for attribute, name in _NAMES.items()
            if name in table.columns or name not in _OPTIONAL
        }
        if start.utcoffset() is None or not all(
            len(column) and column.dtype == polars.Float64 and not column.null_count()
            for column in columns.values()
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
        start=start, **{attribute: column.to_numpy() for attribute, column in columns.items()}
    )


# --- metrics of a recording -----------------------------------------------------------------------

# A longer time without samples is a change of the clock; only its part of a day is counted (s).
_CLOCK_GAP_S, _DAY_S = 366 * 86400, 86400
_DISCHARGE = "discharge", "wet_discharge", "peak_discharge", "retention"
# The metrics that are not known without a column, by the beginnings of their names.
_UNKNOWN = {
    "outflow": ("outflow", "overflow", *_DISCHARGE),
    "low_outlet": ("overflow",),
    "drainage": ("drainage", "roof_retention", *_DISCHARGE),
    "precipitation": ("rain", "roof_retention", "retention"),
}
_SUMMED = (
    "cistern", "roof", "precipitation", "evapotranspiration", "command", "pump_flow", "outflow",
    "drainage", "low_outlet", "other", "other_demand",
)


def compute_results(
    site: Site, trajectory: Trajectory, not_recorded: Collection[str] = ()
) -> dict[str, float]:
    """Return the metrics of a recorded run, without those that need more than was recorded.

    The samples are held until the next one, and read at the middle of every tick: a simulation has
    a sample at the start of each tick, a live site at irregular times. Evapotranspiration, the
    drainage layer and mains water are not recorded, and are computed.

    Args:
        site: site of the run.
        trajectory: at least two samples of the run, before which it has not rained.
        not_recorded: attributes of the trajectory that are 0 because they were not recorded.
    """
    spacings = np.diff(trajectory.time, prepend=0.0)
    time = np.cumsum(np.where(spacings > _CLOCK_GAP_S, spacings % _DAY_S, spacings))
    p, ticks = plant_parameters(site), round(float(time[-1]) / site.tau)
    columns = (getattr(trajectory, name) for name in _SUMMED)
    nothing = np.zeros_like(time)
    samples = np.transpose([nothing if each is None else each for each in columns]).tolist()
    metrics = Metrics(site, ticks, trajectory.start.timestamp())
    layer = site.initial_layer
    for i in np.searchsorted(time[1:-1], (np.arange(ticks) + 0.5) * p.tau).tolist():
        x1, x2, rain, potential, command, pump, outflow, drainage, low_outlet, *other = samples[i]
        percolated, evaporated, _ = flows_in_tick(p, x2, rain * p.a2 + pump, potential)
        mains = mains_inflow(p, x1, outflow + pump - rain * p.effective_catchment, p.tau)
        metrics.add(
            State(x1, x2, layer), command, rain, potential,
            Flows(outflow, pump, drainage, evaporated, False, mains, low_outlet, *other),
        )
        drained = layer_outflow(p, layer, percolated, p.tau)
        layer = max(0.0, layer + p.tau * (percolated - drained))
    missing = {*not_recorded}
    if site.low_outlet_level is not None and trajectory.low_outlet is None:
        missing.add("low_outlet")
    unknown = ("limited", *(start for name in missing for start in _UNKNOWN.get(name, ())))
    results = metrics.results(State(samples[-1][0], samples[-1][1], layer)).metrics
    return {name: value for name, value in results.items() if not name.startswith(unknown)}

