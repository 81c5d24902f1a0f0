"""What a site with its cistern is compared with, and the return periods of its peaks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.storm_water import connected_area
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.sums import PEAKS_MIN
from greenroof_ros.results.table import make_frame
from greenroof_ros.simulation.run import Run, Values
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.file import check_site
from greenroof_ros.site.site import WITHOUT_VALVE, Site

if TYPE_CHECKING:
    import polars

NO_ROOF, NO_IRRIGATION = "no green roof", "green roof without irrigation"
"""what a site is compared with; neither has a cistern"""
PEAKS = {minutes: f"peak_discharge_{minutes}min_l_s" for minutes in PEAKS_MIN}
"""metrics of the peaks by the width of their window (min)"""
_TINY_M2 = 0.01


def remove_cistern(site: Site) -> Site:
    """Return a site whose green roof is not irrigated, and whose tiny cistern overflows at once."""
    return check_site(replace(
        site, irrigation="none", a1=_TINY_M2, initial_cistern=None, initial_roof=None,
        low_outlet_level=None, low_outlet_radius=None, mains_level=None, mains_flow=None,
        monthly_other_demand=None, **WITHOUT_VALVE,
    ))


def simulate_references(site: Site, seasons: Mapping[str, Run], threads: int) -> polars.DataFrame:
    """Return the metrics of a site without a green roof, and of one without irrigation.

    There is a row for each of them (column ``case``) and season. Without a green roof, all rain
    runs off at once.
    """
    run = next(iter(seasons.values()))
    plain, rows = remove_cistern(replace(site, tau=run.site.tau, M=1)), list[dict[str, Any]]()
    parameters = find_controller("onoff").complete_parameters(plain, {})
    cases = [
        Case(plain, parameters, run, plain.a1 * plain.z_o, plain.x2_star)
        for run in seasons.values()
    ]
    made, _ = simulate_season(cases, threads=threads)
    for (season, run), ((results, *_), _) in zip(seasons.items(), made, strict=True):
        metrics = {each.name: results.get(each.name) for each in METRICS}
        fallen, area = metrics["rain_m3"], connected_area(site)
        rain = area * run.site.tau * np.array(run.series.precipitation[: run.steps])
        ticks = np.full(run.steps, run.site.tau)
        peaks = {name: 1000 * find_peak(rain, ticks, width) for width, name in PEAKS.items()}
        rows += [
            {"case": NO_ROOF, "season": season} | dict.fromkeys(metrics) | peaks | {
                "rain_m3": fallen, "discharge_m3": fallen, "wet_discharge_m3": fallen,
                "retention_share": 0.0,
            },
            {"case": NO_IRRIGATION, "season": season} | metrics | {"overflow_days": None},
        ]
    return make_frame(rows, infer_schema_length=None)


def find_peak(volumes: Values, durations: Values, minutes: float) -> float:
    """Return the highest mean of a flow over a number of minutes (m3/s).

    The window may begin at any time, as for the peaks in :mod:`.results.sums`.

    Args:
        volumes: volume in each interval (m3), shape (intervals,).
        durations: duration of each interval (s), shape (intervals,).
        minutes: width of the window (min).
    """
    window, edges = 60 * minutes, np.append(0.0, np.cumsum(durations))
    total = np.append(0.0, np.cumsum(volumes))
    # The mean of constant pieces is largest where the window begins or ends with one of them.
    starts = np.concatenate((edges - window, edges))
    sums = np.interp(starts + window, edges, total) - np.interp(starts, edges, total)
    return float(sums.max()) / window
