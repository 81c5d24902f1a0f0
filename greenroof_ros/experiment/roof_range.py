"""The volumes that the roof can have in a run, and by how much they can change, tick by tick."""

from __future__ import annotations

from array import array
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.plant import drainage_flow, soil_losses
from greenroof_ros.model.site import Site

Values = NDArray[np.float64]

# Beyond the rounding of a year of ticks, and far below anything that shows in a bound.
ROUNDING = 1e-9


class RoofRange(NamedTuple):
    """What the roof keeps to, whatever the controller; volumes in m3."""

    low: Values
    """least volume, shape (N+1,)"""
    high: Values
    """largest volume, shape (N+1,)"""
    least: Values
    """least of the volume after each tick less slope times that before, shape (N,)"""
    greatest: Values
    """largest of it, shape (N,)"""
    unpumped: Values
    """largest change in each tick without pumping, shape (N,)"""
    slope: Values | None = None
    """1 in each tick, for the change alone, where it is None; shape (N,), from 0 to 1"""


def roof_range(
    site: Site, x2: float, rain: Values, evapotranspiration: Values, pumped: Values
) -> RoofRange:
    """Follow the range of the roof's volume under all that the pumps can do.

    Args:
        site: its parameters.
        x2: initial volume (m3).
        rain: in each tick (m/s), shape (N,).
        evapotranspiration: in each tick (m3/s), shape (N,).
        pumped: the most that the pumps can lift in each tick (m3), shape (N,).
    """
    if site.field_capacity is not None:
        return _of_measured(site, x2, rain, evapotranspiration, pumped)
    still = site.tau * (rain * site.a2 - evapotranspiration)
    low, high, drained_least, drained_most = _reach(site, x2, still, pumped)
    pumped = _while_dry(site, low, pumped)
    # A roof that runs dry loses what it held, low at the least.
    return RoofRange(
        low, high, still - drained_most,
        np.maximum(still - drained_least + pumped, -low[:-1]),
        np.maximum(still - drained_least, -low[:-1]),
    )


def _while_dry(site: Site, low: Values, pumped: Values) -> Values:
    """Return what can be pumped: nothing where the roof is above its target even at the least."""
    return np.where(low[:-1] > (1 + ROUNDING) * site.a2 * site.z_veg, 0.0, pumped)


def _reach(
    site: Site, x2: float, still: Values, pumped: Values
) -> tuple[Values, Values, Values, Values]:
    """Follow the range of the roof's volume under all that the pumps can do.

    Args:
        site: its parameters.
        x2: initial volume (m3).
        still: change in each tick without pumping and drainage (m3), shape (N,).
        pumped: the most that the pumps can lift in each tick (m3), shape (N,).

    Returns:
        The least and the largest volume (m3), shape (N+1,); the least and the largest volume that
        drains in each tick (m3), shape (N,).
    """
    low = high = x2
    lows, highs = array("d", [low]), array("d", [high])
    drained_least, drained_most = array("d"), array("d")
    target = (1 + ROUNDING) * site.a2 * site.z_veg
    for change, most in zip(array("d", still), array("d", pumped), strict=True):
        drained = (0.0, 0.0)
        driest, wettest = low, high
        if high >= (1 - ROUNDING) * site.z_cap:
            driest, wettest, drained = _drain(site, low, high)
        if low <= target:
            wettest = max(wettest, min(high, target) + most)
        low, high = max(0.0, driest + change), max(0.0, wettest + change)
        lows.append(low)
        highs.append(high)
        drained_least.append(drained[0])
        drained_most.append(drained[1])
    return (
        np.frombuffer(lows), np.frombuffer(highs),
        np.frombuffer(drained_least), np.frombuffer(drained_most),
    )


def _drain(site: Site, low: float, high: float) -> tuple[float, float, tuple[float, float]]:
    """Drain a roof for a tick that holds from low to high (m3), and high about z_cap or more.

    Drainage sets in at z_cap with a jump and grows linearly from there, so the extremes are at the
    ends of the range and on both sides of z_cap.

    Returns:
        The least and the largest volume left (m3); the least and the largest drained (m3).
    """
    left: list[float] = []
    drained: list[float] = []
    for x2 in (low, min(max(low, site.z_cap), high), high):
        if x2 < (1 + ROUNDING) * site.z_cap:
            left.append(x2)
            drained.append(0.0)
        if x2 >= (1 - ROUNDING) * site.z_cap:
            drained.append(site.tau * drainage_flow(site, max(x2, site.z_cap)))
            left.append(x2 - drained[-1])
    return min(left), max(left), (min(drained), max(drained))


