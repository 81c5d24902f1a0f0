"""The results of a recorded run, from the same running sums as those of a simulation.

The samples are held until the next one, and read at the middle of every tick: a simulation has a
sample at the start of each tick, a live site at irregular times. Evapotranspiration, the drainage
layer and mains water are not recorded, and are computed.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.cistern import mains_inflow
from greenroof_ros.physics.compiled import can_compile, compiled
from greenroof_ros.physics.parameters import Flows, PlantParameters, State, plant_parameters
from greenroof_ros.physics.soil import flows_in_tick, layer_outflow
from greenroof_ros.physics.storm_water import Event, is_wet, time_without_rain
from greenroof_ros.results import sums as s
from greenroof_ros.results.metrics import end_run, find_new_days
from greenroof_ros.results.sums import add
from greenroof_ros.results.trajectory import Trajectory
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

# A shorter run is over before the compiled function is loaded (ticks).
_MIN_COMPILED = 500_000
# A longer time without samples is a change of the clock; only its part of a day is counted (s).
_CLOCK_GAP_S, _DAY_S = 366 * 86400, 86400


class Samples(NamedTuple):
    """The recorded values that the sums need, in the units of a trajectory, each of shape (n,)."""

    time: Values
    cistern: Values
    roof: Values
    precipitation: Values
    evapotranspiration: Values
    command: Values
    pump_flow: Values
    outflow: Values
    drainage: Values
    low_outlet: Values


def add_samples(
    p: PlantParameters, sums: Any, events: Any, samples: Samples, new_day: Any, layer: float,
    without_rain: float,
) -> float:
    """Add the ticks of a record to the sums of :func:`.sums.add`.

    Args:
        p: parameters of the plant.
        sums: as for :func:`.sums.add`.
        events: as for :func:`.sums.add`.
        samples: at least two samples; the run ends with the last one.
        new_day: whether each tick is the first of a day of the site's clock, shape (ticks,).
        layer: water in the drainage layer at the start (m3).
        without_rain: time without rain at the start (s).

    Returns:
        The water in the drainage layer at the end (m3).
    """
    i = 0
    for k in range(len(new_day)):
        while i + 2 < len(samples.time) and samples.time[i + 1] < (k + 0.5) * p.tau:
            i += 1
        x1, x2, rain = samples.cistern[i], samples.roof[i], samples.precipitation[i]
        potential, pump, outflow = (
            samples.evapotranspiration[i], samples.pump_flow[i], samples.outflow[i]
        )
        percolated, evaporated, _ = flows_in_tick(p, x2, rain * p.a2 + pump, potential)
        mains = mains_inflow(p, x1, outflow + pump - rain * p.effective_catchment, p.tau)
        without_rain = time_without_rain(without_rain, rain, p.tau)
        add(
            p, sums, events, State(x1, x2, layer), samples.command[i], rain, potential,
            Flows(
                outflow, pump, samples.drainage[i], evaporated, False, mains,
                samples.low_outlet[i],
            ),
            is_wet(without_rain, p.tau, p.wet_after_s), new_day[k],
        )
        drained = layer_outflow(p, layer, percolated, p.tau)
        layer = max(0.0, layer + p.tau * (percolated - drained))
    return layer


def compute_results(
    site: Site, trajectory: Trajectory, not_recorded: Collection[str] = (),
    without_rain: float = math.inf,
) -> dict[str, float]:
    """Return the metrics of a recorded run, without those that need more than was recorded.

    A time without samples of more than a year, as after a clock was set, counts as less
    than a day.

    Args:
        site: site of the run.
        trajectory: at least two samples of the run.
        not_recorded: attributes of the trajectory that are 0 because they were not recorded.
        without_rain: time without rain at the start (s).
    """
    unknown, nothing = [s.LIMITED], np.zeros_like(trajectory.time)
    if {"outflow", "drainage"} & {*not_recorded}:
        unknown += s.DISCHARGE, s.WET_DISCHARGE, s.PEAK_5, s.PEAK_15, s.PEAK_60
    if "outflow" in not_recorded or (site.low_outlet_level is not None and (
        trajectory.low_outlet is None or "low_outlet" in not_recorded
    )):
        unknown += s.OVERFLOW, s.OVERFLOW_DAYS
    columns = (getattr(trajectory, name) for name in Samples._fields)
    arrays = Samples(*(np.array(nothing if each is None else each) for each in columns))
    spacings = np.diff(arrays.time, prepend=0.0)
    if spacings.max() > _CLOCK_GAP_S:
        spacings = np.where(spacings > _CLOCK_GAP_S, spacings % _DAY_S, spacings)
        arrays = arrays._replace(time=np.cumsum(spacings))
    p, steps = plant_parameters(site), round(float(arrays.time[-1]) / site.tau)
    new_day = np.zeros(steps, np.bool_)
    new_day[find_new_days(site, trajectory.start.timestamp(), steps)] = True
    sums: Any = np.zeros(s.count_places(p))
    events = np.zeros((s.count_events(p, steps), len(Event._fields)))
    samples, add_all = arrays, compiled(add_samples)
    if steps < _MIN_COMPILED or not can_compile():
        add_all, sums = add_samples, sums.tolist()
        samples = Samples(*(column.tolist() for column in arrays))
    layer = add_all(p, sums, events, samples, new_day, site.initial_layer, without_rain)
    last = State(float(samples.cistern[-1]), float(samples.roof[-1]), layer)
    known = [math.nan if place in unknown else float(each) for place, each in enumerate(sums)]
    metrics = end_run(site, known, events, last).metrics
    if {"precipitation", "drainage"} & {*not_recorded}:
        metrics.pop("roof_retention_share", None)
    return metrics
