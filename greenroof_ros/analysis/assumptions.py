"""Assumptions on which the results of simulations rest, and both ends of what is likely.

A climate other than that of the record counts as an assumption.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from greenroof_ros.simulation.inputs import RunInputs
from greenroof_ros.site.site import Site
from greenroof_ros.weather.climate import CLIMATE


class Assumption(NamedTuple):
    """What is seldom known about a site or its climate, and the range in which it probably lies."""

    name: str
    """parameter of the site, or input that changes the climate"""
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
    Assumption(
        "rain_factor", "rain of another climate, relative to the record", 0.9, 1.2, "[assumed]",
    ),
    Assumption(
        "temperature_change", "warming since the record, at the same relative humidity (K)", 1.5,
        3.0, "[assumed]",
    ),
)
OF_WEATHER = {"k_Rs", *CLIMATE}
"""names of those for which the weather must be read again"""


def list_assumptions(site: Site) -> list[Assumption]:
    """Return the assumptions about a site that affect it."""
    return [
        each for each in ASSUMPTIONS if each.name not in CLIMATE
        and (each.name != "percolation_exponent" or site.field_capacity is not None)
    ]


def list_ends(
    site: Site, inputs: RunInputs
) -> Iterator[tuple[Assumption, float, float, Site, RunInputs]]:
    """Yield both ends of every assumption that affects a site.

    Each comes with the value that is used, the value of the end, and a site and inputs that have
    the latter.
    """
    for each in list_assumptions(site):
        for value in (each.low, each.high):
            changed: dict[str, Any] = {each.name: value}
            yield each, getattr(site, each.name), value, replace(site, **changed), inputs
    for each in ASSUMPTIONS[-len(CLIMATE):]:
        for value in (each.low, each.high):
            changed = {each.name: value}
            yield each, getattr(inputs, each.name), value, site, replace(inputs, **changed)
