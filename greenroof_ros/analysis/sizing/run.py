"""A comparison of targets, cisterns and outlets for a site and a weather record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from greenroof_ros.analysis.assumptions import list_ends
from greenroof_ros.analysis.seasons import find_seasons, list_notes, read_window
from greenroof_ros.analysis.sizing import designs as plans
from greenroof_ros.analysis.sizing.choice import KNEE, Prices, choose_volume
from greenroof_ros.analysis.sizing.choice import find_target as choose_target
from greenroof_ros.analysis.sizing.designs import Design
from greenroof_ros.analysis.sizing.results import COST, KEPT, LOST, Results
from greenroof_ros.analysis.sizing.sizes import Sizes, Tested
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import make_record, parameters_of
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.site import Site
from greenroof_ros.weather.summary import as_lines, summarize

PRICES = {parameter.name: parameter for parameter in parameters_of(Prices)}
KNEE_RANGE = Range(0.0, 1e6, "m3")
JOBS = Range(1, 1024, whole=True)
# Share of the cistern that is full when a season begins.
_HALF = 0.5

_OF_RUN = ("site", "weather", "evapotranspiration", "gaps")
OPTIONS = (*_OF_RUN, "volumes", "targets", "outlets", "season", "knee", "jobs", *PRICES)
"""names of the options that a user can pass"""


def size_site(
    given: Mapping[str, Any],
    progress: Callable[[str, float], None] = lambda text, share: None,
    show: Callable[[Mapping[str, Any]], None] = lambda summary: None,
) -> Sizes:
    """Compare targets with the site's own cistern, and then cisterns with the best target.

    Args:
        given: values of :data:`OPTIONS`, by name; an option that is None or left out gets its
            default.
        progress: callback that receives the current task and the share of it that is done, 0 to 1;
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
    for target in targets or []:
        plans.check_target(site, target)
    window, outlet = read_window(values.get("season"), site), plans.choose_outlet(site, outlets)
    own = volumes[len(volumes) // 2] if volumes else plans.find_volume(site)
    progress("reading weather", 0.0)
    weather, _ = inputs.read_records(site)
    summary = summarize(weather, site)
    show(summary)
    ticks = plans.build(site, Design(own, 1000 * site.z_veg, outlet))[0]
    seasons, incomplete = find_seasons(inputs, ticks, weather, window)
    results: dict[Design, Results] = {}

    def run(
        text: str, designs: Sequence[Design], given: Site = site,
        runs: Mapping[str, Run] = seasons, filled: float = _HALF,
    ) -> list[Results]:
        return _simulate(
            [(*plans.build(given, each), filled * each.volume) for each in designs],
            [*runs.values()], prices, jobs, lambda share: progress(text, share),
        )

    def find_target(targets: Sequence[float]) -> float:
        new = [Design(own, target, outlet) for target in targets]
        results.update(zip(new, run("comparing targets", new), strict=True))
        tried = sorted(results)
        lost = np.array([results[design][LOST].mean() for design in tried])
        return choose_target([design.target for design in tried], lost)

    def find_volume(volumes: Sequence[float], made: Mapping[Design, Results]) -> float:
        ranked = [made[Design(volume, target, outlet)] for volume in volumes]
        mains, wet = (
            np.array([each[name].mean() for each in ranked])
            for name in ("mains_m3", "wet_discharge_m3")
        )
        return choose_volume(volumes, mains, wet, prices, knee)

    def compare(volumes: Sequence[float]) -> float:
        new = [
            design for each in outlets for volume in volumes
            if (design := Design(volume, target, each)) not in results
        ]
        results.update(zip(new, run("comparing cisterns", new), strict=True))
        return find_volume(volumes, results)

    target = find_target(targets or plans.choose_targets(site))
    if targets is None:
        target = find_target(plans.refine_targets(site, target))
    compared = volumes or plans.choose_volumes(site)
    volume = compare(compared)
    if volumes is None:
        compared = sorted({*compared, *plans.refine_volumes(compared, volume)})
        volume = compare(compared)
    recommended, tested = Design(volume, target, outlet), []
    empty, full = (
        run("other initial states", [recommended], filled=part)[0] for part in (0.0, 1.0)
    )
    for end in list_ends(site):
        runs, designs = seasons, [Design(each, target, outlet) for each in compared]
        if end.assumption.name == "k_Rs":  # the only one on which evapotranspiration depends
            ended, _ = inputs.read_records(end.site)
            runs, _ = find_seasons(inputs, replace(ticks, k_Rs=end.value), ended, window)
        text = f"assuming {end.assumption.name} {end.value:g}"
        made = dict(zip(designs, run(text, designs, end.site, runs), strict=True))
        if any(not np.array_equal(values, results[recommended][name], equal_nan=True)
               for name, values in made[recommended].items()):
            tested.append(Tested(
                end.assumption, end.value, made[recommended], find_volume(compared, made)
            ))
    contents, *notes = as_lines(summary)
    left_out = [f"season {name} is left out: {why}" for name, why in incomplete.items()]
    return Sizes(
        site, results, recommended, tested, (empty, full), list(seasons), f"{window}",
        [*plans.list_assumed(site, outlets), *_remark(results[recommended], volume, compared)],
        [f"{weather.source}: {contents}", *notes, *list_notes(seasons, site), *left_out],
        prices, knee,
    )


def _simulate(
    designs: Sequence[tuple[Site, Mapping[str, Any], float]], seasons: Sequence[Run],
    prices: Prices | None, jobs: int, progress: Callable[[float], None],
) -> list[Results]:
    """Simulate designs in seasons, and return the results of each design.

    Args:
        designs: site, parameters and initial volume in the cistern (m3) of each design.
        seasons: the seasons, for sites with the ticks of the designs.
        prices: prices of water and cistern; None without costs.
        jobs: number of threads.
        progress: callback that receives the share that is done.
    """
    if not designs:
        return []
    made, _ = simulate_season([
        Case(site, parameters, season, volume, site.x2_star, with_forecast=False)
        for site, parameters, volume in designs for season in seasons
    ], progress=progress, threads=jobs)
    of_designs = []
    for number, (site, *_) in enumerate(designs):
        runs = [own for (own, *_), _ in made[number * len(seasons) : (number + 1) * len(seasons)]]
        results: Results = {
            metric.name: np.array([run.get(metric.name, np.nan) for run in runs])
            for metric in METRICS
        }
        rain, wet = results["rain_m3"], results["wet_discharge_m3"]
        results[KEPT] = 1 - wet / np.where(rain > 0, rain, np.nan)
        results[LOST] = 1 - results["evapotranspiration_ratio"]
        if prices is not None:
            cistern = prices.yearly_cistern_price * site.a1 * site.z_o
            results[COST] = cistern + prices.cost_water(results["mains_m3"], wet)
        of_designs.append(results)
    return of_designs


def _remark(results: Results, volume: float, compared: Sequence[float]) -> list[str]:
    """Return remarks on the recommended cistern (m3) and on the drainage of the roof."""
    remarks = [
        f"The recommended cistern is the {size} of those compared: {other} cisterns are worth "
        "trying." for size, other, end in (
            ("smallest", "smaller", compared[0]), ("largest", "larger", compared[-1]),
        ) if volume == end and len(compared) > 1
    ]
    drained, fallen = (results[name].mean() for name in ("drainage_m3", "rain_roof_m3"))
    if drained > fallen:
        remarks.append(
            f"More water drains from the roof ({drained:.3g} m³ in a season) than rain falls on it "
            f"({fallen:.3g} m³): much of the irrigation percolates. See percolation_exponent."
        )
    return remarks
