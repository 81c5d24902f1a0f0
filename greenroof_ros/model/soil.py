"""A measured roof: what its substrate keeps, what evaporates, and how its drainage layer empties.

Only roofs with a ``field_capacity`` in their site file have it; the paper's soil, Eq. (4), has not.
The substrate is the soil routine of HBV (Bergstrom 1976, SMHI Reports RHO No. 7; Seibert and Vis
2012, doi:10.5194/hess-16-3315-2012, soil moisture routine) with its exponent beta = 2. The
drainage layer is a reservoir whose outflow goes with the square of what it holds.
"""

from __future__ import annotations

import math
from array import array
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.site import Site

Values = NDArray[np.float64]

# lasting_share follows at least that much, of the water that plants can take (1): differences of
# less would be of rounding.
_LEAST_ADDED = 0.005
# Less is not distinguished from nothing (1); a storm that fills the substrate leaves nothing.
_LEAST_LASTING = 1e-3


def filled_share(site: Site, x2: float) -> float:
    """S: how full of water that plants can take a substrate holding x2 (m3) is, from 0 to 1.

    0 at the wilting point and below, 1 at field capacity and above.
    """
    if x2 >= site.z_cap:
        return 1.0
    return max(0.0, (x2 - site.wilting_volume) / site.available_volume)


def kept_share(site: Site, x2: float) -> float:
    """Share of the arriving water that stays in a substrate holding x2 (m3): 1 - S^2.

    The rest finds its way past the soil to the drainage layer. The paper's soil keeps all.
    """
    if site.field_capacity is None:
        return 1.0
    filled = filled_share(site, x2)
    return 1 - filled * filled


def water_to_fill(site: Site, x2: float) -> float:
    """What must arrive until an empty soil holds x2 (m3), below field capacity of a measured roof.

    Up to the wilting point all of it stays; from there dS/dt = (1 - S^2) i / TAW, solved.
    """
    if site.field_capacity is None or x2 <= site.wilting_volume:
        return x2
    return site.wilting_volume + site.available_volume * math.atanh(filled_share(site, x2))


def percolation(site: Site, x2: float, arriving: float, seconds: float) -> float:
    """What leaves the substrate for the drainage layer (m3/s): S^2 of what arrives, and the excess.

    The excess is what is held above field capacity; it leaves within the tick.

    Args:
        site: of a measured roof.
        x2: water in the substrate (m3).
        arriving: rain and pumped water (m3/s).
        seconds: duration of the tick (s).
    """
    filled = filled_share(site, x2)
    return filled * filled * arriving + max(0.0, x2 - site.z_cap) / seconds


def mean_percolation(site: Site, x2: float, arriving: float, seconds: float) -> float:
    """:func:`percolation` on average over a step that may be long (m3/s).

    The share that passes grows as the substrate fills: dS/dt = (1 - S^2) i / TAW, solved for a
    constant i, is

        S(t) = (S + g) / (1 + S g),  g = tanh(i t / TAW).

    Up to the wilting point all stays.

    Args:
        site: of a measured roof.
        x2: water in the substrate at the beginning (m3).
        arriving: rain and pumped water (m3/s).
        seconds: duration of the step (s).
    """
    if x2 >= site.z_cap:
        return arriving + (x2 - site.z_cap) / seconds
    came, most, filled = arriving * seconds, site.available_volume, filled_share(site, x2)
    first = min(came, max(0.0, site.wilting_volume - x2))
    g = math.tanh((came - first) / most)
    kept = first + most * g * (1 - filled * filled) / (1 + filled * g)
    return max(0.0, arriving - kept / seconds)


def water_stress(site: Site, x2: float) -> float:
    """K_s: share of the evapotranspiration that a substrate holding x2 (m3) gives.

    FAO-56, Eq. 84: K_s = (TAW - D_r) / ((1 - p) TAW), at most 1, where TAW is what plants can
    take at field capacity, and D_r what is missing of it. The paper's soil always gives all.
    """
    if site.field_capacity is None:
        return 1.0
    return min(1.0, filled_share(site, x2) / site.stress_onset)


def stress_volume(site: Site) -> float:
    """Return below which volume :func:`water_stress` is less than 1 (m3); 0 of the paper's soil."""
    if site.field_capacity is None:
        return 0.0
    return site.wilting_volume + site.stress_onset * site.available_volume


def layer_outflow(site: Site, layer: float, inflow: float, seconds: float) -> float:
    """Mean flow out of the drainage layer, off the roof, during a tick (m3/s).

    The layer's volume V follows dV/dt = i - k V^2 with k = 1 / (a2 drainage_storage
    drainage_time), solved exactly for a constant inflow i, so that any tick is stable:

        V(t) = (V + i g) / (1 + k V g),  g = tanh(t sqrt(i k)) / sqrt(i k), or t where i = 0.

    What is then above its storage has flown off as well. Without a layer the inflow leaves at once.

    Args:
        site: of a measured roof.
        layer: what it holds (m3).
        inflow: percolation during the tick (m3/s).
        seconds: duration of the tick (s).
    """
    if site.drainage_storage is None:
        return inflow
    k = site.layer_coefficient
    rate = math.sqrt(inflow * k)
    g = math.tanh(rate * seconds) / rate if rate > 0 else seconds
    left = min((layer + inflow * g) / (1 + k * layer * g), site.layer_storage)
    return max(0.0, inflow + (layer - left) / seconds)