def _of_measured(
    site: Site, x2: float, rain: Values, evapotranspiration: Values, pumped: Values
) -> RoofRange:
    """Follow the range of the volume in the substrate of a measured roof.

    Of what arrives the share that stays falls with the volume, what evaporates and what leaves
    above field capacity rise with it. So the change without pumping is largest at the least volume.
    The volume after a tick rises with that before by about the slope of the chord over the range:
    less that, what is left to choose is little.
    """
    low = high = x2
    lows, highs = array("d", [low]), array("d", [high])
    least, greatest, unpumped = array("d"), array("d"), array("d")
    slopes = array("d")
    target = site.a2 * site.z_veg
    for fell, asked, most in zip(
        array("d", rain * site.a2), array("d", evapotranspiration), array("d", pumped), strict=True
    ):
        if low > (1 + ROUNDING) * target:
            most = 0.0
        ends = [x2 + _change(site, x2, fell, asked) for x2 in (low, high)]
        unpumped.append(max(ends[0] - low, -low))
        slope = 1.0
        if high - low > ROUNDING * site.z_cap:
            slope = min(1.0, max(0.0, (ends[1] - ends[0]) / (high - low)))
        reached = {}
        for line in (0.0, slope):
            found = _ends(site, low, high, fell, asked, line)
            reached[line] = min(found), max(found)
            if most > 0:
                end = max(low, min(high, target))
                pumped_to = _ends(site, low, end, fell + most / site.tau, asked, line)
                reached[line] = reached[line][0], max(reached[line][1], *pumped_to)
        least.append(reached[slope][0])
        # A roof that runs dry ends at 0, and not below.
        greatest.append(max(reached[slope][1], -slope * low))
        slopes.append(slope)
        low, high = (max(0.0, volume) for volume in reached[0.0])
        lows.append(low)
        highs.append(high)
    return RoofRange(*(
        np.frombuffer(part) for part in (lows, highs, least, greatest, unpumped, slopes)
    ))


def _change(site: Site, x2: float, arriving: float, asked: float) -> float:
    """Return by how much a measured roof holding x2 (m3) changes in a tick (m3).

    Args:
        site: its parameters.
        x2: volume in the substrate (m3).
        arriving: rain and pumped water (m3/s).
        asked: evapotranspiration of plants that do not lack water (m3/s).
    """
    drained, evaporated = soil_losses(site, x2, arriving, asked)
    return site.tau * (arriving - drained - evaporated)


def _ends(
    site: Site, low: float, high: float, arriving: float, asked: float, line: float
) -> list[float]:
    """Return what may be the least and largest over a range of volumes (m3) after a tick.

    Between the wilting point, the onset of stress and field capacity the volume after a tick is a
    concave parabola of that before, and it is continuous; so it is less a line. So the least is at
    the ends of these pieces, and the largest there or at a parabola's vertex.

    Args:
        site: of a measured roof.
        low: least volume before the tick (m3).
        high: largest volume before the tick (m3).
        arriving: rain and pumped water (m3/s).
        asked: evapotranspiration of plants that do not lack water (m3/s).
        line: so many times the volume before is subtracted from that after.
    """
    dry, most = site.wilting_volume, site.available_volume
    onset = dry + site.stress_onset * most
    found = [low, high]
    found += [x2 for x2 in (dry, onset, site.z_cap) if low < x2 < high]
    if arriving > 0:
        # d/dx2 of x2 - tau (S^2 arriving + K_s asked) - line x2 is 0, of the two pieces.
        for slope in (1.0 - line, 1.0 - line - site.tau * asked / (site.stress_onset * most)):
            vertex = dry + most * (slope * most / (2 * site.tau * arriving))
            if low < vertex < min(high, site.z_cap):
                found.append(vertex)
    return [x2 + _change(site, x2, arriving, asked) - line * x2 for x2 in found]
