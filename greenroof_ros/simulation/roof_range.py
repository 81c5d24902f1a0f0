"""The range of possible volumes on the roof in a run, and of possible changes in each tick."""

from __future__ import annotations

import math
from array import array
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.physics.parameters import PlantParameters, plant_parameters
from greenroof_ros.physics.soil import (
    ALMOST_FULL,
    fill,
    percolation,
    roof_after_tick,
    water_to_fill,
)
from greenroof_ros.site.site import Site

Values = NDArray[np.float64]

# Larger than the rounding errors of a year of ticks, and far too small to show in a bound.
ROUNDING = 1e-9
# Accuracy of a filled share at which a limit may have its extreme (1).
_SHARE_ERROR = 1e-9


class RoofRange(NamedTuple):
    """Limits on the roof's volume under any controller; all volumes are in m3."""

    low: Values
    """minimum volume, shape (N+1,)"""
    high: Values
    """maximum volume, shape (N+1,)"""
    minimum: Values
    """minimum of the volume after each tick minus slope times the volume before it, shape (N,)"""
    maximum: Values
    """maximum of the same, shape (N,)"""
    unpumped: Values
    """maximum change in each tick without pumping, shape (N,)"""
    slope: Values | None = None
    """slope from 0 to 1, shape (N,); None means 1 in every tick, so the limits are of the change"""


def roof_range(
    site: Site, x2: float, rain: Values, evapotranspiration: Values, pumped: Values
) -> RoofRange:
    """Compute the range of the roof's volume for all possible pumping, tick by tick.

    Args:
        site: parameters of the site.
        x2: initial volume (m3).
        rain: rain rate in each tick (m/s), shape (N,).
        evapotranspiration: evapotranspiration in each tick (m3/s), shape (N,).
        pumped: maximum volume that the pumps can lift in each tick (m3), shape (N,).
    """
    p = plant_parameters(site)
    target = (1 + ROUNDING) * site.a2 * site.z_veg
    low = high = x2
    ticks = array("d")
    for fell, potential, max_pumped in zip(
        array("d", rain * site.a2), array("d", evapotranspiration), array("d", pumped), strict=True
    ):
        # Nothing is pumped if even the roof's minimum volume is above its target.
        supply = max_pumped if low <= target else 0.0
        limits = _limits_of_tick(p, low, high, fell, potential, supply)
        low, high = limits[:2]
        ticks.extend(limits)
    lows, highs, minimum, maximum, unpumped, slope = np.ascontiguousarray(
        np.reshape(ticks, (len(rain), -1)).T
    )
    return RoofRange(
        np.append(x2, lows), np.append(x2, highs), minimum, maximum, unpumped,
        slope if p.has_field_capacity else None,
    )


def _limits_of_tick(
    p: PlantParameters, low: float, high: float, rain: float, potential: float, max_pumped: float
) -> tuple[float, ...]:
    """Compute the range of the roof's volume after a tick.

    On a field-capacity soil, the retained share of arriving water falls with the volume, while
    evaporation and the excess above field capacity rise with the volume. The change without pumping
    is therefore largest at the minimum volume, as on the paper's soil, which drains above z_cap.
    The volume after a tick rises with the volume before it, by about the slope of the chord over
    the range. After subtraction of the slope times the volume before the tick, the limits are close
    together.

    Args:
        p: numbers of the site.
        low: minimum volume before the tick (m3).
        high: maximum volume before the tick (m3).
        rain: rain on the roof (m3/s).
        potential: evapotranspiration of plants without water stress (m3/s).
        max_pumped: maximum volume that the pumps can lift in the tick (m3).

    Returns:
        The fields of :class:`RoofRange`; the slope is 1 on the paper's soil.
    """
    slope = 1.0
    if p.has_field_capacity and high - low > ROUNDING * p.z_cap:
        first, last = (roof_after_tick(p, x2, rain, potential) for x2 in (low, high))
        slope = min(1.0, max(0.0, (last - first) / (high - low)))
    reached = {}
    for line in (0.0, slope):
        ends = _ends(p, low, high, rain, potential, line)
        reached[line] = min(ends), max(ends)
        if max_pumped > 0:
            end = max(low, min(high, p.a2 * p.z_veg))
            pumped_to = max(_ends(p, low, end, rain + max_pumped / p.tau, potential, line))
            if not p.has_short_ticks:  # the pumps stop at the target
                full = (1 + ROUNDING) * p.a2 * p.z_veg
                filled = max(full, roof_after_tick(p, full, rain, potential))
                pumped_to = min(pumped_to, filled - line * low)
            reached[line] = reached[line][0], max(reached[line][1], pumped_to)
    unpumped = max(_ends(p, low, low, rain, potential, 1.0))
    # A roof that runs dry ends at 0 and not below it: it loses the water it held, at least low.
    return (
        max(0.0, reached[0.0][0]), max(0.0, reached[0.0][1]), reached[slope][0],
        max(reached[slope][1], -slope * low), max(unpumped, -low), slope,
    )


