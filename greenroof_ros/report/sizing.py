"""Sites of several sizes: cistern and green roof."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from greenroof_ros.model.site import Site
from greenroof_ros.report.seasons import Seasons


class Size(NamedTuple):
    """What an engineer decides first."""

    roof_m2: float
    """area of the green roof"""
    cistern_m3: float
    """volume of the cistern up to its outlet"""


def size_of(site: Site) -> Size:
    """Return the size of a site."""
    return Size(site.a2, site.a1 * site.z_o)


def is_sizing(found: Iterable[Seasons]) -> bool:
    """Whether the sites of some seasons differ in size."""
    return len({size_of(one.site) for one in found}) > 1
