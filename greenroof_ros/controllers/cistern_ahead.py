"""What a low outlet leaves of the cistern's water over a forecast, for the planners' program."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.model.plant import mains_flows, maximum_pump_flows
from greenroof_ros.model.site import Site

Array = NDArray[np.float64]

# No longer (s) at once where water comes in: it and the outlet change the level together.
_LONGEST_S = 300.0
# A share of 0 would be an entry that the solver's matrix has not.
_LEAST_SHARE = 1e-6


class CisternAhead(NamedTuple):
    """The cistern in the steps of a forecast, where it has a low outlet.

    Its *surplus* is what lies above the low outlet, or above the suction level where that is
    higher; it is negative below. Of what is there at the beginning of a step and what rain brings
    in it the outlets leave a share, by which pumped water is lost no more::

        surplus' = min(z, share z),  z = surplus + rain - pumped

    The share is that of a cistern from which nothing is pumped, so that the balance is linear in
    what is pumped, and exact where that is nothing. A lower cistern loses a larger share: with
    half of the surplus pumped 1.4 times as much.
    """

    surplus: float
    """now (m3)"""
    rain: Array
    """what it brings in each step (m3), shape (members, n)"""
    share: Array
    """1, shape (members, n)"""
    least: Array
    """least surplus with which the pumps work (m3), the mains' water counted, shape (n,)"""
    volume: Array
    """in the cistern, mean of each step if nothing is pumped (m3), shape (members, n)"""
    full: Array
    """the pumps' flow at command 1 from that volume (m3/s), shape (members, n)"""

    def left(self, pumped: Array) -> Array:
        """Return the surplus at each step's end (m3) if so much is pumped until then (m3).

        Both have the shape (members, n).
        """
        before = np.full(len(pumped), self.surplus)
        ends = []
        changes = self.rain - np.diff(pumped, prepend=0.0, axis=1)
        for change, share in zip(changes.T, self.share.T, strict=True):
            before = np.minimum(before + change, share * (before + change))
            ends.append(before)
        return np.stack(ends, axis=1)


def cistern_ahead(
    site: Site, x1: float, rain: Array, lengths: Array, slack: float, kept: float
) -> CisternAhead:
    """Look ahead from a cistern holding x1 (m3).

    Args:
        site: with a low outlet.
        x1: what the cistern holds (m3).
        rain: forecast (m/s), shape (members, n).
        lengths: of the steps (s), shape (n,).
        slack: by how much the last tick that pumps may end below the suction level (m3).
        kept: share of a pumped volume that the soil keeps; what is returned are kept volumes and
            flows, but for that in the cistern.
    """
    suction = site.cistern_volume(site.suction_level)
    base = max(site.cistern_volume(site.lowest_outlet), suction)
    course = cistern_course(site, x1, rain, lengths)
    surplus = course - base
    received = rain * lengths * site.effective_catchment
    before = surplus[:, :-1] + received
    share = np.divide(surplus[:, 1:], before, out=np.ones_like(before), where=before > 0)
    volume = (course[:, :-1] + course[:, 1:]) / 2
    given = (site.mains_flow or 0.0) * np.cumsum(lengths)
    return CisternAhead(
        kept * (x1 - base), kept * received, np.clip(share, _LEAST_SHARE, 1.0),
        kept * (min(suction - slack, x1) - base - given), volume,
        kept * maximum_pump_flows(site, volume),
    )


def cistern_course(site: Site, x1: float, rain: Array, lengths: Array) -> Array:
    """Return what the cistern will hold if nothing is pumped (m3), shape (members, n + 1).

    Rain and mains come in, and the low outlet takes its flow, Eq. (2); what is above the outlet at
    z_o is gone at once. The rule is the trapezoidal one in the root of the head, for which a step's
    end is a quadratic equation: without inflow it is exact.

    Args:
        site: with a low outlet.
        x1: what it holds now (m3).
        rain: forecast (m/s), shape (members, n).
        lengths: of the steps (s), shape (n,).
    """
    low, full = site.cistern_volume(site.lowest_outlet), site.cistern_volume(site.z_o)
    above = np.full(len(rain), min(x1, full) - low)
    course = [above]
    for rate, length in zip(rain.T * site.effective_catchment, lengths, strict=True):
        fills = rate.any() or site.mains_flow
        parts = int(np.ceil(length / _LONGEST_S)) if fills else 1
        seconds = length / parts
        half = site.c_low * seconds / 2 / np.sqrt(site.a1)
        for _ in range(parts):
            root = np.sqrt(np.maximum(above, 0.0))
            rest = above + (rate + mains_flows(site, above + low)) * seconds - half * root
            end = np.sqrt(np.maximum(rest, 0.0) + half**2 / 4) - half / 2
            above = end**2 + np.where(root > 0, 0.0, np.minimum(rest, 0.0))
            above = np.minimum(above, full - low)
        course.append(above)
    return np.stack(course, axis=1) + low
