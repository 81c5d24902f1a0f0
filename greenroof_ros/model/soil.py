"""The soil of a roof: the paper's, Eq. (4), or field-capacity soil, with the same methods.

:func:`soil_of` returns the soil of a site; :class:`PaperSoil` documents what each method returns.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.site import Site

Values = NDArray[np.float64]
Losses = tuple[float, float, bool]  # drainage, evapotranspiration; whether they are limited
Drainage = Callable[[Site, float], tuple[float, float]]  # at a volume, and its slope

# Rain raises the water on the paper's roof by no more than this above its target (m).
_ABOVE_M = 0.15
ALMOST_FULL = 1 - 1e-9
"""share of TAW that is treated as full, since only an infinite volume would fill the soil to field
capacity"""
# Eq. (4) with Euler's method takes no more than this (m) in a tick from a soil at its capacity.
_MAX_OVERDRAWN_M = 1e-4
# predict_lasting_share adds at least this share of the water that plants can take (1): smaller
# differences would be rounding errors.
_MIN_ADDED = 0.005
# Minimum result of predict_lasting_share (1): a storm that fills the soil leaves no difference.
_MIN_LASTING = 1e-3


class SoilSlopes(NamedTuple):
    """What the soil does with water at a volume x2, and the derivatives with x2 (1/m3 of each)."""

    retained: float
    """share of the arriving water that stays (1)"""
    retained_2: float
    stress: float
    """share of the potential evapotranspiration that it yields (1)"""
    stress_2: float
    drained: float
    """drainage besides the share of the arriving water that does not stay (m3/s)"""
    drained_2: float


class PaperSoil:
    """Table I's soil: it keeps all water below its capacity, and drains above it by Eq. (4).

    Attributes:
        has_field_capacity: whether it is field-capacity soil.
        above_target: how far rain can raise it above its target (m3).
        retains_all_below: volume below which all arriving water stays, and evaporation is limited
            only by the water that is there (m3); 0 if there is no such volume.
        overdraws: whether a tick of Eq. (4) would take much more than is above the capacity.
        excess: what water above its capacity does, in words.
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
        """Return the drainage from the soil in a tick, if it holds that much (m3/s), Eq. (4).

        It is no more than what is above the capacity and what arrives, if a tick of Eq. (4) would
        take much more from a soil that is just full.

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
        """Return the share of the arriving water that stays (1) in a soil holding x2 (m3)."""
        return 1.0

    def water_stress(self, x2: float) -> float:
        """Return the share of the potential evapotranspiration at a volume x2 (m3) (1)."""
        return 1.0

    def tick(
        self, x2: float, layer: float, available: float, arriving: float, potential: float
    ) -> Losses:
        """Return the flows that leave the roof in a tick, at most what it holds and receives.

        If that is less than Eqs. (1) and (4) demand, both losses are scaled down to it.

        Args:
            x2: volume that the soil holds (m3).
            layer: volume that the drainage layer holds (m3).
            available: what can leave the soil, since it holds or receives it (m3/s).
            arriving: rain and pumped water (m3/s).
            potential: evapotranspiration from the whole bed (m3/s) of plants with sufficient water.

        Returns:
            Drainage and evapotranspiration (m3/s), and whether there was less than was demanded.
        """
        drainage = self.drained(x2, arriving, self._site.tau)
        demand = potential + drainage
        if demand > available:
            share = available / demand
            return drainage * share, potential * share, True
        return drainage, potential, False

    def max_fall_rate(self, level: float) -> float:
        """Return the fastest rate at which drainage lowers a level (m), in m/s.

        It is Eq. (4), even below the capacity.
        """
        return self._site.K * (level + self._site.z_soil) / self._site.z_soil

    def linearise(self, x2: float, q_drain: Drainage) -> SoilSlopes:
        """Return what a linear model around x2 (m3) needs.

        Args:
            x2: volume that the soil holds (m3).
            q_drain: Eq. (9) and its slope, instead of Eq. (4), where drainage starts with a jump.
        """
        return SoilSlopes(1.0, 0.0, 1.0, 0.0, *q_drain(self._site, x2))

    def predict_volume(
        self, x2: Values, arriving: Values | float, potential: Values | float,
        seconds: Values | float,
    ) -> Values:
        """Return the volume on the roof after a step of any length (m3), in which rain comes first.

        Water above the capacity drains at the end of the step.

        Args:
            x2: volume that it holds before (m3).
            arriving: rain and pumped water in the step (m3); its shape must broadcast with x2,
                potential and seconds.
            potential: what would evaporate from plants that lack no water (m3).
            seconds: length of the step (s).
        """
        site = self._site
        remaining = x2 + (arriving - potential)
        drained = site.K / site.z_soil * (remaining + site.a2 * site.z_soil) * seconds
        remaining = np.minimum(remaining, np.maximum(remaining - drained, self.retains_all_below))
        return np.maximum(remaining, 0.0)

    def water_to_fill(self, x2: Any) -> Any:
        """Return the water that fills an empty roof to x2 (m3), of any shape."""
        return x2

    def water_to_raise(self, x2: float, to: float) -> float:
        """Return the water that raises the soil from x2 to a higher volume (m3)."""
        return to - x2

    def fill_empty(self, arrived: Values) -> Values:
        """Return the volume that an empty roof holds (m3) after this much has arrived (m3)."""
        return arrived

    def predict_changes(
        self, x2: float, rain: Values, potential: Values, lengths: Values
    ) -> Values:
        """Predict by how much the roof's volume changes in steps without pumping (m3).

        Args:
            x2: volume on the roof at the beginning (m3).
            rain: mean rain in every step (m/s), shape (n,).
            potential: evapotranspiration from the whole bed (m3/s) of plants with sufficient water,
                shape (n,).
            lengths: lengths of the steps (s), shape (n,).

        Returns:
            Changes of shape (n,).
        """
        return np.asarray((rain * self._site.a2 - potential) * lengths)

    def predict_lasting_share(self, x2: float, changes: Values, *weather: Values) -> Values:
        """Predict the share of water added now that stays on the roof in later steps (1): all.

        Args:
            x2: volume on the roof at the beginning (m3).
            changes: changes without pumping, as :meth:`predict_changes` returns them (m3).
            weather: the arguments rain, potential and lengths of that call.

        Returns:
            The mean in every step, shape (n,).
        """
        return np.ones_like(changes)

    def reconstruct_losses(
        self, layer: float, x2: Values, rain: Values, pump: Values, potential: Values,
        drainage: Values, durations: Values,
    ) -> tuple[Values, Values]:
        """Compute the unmeasured quantities of a roof with known volumes.

        Args:
            layer: volume that its drainage layer holds at first (m3).
            x2: volume at the beginning of every sample (m3), NaN if unknown, shape (n,).
            rain: precipitation (m/s), shape (n,).
            pump: flow from the cistern (m3/s), shape (n,).
            potential: evapotranspiration from the whole bed (m3/s) of plants with sufficient water,
                shape (n,).
            drainage: drainage from the roof (m3/s), shape (n,).
            durations: durations of the samples (s), shape (n,).

        Returns:
            Evapotranspiration (m3/s), and what the drainage layer holds at the beginning of every
            sample (m3), both of shape (n,).
        """
        # As in Plant.flows: no more than the available water evaporates.
        available = x2 / durations + rain * self._site.a2 + pump - drainage
        return np.fmin(potential, np.maximum(available, 0.0)), np.full_like(x2, layer)

    def _darcy(self, x2: float) -> float:
        """Return the drainage (m3/s) of a soil that holds x2 (m3), at least its capacity."""
        site = self._site
        return site.K * site.a2 * (x2 / site.a2 + site.z_soil) / site.z_soil


class FieldCapacitySoil:
    """Field-capacity soil over a drainage layer, with the methods of :class:`PaperSoil`.

    The substrate is the soil routine of HBV (Bergstrom 1976, SMHI Reports RHO No. 7; Seibert and
    Vis 2012, doi:10.5194/hess-16-3315-2012, soil moisture routine) with its exponent beta = 2. The
    drainage layer is a reservoir whose outflow is proportional to the square of its volume. Only
    sites with a ``field_capacity`` have this soil.
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
        """Return S (1): the filled share of the water that plants can take, at x2 (m3).

        It is 0 at the wilting point and below, 1 at field capacity and above.
        """
        if x2 >= self._capacity:
            return 1.0
        return max(0.0, (x2 - self._wilting) / self._available)

    def drained(self, x2: float, arriving: float, seconds: float) -> float:
        """Return the mean percolation out of the substrate in a tick of any length (m3/s).

        The share that passes through grows as the substrate fills. The solution of dS/dt = (1 -
        S^2) i / TAW for a constant i is

            S(t) = (S + g) / (1 + S g),  g = tanh(i t / TAW).

        Up to the wilting point, all water stays. The excess above field capacity leaves within the
        tick.

        Args:
            x2: water in the substrate at the beginning (m3).
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
        """Return 1 - S^2; the rest bypasses the soil to the drainage layer."""
        filled = self.filled_share(x2)
        return 1 - filled * filled

    def water_stress(self, x2: float) -> float:
        """Return K_s = (TAW - D_r) / ((1 - p) TAW), no more than 1: FAO-56, Eq. 84.

        TAW is the water that plants can take at field capacity, and D_r is the part of it that is
        missing.
        """
        return min(1.0, self.filled_share(x2) / self._onset)

    def layer_outflow(self, layer: float, inflow: float, seconds: float) -> float:
        """Return the mean flow from the drainage layer off the roof during a tick (m3/s).

        The layer's volume V follows dV/dt = i - k V^2 with k = 1 / (a2 drainage_storage
        drainage_time), solved exactly for a constant inflow i, so that a tick of any length is
        stable:

            V(t) = (V + i g) / (1 + k V g),  g = tanh(t sqrt(i k)) / sqrt(i k), or t where i = 0.

        The volume above the layer's storage then also leaves within the tick. Without a layer, the
        inflow leaves immediately.

        Args:
            layer: volume that it holds (m3).
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
        """Return drainage and evapotranspiration; there is always enough water to percolate."""
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
        """Return the slopes of the soil itself, since it is continuous.

        At the wilting point, the onset of stress and field capacity the slopes are one-sided.
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
        """Solve dS/dt = (1 - S^2) i, and then the decay below the onset of stress."""
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
        """Solve dS/dt = (1 - S^2) i / TAW; up to the wilting point all of it stays."""
        share = np.clip((x2 - self._wilting) / self._available, 0.0, ALMOST_FULL)
        return np.minimum(x2, self._wilting) + self._available * np.arctanh(share)

    def water_to_raise(self, x2: float, to: float) -> float:
        """Return the inverse of :meth:`drained`: what must arrive in a tick that ends at ``to``."""
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
        """Predict the changes in steps that may be long, as in :meth:`predict_volume`."""
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
        """Predict the share of water added now that is still on the roof in later steps (1).

        :meth:`predict_changes` follows two roofs: one without pumping, and one filled to its target
        now. The share is their difference divided by their first difference, and at least 0.001. It
        falls: the fuller substrate lets more of the rain pass and, if plants lack water, supplies
        more to them. A storm that fills both leaves no difference.
        """
        added = max(self._site.x2_star - x2, _MIN_ADDED * self._available)
        fades = self.predict_changes(x2 + added, *weather) - changes
        ends = 1 + np.cumsum(fades) / added
        return np.asarray(np.maximum(ends - fades / added / 2, _MIN_LASTING))

    def reconstruct_losses(
        self, layer: float, x2: Values, rain: Values, pump: Values, potential: Values,
        drainage: Values, durations: Values,
    ) -> tuple[Values, Values]:
        """Compute what the substrate lost and what percolated; ``drainage`` does not matter."""
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
    """Return the soil of a site: field-capacity soil if its file has a ``field_capacity``."""
    return PaperSoil(site) if site.field_capacity is None else FieldCapacitySoil(site)


def roof_after_tick(soil: Soil, tau: float, x2: float, arriving: float, potential: float) -> float:
    """Return the volume on a roof of x2 (m3) at the end of a tick, below 0 if it would dry out.

    Args:
        soil: soil of the roof.
        tau: duration of the tick (s).
        x2: volume that the roof holds (m3).
        arriving: rain and pumped water (m3/s).
        potential: evapotranspiration from the whole bed (m3/s) of plants with sufficient water.
    """
    evaporated = potential * soil.water_stress(x2)
    return x2 + tau * (arriving - evaporated - soil.drained(x2, arriving, tau))
