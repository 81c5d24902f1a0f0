"""The cistern: its overflow and low outlet, Eq. (2), its mains supply, and its flows in a tick."""

from __future__ import annotations

import math

from greenroof_ros.physics.parameters import SHORT_SHARE, PlantParameters
from greenroof_ros.physics.pump import maximum_pump_flow, pump_flow
from greenroof_ros.site.site import Site

MAX_STEP_S = 10.0
"""maximum length of the steps into which a longer tick is divided (s)"""
ABOVE_SUCTION = 1e-9
"""margin above the suction level at which pumping ends, as a share of this level (1)"""
MIN_RUN_S = 1.0
"""minimum time for which the pumps run in a tick that is not short (s): the paper's tick"""
EMPTIED_H = 12.0
"""time in which an open valve empties a full cistern, and an orifice empties its upper half, at
sites that are designed here (h)"""


def overflow(p: PlantParameters, x1: float) -> float:
    """Return q_out (m3/s): the flow through the upper outlet of a cistern with x1 (m3), Eq. (2)."""
    head = x1 / p.a1 - p.z_o
    return p.c_out * math.sqrt(head) if head > 0 else 0.0


def low_outlet_flow(p: PlantParameters, x1: float) -> float:
    """Return the flow (m3/s) through the open low outlet of a cistern with x1 (m3), Eq. (2)."""
    head = x1 / p.a1 - p.low_outlet_level
    return p.c_low * math.sqrt(head) if head > 0 else 0.0


def mains_inflow(p: PlantParameters, x1: float, drawn: float, seconds: float) -> float:
    """Return the mean flow of mains water in a step (m3/s); 0 without a float valve.

    While the water is below the level of the valve, the valve is open; at this level, the valve
    replaces the drawn water, up to ``mains_flow``.

    Args:
        p: parameters of the plant.
        x1: volume in the cistern at the start of the step (m3).
        drawn: flow of pumped and drained water minus the inflow of rain (m3/s), constant in the
            step.
        seconds: duration of the step (s).
    """
    missing = p.a1 * p.mains_level - x1
    if p.mains_flow == 0 or (missing <= 0 and drawn <= 0):
        return 0.0
    before = 0.0 if missing <= 0 else p.mains_flow  # its flow until the level reaches the valve's
    towards = before - drawn
    reaches = seconds if missing != 0 else 0.0  # s
    if missing * towards > 0:
        reaches = missing / towards
    share = min(1.0, reaches / seconds)
    return before * share + min(max(0.0, drawn), p.mains_flow) * (1 - share)


def draw_other(p: PlantParameters, x1: float, demand: float) -> float:
    """Return the flow that other uses draw in a tick (m3/s): the demand, down to the suction level.

    They draw last, from what the outlets and the pumps leave, and take the rest from the mains.

    Args:
        p: parameters of the plant.
        x1: volume in the cistern at the end of the tick, before they draw (m3).
        demand: water that they need (m3/s).
    """
    return min(demand, max(0.0, x1 - p.a1 * p.suction_level) / p.tau)


def let_out(p: PlantParameters, x1: float, outlet: float, seconds: float) -> tuple[float, float]:
    """Return the volumes that leave through the upper and the low outlet in a step (m3).

    The upper outlet is computed first: while water flows through it, the head of the low outlet
    hardly changes.

    Args:
        p: parameters of the plant.
        x1: volume in the cistern before the flow through the outlets is subtracted (m3).
        outlet: opening of the low outlet's valve, 0 to 1.
        seconds: duration of the step (s).
    """
    upper = _drain(p.a1, x1 - p.a1 * p.z_o, p.c_out * seconds)
    return upper, _drain(p.a1, x1 - upper - p.a1 * p.low_outlet_level, outlet * p.c_low * seconds)


def _drain(a1: float, above: float, drop: float) -> float:
    """Return the volume (m3) that leaves a cistern through an outlet in a step.

    The backward Euler method is used, so that an outlet does not drain more than the water above
    it. The head after a step, s^2, follows from the quadratic equation

        a1 s^2 + c t s = volume above the outlet before its flow is subtracted.

    Args:
        a1: area of the cistern's base (m2).
        above: this volume (m3).
        drop: c t, the coefficient of the outlet times the duration of the step (m^2.5).
    """
    if above <= 0 or drop <= 0:
        return 0.0
    return drop * 2 * above / (drop + math.sqrt(drop * drop + 4 * a1 * above))


def let_out_above(p: PlantParameters, outlet: float) -> float:
    """Return the volume in the cistern above which water flows to the sewer (m3)."""
    return p.a1 * (p.low_outlet_level if outlet > 0 else p.z_o)


