"""What a run comes to: deviation, water balance, energy, pump and frost, from its trajectory.

All sums are Euler's: a value holds from its sample to the next, over dt, the difference of their
times. The flows of the last sample count in no sum, because the run ends in its state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.plant import JOULES_PER_KWH, WATER_DENSITY, head_loss
from greenroof_ros.model.site import Site
from greenroof_ros.recording.trajectory import Trajectory


@dataclass(frozen=True)
class Assumptions:
    """What the bag does not say and a person must assume.

    Attributes:
        efficiency: hydraulic power over electric power of pumps and motors (1).
        energy_price: of a kWh.
        water_price: of a m3 from the mains.
        currency: of both prices.
        band: half width of the band about the target, as a share of the target (1).
    """

    efficiency: float = 0.5
    energy_price: float = 0.115
    water_price: float = 4.1346
    currency: str = "CAD"
    band: float = 0.05


@dataclass(frozen=True)
class Assessment:
    """What a run comes to.

    Attributes:
        hours: from the first sample to the last (h).
        total_deviation_m3: the sum of |x2 - x2*| dt / tau over all samples, the last one with
            dt = tau. For samples a tick apart that is the paper's sum over j = 0..N (Fig.
            5); times tau it is the integral over time (m3 s), whatever the sampling.
        band_hours: within the band about the target (h).
        rain_cistern_m3: rain through the cistern's inlet.
        rain_roof_m3: rain on the roof.
        pumped_m3: from the cistern to the roof.
        outflow_m3: from the cistern to the sewer.
        evapotranspiration_m3: off the roof, at most what it held.
        drainage_m3: off the roof.
        final_cistern_m3: the last x1.
        final_roof_m3: the last x2.
        cistern_change_m3: of storage, last x1 less first.
        roof_change_m3: of storage, last x2 less first.
        cistern_residual_m3: change of storage that the flows do not explain; rounding in a
            simulation, on a site whatever was not measured.
        roof_residual_m3: likewise.
        energy_kwh: of the pumps: rho g q L(x, q) dt over the efficiency, L as in Eq. (3c).
        energy_cost: of that.
        water_value: what as much water from the mains costs.
        pump_starts: how often the flow went from 0 to more; a flow at the first sample counts.
        pump_hours: with a flow (h).
        beyond_hours: with a command above 1, which no real pump follows (h).
        largest_command: (1).
        frost_hours: (h).
        frost_pumped_m3: pumped during frost.
    """

    hours: float
    total_deviation_m3: float
    band_hours: float
    rain_cistern_m3: float
    rain_roof_m3: float
    pumped_m3: float
    outflow_m3: float
    evapotranspiration_m3: float
    drainage_m3: float
    final_cistern_m3: float
    final_roof_m3: float
    cistern_change_m3: float
    roof_change_m3: float
    cistern_residual_m3: float
    roof_residual_m3: float
    energy_kwh: float
    energy_cost: float
    water_value: float
    pump_starts: int
    pump_hours: float
    beyond_hours: float
    largest_command: float
    frost_hours: float
    frost_pumped_m3: float


def assess(site: Site, trajectory: Trajectory, assumptions: Assumptions) -> Assessment:
    """Judge a run.

    Args:
        site: where it was, Table I.
        trajectory: what happened, at least two samples.
        assumptions: what it does not say.
    """
    now = slice(None, -1)
    dt = np.diff(trajectory.time)
    rain = trajectory.precipitation[now]
    flow = trajectory.pump_flow[now]
    drainage = trajectory.drainage[now]
    command = trajectory.command[now]
    deviation = np.abs(trajectory.roof - site.x2_star)
    frost = trajectory.frost[now] > 0

    # As plant.Plant.flows: what the roof cannot give does not evaporate. The drainage is that
    # after the limit, so that the rest of what is there is left to evaporate.
    held = trajectory.roof[now] / dt + rain * site.a2 + flow - drainage
    evaporated = np.minimum(trajectory.evapotranspiration[now], np.maximum(held, 0.0))

    rain_cistern = float(np.sum(rain * dt)) * site.a_in
    rain_roof = float(np.sum(rain * dt)) * site.a2
    pumped = float(np.sum(flow * dt))
    outflow = float(np.sum(trajectory.outflow[now] * dt))
    evapotranspiration = float(np.sum(evaporated * dt))
    drained = float(np.sum(drainage * dt))
    cistern_change = float(trajectory.cistern[-1] - trajectory.cistern[0])
    roof_change = float(trajectory.roof[-1] - trajectory.roof[0])
    power = WATER_DENSITY * site.g * flow * head_loss(site, trajectory.cistern[now], flow)
    energy = float(np.sum(power * dt)) / assumptions.efficiency / JOULES_PER_KWH
    running = flow > 0
    starts = np.count_nonzero(running[1:] & ~running[:-1]) + int(running[0])
    deviations = np.sum(deviation[now] * dt) / site.tau + deviation[-1]
    return Assessment(
        hours=float(trajectory.time[-1] - trajectory.time[0]) / 3600,
        total_deviation_m3=float(deviations),
        band_hours=_hours(dt, deviation[now] <= assumptions.band * site.x2_star),
        rain_cistern_m3=rain_cistern,
        rain_roof_m3=rain_roof,
        pumped_m3=pumped,
        outflow_m3=outflow,
        evapotranspiration_m3=evapotranspiration,
        drainage_m3=drained,
        final_cistern_m3=float(trajectory.cistern[-1]),
        final_roof_m3=float(trajectory.roof[-1]),
        cistern_change_m3=cistern_change,
        roof_change_m3=roof_change,
        cistern_residual_m3=cistern_change - (rain_cistern - pumped - outflow),
        roof_residual_m3=roof_change - (rain_roof + pumped - evapotranspiration - drained),
        energy_kwh=energy,
        energy_cost=energy * assumptions.energy_price,
        water_value=pumped * assumptions.water_price,
        pump_starts=int(starts),
        pump_hours=_hours(dt, running),
        beyond_hours=_hours(dt, command > 1),
        largest_command=float(command.max()),
        frost_hours=_hours(dt, frost),
        frost_pumped_m3=float(np.sum((flow * dt)[frost])),
    )


def _hours(dt: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Time (h) for which something holds."""
    return float(dt[where].sum()) / 3600
