"""The plants of many sites: the tick of :mod:`.plant` and :mod:`.soil` on arrays.

Each volume and flow is that of :class:`.plant.Plant` from the same state, but for rounding (1e-10
of it and better). Where a threshold decides, rounding can turn the decision: a roof that the pump
has just filled to its target is a bit above or below it. Then its next dose comes a tick earlier or
later, so sums over a run agree at least to what evaporates in a tick.

Most ticks are dry, and in them most sites are **calm**: no water stands above an outlet that is
open, and what is missing on the roof is lifted within the first step of a long tick. What flows
then is known without steps. Only the others are stepped, gathered by their rows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.cisterns import CisternFlows, Cisterns
from greenroof_ros.model.plant import MAX_STEP_S, MIN_RUN_S
from greenroof_ros.model.sites import Sites
from greenroof_ros.model.soils import soils_of

Values = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

_TINY = 1e-60


class Moved(NamedTuple):
    """What moves during a tick in each site (m3), as :class:`.plant.Flows` times tau."""

    outflow: Values
    pump: Values
    drainage: Values
    evapotranspiration: Values
    limited: Values
    """1 or 0"""
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
        self._short, self._steps = bool(sites.has_short_ticks[0]), math.ceil(self._tau / MAX_STEP_S)
        self._cisterns, self._soils = Cisterns.of(sites), soils_of(sites)
        self.x1, self.x2, self.layer = x1.copy(), x2.copy(), sites.initial_layer.copy()
        self._target, self._kept = sites.a2 * sites.z_veg, bool(sites.drainage_to_cistern.any())
        # A layer that stores nothing lets through what percolates.
        decay = sites.layer_storage * sites.drainage_time
        self._decay = np.divide(1, decay, out=np.zeros_like(decay), where=sites.has_layer)
        self._outlet, self._held = np.empty(0), np.empty(0)
        self._layers = bool(sites.has_layer.any())
        self._work, self._nothing = np.empty((3, len(sites))), np.zeros(len(sites))
        self._levels: tuple[Values, Values] | None = None

    def levels(self) -> tuple[Values, Values]:
        """Return the water depths in the cisterns and on the roofs (m), as sensors read them."""
        if self._levels is None:
            self._levels = self.x1 / self.sites.a1, self.x2 / self.sites.a2
        return self._levels

    def set_weather(self, rain: Values, potential: Values) -> None:
        """Set the weather of the present tick and of those that follow.

        Args:
            rain: on each site (m/s).
            potential: evapotranspiration off each bed (m3/s), of plants that lack no water.
        """
        self._raining, self._potential = bool(rain.any()), potential
        self._collected = rain * self.sites.effective_catchment
        self._on_roof = rain * self.sites.a2

    def tick(self, command: Values | None, outlet: Values, moved: Moved) -> None:
        """Compute what moves during the present tick, and move on to the next.

        Args:
            command: to the pumps (share of the maximum flow); None if all stand still.
            outlet: share to which each low outlet is open (1).
            moved: where it is written.
        """
        tau, soils, pump = self._tau, self._soils, moved.pump
        evaporated = soils.begin(self.x2, self._potential, self._raining)
        np.multiply(tau, evaporated, out=moved.evapotranspiration)
        for values in (pump, moved.outflow, moved.limited, moved.mains, moved.low_outlet):
            values.fill(0.0)
        if self._short:
            x1 = self._step_short(command, outlet, moved)
        elif self._kept:
            x1, flows = self._step_all(command, outlet, moved)
        elif self._raining:
            x1 = self._step_wet(command, outlet, moved)
        else:
            x1 = self._step_dry(command, outlet, moved)
        arriving = None
        if command is not None:
            arriving = np.divide(pump, tau, out=self._work[0])
        if self._raining:
            arriving = self._on_roof if arriving is None else arriving + self._on_roof
        percolated, evaporated, limited = soils.lose(arriving)
        if limited is not None:
            np.multiply(tau, evaporated, out=moved.evapotranspiration)
            np.logical_or(moved.limited, limited, out=moved.limited)
        self._drain_layer(percolated, moved.drainage)
        if self._kept:
            x1 += self.sites.drainage_to_cistern * moved.drainage
            if not self._short:
                self._let_out_drainage(flows, outlet, moved, x1)
        self.x1 = np.maximum(x1, 0.0, out=x1)
        self._step_roof(percolated, moved)
        self._levels = None

    # --- cisterns ---------------------------------------------------------------------------

    def _step_short(self, command: Values | None, outlet: Values, moved: Moved) -> Values:
        """Write the flows of cisterns in a short tick; return what they hold after it (m3)."""
        sites, cisterns, x1 = self.sites, self._cisterns, self.x1
        flow = np.zeros_like(x1)
        if command is not None:
            cistern, roof = self.levels()
            works = (roof < sites.z_veg) & (cistern >= sites.suction_level)
            flow = np.where(works, command * cisterns.pump_flow(x1), 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            flows, limited = cisterns.step_short(self._tau, x1, self._collected, flow, outlet)
        moved.limited[:] = limited
        return self._write(flows, moved)

    def _write(self, flows: CisternFlows, moved: Moved) -> Values:
        """Write the flows of all cisterns; return what they hold then (m3)."""
        moved.pump[:] = flows.volumes.sum(axis=0)
        moved.outflow[:], moved.low_outlet[:], moved.mains[:] = flows[1:]
        return np.asarray(
            self.x1 + self._tau * self._collected + moved.mains - moved.outflow - moved.pump
        )

    def _step_all(
        self, command: Values | None, outlet: Values, moved: Moved
    ) -> tuple[Values, CisternFlows]:
        """Write the flows of all cisterns in a long tick; return also what they hold after it."""
        command = np.zeros_like(self.x1) if command is None else command
        missing, rise = self._find_missing(command, moved)
        with np.errstate(divide="ignore", invalid="ignore"):
            flows = self._cisterns.step_long(
                self._tau, self._steps, self.x1, self._collected, command, outlet, missing, rise
            )
        return self._write(flows, moved), flows

    def _find_missing(self, command: Values, moved: Moved) -> tuple[Values, Values]:
        """Return what must be pumped (m3), and its fall (m3/s); see :class:`.plant.Plant`."""
        tau, on_roof = self._tau, self._on_roof
        pumps = self._may_pump(command)
        evaporated = moved.evapotranspiration / tau
        rises = on_roof > evaporated
        to = self._target + np.where(rises, 0.0, moved.evapotranspiration)
        missing = self._soils.water_to_raise(to) - np.where(rises, 0.0, tau * on_roof)
        rise = np.where(rises & pumps, on_roof - evaporated, 0.0)
        return np.where(pumps, missing, 0.0), rise

    def _step_wet(self, command: Values | None, outlet: Values, moved: Moved) -> Values:
        """Return what cisterns hold after a long tick with rain (m3), and write their flows."""
        cisterns, x1, missing, rise = self._cisterns, self.x1, self._nothing, self._nothing
        after = x1 + self._tau * self._collected
        stepped = (after > self._find_calm(outlet)) | (x1 < cisterns.filled)
        if command is not None:
            stepped |= command > 0
            missing, rise = self._find_missing(command, moved)
        self._step_some(stepped, command, outlet, missing, rise, after, moved)
        return after

    def _step_dry(self, command: Values | None, outlet: Values, moved: Moved) -> Values:
        """Return what cisterns hold after a long tick without rain (m3), and write their flows."""
        cisterns, x1, missing, lifted = self._cisterns, self.x1, self._nothing, moved.pump
        tau, seconds = self._tau, self._tau / self._steps
        stepped = x1 > self._find_calm(outlet)
        if command is not None:
            to = np.add(self._target, moved.evapotranspiration, out=self._work[0])
            missing = self._soils.water_to_raise(to)
            missing *= self._may_pump(command)
            flow = command * cisterns.pump_flow(x1)
            min_volume = flow * min(seconds, MIN_RUN_S)
            np.multiply(missing, missing >= min_volume, out=lifted)
            usable = x1 - cisterns.lowest
            more = lifted > np.minimum(flow * seconds, usable)
            if more.any():
                empty = more & (usable < min_volume) & (cisterns.mains_flow == 0)
                lifted[empty] = 0.0
                stepped |= more & ~empty
        left = np.subtract(x1, lifted, out=self._work[1])
        after: Values = np.maximum(left, cisterns.filled)
        mains = np.subtract(after, left, out=moved.mains)
        if mains.any():
            # They can refill in the other steps what was pumped in the first.
            stepped |= mains > cisterns.mains_flow * (tau - seconds)
        self._step_some(stepped, command, outlet, missing, self._nothing, after, moved)
        return after

    def _may_pump(self, command: Values) -> Flags:
        """Return where the pumps are commanded, and the roof is below its target."""
        return np.asarray((command > 0) & (self.levels()[1] < self.sites.z_veg))

    def _find_calm(self, outlet: Values) -> Values:
        """Return the volume (m3) up to which no water leaves each cistern for the sewer."""
        if outlet is not self._outlet:
            held = self._cisterns.hold(outlet)
            # Mains that fill beyond an outlet: it always flows.
            self._held = np.where(self._cisterns.filled > held, -math.inf, held)
            self._outlet = outlet
        return self._held

    def _step_some(
        self, stepped: Flags, command: Values | None, outlet: Values, missing: Values,
        rise: Values, after: Values, moved: Moved,
    ) -> None:
        """Step some cisterns through a long tick, and write what they hold after it (m3)."""
        rows = stepped.nonzero()[0]
        if not len(rows):
            return
        command = self._nothing if command is None else command
        x1, collected = self.x1[rows], self._collected[rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            flows = self._cisterns.take(rows).step_long(
                self._tau, self._steps, x1, collected,
                *(values[rows] for values in (command, outlet, missing, rise)),
            )
        pump = flows.volumes.sum(axis=0)
        moved.pump[rows] = pump
        moved.outflow[rows], moved.low_outlet[rows], moved.mains[rows] = flows[1:]
        after[rows] = x1 + self._tau * collected + flows.mains - flows.outflow - pump

    def _let_out_drainage(
        self, flows: CisternFlows, outlet: Values, moved: Moved, after: Values
    ) -> None:
        """Compute again what flows out and in where drainage flows into the cistern, too."""
        tau, cisterns = self._tau, self._cisterns
        arriving = self._collected + self.sites.drainage_to_cistern * moved.drainage / tau
        again = (self.sites.drainage_to_cistern > 0) & (moved.drainage > 0)
        filled = self.x1 + tau * arriving + moved.mains
        again &= (moved.mains > 0) | (filled > cisterns.hold(outlet))
        rows = np.flatnonzero(again)
        if not len(rows):
            return
        cisterns, arriving = cisterns.take(rows), arriving[rows]
        x1, seconds = self.x1[rows], tau / self._steps
        out, low, mains = np.zeros((3, len(rows)))
        with np.errstate(divide="ignore", invalid="ignore"):
            for pumped in flows.volumes[:, rows]:
                let_in = seconds * cisterns.mains(x1, pumped / seconds - arriving, seconds)
                x1 = x1 + seconds * arriving + let_in - pumped
                upper, lower = cisterns.let_out(x1, outlet[rows], seconds)
                x1 = x1 - upper - lower
                out += upper + lower
                low += lower
                mains += let_in
        moved.outflow[rows], moved.low_outlet[rows], moved.mains[rows] = out, low, mains
        after[rows] = self.x1[rows] + tau * arriving + mains - out - moved.pump[rows]

    # --- roofs ------------------------------------------------------------------------------

    def _drain_layer(self, percolated: Values | None, drainage: Values) -> None:
        """Write what drains off the roofs in a tick (m3), through their drainage layers."""
        sites, layer, tau, k = self.sites, self.layer, self._tau, self._decay
        if not self._layers:
            if percolated is None:
                drainage.fill(0.0)
            else:
                np.multiply(tau, percolated, out=drainage)
            return
        g, remaining, part = self._work
        if percolated is None:
            np.multiply(k, layer, out=part)
            np.multiply(part, tau, out=part)
            np.add(1, part, out=part)
            np.divide(layer, part, out=remaining)
        else:
            # tanh(r t) / r is t for the smallest r.
            rate = np.multiply(percolated, k, out=part)
            np.add(rate, _TINY, out=rate)
            np.sqrt(rate, out=rate)
            np.multiply(rate, tau, out=g)
            np.tanh(g, out=g)
            np.divide(g, rate, out=g)
            np.multiply(k, layer, out=part)
            np.multiply(part, g, out=part)
            np.add(1, part, out=part)
            np.multiply(percolated, g, out=remaining)
            np.add(layer, remaining, out=remaining)
            np.divide(remaining, part, out=remaining)
        np.minimum(remaining, sites.layer_storage, out=remaining)
        drained = np.subtract(layer, remaining, out=part)
        np.divide(drained, tau, out=drained)
        if percolated is not None:
            np.add(percolated, drained, out=drained)
        np.maximum(drained, 0.0, out=drained)
        np.multiply(tau, drained, out=drainage)
        if percolated is None:
            np.subtract(layer, drainage, out=layer)
        else:
            np.subtract(percolated, drained, out=drained)
            np.multiply(tau, drained, out=drained)
            np.add(layer, drained, out=layer)
        np.maximum(layer, 0.0, out=layer)

    def _step_roof(self, percolated: Values | None, moved: Moved) -> None:
        """Move the roofs on to the next tick."""
        lost = moved.evapotranspiration
        if percolated is not None:
            lost = np.add(lost, np.multiply(self._tau, percolated, out=percolated), out=percolated)
        if self._raining:
            self.x2 += self._tau * self._on_roof
        self.x2 -= lost
        self.x2 += moved.pump
        np.maximum(self.x2, 0.0, out=self.x2)
