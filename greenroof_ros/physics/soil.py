"""The soils of a roof: the paper's soil, Eq. (4), and a field-capacity soil.

Both soils have the same methods, which are documented in :class:`PaperSoil`. :func:`soil_of`
returns the soil of a site.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.site.site import Site

Values = NDArray[np.float64]
Losses = tuple[float, float, bool]  # drainage, evapotranspiration; whether they are limited
Drainage = Callable[[Site, float], tuple[float, float]]  # at a volume, and its slope

# Rain raises the water on the paper's roof by no more than this above its target (m).
_ABOVE_M = 0.15
ALMOST_FULL = 1 - 1e-9
"""share of TAW that counts as full, because only an infinite volume would fill the soil to field
capacity
"""
# Eq. (4) with Euler's method takes no more than this (m) in a tick from a soil at its capacity.
_MAX_OVERDRAWN_M = 1e-4
# predict_lasting_share adds at least this share of the water that plants can take (1): smaller
# differences would be rounding errors.
_MIN_ADDED = 0.005
# Minimum result of predict_lasting_share (1): a storm that fills the soil leaves no difference.
_MIN_LASTING = 1e-3


class SoilSlopes(NamedTuple):
    """The response of the soil to water at a volume x2, and its derivatives in x2 (per m3)."""

    retained: float
    """share of the arriving water that stays in the soil (1)"""
    retained_2: float
    stress: float
    """share of the potential evapotranspiration that the soil yields (1)"""
    stress_2: float
    drained: float
    """drainage in addition to the arriving water that does not stay (m3/s)"""
    drained_2: float


class PaperSoil:
    """The soil of Table I, which drains only above its capacity, according to Eq. (4).

    Attributes:
        has_field_capacity: whether the soil is a field-capacity soil.
        above_target: volume by which rain can raise the water above the target (m3).
        retains_all_below: volume below which all arriving water stays in the soil, and evaporation
            is limited only by the available water (m3); 0 if there is no such volume.
        overdraws: whether Eq. (4) would drain much more than the water above the capacity in a
            tick.
        excess: predicate for sentences about the water above the capacity.
        stress_volume: volume below which :meth:`water_stress` is less than 1 (m3).
    """

    has_field_capacity = False
    excess = "stay on its surface"
    stress_volume = 0.0

    def __init__(self, site: Site) -> None:
        self._site, self.retains_all_below = site, site.z_cap
        self.above_target = site.a2 * _ABOVE_M
        self.overdraws = 2 * site.K * site.tau > _MAX_OVERDRAWN_M

    def drained(self, x2: float, arriving: float, seconds: float) -> float:
        """Return the drainage from a soil with enough water in a tick (m3/s), Eq. (4).

        If Eq. (4) would drain much more than the water above the capacity in a tick, the drainage
        is limited to this water and the arriving water.

        Args:
            x2: volume that the soil holds (m3).
            arriving: rain and pumped water (m3/s).
            seconds: duration of the tick (s).
        """
        above = x2 - self.retains_all_below
        if above < 0:
            return 0.0
        drainage = self._darcy(x2)
        return min(drainage, above / seconds + arriving) if self.overdraws else drainage

    def retained_share(self, x2: float) -> float:
        """Return the share of the arriving water that a soil with x2 (m3) retains (1)."""
        return 1.0

    def water_stress(self, x2: float) -> float:
        """Return the ratio of actual to potential evapotranspiration at a volume x2 in m3 (1)."""
        return 1.0

    def tick(
        self, x2: float, layer: float, available: float, arriving: float, potential: float
    ) -> Losses:
        """Return the flows that leave the roof in a tick, limited to the available water.

        If less water is available than Eqs. (1) and (4) demand, both flows are scaled down.

        Args:
            x2: volume that the soil holds (m3).
            layer: volume that the drainage layer holds (m3).
            available: water that the soil holds or receives (m3/s).
            arriving: rain and pumped water (m3/s).
            potential: potential evapotranspiration from the whole bed (m3/s).

        Returns:
            Drainage and evapotranspiration (m3/s), and whether less water was available than was
            demanded.
        """
        drainage = self.drained(x2, arriving, self._site.tau)
        demand = potential + drainage
        if demand > available:
            share = available / demand
            return drainage * share, potential * share, True
        return drainage, potential, False

    def max_fall_rate(self, level: float) -> float:
        """Return the maximum rate (m/s) at which drainage lowers the water from a level (m).

        The rate is that of Eq. (4), even below the capacity.
        """
        return self._site.K * (level + self._site.z_soil) / self._site.z_soil

    def linearise(self, x2: float, q_drain: Drainage) -> SoilSlopes:
        """Return the slopes for a linear model at x2 (m3).

        Args:
            x2: volume that the soil holds (m3).
            q_drain: function for Eq. (9) and its slope, which replaces the discontinuous Eq. (4).
        """
        return SoilSlopes(1.0, 0.0, 1.0, 0.0, *q_drain(self._site, x2))

    def predict_volume(
        self, x2: Values, arriving: Values | float, potential: Values | float,
        seconds: Values | float,
    ) -> Values:
        """Return the volume on the roof after a step of any length (m3).

        Rain falls at the start of the step, and water above the capacity drains at the end of the
        step.

        Args:
            x2: volume on the roof before the step (m3).
            arriving: rain and pumped water in the step (m3); its shape must be broadcastable with
                those of x2, potential and seconds.
            potential: potential evapotranspiration (m3).
            seconds: length of the step (s).
        """
        site = self._site
        remaining = x2 + (arriving - potential)
        drained = site.K / site.z_soil * (remaining + site.a2 * site.z_soil) * seconds
        remaining = np.minimum(remaining, np.maximum(remaining - drained, self.retains_all_below))
        return np.maximum(remaining, 0.0)

    def water_to_fill(self, x2: Any) -> Any:
        """Return the water needed to fill an empty roof to a volume x2 (m3, any shape)."""
        return x2

    def water_to_raise(self, x2: float, to: float) -> float:
        """Return the water needed to fill the soil from x2 to a higher volume (m3)."""
        return to - x2

    def fill_empty(self, arrived: Values) -> Values:
        """Return the volume on an initially empty roof after a volume of water has arrived (m3)."""
        return arrived

    def predict_changes(
        self, x2: float, rain: Values, potential: Values, lengths: Values
    ) -> Values:
        """Predict the changes in the volume on the roof in steps without pumping (m3).

        Args:
            x2: volume on the roof at the beginning (m3).
            rain: mean rain in every step (m/s), shape (n,).
            potential: potential evapotranspiration from the whole bed (m3/s),
                shape (n,).
            lengths: lengths of the steps (s), shape (n,).

        Returns:
            The changes, shape (n,).
        """
        return np.asarray((rain * self._site.a2 - potential) * lengths)

    def predict_lasting_share(self, x2: float, changes: Values, *weather: Values) -> Values:
        """Predict the share of water added now that remains on the roof in later steps: always 1.

        Args:
            x2: volume on the roof at the beginning (m3).
            changes: changes without pumping, as returned by :meth:`predict_changes` (m3).
            weather: arguments rain, potential and lengths of :meth:`predict_changes`.

        Returns:
            The mean share in every step, shape (n,).
        """
        return np.ones_like(changes)

    def reconstruct_losses(
        self, layer: float, x2: Values, rain: Values, pump: Values, potential: Values,
        drainage: Values, durations: Values,
    ) -> tuple[Values, Values]:
        """Compute the quantities that are not measured on a roof whose volumes are known.

        Args:
            layer: initial volume in the drainage layer (m3).
            x2: volume at the start of every sample (m3), NaN if unknown, shape (n,).
            rain: precipitation (m/s), shape (n,).
            pump: flow from the cistern (m3/s), shape (n,).
            potential: potential evapotranspiration from the whole bed (m3/s),
                shape (n,).
            drainage: drainage from the roof (m3/s), shape (n,).
            durations: durations of the samples (s), shape (n,).

        Returns:
            Evapotranspiration (m3/s), and the volume in the drainage layer at the start of every
            sample (m3), both of shape (n,).
        """
        # As in Plant.flows: no more than the available water evaporates.
        available = x2 / durations + rain * self._site.a2 + pump - drainage
        return np.fmin(potential, np.maximum(available, 0.0)), np.full_like(x2, layer)

    def _darcy(self, x2: float) -> float:
        """Return the drainage (m3/s) of a soil with x2 (m3), at or above its capacity."""
        site = self._site
        return site.K * site.a2 * (x2 / site.a2 + site.z_soil) / site.z_soil


class FieldCapacitySoil:
    """A field-capacity soil over a drainage layer, with the methods of :class:`PaperSoil`.

    The substrate is modeled by the soil routine of HBV (Bergstrom 1976, SMHI Reports RHO No. 7;
    Seibert and Vis 2012, doi:10.5194/hess-16-3315-2012, soil moisture routine) with the exponent
    beta = 2. The drainage layer is a reservoir with an outflow proportional to the square of its
    volume. Only sites with a ``field_capacity`` have this soil.
    """

    has_field_capacity = True
    excess = "drain immediately"
    retains_all_below = 0.0
    overdraws = False

    def __init__(self, site: Site) -> None:
        self._site, self._a2, self._tau, self._capacity = site, site.a2, site.tau, site.z_cap
        self._wilting, self._available = site.wilting_volume, site.available_volume
        self._onset, self._drying = site.stress_onset, site.stress_onset * site.available_volume
        self.above_target = site.z_cap - site.x2_star
        self.stress_volume = self._wilting + self._drying

    def filled_share(self, x2: float) -> float:
        """Return S (1): the filled share of the available water capacity at x2 (m3).

        S is 0 at and below the wilting point, and 1 at and above field capacity.
        """
        if x2 >= self._capacity:
            return 1.0
        return max(0.0, (x2 - self._wilting) / self._available)

    def drained(self, x2: float, arriving: float, seconds: float) -> float:
        """Return the mean percolation from the substrate in a tick of any length (m3/s).

        The share of water that percolates increases as the substrate fills. The solution of dS/dt =
        (1 - S^2) i / TAW for a constant i is

            S(t) = (S + g) / (1 + S g),  g = tanh(i t / TAW).

        Below the wilting point, all water stays in the substrate. Water above field capacity
        percolates within the tick.

        Args:
            x2: water in the substrate at the start of the tick (m3).
            arriving: rain and pumped water (m3/s).
            seconds: duration of the tick (s).
        """
        if x2 >= self._capacity:
            return arriving + (x2 - self._capacity) / seconds
        arrived, available, filled = arriving * seconds, self._available, self.filled_share(x2)
        first = min(arrived, max(0.0, self._wilting - x2))
        g = math.tanh((arrived - first) / available)
        retained = first + available * g * (1 - filled * filled) / (1 + filled * g)
        return max(0.0, arriving - retained / seconds)

    def retained_share(self, x2: float) -> float:
        """Return 1 - S^2; the rest of the water bypasses the soil and enters the drainage layer."""
        filled = self.filled_share(x2)
        return 1 - filled * filled

    def water_stress(self, x2: float) -> float:
        """Return K_s = (TAW - D_r) / ((1 - p) TAW), at most 1, FAO-56 Eq. 84.

        TAW is the water that plants can take up at field capacity, and D_r is the depleted part of
        this water.
        """
        return min(1.0, self.filled_share(x2) / self._onset)

    def layer_outflow(self, layer: float, inflow: float, seconds: float) -> float:
        """Return the mean flow that leaves the roof through the drainage layer in a tick (m3/s).

        The layer's volume V follows dV/dt = i - k V^2 with k = 1 / (a2 drainage_storage
        drainage_time), solved exactly for a constant inflow i, so that the result is stable for
        ticks of any length:

            V(t) = (V + i g) / (1 + k V g),  g = tanh(t sqrt(i k)) / sqrt(i k), or t where i = 0.

        Any volume above the layer's storage also drains within the tick. Without a layer, the
        inflow drains immediately.

        Args:
            layer: volume in the drainage layer (m3).
            inflow: percolation during the tick (m3/s).
            seconds: duration of the tick (s).
        """
        site = self._site
        if site.drainage_time is None:
            return inflow
        k = 1 / (site.layer_storage * site.drainage_time)
        rate = math.sqrt(inflow * k)
        g = math.tanh(rate * seconds) / rate if rate > 0 else seconds
        remaining = min((layer + inflow * g) / (1 + k * layer * g), site.layer_storage)
        return max(0.0, inflow + (layer - remaining) / seconds)

    def tick(
        self, x2: float, layer: float, available: float, arriving: float, potential: float
    ) -> Losses:
        """Return drainage and evapotranspiration; available water never limits percolation."""
        percolated = self.drained(x2, arriving, self._tau)
        evaporated, remaining = potential * self.water_stress(x2), available - percolated
        limited = evaporated > remaining
        if limited:
            evaporated = max(0.0, remaining)
        return self.layer_outflow(layer, percolated, self._tau), evaporated, limited

    def max_fall_rate(self, level: float) -> float:
        """Return the rate that removes the excess within a tick (m/s)."""
        return max(0.0, level - self._site.roof_level(self._capacity)) / self._tau

    def linearise(self, x2: float, q_drain: Drainage) -> SoilSlopes:
        """Return the slopes without smoothing, because the soil's response is continuous.

        At the wilting point, the onset of stress and field capacity, the slopes are one-sided.
        """
        filled, stress = self.filled_share(x2), self.water_stress(x2)
        excess = max(0.0, x2 - self._capacity)
        filled_2 = 1 / self._available if self._wilting <= x2 < self._capacity else 0.0
        return SoilSlopes(
            1 - filled * filled, -2 * filled * filled_2,
            stress, filled_2 / self._onset if stress < 1 else 0.0,
            excess / self._tau, 1 / self._tau if excess else 0.0,
        )

    def predict_volume(
        self, x2: Values, arriving: Values | float, potential: Values | float,
        seconds: Values | float,
    ) -> Values:
        """Solve dS/dt = (1 - S^2) i, and then the decay of the volume below the onset of stress."""
        wilting, available, drying = self._wilting, self._available, self._drying
        water = x2
        if np.any(arriving):
            first = np.minimum(arriving, np.maximum(wilting - x2, 0.0))
            share = np.minimum(np.maximum((x2 - wilting) / available, 0.0), 1.0)
            gained = np.tanh((arriving - first) / available)
            wet = (share + gained) / (1 + share * gained)
            water = np.minimum(x2, wilting) + first + available * wet
        easy = np.minimum(np.maximum(water - (wilting + drying), 0.0), potential)
        water = water - easy
        decay = np.expm1((easy - potential) / drying)
        return np.asarray(water + np.maximum(water - wilting, 0.0) * decay)

    def water_to_fill(self, x2: Any) -> Any:
        """Solve dS/dt = (1 - S^2) i / TAW; below the wilting point, all water is retained."""
        share = np.clip((x2 - self._wilting) / self._available, 0.0, ALMOST_FULL)
        return np.minimum(x2, self._wilting) + self._available * np.arctanh(share)

    def water_to_raise(self, x2: float, to: float) -> float:
        """Return the volume of water that must arrive in a tick that ends at the volume ``to``."""
        filled, reached = self.filled_share(x2), min(self.filled_share(to), ALMOST_FULL)
        first = max(0.0, min(to, self._wilting) - x2)
        g = max(0.0, (reached - filled) / (1 - filled * reached))
        return first + self._available * math.atanh(g)

    def fill_empty(self, arrived: Values) -> Values:
        """Return the inverse of :meth:`water_to_fill`."""
        more = np.maximum(arrived - self._wilting, 0.0) / self._available
        return np.minimum(arrived, self._wilting) + self._available * np.tanh(more)

    def predict_changes(
        self, x2: float, rain: Values, potential: Values, lengths: Values
    ) -> Values:
        """Predict changes in steps of any length, as in :meth:`predict_volume`."""
        dry, available, drying = self._wilting, self._available, self._drying
        stressed = dry + drying  # below this, evapotranspiration decays
        fallen, demand = rain * self._a2 * lengths, potential * lengths
        # Computed for all steps together, and right for most, which begin above the wilting point
        # and are in stress after the rain.
        steps = fallen, np.tanh(fallen / available), demand, np.expm1(-demand / drying)
        volumes = [x2]
        for fell, gained, dried, decay in zip(*(part.tolist() for part in steps), strict=True):
            volume = volumes[-1]
            first = min(fell, max(dry - volume, 0.0))
            if first > 0:
                gained = float(np.tanh((fell - first) / available))
            if volume + first < dry:
                volume += first
            else:
                filled = min(max((volume - dry) / available, 0.0), 1.0)
                volume = dry + available * ((filled + gained) / (1 + filled * gained))
            easy = min(dried, max(volume - stressed, 0.0))
            if easy == dried:
                decay = 0.0
            elif easy > 0:
                decay = float(np.expm1((easy - dried) / drying))
            volume = volume - easy
            volumes.append(volume + max(volume - dry, 0.0) * decay)
        return np.diff(volumes)

    def predict_lasting_share(self, x2: float, changes: Values, *weather: Values) -> Values:
        """Predict the share of water added now that remains on the roof in later steps (1).

        Two roofs are simulated with :meth:`predict_changes`: a roof without pumping, and a roof
        that is filled to its target now. The share is the difference between their volumes, divided
        by its initial value, but at least 0.001. The share decreases, because more rain percolates
        through the fuller substrate, and because plants that lack water take up more from a fuller
        substrate. After a storm that fills both roofs, the difference vanishes.
        """
        added = max(self._site.x2_star - x2, _MIN_ADDED * self._available)
        fades = self.predict_changes(x2 + added, *weather) - changes
        ends = 1 + np.cumsum(fades) / added
        return np.asarray(np.maximum(ends - fades / added / 2, _MIN_LASTING))

    def reconstruct_losses(
        self, layer: float, x2: Values, rain: Values, pump: Values, potential: Values,
        drainage: Values, durations: Values,
    ) -> tuple[Values, Values]:
        """Compute evapotranspiration and the drainage layer's volumes; ``drainage`` is not used."""
        samples = np.nan_to_num(x2), rain * self._a2 + pump, potential, durations
        evaporated, layers = array("d"), array("d")
        for volume, arriving, demand, seconds in zip(
            *(array("d", column) for column in samples), strict=True
        ):
            percolated = self.drained(volume, arriving, seconds)
            available = volume / seconds + arriving - percolated
            evaporated.append(max(0.0, min(demand * self.water_stress(volume), available)))
            layers.append(layer)
            drained = self.layer_outflow(layer, percolated, seconds)
            layer = max(0.0, layer + seconds * (percolated - drained))
        return np.frombuffer(evaporated), np.frombuffer(layers)


Soil: TypeAlias = PaperSoil | FieldCapacitySoil


def soil_of(site: Site) -> Soil:
    """Return the soil of a site: a field-capacity soil if the site has a ``field_capacity``."""
    return PaperSoil(site) if site.field_capacity is None else FieldCapacitySoil(site)


def roof_after_tick(soil: Soil, tau: float, x2: float, arriving: float, potential: float) -> float:
    """Return the volume on a roof (m3) at the end of a tick; negative if the roof would dry out.

    Args:
        soil: soil of the roof.
        tau: duration of the tick (s).
        x2: volume on the roof at the start of the tick (m3).
        arriving: rain and pumped water (m3/s).
        potential: potential evapotranspiration from the whole bed (m3/s).
    """
    evaporated = potential * soil.water_stress(x2)
    return x2 + tau * (arriving - evaporated - soil.drained(x2, arriving, tau))
