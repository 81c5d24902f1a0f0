"""Assumptions on which the results of simulations rest, and both ends of what is likely."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from greenroof_ros.site.site import Site


class Assumption(NamedTuple):
    """A parameter of the site that is seldom known, and the range in which it probably lies."""

    name: str
    """parameter of the site"""
    label: str
    low: float
    high: float
    source: str
    """source of the range"""


ASSUMPTIONS = (
    Assumption(
        "percolation_exponent", "exponent of the percolation below field capacity", 1.5, 3.0,
        "two measured roofs, doc/explanation/roof.md",
    ),
    Assumption(
        "wet_after", "time after rain during which the weather counts as wet (h)", 1.0, 6.0,
        "time that a combined sewer takes to empty [assumed]",
    ),
    Assumption(
        "runoff_coefficient", "runoff coefficient of the ordinary roofs", 0.75, 0.95,
        "roofs, ASCE (1992)",
    ),
    Assumption(
        "k_Rs", "coefficient of the solar radiation that was not measured", 0.16, 0.19,
        "inland and coast, FAO-56, Eq. 50",
    ),
)


def list_ends(site: Site) -> Iterator[tuple[Assumption, float, Site]]:
    """Yield both ends of every assumption that affects a site, each with a site that has it."""
    for each in ASSUMPTIONS:
        if each.name != "percolation_exponent" or site.field_capacity is not None:
            for value in (each.low, each.high):
                changed: dict[str, Any] = {each.name: value}
                yield each, value, replace(site, **changed)
