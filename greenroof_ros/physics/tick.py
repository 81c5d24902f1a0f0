"""A tick of the plant, Eq. (1): where all simulations, plain or compiled, get the next state.

Short ticks, as in Table I, are integrated with Euler's method, as in the paper. In longer ticks,
flows can stop within the tick. A field-capacity soil can have a third state, the water in its
drainage layer.
"""

from __future__ import annotations

import math

from greenroof_ros.physics.cistern import (
    draw_other,
    flows_in_long_tick,
    flows_in_short_tick,
    let_out_above,
)
from greenroof_ros.physics.parameters import Flows, PlantParameters, State
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.soil import flows_in_tick, layer_outflow, water_stress, water_to_raise

OWN_PUMPS = math.nan
"""stands for the pumped flow if the site's own pumps follow the command"""


def step(
    p: PlantParameters, state: State, rain: float, potential: float, command: float,
    outlet: float, pumped: float, other_demand: float = 0.0,
) -> tuple[State, Flows]:
    """Return the state after a tick, and the flows in it, Eqs. (1) to (4).

    Of the paper's flows, ``outflow`` is q_out, ``pump`` q_pump, and ``drainage`` q_drain.

    Args:
        p: parameters of the plant.
        state: state at the start of the tick.
        rain: rain rate w_r (m/s).
        potential: potential evapotranspiration w_e from the whole bed (m3/s).
        command: command u to the pumps (share of the maximum flow), Eq. (3a).
        outlet: opening of the low outlet's valve, 0 to 1; 1 without a valve.
        pumped: flow from the cistern to the roof (m3/s) if another program drives the pumps;
            otherwise :data:`OWN_PUMPS`.
        other_demand: water that other uses need (m3/s), see :func:`draw_other`.
    """
    x1, x2, layer = state
    tau, collected, fallen = p.tau, rain * p.effective_catchment, rain * p.a2
    if p.has_short_ticks:
        outflow, low, pump, mains, limited = flows_in_short_tick(
            p, x1, x2, collected, command, outlet, pumped
        )
    else:
        missing, rise = math.inf, 0.0
        if math.isnan(pumped):
            missing, rise = missing_on_roof(p, x2, fallen, potential) if command > 0 else (0.0, 0.0)
        outflow, low, pump, mains, limited = flows_in_long_tick(
            p, x1, collected, command, outlet, pumped, missing, rise
        )
    percolated, evaporated, dry = flows_in_tick(p, x2, fallen + pump, potential)
    drained = layer_outflow(p, layer, percolated, tau)
    if p.drainage_to_cistern > 0 and not p.has_short_ticks:
        arriving = collected + p.drainage_to_cistern * drained
        if mains > 0 or x1 + tau * (arriving + mains) > let_out_above(p, outlet):
            # The drainage depends on the pumped water, and can leave the cistern in the same tick.
            outflow, low, _, mains, _ = flows_in_long_tick(
                p, x1, arriving, command, outlet, pumped, tau * pump, 0.0
            )
            if mains > 0:  # they were open when the pumps emptied the cistern, as at first
                mains = max(mains, outflow + pump - arriving - x1 / tau)
    into_cistern = collected + mains + p.drainage_to_cistern * drained
    cistern = x1 + tau * (into_cistern - outflow - pump)
    other = draw_other(p, cistern, other_demand) if other_demand > 0 else 0.0
    after = State(
        # A limited tank ends at 0, not a bit below it.
        max(0.0, cistern - tau * other),
        max(0.0, x2 + tau * (fallen + pump - (evaporated + percolated))),
        max(0.0, layer + tau * (percolated - drained)),
    )
    return after, Flows(
        outflow, pump, drained, evaporated, limited or dry, mains, low, other, other_demand
    )


def missing_on_roof(
    p: PlantParameters, x2: float, fallen: float, potential: float
) -> tuple[float, float]:
    """Return the volume that must be pumped to fill the roof to its target in a long tick.

    Args:
        p: parameters of the plant.
        x2: volume on the roof (m3).
        fallen: rain on the roof (m3/s).
        potential: potential evapotranspiration from the roof (m3/s).

    Returns:
        The volume (m3), and the rate at which rain reduces it (m3/s).
    """
    if x2 / p.a2 >= p.z_veg:
        return 0.0, 0.0
    target, evaporated = p.a2 * p.z_veg, potential * water_stress(p, x2)
    if fallen > evaporated:
        return water_to_raise(p, x2, target), fallen - evaporated
    # The pumps also replace what is lost during the rest of the tick.
    return water_to_raise(p, x2, target + p.tau * evaporated) - p.tau * fallen, 0.0


def command_to(
    p: PlantParameters, x1: float, x2: float, target: float, rain: float, potential: float
) -> float:
    """Return the command that brings a roof's volume to a target within a tick; 0 if impossible.

    Args:
        p: parameters of the plant.
        x1: volume in the cistern (m3).
        x2: volume on the roof (m3).
        target: volume on the roof at the end of the tick (m3).
        rain: rain in the tick (m/s).
        potential: potential evapotranspiration from the whole bed (m3/s).
    """
    stays = target - x2 + p.tau * potential * water_stress(p, x2)
    full = maximum_pump_flow(p, x1)
    if stays <= 0 or full <= 0:
        return 0.0
    arriving = water_to_raise(p, x2, x2 + stays) / p.tau
    return max(0.0, arriving - rain * p.a2) / full
