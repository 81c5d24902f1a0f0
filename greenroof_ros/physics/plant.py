"""The plant, Eqs. (1)-(4) of the paper, integrated tick by tick.

Short ticks, as in Table I, are integrated with Euler's method, as in the paper. In longer ticks
(see :func:`has_short_ticks`), the flows of outlets, pumps and mains water can stop within the tick,
as soon as the water reaches their levels. Eq. (4) and the field-capacity soil are in
:mod:`greenroof_ros.physics.soil`. A field-capacity soil can have a third state: the water in its
drainage layer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.soil import Soil, soil_of
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

# Makes a named tuple from a tuple in half the time that its own class takes.
_new = tuple.__new__

# A short tick: see :func:`has_short_ticks`.
_SHORT_HEAD = 1e-4

SHORT_SHARE = 0.01
"""maximum share of the roof's target that pumps at full flow can deliver in a short tick"""

MAX_STEP_S = 10.0
"""maximum length of the steps into which a longer tick is divided for the cistern (s)"""

ABOVE_SUCTION = 1e-9
"""margin above the suction level at which pumping ends, as a share of this level"""

RUNNING_SHARE = 0.01
"""share of their maximum flow above which the pumps count as running"""

MIN_RUN_S = 1.0
"""minimum time for which the pumps run in a tick that is not short (s): the paper's tick"""

EMPTIED_H = 12.0
"""time in which an open valve empties a full cistern, and an orifice empties its upper half, at
sites that are designed here (h)"""


def overflow(site: Site, x1: float) -> float:
    """Return q_out (m3/s): the flow through the upper outlet of a cistern with x1 (m3), Eq. (2)."""
    head = x1 / site.a1 - site.z_o
    return site.c_out * math.sqrt(head) if head > 0 else 0.0


def outlet_flow(site: Site, x1: float) -> float:
    """Return the flow (m3/s) through both open outlets of a cistern with x1 (m3)."""
    return overflow(site, x1) + low_outlet_flow(site, x1)


def low_outlet_flow(site: Site, x1: float) -> float:
    """Return the flow (m3/s) through the open low outlet of a cistern with x1 (m3), Eq. (2)."""
    if site.low_outlet_level is None:
        return 0.0
    head = x1 / site.a1 - site.low_outlet_level
    return site.c_low * math.sqrt(head) if head > 0 else 0.0


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


def has_short_ticks(site: Site) -> bool:
    """Return whether Euler's method is accurate enough for a tick, as it is in Table I.

    In a short tick, pumps at full flow deliver at most 1 % of the roof's target. With Euler's
    method, an outlet drains more than the water above it if the head is below (tau c / a1)^2, with
    c as in Eq. (2); in a short tick, this limit is at most 0.1 mm.
    """
    pumped = site.tau * maximum_pump_flow(site, site.a1 * site.z_o)
    overdrawn = (site.tau * max(site.c_out, site.c_low) / site.a1) ** 2
    return pumped <= SHORT_SHARE * site.x2_star and overdrawn <= _SHORT_HEAD


def mains_flow(site: Site, x1: float, drawn: float, seconds: float) -> float:
    """Return the mean flow of mains water in a step (m3/s); 0 without a float valve.

    While the water is below the level of the valve, the valve is open; at this level, the valve
    replaces the drawn water, up to ``mains_flow``.

    Args:
        site: parameters of the site.
        x1: volume in the cistern at the start of the step (m3).
        drawn: flow of pumped and drained water minus the inflow of rain (m3/s), constant in the
            step.
        seconds: duration of the step (s).
    """
    if site.mains_flow is None or site.mains_level is None:
        return 0.0
    missing, maximum = site.a1 * site.mains_level - x1, site.mains_flow
    before = 0.0 if missing <= 0 else maximum  # its flow until the level reaches the valve's
    towards = before - drawn
    reaches = missing / towards if missing * towards > 0 else seconds if missing else 0.0  # s
    share = min(1.0, reaches / seconds)
    return before * share + min(max(0.0, drawn), maximum) * (1 - share)


def maximum_pump_flow(site: Site, x1: float) -> float:
    """Return the pumps' flow (m3/s) at command 1 from a cistern with x1 (m3), Eq. (3e).

    The flow is 0 if the pumps cannot lift water to the roof; they must not run at such a level.
    """
    head = x1 / site.a1 + site.c_hat - site.d
    return site.b * math.sqrt(head) if head > 0 else 0.0


