"""A comparison of cisterns for a site and a weather record."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from greenroof_ros.analysis.sizing import designs as plans
from greenroof_ros.analysis.sizing.choice import KNEE, Prices
from greenroof_ros.analysis.sizing.columns import COST, KEPT
from greenroof_ros.analysis.sizing.seasons import find_seasons, list_notes, read_window
from greenroof_ros.analysis.sizing.sizes import Sizes
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import make_record, parameters_of
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.text import number_of
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.weather.summary import as_lines, summarize

PRICES = {parameter.name: parameter for parameter in parameters_of(Prices)}
KNEE_RANGE = Range(0.0, 1e6, "m3")
JOBS = Range(1, 1024, whole=True)
# Share of the cistern that is full when a season begins.
_HALF = 0.5

_OF_RUN = ("site", "weather", "evapotranspiration", "gaps")
_OWN = ("volumes", "targets", "outlets", "season", "knee", "jobs", *PRICES)
OPTIONS = (*_OF_RUN, *_OWN)
"""names of the options that a user can pass"""


def size_site(
    given: Mapping[str, Any],
    progress: Callable[[str, float], None] = lambda text, share: None,
    show: Callable[[Mapping[str, Any]], None] = lambda summary: None,
) -> Sizes:
    """Compare the designs of a site over the seasons of its weather.

    Args:
        given: values of :data:`OPTIONS`, by name; an option that is None or left out gets its
            default.
        progress: callback that receives the current task and the share of all work done, 0 to 1;
            an error that it raises ends the runs.
        show: function that receives the summary of the weather.

    Raises:
        ConfigurationError: if an input is invalid; the key of the error is the option's name.
    """
    values = {name: value for name, value in given.items() if value is not None}
    volumes = plans.read_numbers(values.get("volumes"), "volumes", plans.VOLUMES)
    targets = plans.read_numbers(values.get("targets"), "targets", plans.TARGETS)
    outlets = plans.read_outlets(values.get("outlets"))
    knee = KNEE_RANGE.read(values.get("knee", KNEE), key="knee")
    jobs = int(JOBS.read(values.get("jobs", 1), key="jobs"))
    priced = {name: values[name] for name in PRICES if name in values}
    prices = make_record(Prices, priced) if priced else None
    if "weather" not in values:
        raise ConfigurationError(
            "is missing; specify records that cover at least one season", key="weather"
        )
    inputs = make_inputs(
        find_controller(plans.CONTROLLER),
        {name: values[name] for name in _OF_RUN if name in values},
    )
    site = inputs.read_site()
    window = read_window(values.get("season"), site)
    targets = targets or plans.choose_targets(site)
    middle = targets[len(targets) // 2]
    designs, notes = plans.make_designs(
        site, volumes or plans.choose_volumes(site), targets, outlets
    )
    progress("reading weather", 0.0)
    weather, _ = inputs.read_records(site)
    summary = summarize(weather, site)
    show(summary)
    runs, incomplete = find_seasons(inputs, designs[0].site, weather, window)

    shape = len(designs), len(runs)
    text = f"{number_of(len(designs), 'design')} in {number_of(len(runs), 'season')}"
    # Every second cistern of one target and outlet is also run from other initial states.
    outlet = plans.choose_outlet(site, outlets)
    tried = [one for one in designs if (one.target, one.outlet) == (middle, outlet)][::-2]
    made, _ = simulate_season([
        Case(
            design.site, design.parameters, season, filled * design.volume, design.site.x2_star,
            with_forecast=False,
        )
        for group, filled in ((designs, _HALF), (tried, 0.0), (tried, 1.0))
        for design in group for season in runs.values()
    ], progress=lambda share: progress(text, share), threads=jobs)
    results = {
        metric.name: np.array([own.get(metric.name, np.nan) for (own, *_), _ in made])
        for metric in METRICS
    }
    metrics = {name: series[: math.prod(shape)].reshape(shape) for name, series in results.items()}
    starts = {
        name: np.ma.masked_invalid(
            series[math.prod(shape) :].reshape(2, len(tried), -1)
        ).mean(axis=2).filled(np.nan)
        for name, series in results.items()
    }
    metrics[KEPT] = 1 - np.divide(
        metrics["wet_discharge_m3"], metrics["rain_m3"], where=metrics["rain_m3"] > 0,
        out=np.full(shape, np.nan),
    )
    if prices is not None:
        cistern = np.array([[prices.yearly_cistern_price * design.volume] for design in designs])
        mains, wet = metrics["mains_m3"], metrics["wet_discharge_m3"]
        metrics[COST] = cistern + prices.cost_water(mains, wet)
    return Sizes(
        site, designs, list(runs), f"{window}", 24.0 * window.days, metrics, incomplete,
        [*notes, *as_lines(summary), *list_notes(runs, site)], prices, knee, tried, starts,
    )
