"""The results of a recorded run, from the same running sums as those of a simulation.

The samples are held until the next one, and read at the middle of every tick: a simulation has a
sample at the start of each tick, a live site at irregular times. Evapotranspiration, the drainage
layer and mains water are not recorded, and are computed.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from greenroof_ros.physics.cistern import mains_inflow
from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.soil import flows_in_tick, layer_outflow
from greenroof_ros.results.metrics import Metrics
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.site.site import Site

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
_COLUMNS = (
    "cistern", "roof", "precipitation", "evapotranspiration", "command", "pump_flow", "outflow",
    "drainage", "low_outlet", "other", "other_demand",
)


def compute_results(
    site: Site, trajectory: Trajectory, not_recorded: Collection[str] = ()
) -> dict[str, float]:
    """Return the metrics of a recorded run, without those that need more than was recorded.

    Args:
        site: site of the run.
        trajectory: at least two samples of the run, before which it has not rained.
        not_recorded: attributes of the trajectory that are 0 because they were not recorded.
    """
    spacings = np.diff(trajectory.time, prepend=0.0)
    time = np.cumsum(np.where(spacings > _CLOCK_GAP_S, spacings % _DAY_S, spacings))
    p, ticks = plant_parameters(site), round(float(time[-1]) / site.tau)
    columns = (getattr(trajectory, name) for name in _COLUMNS)
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