def pumps_run(site: Site, flow: Any) -> Any:
    """Return whether the pumps are running at a flow (m3/s, any shape): above 1 % of the maximum.

    The maximum flow is that from a cistern filled to its overflow. Smaller flows are caused by a
    lag whose output never quite reaches 0, or by the noise of a flow meter.
    """
    return flow > RUNNING_SHARE * maximum_pump_flow(site, site.a1 * site.z_o)


def pump_flow(site: Site, x1: float, x2: float, command: float) -> float:
    """Return q_pump (m3/s) for volumes (m3) and a command (share of the maximum flow), Eq. (3a)."""
    if x2 / site.a2 >= site.z_veg or x1 / site.a1 < site.suction_level:
        return 0.0
    return command * maximum_pump_flow(site, x1)


def command_to(
    site: Site, soil: Soil, x1: float, x2: float, target: float, rain: float, potential: float
) -> float:
    """Return the command that brings a roof's volume to a target within a tick; 0 if impossible.

    Args:
        site: parameters of the site.
        soil: soil of the site.
        x1: volume in the cistern (m3).
        x2: volume on the roof (m3).
        target: volume on the roof at the end of the tick (m3).
        rain: rain in the tick (m/s).
        potential: potential evapotranspiration from the whole bed (m3/s).
    """
    stays = target - x2 + site.tau * potential * soil.water_stress(x2)
    full = maximum_pump_flow(site, x1)
    if stays <= 0 or full <= 0:
        return 0.0
    arriving = soil.water_to_raise(x2, x2 + stays) / site.tau
    return max(0.0, arriving - rain * site.a2) / full


def head_loss(site: Site, x1: Values, flow: Values) -> Values:
    """Return L (m), Eq. (3c): the head required for flows (m3/s) from a cistern with x1 (m3)."""
    # float_power yields the bits of a number's square; numpy's square does not.
    return site.pipe_resistance * np.float_power(flow, 2) + site.d - x1 / site.a1


class Flows(NamedTuple):
    """The flows during one tick (m3/s), limited to the water in each tank."""

    outflow: float
    """flow from the cistern to the sewer"""
    pump: float
    """flow from the cistern to the roof"""
    drainage: float
    """drainage from the roof"""
    evapotranspiration: float
    """evapotranspiration from the roof"""
    limited: bool
    """whether a tank contained less water than was demanded"""
    mains: float
    """flow of mains water into the cistern"""
    low_outlet: float = 0.0
    """part of the outflow that leaves through the low outlet"""