def _ends(
    p: PlantParameters, low: float, high: float, arriving: float, potential: float, line: float
) -> list[float]:
    """Return candidates for the minimum and maximum volume after a tick, minus a line (m3).

    The drainage of the paper's soil begins at z_cap with a jump, and is linear above z_cap. The
    extremes are therefore at the ends of the range and on both sides of z_cap.

    On a field-capacity soil, the volume after a tick is a continuous function of the volume before
    the tick. The function is concave between the wilting point, the onset of stress and field
    capacity. Subtracting a line changes neither property. The minimum is therefore at an end of one
    of these pieces, and the maximum is at an end or where the slope is 0.

    Args:
        p: numbers of the site.
        low: minimum volume before the tick (m3).
        high: maximum volume before the tick (m3).
        arriving: rain and pumped water (m3/s).
        potential: evapotranspiration of plants without water stress (m3/s).
        line: slope of the line, by which the volume before the tick is multiplied.
    """
    if not p.has_field_capacity:
        full, ends = p.z_cap, []
        for x2 in (low, min(max(low, full), high), high):
            after = x2 - line * x2 + p.tau * (arriving - potential)
            if x2 < (1 + ROUNDING) * full:
                ends.append(after)
            if x2 >= (1 - ROUNDING) * full:
                drained = percolation(p, max(x2, full), arriving, p.tau)
                ends.append(after - p.tau * drained)
        return ends
    dry, available = p.wilting_volume, p.available_volume
    drying = p.stress_onset * available
    volumes = [low, high]
    volumes += [x2 for x2 in (dry, dry + drying, p.z_cap) if low < x2 < high]
    arrived, exponent = p.tau * arriving, p.percolation_exponent
    if arrived > 0:
        # Below the wilting point the slope is 1 - S'^beta, S' being the share after the tick.
        volumes.append(dry - arrived)
        if 0 < line < 1:
            u = water_to_fill(exponent, 0.0, (1 - line) ** (1 / exponent))
            volumes.append(dry - arrived + available * u)
        # Above it, (1 - S'^beta) / (1 - S^beta) = steep, for the two pieces.
        for steep in (line, line + p.tau * potential / drying):
            if steep > 0:
                volumes.append(dry + available * _share_of_slope(p, arrived / available, steep))
        volumes = [x2 for x2 in volumes if low <= x2 <= high]
    return [roof_after_tick(p, x2, arriving, potential) - line * x2 for x2 in volumes]


def _share_of_slope(p: PlantParameters, u: float, slope: float) -> float:
    """Return the filled share at which the share after a tick has a slope, which falls with it (1).

    Args:
        p: numbers of the site.
        u: water that arrives in the tick (as a share of TAW).
        slope: the slope.
    """
    exponent = p.percolation_exponent
    if exponent == 2:  # (1 - g^2) / (1 + S g)^2
        g = math.tanh(u)
        return (math.sqrt((1 - g * g) / slope) - 1) / g
    low, high = 0.0, ALMOST_FULL
    while high - low > _SHARE_ERROR:
        middle = (low + high) / 2
        after = fill(exponent, middle, u)
        if (1 - after**exponent) / (1 - middle**exponent) > slope:
            low = middle
        else:
            high = middle
    return low
