"""The comparison of targets, cisterns and outlets of a site over all seasons of a record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.analysis.assumptions import list_ends
from greenroof_ros.analysis.references import simulate_references
from greenroof_ros.analysis.seasons import find_ranges, find_seasons, list_notes, read_window
from greenroof_ros.analysis.sizing import designs as plans
from greenroof_ros.analysis.sizing.designs import BY_DESIGN, KEPT, LOST, Design
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.table import make_frame
from greenroof_ros.simulation.inputs import RunInputs, make_inputs
from greenroof_ros.simulation.run import Run
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.site import Site
from greenroof_ros.weather.summary import as_lines, summarize

if TYPE_CHECKING:
    import polars

    from greenroof_ros.analysis.sizing.sizes import Sizes

KNEE_RANGE = Range(0.0, 1e6, "m3")
# Share of the cistern that is full when a season begins.
_HALF = 0.5


def size(
    weather: Any, site: Any = None, *, evapotranspiration: str | None = None,
    gaps: str | None = None, volumes: Sequence[float] | None = None,
    targets: Sequence[float] | None = None, outlets: Sequence[str] | None = None,
    season: str | None = None, rain_factor: float = 1.0, temperature_change: float = 0.0,
    knee: float = plans.KNEE, jobs: int = 1,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Sizes:
    """Compare cisterns, targets and outlets over all seasons of a record, like ``greenroof size``.

    Targets are compared with the site's own cistern, and then cisterns with the best target.

    Args:
        weather: files, a pattern or a data frame, as for ``gr.simulate``, with at least one season.
        site: a site file, or a site from ``gr.read_site``; by default the paper's site.
        evapotranspiration: as for ``gr.simulate``.
        gaps: as for ``gr.simulate``.
        volumes: volumes of the cistern up to its overflow (m3); by default the site's own, and
            volumes that suit the roof and the catchment.
        targets: target depths of the water on the roof (mm); by default the site's target, and
            steps of a twentieth of what the soil holds.
        outlets: any of ``"none"``, ``"drain"`` and ``"plan"``; by default all three, or only
            ``"none"`` for a site without a low outlet.
        season: first and last day of the season, as in ``"05-01/10-31"``; by default May to
            October, or November to April south of the equator.
        rain_factor: factor by which all rain is multiplied, for another climate.
        temperature_change: difference that is added to all temperatures (K); the relative humidity
            stays.
        knee: minimum volume of water that each additional m3 of cistern must save per season (m3).
        jobs: number of threads.
        progress: callback that receives the current task and the share of it that is done, 0 to 1;
            an error that it raises ends the runs.

    Returns:
        The results: ``.sentence``, ``.table``, ``.table_of_seasons``, ``.plot()`` and
        ``.save(directory)``, which writes the page.

    Raises:
        ConfigurationError: if an input is invalid, or a package is not installed; the message
            names it and states what would be right.

    Example:
        >>> import greenroof_ros as gr
        >>> sizes = gr.size(
        ...     site="config/site_valve.yaml", weather="config/weather/toronto_2021-07.csv",
        ...     season="07-07/07-08", volumes=[5, 10], targets=[36, 39], outlets=["none"],
        ... )
        >>> sizes.recommended.target_mm
        36.0
    """
    with require_extra("study"):
        from greenroof_ros.analysis.sizing.sizes import Sizes
    own_volumes = None if volumes is None else plans.read_numbers(volumes, "volumes", plans.VOLUMES)
    own_targets = None if targets is None else plans.read_numbers(targets, "targets", plans.TARGETS)
    knee = KNEE_RANGE.read(knee, key="knee")
    inputs = make_inputs(find_controller(plans.CONTROLLER), {
        "site": site, "weather": weather, "evapotranspiration": evapotranspiration, "gaps": gaps,
        "rain_factor": rain_factor, "temperature_change": temperature_change,
    })
    base = inputs.read_site()
    plans.check_mains(base)
    for target in own_targets or []:
        plans.check_target(base, target)
    kinds, window = plans.read_outlets(outlets, base), read_window(season, base)
    outlet = plans.choose_outlet(base, kinds)
    compared = own_volumes or plans.choose_volumes(base)
    own = compared[len(compared) // 2] if own_volumes else plans.find_volume(base)
    progress("reading weather", 0.0)
    record, _ = inputs.read_records(base)
    ticks = plans.build(base, Design(own, 1000 * base.z_veg, outlet))[0]
    seasons, incomplete = find_seasons(inputs, ticks, record, window)

    def run(
        text: str, designs: Sequence[Design], like: Site = base,
        runs: Mapping[str, Run] = seasons, filled: float = _HALF,
    ) -> polars.DataFrame:
        return _simulate(
            {each: plans.build(like, each) for each in designs}, runs, filled, jobs,
            lambda share: progress(text, share),
        )

    def best_target(rows: polars.DataFrame) -> float:
        means = find_ranges(rows, BY_DESIGN).sort("target_mm")
        return plans.find_target(means["target_mm"].to_list(), means[LOST].to_numpy())

    def add_volumes(rows: polars.DataFrame, volumes: Sequence[float]) -> polars.DataFrame:
        there = {*rows.select(BY_DESIGN).iter_rows()}
        designs = [Design(volume, target, kind) for kind in kinds for volume in volumes]
        new = [design for design in designs if design not in there]
        return rows.vstack(run("comparing cisterns", new)) if new else rows

    def best_volume(rows: polars.DataFrame) -> float:
        means = find_ranges(rows.filter(target_mm=target, outlet=outlet), BY_DESIGN)
        volumes, mains, wet = means.sort("volume_m3")["volume_m3", "mains_m3", "wet_discharge_m3"]
        return float(volumes[plans.find_knee(volumes.to_list(), -(mains + wet).to_numpy(), knee)])

    levels = own_targets or plans.choose_targets(base)
    rows = run("comparing targets", [Design(own, level, outlet) for level in levels])
    target = best_target(rows)
    if own_targets is None:
        finer = [Design(own, level, outlet) for level in plans.refine_targets(base, target)]
        rows = rows.vstack(run("comparing targets", finer))
        target = best_target(rows)
    rows = add_volumes(rows, compared)
    volume = best_volume(rows)
    if own_volumes is None:
        more = plans.refine_volumes(compared, volume)
        compared, rows = sorted({*compared, *more}), add_volumes(rows, more)
        volume = best_volume(rows)
    best = Design(volume, target, outlet)
    reference, tested = rows.filter(**best._asdict()), list[dict[str, Any]]()
    designs = [Design(each, target, outlet) for each in compared]

    def read_runs(changed: Site, other: RunInputs) -> dict[str, Run]:
        ended, _ = other.read_records(changed)
        return find_seasons(other, replace(ticks, k_Rs=changed.k_Rs), ended, window)[0]

    def test(words: Mapping[str, str], made: polars.DataFrame) -> None:
        changed = made.filter(**best._asdict())
        if not (tested and changed.equals(reference)):
            about = {**words, "best_cistern_m3": best_volume(made)}
            tested.extend(about | row for row in changed.drop(BY_DESIGN).to_dicts())

    for words, change, runs in list_ends(base, inputs, seasons, read_runs):
        like = replace(base, **change)
        test(words, run("testing assumptions", designs, like, runs) if tested else rows)
    for filled in (0.0, 1.0):
        made = run("other initial states", designs, filled=filled)
        label = f"share of the cistern filled at the start; used: {_HALF:g}"
        test({"assumption": label, "value": f"{filled:g}"}, made)
    contents, *notes = as_lines(summarize(record, base))
    left_out = [f"season {name} is left out: {why}" for name, why in incomplete.items()]
    return Sizes(
        inputs.site.stem if isinstance(inputs.site, Path) else "", base, rows, best,
        make_frame(tested), simulate_references(base, seasons, jobs), list(seasons), f"{window}",
        [*plans.list_assumed(base), *_remark(reference, volume, compared)],
        [f"{record.source}: {contents}", *notes, *list_notes(seasons, base), *left_out],
        knee,
    )


def _simulate(
    designs: Mapping[Design, tuple[Site, Mapping[str, Any]]], seasons: Mapping[str, Run],
    filled: float, jobs: int, progress: Callable[[float], None],
) -> polars.DataFrame:
    """Simulate designs in seasons, and return a row for each design and season.

    Args:
        designs: site and parameters of each design.
        seasons: the seasons by name, for sites with the ticks of the designs.
        filled: share of the cistern that is full at the start.
        jobs: number of threads.
        progress: callback that receives the share that is done.
    """
    made, _ = simulate_season([
        Case(site, parameters, season, filled * design.volume_m3, site.x2_star, with_forecast=False)
        for design, (site, parameters) in designs.items() for season in seasons.values()
    ], progress=progress, threads=jobs)
    rows = []
    for (design, season), ((results, *_), _) in zip(product(designs, seasons), made, strict=True):
        row: dict[str, Any] = {each.name: results.get(each.name) for each in METRICS}
        rain, wet = row["rain_m3"], row["wet_discharge_m3"]
        row |= {KEPT: 1 - wet / rain if rain else None, LOST: 1 - row["evapotranspiration_ratio"]}
        rows.append({**design._asdict(), "season": season, **row})
    return make_frame(rows, infer_schema_length=None)


def _remark(rows: polars.DataFrame, volume: float, compared: Sequence[float]) -> list[str]:
    """Return remarks on the recommended cistern (m3), and on what is unusual in its results."""
    remarks = [
        f"The recommended cistern is the {size} of those compared: {other} cisterns are worth "
        "trying." for size, other, end in (
            ("smallest", "smaller", compared[0]), ("largest", "larger", compared[-1]),
        ) if volume == end and len(compared) > 1
    ]
    drained, fallen = rows.select("drainage_m3", "rain_roof_m3").mean().row(0)
    if drained > fallen:
        remarks.append(
            f"More water drains from the roof ({drained:.3g} m³ in a season) than rain falls on it "
            f"({fallen:.3g} m³): much of the irrigation percolates below field capacity."
        )
    return remarks