class Followed(NamedTuple):
    """What left a measured roof, and what its drainage layer held, sample by sample."""

    evaporated: Values
    """m3/s, shape (n,)"""
    drained: Values
    """out of the drainage layer, off the roof (m3/s), shape (n,)"""
    layer: Values
    """at the beginning of each sample (m3), shape (n,)"""
    left: float
    """in the layer at the end (m3)"""


def follow(
    site: Site, layer: float, x2: Values, arriving: Values, evapotranspiration: Values,
    durations: Values,
) -> Followed:
    """Compute what nobody measures on a measured roof whose substrate's volume is known.

    Args:
        site: of a measured roof.
        layer: what its drainage layer holds at first (m3).
        x2: in the substrate at the beginning of each sample (m3), shape (n,).
        arriving: rain and pumped water (m3/s), shape (n,).
        evapotranspiration: off the whole bed, of plants that do not lack water (m3/s), shape (n,).
        durations: of the samples (s), shape (n,).
    """
    evaporated, drained, layers = array("d"), array("d"), array("d")
    for volume, comes, asked, seconds in zip(
        *(array("d", one) for one in (x2, arriving, evapotranspiration, durations)), strict=True
    ):
        percolated = percolation(site, volume, comes, seconds)
        left = volume / seconds + comes - percolated
        evaporated.append(max(0.0, min(asked * water_stress(site, volume), left)))
        drained.append(layer_outflow(site, layer, percolated, seconds))
        layers.append(layer)
        layer = max(0.0, layer + seconds * (percolated - drained[-1]))
    return Followed(
        np.frombuffer(evaporated), np.frombuffer(drained), np.frombuffer(layers), layer
    )


def free_changes(
    site: Site, x2: float, rain: Values, evapotranspiration: Values, lengths: Values
) -> Values:
    """Predict by how much the roof's volume changes in steps without pumping (m3).

    Of the paper's soil that is rain less evapotranspiration. Of a measured roof each step's rain
    comes first, of which dS/dt = (1 - S^2) i / TAW keeps tanh's share, then its
    evapotranspiration, which decays as the substrate dries. Both are solved exactly, so that steps
    may be long.

    Args:
        site: its parameters.
        x2: volume on the roof at the beginning (m3).
        rain: mean in each step (m/s), shape (members, n).
        evapotranspiration: asked for, off the whole bed (m3/s), shape (n,).
        lengths: of the steps (s), shape (n,).

    Returns:
        Shape (members, n).
    """
    if site.field_capacity is None:
        return np.asarray((rain * site.a2 - evapotranspiration) * lengths)
    dry, most = site.wilting_volume, site.available_volume
    stressed = dry + site.stress_onset * most  # below it evapotranspiration decays
    fallen, wanted = rain * site.a2 * lengths, evapotranspiration * lengths
    drying = site.stress_onset * most
    # Of most steps, all at once: those that begin above the wilting point, and end all stressed.
    gains, losses = np.tanh(fallen / most), np.expm1(-wanted / drying).tolist()
    volumes = []
    for member, member_gains in zip(fallen.tolist(), gains.tolist(), strict=True):
        volume = x2
        volumes.append([volume])
        for fell, gained, asked, lost in zip(
            member, member_gains, wanted.tolist(), losses, strict=True
        ):
            first = min(fell, max(dry - volume, 0.0))
            if first > 0:
                gained = float(np.tanh((fell - first) / most))
            if volume + first < dry:
                volume += first
            else:
                filled = min(max((volume - dry) / most, 0.0), 1.0)
                volume = dry + most * ((filled + gained) / (1 + filled * gained))
            easy = min(asked, max(volume - stressed, 0.0))
            if easy == asked:
                lost = 0.0
            elif easy > 0:
                lost = float(np.expm1((easy - asked) / drying))
            volume = volume - easy
            volume += max(volume - dry, 0.0) * lost
            volumes[-1].append(volume)
    return np.diff(volumes, axis=1)


def lasting_share(
    site: Site, x2: float, changes: Values, rain: Values, evapotranspiration: Values,
    lengths: Values,
) -> Values | None:
    """Predict which share of the water that fills the roof now is still on it in later steps (1).

    Two roofs are followed by :func:`free_changes`: one left alone, and one filled to its target
    now. What they differ by, over what they differed by at first, is the share. On a measured roof
    it falls: the fuller substrate lets more of each rain pass and, where plants lack water, gives
    more to them. A storm that fills both leaves no difference.

    Args:
        site: its parameters.
        x2: volume on the roof at the beginning (m3).
        changes: of the roof left alone, as :func:`free_changes` returns them (m3).
        rain: mean in each step (m/s), shape (members, n).
        evapotranspiration: asked for, off the whole bed (m3/s), shape (n,).
        lengths: of the steps (s), shape (n,).

    Returns:
        The mean of each step, at least 0.001, shape (members, n); None of the paper's soil, in
        which all of it stays.
    """
    if site.field_capacity is None:
        return None
    added = max(site.x2_star - x2, _LEAST_ADDED * site.available_volume)
    fades = free_changes(site, x2 + added, rain, evapotranspiration, lengths) - changes
    ends = 1 + np.cumsum(fades, axis=1) / added
    return np.asarray(np.maximum(ends - fades / added / 2, _LEAST_LASTING))