def flows_in_short_tick(
    p: PlantParameters, x1: float, x2: float, collected: float, command: float, outlet: float,
    pumped: float,
) -> tuple[float, float, float, float, bool]:
    """Return the flows into and out of the cistern in a short tick, Eqs. (1) to (3), by Euler.

    If the paper's model would take more water than the cistern contains and receives, all flows out
    of it are scaled down to the available amount.

    Args:
        p: parameters of the plant.
        x1: volume in the cistern (m3).
        x2: volume on the roof (m3).
        collected: rain that flows into the cistern (m3/s).
        command: command to the pumps (share of the maximum flow).
        outlet: opening of the low outlet's valve, 0 to 1.
        pumped: flow to the roof (m3/s) if another program drives the pumps; otherwise NaN.

    Returns:
        Outflow, its part through the low outlet, pumped water and mains water (m3/s), and whether
        the cistern contained less water than was demanded.
    """
    pump, outflow, low = pumped, 0.0, 0.0
    if math.isnan(pumped):
        pump = pump_flow(p, x1, x2, command)
    if x1 / p.a1 > p.low_outlet_level:
        low = outlet * low_outlet_flow(p, x1)
        outflow = overflow(p, x1) + low
    demand = outflow + pump
    mains = mains_inflow(p, x1, demand - collected, p.tau)
    available = x1 / p.tau + collected + mains
    if demand <= available:
        return outflow, low, pump, mains, False
    share = available / demand
    return outflow * share, low * share, pump * share, mains, True


def flows_in_long_tick(
    p: PlantParameters, x1: float, collected: float, command: float, outlet: float, pumped: float,
    missing: float, rise: float,
) -> tuple[float, float, float, float, bool]:
    """Return the flows into and out of the cistern in a tick that is not short.

    The flows of outlets, pumps and mains water stop within the tick, as soon as the water reaches
    their levels. If a flow changes quickly, the tick is divided into steps of up to 10 s. In each
    step, the pumps and the mains inflow stop at their respective levels before the outflow is
    computed.

    Args:
        p: parameters of the plant.
        x1: volume in the cistern (m3).
        collected: as for :func:`flows_in_short_tick`.
        command: as for :func:`flows_in_short_tick`.
        outlet: as for :func:`flows_in_short_tick`.
        pumped: as for :func:`flows_in_short_tick`.
        missing: volume that the pumps must deliver, such as to fill the roof to its target (m3).
        rise: rate at which rain reduces ``missing`` (m3/s).

    Returns:
        As :func:`flows_in_short_tick`.
    """
    tau, own = p.tau, math.isnan(pumped)
    lowest, min_run, flow = p.a1 * p.suction_level * (1 + ABOVE_SUCTION), MIN_RUN_S, 0.0
    if not own:
        flow, lowest, min_run = pumped, 0.0, 0.0
    elif missing > 0:
        flow = command * maximum_pump_flow(p, x1)
    supplied, drains, steps = p.a1 * p.mains_level, let_out_above(p, outlet), 1
    if max(x1, supplied) + tau * collected > drains or tau * flow > SHORT_SHARE * p.x2_star:
        steps = math.ceil(tau / MAX_STEP_S)
    elif flow == 0 and (p.mains_flow == 0 or x1 >= supplied):
        return 0.0, 0.0, 0.0, 0.0, False
    seconds, running, limited = tau / steps, False, False
    out = let = lifted = came = 0.0  # m3
    for number in range(steps):
        if own and number > 0:
            flow = command * maximum_pump_flow(p, x1) if missing > 0 else 0.0
        volume = min(flow * seconds, missing * flow / (flow + rise)) if flow > 0 else 0.0
        min_volume = 0.0 if running else flow * min(seconds, min_run)
        arrives = seconds * collected
        mains = seconds * mains_inflow(p, x1, -collected, seconds)
        if volume > 0 and min(volume, x1 + arrives + mains - lowest) >= min_volume:
            mains = seconds * mains_inflow(p, x1, volume / seconds - collected, seconds)
            usable = x1 + arrives + mains - lowest
            if volume > usable:
                volume, limited = usable, not own
        else:
            volume = 0.0
        running = volume >= flow * seconds > 0
        missing -= volume + seconds * rise
        x1 += arrives + mains - volume
        lifted += volume
        came += mains
        if x1 > drains:
            upper, low = let_out(p, x1, outlet, seconds)
            x1 -= upper + low
            out += upper + low
            let += low
        elif volume == arrives == mains == 0:
            break  # nothing can happen in the other steps, either
    return out / tau, let / tau, lifted / tau, came / tau, limited


def find_outlet_radius(site: Site, base: float, head: float, seconds: float) -> float:
    """Return the radius (m) of an outlet that drains a cistern to its level in a given time.

    According to Eq. (2), the square root of the head decreases linearly with time, so draining
    takes 2 a1 sqrt(head) / c.

    Args:
        site: site with the discharge coefficient and the acceleration due to gravity.
        base: base area of the cistern (m2).
        head: head of the full cistern above the outlet (m).
        seconds: time until the cistern is drained to the outlet's level (s).
    """
    coefficient = 2 * base * math.sqrt(head) / seconds
    return math.sqrt(coefficient / (site.c_d * math.pi * math.sqrt(2 * site.g)))
