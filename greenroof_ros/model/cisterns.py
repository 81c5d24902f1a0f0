"""Inflow and outflow of many sites' cisterns in a tick, computed as in :class:`.plant.Plant`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.sites import Sites
from greenroof_ros.physics.plant import ABOVE_SUCTION, MIN_RUN_S, SHORT_SHARE

Values = NDArray[np.float64]
Rows = NDArray[np.intp]
Flags = NDArray[np.bool_]

_TINY, _ALMOST = 1e-300, 1 - 1e-9
# So small that what it lets out is none, and its reciprocal times any volume is finite (m3).
_NO_OUTLET = 1e-200


class CisternFlows(NamedTuple):
    """Volumes that flow during a tick (m3), each of shape (n,)."""

    volumes: Values
    """volume pumped in each step, shape (steps, n)"""
    outflow: Values
    low_outlet: Values
    mains: Values


class Cisterns:
    """The site parameters that determine the flows of cisterns, each of shape (n,).

    Attributes:
        upper: volume up to the level of the upper outlet (m3).
        lower: volume up to the level of the low outlet, or of the upper outlet if there is no low
            outlet (m3).
        lowest: minimum volume that the pumps leave in the cistern (m3).
        filled: volume to which mains water fills the cistern (m3).
        mains_flow: flow of mains water while the float valve is open (m3/s).
    """

    def __init__(self, values: Values) -> None:
        """Set the parameters, given in the order used by :meth:`of`."""
        self._values = values
        (
            self._a1, self._b, self._lift, self._c_out, self._c_low, self.mains_flow,
            self.upper, self.lower, self.lowest, self.filled, self._much,
        ) = values

    @classmethod
    def of(cls, sites: Sites) -> Cisterns:
        """Return the cisterns of the given sites."""
        a1 = sites.a1
        return cls(np.stack((
            a1, sites.b, sites.c_hat - sites.d, sites.c_out, sites.c_low, sites.mains_flow,
            a1 * sites.z_o, a1 * sites.low_outlet_level,
            a1 * sites.suction_level * (1 + ABOVE_SUCTION), a1 * sites.mains_level,
            SHORT_SHARE * sites.x2_star,
        )))

    def take(self, rows: Rows | slice) -> Cisterns:
        """Return the selected cisterns, or all cisterns if ``rows`` is a slice."""
        return self if isinstance(rows, slice) else Cisterns(self._values.take(rows, axis=1))

    def pump_flow(self, x1: Values) -> Values:
        """Return the flow of the pumps at command 1 (m3/s), Eq. (3e)."""
        head = x1 / self._a1
        head += self._lift
        np.maximum(head, 0.0, out=head)
        np.sqrt(head, out=head)
        return np.asarray(np.multiply(self._b, head, out=head))

    def hold(self, outlet: Values) -> Values:
        """Return the volume above which water flows to the sewer (m3)."""
        return np.asarray(np.where(outlet > 0, self.lower, self.upper))

    def mains(self, x1: Values, drawn: Values, seconds: float) -> Values:
        """Return the mean flow of mains water in a step (m3/s); see :func:`.plant.mains_flow`."""
        missing = self.filled - x1
        before = np.where(missing > 0, self.mains_flow, 0.0)
        towards = before - drawn
        reaches = np.where(
            missing * towards > 0, missing / towards, np.where(missing != 0, seconds, 0.0)
        )
        share = np.minimum(reaches / seconds, 1.0)
        later = np.minimum(np.maximum(drawn, 0.0), self.mains_flow)
        return np.asarray(before * share + later * (1 - share))

    def step_short(
        self, tau: float, x1: Values, collected: Values, flow: Values, outlet: Values
    ) -> tuple[CisternFlows, Flags]:
        """Return the volumes that flow in a short tick, and a mask of cisterns with unmet demand.

        Args:
            tau: duration of the tick (s).
            x1: volume in each cistern (m3).
            collected: rain that flows into the cistern (m3/s).
            flow: flow of the pumps (m3/s).
            outlet: opening of each low outlet, 0 to 1.
        """
        pump, level = tau * flow, x1 / self._a1
        low = tau * outlet * self._c_low * _root(level - self.lower / self._a1)
        out = low + tau * self._c_out * _root(level - self.upper / self._a1)
        demand = out + pump
        mains = tau * self.mains(x1, demand / tau - collected, tau)
        available = x1 + tau * collected + mains
        limited = demand > available
        share = np.where(limited, available / demand, 1.0)
        return CisternFlows((share * pump)[None], share * out, share * low, mains), limited

    def is_quick(self, pumped: Values) -> Flags:
        """Return a mask of cisterns whose pumped volume (m3) requires the tick to be divided."""
        return np.asarray(pumped > self._much)

    def drain(self, seconds: float, steps: int, x1: Values, outlet: Values) -> Values:
        """Return the volume that leaves through the low outlets if there is no other flow (m3).

        The result equals that of :class:`_Outlets`. Let c be the coefficient of the outlet, t the
        duration of a step, h the head, and u^2 = h (2 a1 / (c t))^2; each step then changes u to
        sqrt(1 + u^2) - 1.

        Args:
            seconds: duration of a step (s).
            steps: number of steps.
            x1: volume in each cistern (m3).
            outlet: opening of each low outlet, 0 to 1.
        """
        drop = outlet * self._c_low * seconds
        unit = drop * drop / (4 * self._a1) + _NO_OUTLET
        above = x1 - self.lower
        np.maximum(above, 0.0, out=above)
        u = np.sqrt(np.divide(above, unit, out=above), out=above)
        square, root, total = np.empty_like(u), np.empty_like(u), np.zeros_like(u)
        for _ in range(steps):
            np.multiply(u, u, out=square)
            np.add(square, 1, out=root)
            np.sqrt(root, out=root)
            np.add(root, 1, out=root)
            np.divide(square, root, out=u)
            np.add(total, u, out=total)
        return np.asarray(2 * unit * total)

    def step_long(
        self, tau: float, steps: int, x1: Values, collected: Values, command: Values,
        outlet: Values, missing: Values, rise: Values,
    ) -> CisternFlows:
        """Return the volumes that flow in a long tick.

        Args:
            tau: duration of the tick (s).
            steps: number of steps into which the tick is divided if a flow is large; otherwise, the
                pumped volume is divided evenly among the steps.
            x1: volume in each cistern (m3).
            collected: rain that flows into the cistern (m3/s).
            command: command to the pumps (share of the maximum flow).
            outlet: opening of each low outlet, 0 to 1.
            missing: volume that must be pumped to fill the roof to its target (m3).
            rise: rate at which rain reduces ``missing`` (m3/s).
        """
        flow = np.where(missing > 0, command * self.pump_flow(x1), 0.0)
        if flow.any():
            # Less than a dose is never pumped, not even at the level to which it can fall.
            held = np.minimum(x1, self.upper)
            held -= tau * self._c_low * _root((held - self.lower) / self._a1)
            lowest_flow = command * self.pump_flow(np.maximum(held, self.lowest))
            missing = missing * (missing >= lowest_flow * min(tau / steps, MIN_RUN_S) * _ALMOST)
        quick = np.maximum(x1, self.filled) + tau * collected > self.hold(outlet)
        quick |= self.is_quick(tau * flow)
        given = x1, collected, command, outlet, missing, rise
        if quick.all():
            return self._step(tau, steps, *given)
        volumes = np.empty((steps, len(x1)))
        flows = CisternFlows(volumes, *(np.empty_like(x1) for _ in range(3)))
        for rows, parts in ((np.flatnonzero(~quick), 1), (np.flatnonzero(quick), steps)):
            if len(rows):
                part = self.take(rows)._step(tau, parts, *(values[rows] for values in given))
                volumes[:, rows] = part.volumes * (parts / steps)
                for all_of, own in zip(flows[1:], part[1:], strict=True):
                    all_of[rows] = own
        return flows

    def _step(
        self, tau: float, steps: int, x1: Values, collected: Values, command: Values,
        outlet: Values, missing: Values, rise: Values,
    ) -> CisternFlows:
        """Return the volumes that flow in a long tick, with equal steps for all cisterns."""
        seconds = tau / steps
        arrives = seconds * collected if collected.any() else 0.0
        running = np.zeros(len(x1), bool)
        volumes = np.zeros((steps, len(x1)))
        let_in, outlets = np.zeros(len(x1)), _Outlets(self, outlet, seconds)
        pumps = bool((missing > 0).any())
        # Outlets are above the level of the mains: without pumping it never falls to that.
        fills = pumps or bool((np.minimum(x1, self.lower) < self.filled).any())
        for volume in volumes:
            if pumps:
                flow = np.where(missing > 0, command * self.pump_flow(x1), 0.0)
                mains = self._pump(seconds, x1, collected, flow, missing, rise, running, volume)
                running = (volume >= flow * seconds) & (flow > 0)
                missing = missing - volume - seconds * rise
                pumps = bool((missing > 0).any())
                let_in += mains
                x1 = x1 + arrives + mains - volume
            elif fills and (x1 < self.filled).any():
                mains = seconds * self.mains(x1, -collected, seconds)
                let_in += mains
                x1 = x1 + arrives + mains
            else:
                x1 = x1 + arrives
            outlets.let_out(x1)
        return CisternFlows(volumes, outlets.upper + outlets.low, outlets.low, let_in)

    def _pump(
        self, seconds: float, x1: Values, collected: Values, flow: Values, missing: Values,
        rise: Values, running: Flags, volume: Values,
    ) -> Values:
        """Write the pumped volume to ``volume``, and return the inflow of mains water (m3).

        Args:
            seconds: duration of the step (s).
            x1: volume in each cistern (m3).
            collected: rain that flows into the cistern (m3/s).
            flow: flow of the pumps (m3/s).
            missing: volume that must be pumped to fill the roof to its target (m3).
            rise: rate at which rain reduces ``missing`` (m3/s).
            running: mask of the pumps that were running at the end of the previous step.
            volume: array to which the pumped volume is written (m3).
        """
        share = np.divide(flow, flow + rise, out=np.zeros_like(flow), where=flow > 0)
        wanted = np.minimum(flow * seconds, missing * share)
        min_volume = np.where(running, 0.0, flow * min(seconds, MIN_RUN_S))
        usable = x1 + seconds * collected - self.lowest
        if (usable + self.lowest - wanted >= self.filled).all() and (x1 >= self.filled).all():
            mains = more = np.zeros_like(x1)  # they stay closed
        else:
            mains = seconds * self.mains(x1, -collected, seconds)
            more = seconds * self.mains(x1, wanted / seconds - collected, seconds)
        runs = (wanted > 0) & (np.minimum(wanted, usable + mains) >= min_volume)
        mains = np.where(runs, more, mains)
        volume[:] = np.where(runs, np.minimum(wanted, usable + mains), 0.0)
        return mains

    def let_out_all(
        self, seconds: float, x1: Values, arriving: Values, outlet: Values, volumes: Values
    ) -> CisternFlows:
        """Return the volumes that flow in a long tick with a known pumped volume.

        Args:
            seconds: duration of a step.
            x1: volume in each cistern (m3).
            arriving: rain and drainage that flow into each cistern (m3/s).
            outlet: opening of each low outlet, 0 to 1.
            volumes: pumped volume in each step (m3), shape (steps, n).
        """
        let_in, outlets = np.zeros(len(x1)), _Outlets(self, outlet, seconds)
        for pumped in volumes:
            mains = seconds * self.mains(x1, pumped / seconds - arriving, seconds)
            let_in += mains
            x1 = x1 + seconds * arriving + mains - pumped
            outlets.let_out(x1)
        return CisternFlows(volumes, outlets.upper + outlets.low, outlets.low, let_in)


class _Outlets:
    """The upper and low outlets of cisterns, computed in steps, as in :class:`.plant.Plant`.

    Attributes:
        upper: volume that has left through the upper outlets (m3).
        low: volume that has left through the low outlets (m3).
    """

    def __init__(self, cisterns: Cisterns, outlet: Values, seconds: float) -> None:
        """Prepare the first step.

        Args:
            cisterns: cisterns to which the outlets belong.
            outlet: opening of each low outlet, 0 to 1.
            seconds: duration of a step (s).
        """
        self._cisterns, self._four_a1 = cisterns, 4 * cisterns._a1
        self._upper = self._drop(cisterns._c_out * seconds)
        self._low = self._drop(outlet * cisterns._c_low * seconds)
        self.upper, self.low = np.zeros((2, len(outlet)))

    def _drop(self, drop: Values) -> tuple[Values, Values, Values]:
        """Return c t, its double, and its square, which is positive even for a closed outlet."""
        return drop, 2 * drop, drop * drop + _TINY

    def let_out(self, x1: Values) -> None:
        """Subtract the water that leaves through the outlets in a step from ``x1`` (m3)."""
        above = x1 - self._cisterns.upper
        if above.max() > 0:
            upper = self._take(above, *self._upper)
            self.upper += upper
            x1 -= upper
        low = self._take(np.subtract(x1, self._cisterns.lower, out=above), *self._low)
        self.low += low
        x1 -= low

    def _take(self, above: Values, drop: Values, double: Values, square: Values) -> Values:
        """Return the volume (m3) that leaves through an outlet, given the volume above it (m3)."""
        np.maximum(above, 0.0, out=above)
        root = self._four_a1 * above
        root += square
        np.sqrt(root, out=root)
        root += drop
        above *= double
        return np.asarray(np.divide(above, root, out=root))


def _root(head: Values) -> Values:
    return np.sqrt(np.maximum(head, 0.0))