class Plant:
    """A cistern and a roof, computed tick by tick.

    Attributes:
        x1: water volume in the cistern (m3).
        x2: water volume on the green roof (m3); for a field-capacity soil, the volume in its
            substrate.
        layer: water volume in the drainage layer of a field-capacity soil (m3), initially the
            site's ``initial_layer``; always 0 for the paper's soil.
    """

    def __init__(self, site: Site, x1: float, x2: float) -> None:
        self._site = site
        # Looked up once, since the processor time per tick matters.
        self._a1, self._a2, self._tau = site.a1, site.a2, site.tau
        self._min_outlet_level, self._catchment = site.min_outlet_level, site.effective_catchment
        self._soil = soil_of(site)
        self._retains_all_below = self._soil.retains_all_below
        self._has_layer = site.drainage_storage is not None
        self._has_mains = site.mains_flow is not None
        self._kept = site.drainage_to_cistern
        self._short = has_short_ticks(site)
        self.x1 = x1
        self.x2 = x2
        self.layer = site.initial_layer

    def levels(self) -> tuple[float, float]:
        """Return the levels of the cistern and the roof (m), as sensors would measure them.

        The roof's sensor is in the substrate, and does not detect water in the drainage layer.
        """
        return self.x1 / self._a1, self.x2 / self._a2

    def flows(
        self, precipitation: float, evapotranspiration: float, command: float,
        pumped: float | None = None, outlet: float = 1.0,
    ) -> Flows:
        """Return the flows during the current tick.

        If the paper's model would drain more water from a tank than the tank contains and receives,
        all flows from the tank are scaled down to the available amount.

        Args:
            precipitation: rain rate (m/s).
            evapotranspiration: potential evapotranspiration from the whole bed (m3/s).
            command: command to the pumps (share of the maximum flow), Eq. (3a).
            pumped: flow from the cistern to the roof (m3/s) if another program drives the pumps;
                otherwise None.
            outlet: opening of the low outlet's valve, 0 to 1.
        """
        x1, x2, tau = self.x1, self.x2, self._tau
        collected, rain = precipitation * self._catchment, precipitation * self._a2
        mains, low, limited = 0.0, 0.0, False
        if not self._short:
            missing = rise = 0.0
            if pumped is None and command and x2 / self._a2 < self._site.z_veg:
                missing, rise = self._find_missing(rain, evapotranspiration)
            outflow, low, pump, mains, volumes, limited = self._step_cistern(
                collected, command, pumped, outlet, missing, rise
            )
        else:
            pump = pump_flow(self._site, x1, x2, command) if pumped is None else pumped
            outflow = 0.0
            if x1 / self._a1 > self._min_outlet_level:
                low = outlet * low_outlet_flow(self._site, x1)
                outflow = overflow(self._site, x1) + low
            demand = outflow + pump
            if self._has_mains:
                mains = mains_flow(self._site, x1, demand - collected, tau)
            available = x1 / tau + collected + mains
            if demand > available:
                share = available / demand
                outflow *= share
                low *= share
                pump *= share
                limited = True
        drainage = 0.0
        available = x2 / tau + rain + pump
        # Otherwise the soil loses what is demanded, as in most ticks of the paper's site; this
        # saves a call that would make them a tenth longer.
        if x2 >= self._retains_all_below or evapotranspiration > available:
            drainage, evapotranspiration, dry = self._soil.tick(
                x2, self.layer, available, rain + pump, evapotranspiration
            )
            limited = limited or dry
            if self._kept and not self._short:
                arriving = collected + self._kept * drainage
                if mains or self.x1 + tau * (arriving + mains) > self._fits(outlet):
                    outflow, low, mains = self._step_outlets(arriving, volumes, outlet)
        return _new(Flows, (outflow, pump, drainage, evapotranspiration, limited, mains, low))

    def _fits(self, outlet: float) -> float:
        """Return the volume in the cistern above which water flows to the sewer (m3)."""
        return self._a1 * (self._site.min_outlet_level if outlet else self._site.z_o)

    def _find_missing(self, rain: float, evapotranspiration: float) -> tuple[float, float]:
        """Return the volume that must be pumped to fill the roof to its target in a long tick.

        Args:
            rain: rain on the roof (m3/s).
            evapotranspiration: potential evapotranspiration from the roof (m3/s).

        Returns:
            The volume (m3), and the rate at which rain reduces it (m3/s).
        """
        target = self._a2 * self._site.z_veg
        evaporated = evapotranspiration * self._soil.water_stress(self.x2)
        if rain > evaporated:
            return self._soil.water_to_raise(self.x2, target), rain - evaporated
        # They also replace what is lost during the rest of the tick.
        arrive = self._soil.water_to_raise(self.x2, target + self._tau * evaporated)
        return arrive - self._tau * rain, 0.0

    def _step_cistern(
        self, collected: float, command: float, pumped: float | None, outlet: float,
        missing: float, rise: float,
    ) -> tuple[float, float, float, float, list[float], bool]:
        """Return the flows into and out of the cistern during a long tick.

        If a flow changes quickly, the tick is divided into steps of up to 10 s. In each step, the
        pumps and the mains inflow stop at their respective levels before the outflow is computed.

        Args:
            collected: rain that flows into the cistern (m3/s).
            command: command to the pumps (share of the maximum flow).
            pumped: flow to the roof (m3/s) if another program drives the pumps; otherwise None.
            outlet: opening of the low outlet's valve, 0 to 1.
            missing: volume that must be pumped to fill the roof to its target (m3).
            rise: rate at which rain reduces ``missing`` (m3/s).

        Returns:
            Outflow, its part through the low outlet, pumped water and mains water (m3/s), the
            volume pumped in every step (m3), and whether the cistern contained less water than
            another program pumped.
        """
        site, x1, tau = self._site, self.x1, self._tau
        lowest, min_run = self._a1 * site.suction_level * (1 + ABOVE_SUCTION), MIN_RUN_S
        flow = command * maximum_pump_flow(site, x1) if missing > 0 else 0.0
        if pumped is not None:
            flow, missing, lowest, min_run = pumped, math.inf, 0.0, 0.0
        filled = max(x1, self._a1 * (site.mains_level or 0.0)) + tau * collected
        overflows = filled > self._fits(outlet)
        quick = overflows or tau * flow > SHORT_SHARE * site.x2_star
        steps = math.ceil(tau / MAX_STEP_S) if quick else 1
        seconds, running, limited = tau / steps, False, False
        out = let_out = lifted = let_in = 0.0  # m3
        volumes = []
        for _ in range(steps):
            if pumped is None:
                flow = command * maximum_pump_flow(site, x1) if missing > 0 else 0.0
            volume = min(flow * seconds, missing * flow / (flow + rise)) if flow else 0.0
            min_volume = 0.0 if running else flow * min(seconds, min_run)
            arrives = seconds * collected
            mains = seconds * mains_flow(site, x1, -collected, seconds)
            if volume and min(volume, x1 + arrives + mains - lowest) >= min_volume:
                mains = seconds * mains_flow(site, x1, volume / seconds - collected, seconds)
                usable = x1 + arrives + mains - lowest
                if volume > usable:
                    volume, limited = usable, pumped is not None
            else:
                volume = 0.0
            running = volume >= flow * seconds > 0
            missing -= volume + seconds * rise
            x1 += arrives + mains - volume
            volumes.append(volume)
            lifted += volume
            let_in += mains
            upper, low = self._let_out(x1, outlet, seconds)
            x1 -= upper + low
            out += upper + low
            let_out += low
        return out / tau, let_out / tau, lifted / tau, let_in / tau, volumes, limited

    def _step_outlets(
        self, arriving: float, volumes: Sequence[float], outlet: float
    ) -> tuple[float, float, float]:
        """Return outflow, its part through the low outlet, and mains water in a long tick (m3/s).

        The roof's drainage depends on the pumped water, so it is known only after the pumps have
        run; water that drains into the cistern can leave the cistern in the same tick.

        Args:
            arriving: rain and drainage that flow into the cistern (m3/s).
            volumes: volumes pumped in every step, or in the whole tick (m3), as returned by
                :meth:`_step_cistern`.
            outlet: opening of the low outlet's valve, 0 to 1.
        """
        x1, tau = self.x1, self._tau
        steps = math.ceil(tau / MAX_STEP_S)
        if len(volumes) < steps:
            volumes = [volumes[0] / steps] * steps
        seconds = tau / steps
        out = let_out = let_in = 0.0  # m3
        for volume in volumes:
            mains = seconds * mains_flow(self._site, x1, volume / seconds - arriving, seconds)
            x1 += seconds * arriving + mains - volume
            upper, low = self._let_out(x1, outlet, seconds)
            x1 -= upper + low
            out += upper + low
            let_out += low
            let_in += mains
        return out / tau, let_out / tau, let_in / tau

    def _let_out(self, x1: float, outlet: float, seconds: float) -> tuple[float, float]:
        """Return the volumes that leave through the upper and the low outlet in a step (m3).

        The backward Euler method is used, so that an outlet does not drain more than the water
        above it. The head after a step, s^2, follows from the quadratic equation

            a1 s^2 + c t s = volume above the outlet before its flow is subtracted.

        The upper outlet is computed first: while water flows through it, the head of the low outlet
        hardly changes.

        Args:
            x1: volume in the cistern before the flow through the outlets is subtracted (m3).
            outlet: opening of the low outlet's valve, 0 to 1.
            seconds: duration of the step (s).
        """
        site, a1 = self._site, self._a1
        upper = low = 0.0
        above = x1 - a1 * site.z_o
        if above > 0:
            drop = site.c_out * seconds
            upper = drop * 2 * above / (drop + math.sqrt(drop**2 + 4 * a1 * above))
        if site.low_outlet_level is not None and outlet:
            above = x1 - upper - a1 * site.low_outlet_level
            if above > 0:
                drop = outlet * site.c_low * seconds
                low = drop * 2 * above / (drop + math.sqrt(drop**2 + 4 * a1 * above))
        return upper, low

    def step(self, precipitation: float, flows: Flows) -> None:
        """Proceed by one tick, Eq. (1).

        Args:
            precipitation: rain rate (m/s), the same as passed to :meth:`flows`.
            flows: flows that :meth:`flows` returned for the current tick.
        """
        outflow, pump, drained, evapotranspiration, _, mains, _ = flows
        tau = self._tau
        into_cistern = precipitation * self._catchment + mains + self._kept * drained
        into_roof = precipitation * self._a2 + pump
        if self._has_layer:
            drained = self._soil.drained(self.x2, into_roof, tau)
            self.layer = max(0.0, self.layer + tau * (drained - flows.drainage))
        x1 = self.x1 + tau * (into_cistern - outflow - pump)
        x2 = self.x2 + tau * (into_roof - (evapotranspiration + drained))
        # A limited tank ends at 0, not a bit below it.
        self.x1 = x1 if x1 > 0 else 0.0
        self.x2 = x2 if x2 > 0 else 0.0
