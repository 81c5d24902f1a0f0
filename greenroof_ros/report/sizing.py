"""Sites of several sizes: cistern and green roof."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import NamedTuple

from greenroof_ros.model.site import Site

# What follows a site's size: areas, the cistern's depth, and the volumes in them.
_BY_SIZE = {"a1", "a2", "z_o", "x2_star", "initial_cistern", "initial_roof", "initial_layer"}


class Size(NamedTuple):
    """What an engineer decides first."""

    roof_m2: float
    """area of the green roof"""
    cistern_m3: float
    """volume of the cistern up to its outlet"""


def size_of(site: Site) -> Size:
    """Return the size of a site."""
    return Size(site.a2, site.a1 * site.z_o)


def is_sizing(sites: Iterable[Site]) -> bool:
    """Whether the sites of some seasons differ in size, and in nothing else."""
    different = set(sites)
    others = {
        tuple(value for name, value in asdict(site).items() if name not in _BY_SIZE)
        for site in different
    }
    return len({size_of(site) for site in different}) > 1 and len(others) == 1
