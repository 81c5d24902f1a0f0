"""Assumptions on which the results of simulations rest, and both ends of what is likely.

A climate other than that of the record counts as an assumption.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

from greenroof_ros.simulation.inputs import RunInputs
from greenroof_ros.simulation.run import Run
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
# Names of those for which the weather must be read again.
_OF_WEATHER = {"k_Rs", *CLIMATE}


def list_assumptions(site: Site) -> list[Assumption]:
    """Return the assumptions about a site that affect it."""
    return [
        each for each in ASSUMPTIONS if each.name not in CLIMATE
        and (each.name != "percolation_exponent" or site.field_capacity is not None)
    ]


def list_ends(
    site: Site, inputs: RunInputs, runs: dict[str, Run],
    read_runs: Callable[[Site, RunInputs], dict[str, Run]],
) -> Iterator[tuple[dict[str, str], dict[str, Any], dict[str, Run]]]:
    """Yield a site as it is, and with both ends of every assumption that affects it, one at a time.

    Args:
        site: the site.
        inputs: inputs with which the weather was read.
        runs: the run of each season, by name.
        read_runs: function that reads the weather again, and returns the runs of a site.

    Yields:
        The assumption and its value in words, as ``assumption`` and ``value``; the parameters of
        the site that change; and the runs.
    """
    yield {"assumption": "as used", "value": ""}, {}, runs
    of_climate = [each for each in ASSUMPTIONS if each.name in CLIMATE]
    for each in (*list_assumptions(site), *of_climate):
        used: float = getattr(inputs if each in of_climate else site, each.name)
        for value in (each.low, each.high):
            change: dict[str, Any] = {each.name: value}
            own, changed = runs, inputs
            if each in of_climate:
                change, changed = {}, replace(inputs, **change)
            if each.name in _OF_WEATHER:
                own = read_runs(replace(site, **change), changed)
            words = {"assumption": f"{each.label}; used: {used:g}", "value": f"{value:g}"}
            yield words, change, own
