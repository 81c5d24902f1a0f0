"""The plants of many sites under on/off control, computed with arrays as in :mod:`.plant`.

Every volume and flow equals that of :class:`.plant.Plant` for the same state, except for rounding
(a relative error of at most 1e-10). Rounding can reverse decisions at a threshold: a roof that the
pump has just filled to its target can end up slightly above or below the target. The next dose then
begins one tick earlier or later, so the sums over a run differ by at most the evaporation of one
tick. In most ticks, most sites are calm: the water level is below all open outlets, and the pump is
either off or delivers the whole missing volume in the first step of a long tick. The flows of calm
sites are computed without steps. Only the other sites, a subset of the rows, are computed in steps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.cisterns import CisternFlows, Cisterns
from greenroof_ros.model.sites import Sites
from greenroof_ros.model.soils import soils_of
from greenroof_ros.physics.plant import MAX_STEP_S, MIN_RUN_S

Values = NDArray[np.float64]
Rows = NDArray[np.intp] | slice
Flags = NDArray[np.bool_]

# Relative; more than the rounding error of a volume.
_ROUNDING = 1e-9
# tanh(r t) / (r t) is 1 for such an (r t)^2.
_TINY = 1e-60
_ALL = slice(None)


class Moved(NamedTuple):
    """Volumes that flow during a tick at each site (m3): :class:`.plant.Flows` times tau."""

    outflow: Values
    pump: Values
    drainage: Values
    evapotranspiration: Values
    limited: Values
    """1 if a tank contained less water than was demanded, otherwise 0"""
    mains: Values
    low_outlet: Values


class _Pumping(NamedTuple):
    """The sites at which pumps may run in a tick."""

    rows: Rows
    missing: Values
    """volume that must be pumped to fill each roof to its target (m3), infinite in a short tick; 0
    if the pump does not run
    """
    rise: Values | float = 0.0
    """rate at which rain reduces ``missing`` (m3/s)"""


class Plants:
    """The cisterns and roofs of many sites, with the attributes of a single plant as arrays.

    Attributes:
        x1: volume in each cistern (m3).
        x2: volume on each roof (m3).
        layer: volume in each drainage layer (m3).
        moved: volumes that flowed in the last tick.
        all_moved: the volumes of ``moved`` in one array, shape (7, n).
        flowed: whether the last tick had any flows other than drainage, evapotranspiration and
            pumped water.
    """

    def __init__(
        self, sites: Sites, x1: Values, x2: Values, fraction: Values, level: Values
    ) -> None:
        """Set the initial volumes.

        Args:
            sites: sites with the same tau. Either all or none have short ticks, and either all or
                none have a field-capacity soil.
            x1: volume in each cistern (m3).
            x2: volume on each roof (m3).
            fraction: command of the on/off control during pumping (share of the maximum flow).
            level: share of the target to which on/off control fills each roof (1).
        """
        self.sites, self._tau = sites, float(sites.tau[0])
        self.x1, self.x2, self.layer = x1.copy(), x2.copy(), sites.initial_layer.copy()
        self.all_moved = np.zeros((len(Moved._fields), len(sites)))
        self.moved = Moved(*self.all_moved)
        self.flowed = False
        self._short, self._steps = bool(sites.has_short_ticks[0]), math.ceil(self._tau / MAX_STEP_S)
        self._cisterns, self._soils = Cisterns.of(sites), soils_of(sites)
        self._kept = bool(sites.drainage_to_cistern.any())
        self._fraction, self._dry = fraction, level * sites.z_veg
        self._suction, self._target = sites.a1 * sites.suction_level, sites.a2 * sites.z_veg
        # A layer that stores nothing lets through what percolates.
        self._layers, decay = bool(sites.has_layer.any()), sites.layer_storage * sites.drainage_time
        self._decay = np.divide(
            self._tau, decay, out=np.zeros_like(decay), where=sites.has_layer
        )
        self._work = [np.empty(len(sites)), np.empty(len(sites))]
        self._outlet, self._calm, self._low_only = (np.empty(0) for _ in range(3))
        # Rows whose low outlets alone flow; most are the same for many ticks.
        self._draining = np.empty(0, np.intp), self._cisterns
        # In a long tick a pump lifts no less than this (m3).
        flow = fraction * self._cisterns.pump_flow(self._suction)
        self._min_lifted = (1 - _ROUNDING) * flow * min(self._tau / self._steps, MIN_RUN_S)
        if self._short:
            self._min_lifted.fill(0.0)

    def set_weather(self, rain: Values, potential: Values) -> None:
        """Set the weather for the current tick and for later ticks.

        Args:
            rain: rain on each site (m/s).
            potential: potential evapotranspiration from each bed (m3/s).
        """
        sites, tau = self.sites, self._tau
        self._raining, self._on_roof = bool(rain.any()), rain * sites.a2
        self._collected = rain * sites.effective_catchment
        self._soils.set_weather(tau * potential, self._raining)
        # Of what is missing at most a share passes the soil; it is replaced with what evaporates.
        highest = self._target + tau * potential
        least = self._min_lifted * (1 - self._soils.passing(highest))
        self._pumps_below = (1 + _ROUNDING) * np.minimum(highest - least, sites.a2 * self._dry)

    def tick(self, outlet: Values, allowed: Flags | None = None) -> Moved:
        """Return the volumes that flow during the current tick, and proceed to the next tick.

        Args:
            outlet: opening of each low outlet, 0 to 1.
            allowed: mask of the sites whose pumps may run; None if all pumps may run.
        """
        moved, soils = self.moved, self._soils
        (self.all_moved if self.flowed else moved.pump).fill(0.0)
        self.flowed = False
        settled = soils.begin(self.x2, moved.evapotranspiration)
        pumping = self._find_pumping(allowed)
        if self._short:
            x1 = self._step_short(pumping, outlet)
        elif self._kept:
            x1, flows = self._step_all(pumping, outlet)
        elif self._raining:
            x1 = self._step_wet(pumping, outlet)
        else:
            x1 = self._step_dry(pumping, outlet)
        if settled:
            self._step_settled(pumping)
        else:
            self._step_roof()
        if self._kept:
            x1 += self.sites.drainage_to_cistern * moved.drainage
            if not self._short:
                self._let_out_drainage(flows, outlet, x1)
        self.x1 = np.maximum(x1, 0.0, out=x1)
        return moved

    # --- pumps ------------------------------------------------------------------------------

    def _find_pumping(self, allowed: Flags | None) -> _Pumping | None:
        """Return the sites at which pumps may run, with their missing volumes; None if none.

        On/off control, Eq. (12), pumps while the roof is too dry and the cistern contains enough
        water.
        """
        below = self.x2 <= self._pumps_below
        if allowed is not None:
            below &= allowed
        found = below.nonzero()[0]
        if not len(found):
            return None
        rows: Rows = found if 2 * len(found) < len(below) else _ALL
        runs = self.x2[rows] / self.sites.a2[rows] < self._dry[rows]
        runs &= self.x1[rows] >= self._suction[rows]
        if allowed is not None:
            runs &= allowed[rows]
        if self._short:
            return _Pumping(rows, np.where(runs, math.inf, 0.0))
        evaporated, to = self.moved.evapotranspiration[rows], self._target[rows]
        rise: Values | float = 0.0
        if not self._raining:
            missing = self._soils.water_to_raise(to + evaporated, rows)
        else:
            fallen = self._tau * self._on_roof[rows]
            rises = fallen > evaporated
            missing = self._soils.water_to_raise(to + np.where(rises, 0.0, evaporated), rows)
            missing -= np.where(rises, 0.0, fallen)
            rise = np.where(rises & runs, fallen - evaporated, 0.0) / self._tau
        runs &= missing >= self._min_lifted[rows]
        return _Pumping(rows, np.multiply(missing, runs, out=missing), rise)

    # --- cisterns ---------------------------------------------------------------------------

    def _step_short(self, pumping: _Pumping | None, outlet: Values) -> Values:
        """Store the flows of the cisterns in a short tick, and return their final volumes (m3)."""
        cisterns, x1 = self._cisterns, self.x1
        flow = np.zeros_like(x1)
        if pumping is not None:
            runs, fraction = pumping.missing > 0, self._fraction[pumping.rows]
            flow[pumping.rows] = runs * fraction * cisterns.pump_flow(x1)[pumping.rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            flows, limited = cisterns.step_short(self._tau, x1, self._collected, flow, outlet)
        self.moved.limited[:] = limited
        return self._write(_ALL, flows)

    def _write(self, rows: Rows, flows: CisternFlows) -> Values:
        """Store the flows of some cisterns, and return their final volumes (m3)."""
        moved, pump = self.moved, flows.volumes.sum(axis=0)
        moved.pump[rows], moved.mains[rows] = pump, flows.mains
        moved.outflow[rows], moved.low_outlet[rows] = flows.outflow, flows.low_outlet
        self.flowed = True
        collected = self._tau * self._collected[rows]
        return np.asarray(self.x1[rows] + collected + flows.mains - flows.outflow - pump)

    def _step_rows(
        self, rows: Rows, pumping: _Pumping | None, outlet: Values
    ) -> CisternFlows:
        """Return the flows of some cisterns in a long tick, computed in steps."""
        cisterns = self._cisterns.take(rows)
        missing, rise = np.zeros((2, len(self.sites)))
        if pumping is not None:
            missing[pumping.rows], rise[pumping.rows] = pumping.missing, pumping.rise
        with np.errstate(divide="ignore", invalid="ignore"):
            return cisterns.step_long(self._tau, self._steps, *(values[rows] for values in (
                self.x1, self._collected, self._fraction, outlet, missing, rise
            )))

    def _step_all(
        self, pumping: _Pumping | None, outlet: Values
    ) -> tuple[Values, CisternFlows]:
        """Store all cisterns' flows in a long tick; return the final volumes (m3) and flows."""
        flows = self._step_rows(_ALL, pumping, outlet)
        return self._write(_ALL, flows), flows

    def _step_wet(self, pumping: _Pumping | None, outlet: Values) -> Values:
        """Store all cisterns' flows in a long tick with rain; return the final volumes (m3)."""
        filled = self._cisterns.filled
        after = self.x1 + self._tau * self._collected
        stepped = (after > self._find_calm(outlet)) | (self.x1 < filled)
        if pumping is not None:
            stepped[pumping.rows] |= pumping.missing > 0
        self._step_some(stepped, pumping, outlet, after)
        return after

    def _step_dry(self, pumping: _Pumping | None, outlet: Values) -> Values:
        """Store all cisterns' flows in a long tick without rain; return the final volumes (m3)."""
        cisterns, moved = self._cisterns, self.moved
        flowing = self.x1 > self._find_calm(outlet)
        stepped = self.x1 > self._low_only
        if pumping is not None:
            self._lift(pumping, flowing, stepped)
        after: Values = self.x1 - moved.pump
        low = (after < cisterns.filled).nonzero()[0]
        if len(low):
            mains = cisterns.filled[low] - after[low]
            # They can refill in the other steps what is pumped in the first.
            most = cisterns.mains_flow[low] * (self._tau - self._tau / self._steps)
            stepped[low] |= np.maximum(mains, moved.pump[low]) > most
            moved.mains[low], after[low], self.flowed = mains, cisterns.filled[low], True
        flowing &= ~stepped
        self._drain_some(flowing, outlet, after)
        self._step_some(stepped, pumping, outlet, after)
        return after

    def _lift(self, pumping: _Pumping, flowing: Flags, stepped: Flags) -> None:
        """Store the volume pumped in the first step of a dry tick; mark rows that need steps."""
        rows, missing, tau, seconds = *pumping[:2], self._tau, self._tau / self._steps
        cisterns, x1 = self._cisterns.take(rows), self.x1[rows]
        flow = cisterns.pump_flow(x1)
        flow *= self._fraction[rows]
        min_volume = flow * min(seconds, MIN_RUN_S)
        lifted = missing * (missing >= min_volume)
        usable = x1 - cisterns.lowest
        more = lifted > np.minimum(flow * seconds, usable)
        if more.any():
            # Where nothing is quick, the tick is a single step.
            quick = flowing[rows] | cisterns.is_quick(tau * flow)
            more &= quick | (lifted > np.minimum(flow * tau, usable))
            empty = more & (usable < min_volume) & (cisterns.mains_flow == 0)
            lifted[empty] = 0.0
            stepped[rows] |= more & ~empty
        later = missing > lifted
        if later.any():  # the dose that is too small for the pump's flow may suffice as it falls
            stepped[rows] |= later & flowing[rows]
        self.moved.pump[rows] = lifted

    def _find_calm(self, outlet: Values) -> Values:
        """Return the volume (m3) up to which no water flows from each cistern to the sewer."""
        if outlet is not self._outlet:
            cisterns, held = self._cisterns, self._cisterns.hold(outlet)
            # Mains that fill beyond an outlet: it always flows.
            always = cisterns.filled > held
            self._calm = np.where(always, -math.inf, held)
            self._low_only = np.where(always, -math.inf, cisterns.upper)
            self._outlet = outlet
        return self._calm

    def _drain_some(self, flowing: Flags, outlet: Values, after: Values) -> None:
        """Drain cisterns whose only flow after the first step is through the low outlet."""
        rows = flowing.nonzero()[0]
        if not len(rows):
            return
        if len(rows) != len(self._draining[0]) or (rows != self._draining[0]).any():
            self._draining = rows, self._cisterns.take(rows)
        cisterns, steps = self._draining[1], self._steps
        low = cisterns.drain(self._tau / steps, steps, after[rows], outlet[rows])
        self.moved.outflow[rows] = self.moved.low_outlet[rows] = low
        after[rows] -= low
        self.flowed = True

    def _step_some(
        self, stepped: Flags, pumping: _Pumping | None, outlet: Values, after: Values
    ) -> None:
        """Simulate some cisterns in the steps of a long tick; store their final volumes (m3)."""
        rows = stepped.nonzero()[0]
        if len(rows):
            after[rows] = self._write(rows, self._step_rows(rows, pumping, outlet))

    def _let_out_drainage(self, flows: CisternFlows, outlet: Values, after: Values) -> None:
        """Recompute the outflow and the inflow of cisterns that receive drainage."""
        tau, cisterns, moved, kept = (
            self._tau, self._cisterns, self.moved, self.sites.drainage_to_cistern
        )
        arriving = self._collected + kept * moved.drainage / tau
        again = (kept > 0) & (moved.drainage > 0)
        again &= (moved.mains > 0) | (
            self.x1 + tau * arriving + moved.mains > cisterns.hold(outlet)
        )
        rows = again.nonzero()[0]
        if len(rows):
            with np.errstate(divide="ignore", invalid="ignore"):
                flows = cisterns.take(rows).let_out_all(
                    tau / self._steps, self.x1[rows], arriving[rows], outlet[rows],
                    flows.volumes[:, rows],
                )
            after[rows] = self._write(rows, flows) + kept[rows] * moved.drainage[rows]

    # --- roofs ------------------------------------------------------------------------------

    def _step_settled(self, pumping: _Pumping | None) -> None:
        """Advance roofs without rain to the next tick; only pumped water percolates."""
        moved, layer, x2 = self.moved, self.layer, self.x2
        if pumping is not None:
            rows, pump = pumping.rows, moved.pump[pumping.rows]
            percolated = self._soils.percolate(pump, rows)
            remaining, drained = self._drain_layer(percolated, rows)
        if pumping is None or rows is not _ALL:
            self._empty_layers()
            layer = self.layer
        x2 -= moved.evapotranspiration
        if pumping is not None:
            x2[rows] += pump - percolated
            moved.drainage[rows], layer[rows] = drained, remaining

    def _empty_layers(self) -> None:
        """Drain the drainage layers that receive no water."""
        layer, drainage = self.layer, self.moved.drainage
        if not self._layers:
            drainage.fill(0.0)
            return
        part, remaining = self._work
        np.multiply(self._decay, layer, out=part)
        np.add(part, 1, out=part)
        np.divide(layer, part, out=remaining)
        np.subtract(layer, remaining, out=drainage)
        self.layer, self._work[1] = remaining, layer

    def _step_roof(self) -> None:
        """Advance roofs to the next tick in any weather."""
        moved, x2 = self.moved, self.x2
        arrived = self._tau * self._on_roof + moved.pump
        percolated, evaporated, limited = self._soils.lose(moved.evapotranspiration, arrived)
        if limited.any():
            moved.limited[limited] = 1.0
            self.flowed = True
        moved.evapotranspiration[:] = evaporated
        self.layer[:], moved.drainage[:] = self._drain_layer(percolated, _ALL)
        np.maximum(x2 + arrived - percolated - evaporated, 0.0, out=x2)

    def _drain_layer(self, percolated: Values, rows: Rows) -> tuple[Values | float, Values]:
        """Return the remaining and the drained volumes of drainage layers (m3); see :mod:`.soil`.

        Args:
            percolated: volume that leaves the substrates (m3).
            rows: selection of the roofs.
        """
        if not self._layers:
            return 0.0, percolated
        # With layer and inflow as volumes, g is tanh(r t) / (r t).
        layer, decay = self.layer[rows], self._decay[rows]
        held, rate = layer + percolated, percolated * decay
        rate += _TINY
        np.sqrt(rate, out=rate)
        g = np.tanh(rate)
        g /= rate
        remaining = np.multiply(percolated, g, out=rate)
        remaining += layer
        g *= decay
        g *= layer
        g += 1
        remaining /= g
        np.minimum(remaining, self.sites.layer_storage[rows], out=remaining)
        np.minimum(remaining, held, out=remaining)
        return remaining, np.subtract(held, remaining, out=held)
