"""The results of a run from its trajectory: its metrics, water balance, prices and frost.

All sums are Euler's: a value holds from its sample to the next, over the difference of their
times. The flows of the last sample count in no sum, because the run ends in its state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.metrics import NEAR_TARGET, Samples, Totals, totals_of
from greenroof_ros.model.plant import mains_flows
from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import soil_of
from greenroof_ros.recording.trajectory import Trajectory


@dataclass(frozen=True)
class Assumptions:
    """What the bag does not say and a person must assume.

    Attributes:
        energy_price: of a kWh of electric energy.
        water_price: of a m3 from the mains.
        currency: of both prices.
        band: half width of the band about the target, as a share of the target (1).
    """

    energy_price: float = 0.115
    water_price: float = 4.1346
    currency: str = "CAD"
    band: float = NEAR_TARGET


@dataclass(frozen=True)
class Assessment:
    """The results of a run.

    Attributes:
        metrics: those of :data:`greenroof_ros.model.metrics.METRICS` that a trajectory says.
        hours: from the first sample to the last (h).
        band_hours: within the band about the target (h).
        cistern_change_m3: of storage, last x1 less first.
        roof_change_m3: of storage, last x2 less first, of a measured roof with its drainage layer.
        cistern_residual_m3: change of storage that the flows do not explain; rounding in a
            simulation, on a site whatever was not measured.
        roof_residual_m3: likewise.
        energy_cost: of the electric energy.
        water_value: what as much water from the mains costs.
        frost_hours: (h).
        frost_pumped_m3: pumped during frost.
    """

    metrics: Totals
    hours: float
    band_hours: float
    cistern_change_m3: float
    roof_change_m3: float
    cistern_residual_m3: float
    roof_residual_m3: float
    energy_cost: float
    water_value: float
    frost_hours: float
    frost_pumped_m3: float


def assess(site: Site, trajectory: Trajectory, assumptions: Assumptions) -> Assessment:
    """Judge a run.

    Args:
        site: where it was, Table I.
        trajectory: what happened, at least two samples.
        assumptions: what it does not say.
    """
    samples = _samples(site, trajectory)
    metrics = totals_of(site, samples)
    now = slice(None, -1)
    dt = np.diff(trajectory.time)
    deviation = np.abs(trajectory.roof[now] - site.x2_star)
    frost = trajectory.frost[now] > 0
    cistern_change = float(trajectory.cistern[-1] - trajectory.cistern[0])
    roof_change = float(trajectory.roof[-1] - trajectory.roof[0])
    roof_change += float(samples.layer[-1] - samples.layer[0])
    pumped = metrics["pumped_m3"]
    cistern_flows = metrics["rain_cistern_m3"] - pumped - metrics["outflow_m3"]
    cistern_flows += metrics.get("mains_m3", 0.0)
    roof_flows = (
        metrics["rain_roof_m3"] + pumped - metrics["evapotranspiration_m3"]
        - metrics["drainage_m3"]
    )
    return Assessment(
        metrics=metrics,
        hours=float(trajectory.time[-1] - trajectory.time[0]) / 3600,
        band_hours=_hours(dt, deviation <= assumptions.band * site.x2_star),
        cistern_change_m3=cistern_change,
        roof_change_m3=roof_change,
        cistern_residual_m3=cistern_change - cistern_flows,
        roof_residual_m3=roof_change - roof_flows,
        energy_cost=metrics["electric_energy_kwh"] * assumptions.energy_price,
        water_value=pumped * assumptions.water_price,
        frost_hours=_hours(dt, frost),
        frost_pumped_m3=float(np.sum((trajectory.pump_flow[now] * dt)[frost])),
    )


def _samples(site: Site, trajectory: Trajectory) -> Samples:
    """Return a whole run as samples; where a tank's flows were limited is unknown.

    The drainage layer of a measured roof is computed from what percolates; it begins with
    the site's ``initial_layer``.
    """
    dt = np.append(np.diff(trajectory.time), site.tau)

    def until_the_end(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.append(values[:-1], 0.0)

    rain = until_the_end(trajectory.precipitation)
    flow = until_the_end(trajectory.pump_flow)
    drainage = until_the_end(trajectory.drainage)
    asked = until_the_end(trajectory.evapotranspiration)
    mains = None
    if site.mains_level is not None:
        mains = until_the_end(mains_flows(site, trajectory.cistern))
    followed = soil_of(site).follow(
        site.initial_layer, trajectory.roof, rain, flow, asked, drainage, dt,
    )
    return Samples(
        duration=dt,
        cistern=trajectory.cistern,
        roof=trajectory.roof,
        command=until_the_end(trajectory.command),
        precipitation=rain,
        outflow=until_the_end(trajectory.outflow),
        pump=flow,
        drainage=drainage,
        evapotranspiration=followed.evaporated,
        layer=followed.layer,
        mains=mains,
        potential=asked,
        time=trajectory.time,
    )


def _hours(dt: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Time (h) for which something holds."""
    return float(dt[where].sum()) / 3600
