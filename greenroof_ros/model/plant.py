"""The exact plant: Eqs. (1)-(4) of the paper, stepped by Euler's rule.

Eq. (4) is in :mod:`greenroof_ros.model.soil`, with the measured soil, which can have a
third state: the water in its drainage layer.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.site import Site
from greenroof_ros.model.soil import Soil, soil_of

Values = NDArray[np.float64]

# Makes a named tuple from a tuple in half the time of its own class.
_new = tuple.__new__

RUNNING_SHARE = 0.01
"""The pumps run above this share of their maximum flow."""


def outlet_flow(site: Site, x1: float) -> float:
    """q_out (m3/s): what leaves a cistern holding x1 (m3) for the sewer, Eq. (2).

    If there is a low outlet, it is the flow of both outlets.
    """
    head = x1 / site.a1 - site.z_o
    flow = site.c_out * math.sqrt(head) if head > 0 else 0.0
    return flow + low_outlet_flow(site, x1)


def low_outlet_flow(site: Site, x1: float) -> float:
    """What the low outlet takes (m3/s) from a cistern holding x1 (m3): Eq. (2) at its elevation."""
    if site.low_outlet_level is None:
        return 0.0
    head = x1 / site.a1 - site.low_outlet_level
    return site.c_low * math.sqrt(head) if head > 0 else 0.0


def mains_flow(site: Site, x1: Any) -> Any:
    """The mains' flow (m3/s) into a cistern holding x1 (m3, of any shape): the valve's, or 0.

    The valve is checked once a tick, and is open for the whole tick if the level is below its own.
    """
    return (site.mains_flow or 0.0) * (x1 / site.a1 < (site.mains_level or 0.0))


def maximum_pump_flow(site: Site, x1: float) -> float:
    """The pumps' flow (m3/s) at command 1 from a cistern holding x1 (m3), Eq. (3e).

    It is 0 if the pumps cannot lift water to the roof; they must not run at such a level anyway.
    """
    head = x1 / site.a1 + site.c_hat - site.d
    return site.b * math.sqrt(head) if head > 0 else 0.0


def pumps_run(site: Site, flow: Any) -> Any:
    """Whether the pumps run at a flow (m3/s, of any shape): above 1 % of their maximum flow.

    The maximum is that from a cistern full up to its outlet. A smaller flow is the end of a lag,
    which never quite reaches 0, or the noise of a meter.
    """
    return flow > RUNNING_SHARE * maximum_pump_flow(site, site.a1 * site.z_o)


def pump_flow(site: Site, x1: float, x2: float, command: float) -> float:
    """q_pump (m3/s) at volumes x1, x2 (m3) and a command (share of the maximum flow), Eq. (3a)."""
    if x2 / site.a2 >= site.z_veg or x1 / site.a1 < site.suction_level:
        return 0.0
    return command * maximum_pump_flow(site, x1)


def command_to(
    site: Site, soil: Soil, x1: float, x2: float, target: float, rain: float, potential: float
) -> float:
    """Return the command that brings a roof from x2 to a volume in a tick; 0 if none does.

    Args:
        site: its parameters.
        soil: of the site.
        x1: in the cistern (m3).
        x2: on the roof (m3).
        target: volume on it at the end of the tick (m3).
        rain: in the tick (m/s).
        potential: evapotranspiration off the whole bed (m3/s) of plants that lack no water.
    """
    share = soil.retained_share(x2)
    stays = share * maximum_pump_flow(site, x1)
    if stays <= 0:
        return 0.0
    inflow = rain * site.a2 * share - potential * soil.water_stress(x2)
    return max(0.0, ((target - x2) / site.tau - inflow) / stays)


def head_loss(site: Site, x1: Values, flow: Values) -> Values:
    """L (m): the head needed by flows (m3/s) from a cistern holding x1 (m3), Eq. (3c)."""
    # float_power gives the bits of a number's square; numpy's square does not.
    return site.pipe_resistance * np.float_power(flow, 2) + site.d - x1 / site.a1


class Flows(NamedTuple):
    """What moves during one tick (m3/s), limited to what each tank holds."""

    outflow: float
    """from the cistern to the sewer"""
    pump: float
    """from the cistern to the roof"""
    drainage: float
    """off the roof"""
    evapotranspiration: float
    """off the roof"""
    limited: bool
    """whether a tank held less than was demanded"""


class Plant:
    """Cistern and roof, stepped tick by tick.

    Attributes:
        x1: water volume in the cistern (m3).
        x2: water volume in the green roof (m3), on a measured soil in its substrate.
        layer: water volume in the drainage layer of a measured soil (m3), at first the site's
            ``initial_layer``; always 0 on other roofs.
    """

    def __init__(self, site: Site, x1: float, x2: float) -> None:
        self._site = site
        # Looked up once: the time of a tick counts.
        self._a1, self._a2, self._tau = site.a1, site.a2, site.tau
        self._min_outlet_level, self._catchment = site.min_outlet_level, site.effective_catchment
        self._soil = soil_of(site)
        self._retains_all_below = self._soil.retains_all_below
        self._has_layer = site.drainage_storage is not None
        self._has_mains = site.mains_level is not None
        self.x1 = x1
        self.x2 = x2
        self.layer = site.initial_layer

    def levels(self) -> tuple[float, float]:
        """Water depth in the cistern and on the roof (m), as sensors would measure them.

        The roof's sensor stands in the substrate; it does not see the drainage layer.
        """
        return self.x1 / self._a1, self.x2 / self._a2

    def pump_flow(self, command: float) -> float:
        """What the pumps deliver now at a command (m3/s), Eq. (3a)."""
        return pump_flow(self._site, self.x1, self.x2, command) if command else 0.0

    def flows(self, precipitation: float, evapotranspiration: float, pump: float) -> Flows:
        """Return what moves during the present tick.

        If the paper's model would empty a tank below zero, all that leaves it is scaled down to
        what it holds plus what enters it.

        Args:
            precipitation: rain (m/s).
            evapotranspiration: off the whole bed (m3/s), of plants that do not lack water.
            pump: flow from the cistern to the roof (m3/s).
        """
        x1, x2 = self.x1, self.x2
        outflow = outlet_flow(self._site, x1) if x1 / self._a1 > self._min_outlet_level else 0.0
        limited = False
        demand = outflow + pump
        available = x1 / self._tau + precipitation * self._catchment
        if self._has_mains:
            available += mains_flow(self._site, x1)
        if demand > available:
            share = available / demand
            outflow *= share
            pump *= share
            limited = True
        drainage = 0.0
        available = x2 / self._tau + precipitation * self._a2 + pump
        # Otherwise the soil loses what is demanded: in most ticks of the paper's site, which saves
        # a call that would make them a tenth longer.
        if x2 >= self._retains_all_below or evapotranspiration > available:
            arriving = precipitation * self._a2 + pump
            drainage, evapotranspiration, dry = self._soil.tick(
                x2, self.layer, available, arriving, evapotranspiration
            )
            limited = limited or dry
        return _new(Flows, (outflow, pump, drainage, evapotranspiration, limited))

    def step(self, precipitation: float, flows: Flows) -> None:
        """Move on by one tick, Eq. (1).

        Args:
            precipitation: rain (m/s), the same as given to :meth:`flows`.
            flows: what :meth:`flows` returned for the present tick.
        """
        outflow, pump, drained, evapotranspiration, _ = flows
        tau = self._tau
        into_cistern = precipitation * self._catchment
        if self._has_mains:
            into_cistern += mains_flow(self._site, self.x1)
        into_roof = precipitation * self._a2 + pump
        if self._has_layer:
            drained = self._soil.drained(self.x2, into_roof, tau)
            self.layer = max(0.0, self.layer + tau * (drained - flows.drainage))
        x1 = self.x1 + tau * (into_cistern - outflow - pump)
        x2 = self.x2 + tau * (into_roof - (evapotranspiration + drained))
        # A limited tank ends at 0, not a bit below it.
        self.x1 = x1 if x1 > 0 else 0.0
        self.x2 = x2 if x2 > 0 else 0.0
