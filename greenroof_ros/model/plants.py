"""The plants of many sites: the tick of :mod:`.plant` and :mod:`.soil` on arrays.

Each volume and flow is that of :class:`.plant.Plant` from the same state, but for rounding (1e-10
of it and better). Where a threshold decides, rounding can turn the decision: a roof that the pump
has just filled to its target is a bit above or below it. Then its next dose comes a tick earlier or
later, so sums over a run agree to about what evaporates in a tick.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model import plant as single
from greenroof_ros.model.plant import MIN_RUN_S
from greenroof_ros.model.sites import Sites

Values = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

_MAX_STEP_S, _SHORT_SHARE, _ROUNDING = single._MAX_STEP_S, single._SHORT_SHARE, single._ROUNDING
_MAX_OVERDRAWN_M, _ALMOST_FULL = 1e-4, 1 - 1e-9


class Moved(NamedTuple):
    """What moves during a tick in each site (m3), as :class:`.plant.Flows` times tau."""

    outflow: Values
    pump: Values
    drainage: Values
    evapotranspiration: Values
    limited: Flags
    mains: Values
    low_outlet: Values


class Plants:
    """Cisterns and roofs of sites, stepped together; the attributes are those of one plant.

    Attributes:
        x1: in each cistern (m3).
        x2: on each roof (m3).
        layer: in each drainage layer (m3).
    """

    def __init__(self, sites: Sites, x1: Values, x2: Values) -> None:
        """Set the initial volumes.

        Args:
            sites: all with the same tau; all with short ticks or none; all with a measured soil or
                none.
            x1: in each cistern (m3).
            x2: on each roof (m3).
        """
        self.sites, self._tau = sites, float(sites.tau[0])
        self._short, self._measured = bool(sites.has_short_ticks[0]), bool(sites.measured[0])
        self.x1, self.x2, self.layer = x1.copy(), x2.copy(), sites.initial_layer.copy()
        self._kept = bool(sites.drainage_to_cistern.any())
        self._mains_volume = sites.a1 * sites.mains_level
        self._steps = math.ceil(self._tau / _MAX_STEP_S)

    def tick(self, rain: Values, potential: Values, command: Values, outlet: Values) -> Moved:
        """Return what moves during the present tick, and move on to the next.

        Args:
            rain: on each site (m/s).
            potential: evapotranspiration off each bed (m3/s), of plants that lack no water.
            command: to the pumps (share of the maximum flow).
            outlet: share to which each low outlet is open (1).
        """
        sites, tau = self.sites, self._tau
        with np.errstate(divide="ignore", invalid="ignore"):
            collected, on_roof = rain * sites.effective_catchment, rain * sites.a2
            if self._short:
                cistern = self._short_cistern(collected, command, outlet)
            else:
                missing, rise = self._find_missing(on_roof, potential, command)
                cistern = self._long_cistern(collected, command, outlet, missing, rise)
            volumes, out, low, mains, limited = cistern
            pump = volumes.sum(axis=0)
            drainage, evaporated, percolated, dry = self._soil(
                on_roof + pump / tau, potential
            )
            limited |= dry
            if self._kept and not self._short:
                self._let_out_drainage(collected, drainage, volumes, outlet, out, low, mains)
            self.x1 = np.maximum(self.x1 + tau * (
                collected + sites.drainage_to_cistern * drainage
            ) + mains - out - pump, 0.0)
            self.layer = np.where(
                sites.has_layer, np.maximum(self.layer + tau * (percolated - drainage), 0.0),
                self.layer,
            )
            self.x2 = np.maximum(
                self.x2 + tau * (on_roof - evaporated - percolated) + pump, 0.0
            )
        return Moved(out, pump, tau * drainage, tau * evaporated, limited, mains, low)

    # --- cistern ----------------------------------------------------------------------------

    def _max_flow(self, x1: Values, rows: Rows | slice = slice(None)) -> Values:
        """Return the pumps' flow at command 1 (m3/s), Eq. (3e)."""
        sites = self.sites
        head = x1 / sites.a1[rows] + sites.c_hat[rows] - sites.d[rows]
        return np.asarray(sites.b[rows] * np.sqrt(np.maximum(head, 0.0)))

    def _short_cistern(
        self, collected: Values, command: Values, outlet: Values
    ) -> tuple[Values, Values, Values, Values, Flags]:
        """Return pumped water, shape (1, n), outflow, low outlet, mains (m3), and the limited."""
        sites, x1, tau = self.sites, self.x1, self._tau
        level = x1 / sites.a1
        works = (self.x2 / sites.a2 < sites.z_veg) & (level >= sites.suction_level)
        pump = tau * np.where(works, command * self._max_flow(x1), 0.0)
        above = level - sites.low_outlet_level
        low = tau * outlet * sites.c_low * np.sqrt(np.maximum(above, 0.0))
        out = low + tau * sites.c_out * np.sqrt(np.maximum(level - sites.z_o, 0.0))
        demand = out + pump
        mains = tau * self._mains_flow(x1, demand / tau - collected, tau)
        available = x1 + tau * collected + mains
        limited = demand > available
        share = np.where(limited, available / demand, 1.0)
        return (share * pump)[None], share * out, share * low, mains, limited

    def _mains_flow(
        self, x1: Values, drawn: Values, seconds: float, rows: Rows | slice = slice(None)
    ) -> Values:
        """Return the mean flow of the mains (m3/s); see :func:`.plant.mains_flow`."""
        missing, maximum = self._mains_volume[rows] - x1, self.sites.mains_flow[rows]
        before = np.where(missing > 0, maximum, 0.0)
        towards = before - drawn
        reaches = np.where(
            missing * towards > 0, missing / towards, np.where(missing != 0, seconds, 0.0)
        )
        share = np.minimum(reaches / seconds, 1.0)
        later = np.minimum(np.maximum(drawn, 0.0), maximum)
        return np.asarray(before * share + later * (1 - share))

    def _find_missing(
        self, on_roof: Values, potential: Values, command: Values
    ) -> tuple[Values, Values]:
        """Return what must be pumped (m3), and its fall (m3/s); see :class:`.plant.Plant`."""
        sites, x2 = self.sites, self.x2
        pumps = (command > 0) & (x2 / sites.a2 < sites.z_veg)
        if not pumps.any():
            nothing = np.zeros_like(x2)
            return nothing, nothing
        evaporated = potential * self._stress(x2)
        target = sites.a2 * sites.z_veg
        rises = on_roof > evaporated
        to = target + np.where(rises, 0.0, self._tau * evaporated)
        missing = self._water_to_raise(x2, to) - np.where(rises, 0.0, self._tau * on_roof)
        rise = np.where(rises & pumps, on_roof - evaporated, 0.0)
        return np.where(pumps, missing, 0.0), rise

    def _long_cistern(
        self, collected: Values, command: Values, outlet: Values, missing: Values, rise: Values
    ) -> tuple[Values, Values, Values, Values, Flags]:
        """Return what :meth:`_short_cistern` returns, with what is pumped in each step of a tick.

        If nothing is quick in a site, it is pumped evenly in its tick.
        """
        sites, x1, tau, steps = self.sites, self.x1, self._tau, self._steps
        flow = np.where(missing > 0, command * self._max_flow(x1), 0.0)
        filled = np.maximum(x1, self._mains_volume) + tau * collected
        quick = filled > self._fits(outlet)
        quick |= tau * flow > _SHORT_SHARE * sites.x2_star
        volumes = np.empty((steps, len(x1)))
        out, low, mains = (np.empty_like(x1) for _ in range(3))
        for rows, parts in ((np.flatnonzero(~quick), 1), (np.flatnonzero(quick), steps)):
            if len(rows):
                pumped, out[rows], low[rows], mains[rows] = self._step_cisterns(
                    rows, parts, collected[rows], command[rows], outlet[rows], missing[rows],
                    rise[rows],
                )
                volumes[:, rows] = pumped if parts == steps else pumped / steps
        return volumes, out, low, mains, np.zeros(len(x1), bool)

    def _fits(self, outlet: Values) -> Values:
        """Return the volume above which water leaves each cistern for the sewer (m3)."""
        sites = self.sites
        level = np.where(outlet > 0, sites.low_outlet_level, sites.z_o)
        return np.asarray(sites.a1 * level)

    def _step_cisterns(
        self, rows: Rows, steps: int, collected: Values, command: Values, outlet: Values,
        missing: Values, rise: Values,
    ) -> tuple[Values, Values, Values, Values]:
        """Return what is pumped in each step, and what flows out and in (m3), of some sites."""
        sites, x1 = self.sites, self.x1[rows]
        seconds = self._tau / steps
        lowest = sites.a1[rows] * sites.suction_level[rows] * (1 + _ROUNDING)
        arrives = seconds * collected
        running = np.zeros(len(x1), bool)
        volumes = np.zeros((steps, len(x1)))
        out, let_out, let_in = (np.zeros_like(x1) for _ in range(3))
        for step in range(steps):
            mains = seconds * self._mains_flow(x1, -collected, seconds, rows)
            flow = np.where(missing > 0, command * self._max_flow(x1, rows), 0.0)
            if flow.any():
                full = flow * seconds
                volume = np.minimum(full, missing * np.divide(
                    flow, flow + rise, out=np.zeros_like(flow), where=flow > 0
                ))
                least = np.where(running, 0.0, flow * min(seconds, MIN_RUN_S))
                runs = volume > 0
                runs &= np.minimum(volume, x1 + arrives + mains - lowest) >= least
                refilled = seconds * self._mains_flow(
                    x1, volume / seconds - collected, seconds, rows
                )
                mains = np.where(runs, refilled, mains)
                volume = np.where(runs, np.minimum(volume, x1 + arrives + mains - lowest), 0.0)
                running = (volume >= full) & (full > 0)
                missing = missing - volume
                volumes[step] = volume
            missing = missing - seconds * rise
            x1 = x1 + arrives + mains - volumes[step]
            upper, low = self._let_out(x1, outlet, seconds, rows)
            x1 = x1 - upper - low
            out += upper + low
            let_out += low
            let_in += mains
        return volumes, out, let_out, let_in

    def _let_out(
        self, x1: Values, outlet: Values, seconds: float, rows: Rows
    ) -> tuple[Values, Values]:
        """Return what both outlets take in a step (m3); see :class:`.plant.Plant`."""
        sites = self.sites
        a1 = sites.a1[rows]
        upper = _take(x1 - a1 * sites.z_o[rows], sites.c_out[rows] * seconds, a1)
        above = x1 - upper - a1 * sites.low_outlet_level[rows]
        return upper, _take(above, outlet * sites.c_low[rows] * seconds, a1)

    def _let_out_drainage(
        self, collected: Values, drainage: Values, volumes: Values, outlet: Values, out: Values,
        low: Values, mains: Values,
    ) -> None:
        """Compute again what flows out and in where drainage flows into the cistern, too."""
        kept = self.sites.drainage_to_cistern
        arriving = collected + kept * drainage
        again = (kept > 0) & (drainage > 0)
        again &= (mains > 0) | (self.x1 + self._tau * arriving + mains > self._fits(outlet))
        rows = np.flatnonzero(again)
        if not len(rows):
            return
        x1, arriving, share = self.x1[rows], arriving[rows], outlet[rows]
        seconds = self._tau / self._steps
        out[rows] = low[rows] = mains[rows] = 0.0
        for pumped in volumes[:, rows]:
            let_in = seconds * self._mains_flow(x1, pumped / seconds - arriving, seconds, rows)
            x1 = x1 + seconds * arriving + let_in - pumped
            upper, lower = self._let_out(x1, share, seconds, rows)
            x1 = x1 - upper - lower
            out[rows] += upper + lower
            low[rows] += lower
            mains[rows] += let_in

    # --- soil -------------------------------------------------------------------------------

    def _filled_share(self, x2: Values) -> Values:
        sites = self.sites
        share = np.maximum((x2 - sites.wilting_volume) / sites.available_volume, 0.0)
        return np.where(x2 >= sites.z_cap, 1.0, share)

    def _stress(self, x2: Values) -> Values | float:
        if not self._measured:
            return 1.0
        return np.minimum(self._filled_share(x2) / self.sites.stress_onset, 1.0)

    def _water_to_raise(self, x2: Values, to: Values) -> Values:
        """Return the water that raises each soil in a tick; see :mod:`.soil`."""
        if not self._measured:
            return to - x2
        sites = self.sites
        filled, reached = self._filled_share(x2), self._filled_share(to)
        reached = np.minimum(reached, _ALMOST_FULL)
        first = np.maximum(np.minimum(to, sites.wilting_volume) - x2, 0.0)
        g = np.maximum((reached - filled) / (1 - filled * reached), 0.0)
        return np.asarray(first + sites.available_volume * np.arctanh(g))

    def _soil(
        self, arriving: Values, potential: Values
    ) -> tuple[Values, Values, Values, Flags]:
        """Return drainage off the roof, evapotranspiration, percolation (m3/s), and the limited."""
        sites, x2, tau = self.sites, self.x2, self._tau
        available = x2 / tau + arriving
        if not self._measured:
            above = x2 - sites.z_cap
            darcy = sites.K * sites.a2 * (x2 / sites.a2 + sites.z_soil) / sites.z_soil
            overdraws = 2 * sites.K * tau > _MAX_OVERDRAWN_M
            darcy = np.where(overdraws, np.minimum(darcy, above / tau + arriving), darcy)
            drainage = np.where(above < 0, 0.0, darcy)
            demand = potential + drainage
            limited = demand > available
            share = np.where(limited, available / demand, 1.0)
            return share * drainage, share * potential, share * drainage, limited
        percolated = self._percolate(arriving)
        evaporated, remaining = potential * self._stress(x2), available - percolated
        limited = evaporated > remaining
        evaporated = np.where(limited, np.maximum(remaining, 0.0), evaporated)
        return self._drain_layer(percolated), evaporated, percolated, limited

    def _percolate(self, arriving: Values) -> Values:
        """Return the percolation out of each substrate (m3/s)."""
        sites, x2, tau = self.sites, self.x2, self._tau
        filled, available = self._filled_share(x2), sites.available_volume
        first = np.minimum(arriving * tau, np.maximum(sites.wilting_volume - x2, 0.0))
        g = np.tanh((arriving * tau - first) / available)
        retained = first + available * g * (1 - filled * filled) / (1 + filled * g)
        above = arriving + (x2 - sites.z_cap) / tau
        return np.where(
            x2 >= sites.z_cap, above, np.maximum(arriving - retained / tau, 0.0)
        )

    def _drain_layer(self, inflow: Values) -> Values:
        """Return the outflow of each drainage layer, off the roof (m3/s)."""
        sites, layer, tau = self.sites, self.layer, self._tau
        k = 1 / (sites.layer_storage * sites.drainage_time)
        rate = np.sqrt(inflow * k)
        g = np.where(rate > 0, np.tanh(rate * tau) / rate, tau)
        remaining = np.minimum((layer + inflow * g) / (1 + k * layer * g), sites.layer_storage)
        drained = np.maximum(inflow + (layer - remaining) / tau, 0.0)
        return np.where(sites.has_layer, drained, inflow)


def _take(above: Values, drop: Values, a1: Values) -> Values:
    """Return what an outlet takes in a step of what stands above it (m3), backward Euler."""
    above = np.maximum(above, 0.0)
    root = np.sqrt(drop**2 + 4 * a1 * above)
    return np.divide(
        drop * 2 * above, drop + root, out=np.zeros_like(above), where=above > 0
    )
