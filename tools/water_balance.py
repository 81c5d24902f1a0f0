"""Compute a cistern's water balance in daily and monthly steps, independently of the package.

This is the method of rainwater practitioners: the yield-after-spillage rule of Jenkins, Pearson,
Moore, Sun and Valentine (1978), Feasibility of rainwater collection systems in California, UC
Berkeley. Two papers compare it with yield before spillage and with other steps: Fewkes and Butler
(2000), Simulating the performance of rainwater collection and reuse systems using behavioural
models, Building Services Engineering Research and Technology 21(2), 99-106; and Mitchell (2007),
How important is the selection of computational analysis method to the accuracy of rainwater tank
behaviour modelling?, Hydrological Processes 21(21), 2850-2861.

``python tools/water_balance.py SITE WEATHER [WEATHER ...]`` compares the method with ``gr.size``.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import pandas as pd


@dataclass(frozen=True)
class House:
    """The values of a site that the balance needs: areas (m2), depths of water on the roof (mm)."""

    roof: float
    catchment: float
    """area of the catchment times its runoff coefficient"""
    target: float
    full: float
    """field capacity"""
    stressed: float
    """depth below which plants transpire less"""
    wilted: float
    """depth at which plants stop transpiring"""
    exponent: float = 2.0
    """of the filled share, which gives the share of the arriving water that percolates"""


# Water arrives in portions of this depth (mm), and part of each portion percolates.
_PORTION_MM = 0.1


def find_demand(weather: pd.DataFrame, house: House, *, percolates: bool) -> pd.Series:
    """Return the water that must be pumped at the end of each day to reach the target (mm).

    Args:
        weather: daily ``rain`` and ``evapotranspiration`` of plants that lack no water (mm).
        house: the site.
        percolates: whether a share of the arriving water, a power of the filled share of the soil
            as in HBV, percolates even below field capacity; otherwise the roof is a bucket.
    """
    def hold(level: float) -> float:
        """Return the share of the arriving water that stays."""
        filled = (level - house.wilted) / (house.full - house.wilted)
        return 1 - filled**house.exponent if percolates else 1

    level, demand = house.target, []
    for rain, potential in zip(weather["rain"], weather["evapotranspiration"], strict=True):
        while rain > 0:
            level = min(level + min(rain, _PORTION_MM) * hold(level), house.full)
            rain -= _PORTION_MM
        share = min(1.0, max(0.0, (level - house.wilted) / (house.stressed - house.wilted)))
        level -= potential * share
        pumped = 0.0
        while level < house.target:
            missing = min(house.target - level, _PORTION_MM)
            pumped += missing / hold(level)
            level += missing
        demand.append(pumped)
    return pd.Series(demand, weather.index)


def find_yield(
    inflow: pd.Series, demand: pd.Series, capacity: float, stored: float, *, after_spillage: bool
) -> float:
    """Return the volume of rainwater that meets a demand (m3), at most as much as flowed in.

    Args:
        inflow: volume that flows into the cistern in each step (m3).
        demand: volume that is demanded in each step (m3).
        capacity: usable volume of the cistern (m3).
        stored: part of the usable volume that is filled at the start (m3).
        after_spillage: whether the cistern spills before water is taken in a step, or afterwards.
    """
    total = 0.0
    for arriving, wanted in zip(inflow, demand, strict=True):
        if after_spillage:
            used = min(wanted, stored)
            stored = min(stored + arriving - used, capacity - used)
        else:
            used = min(wanted, stored + arriving)
            stored = min(stored + arriving - used, capacity)
        total += used
    return min(total, float(inflow.sum()))


def find_share(
    weather: pd.DataFrame, house: House, capacity: float, stored: float, rule: str
) -> float:
    """Return the share of a season's demand that the cistern meets (1).

    Args:
        weather: weather of the season's days.
        house: the site.
        capacity: usable volume of the cistern (m3).
        stored: part of the usable volume that is filled at the start (m3).
        rule: one of :data:`RULES`; with monthly steps the demand is that of monthly tables,
            evapotranspiration minus rain.
    """
    demand = find_demand(weather, house, percolates="percolation" in rule)
    if rule.startswith("monthly"):
        weather = weather.resample("MS").sum()
        demand = (weather["evapotranspiration"] - weather["rain"]).clip(lower=0.0)
    demand *= house.roof / 1000
    inflow = weather["rain"] * house.catchment / 1000
    met = find_yield(inflow, demand, capacity, stored, after_spillage="YAS" in rule)
    return met / demand.sum()


RULES = ("daily YAS, percolation", "daily YBS, percolation", "daily YAS, bucket", "monthly YAS")


def compare(sizes: object, weather: dict[str, pd.DataFrame], target: float) -> pd.DataFrame:
    """Return the share of the demand that is met, by volume, from ``gr.size`` and from every rule.

    Args:
        sizes: result of ``gr.size`` with the outlet ``none``.
        weather: weather of the days of each season.
        target: water to keep on the roof (mm).
    """
    rows = []
    site, table = sizes.site, sizes.table  # type: ignore[attr-defined]
    means = table.filter(target_mm=target, outlet="none").sort("volume_m3")
    for volume, met in means.select("volume_m3", "demand_met_share").iter_rows():
        onset = site.wilting_point + (1 - site.depletion_fraction) * (
            site.field_capacity - site.wilting_point
        )
        depth = 1000 * site.z_soil
        house = House(
            site.a2, site.a_in * site.runoff_coefficient, target, depth * site.field_capacity,
            depth * onset, depth * site.wilting_point, site.percolation_exponent,
        )
        capacity = volume * (1 - site.mains_level / site.z_o)
        stored = volume * (0.5 - site.mains_level / site.z_o)
        rows.append({
            "volume_m3": volume,
            "size": met,
            **{
                rule: sum(
                    find_share(days, house, capacity, stored, rule) for days in weather.values()
                ) / len(weather) for rule in RULES
            },
        })
    return pd.DataFrame(rows)


def main() -> None:
    """Print the comparison for a site's cisterns over the complete seasons of a record."""
    import greenroof_ros as gr
    from greenroof_ros.controllers.registry import find_controller
    from greenroof_ros.simulation.inputs import make_inputs

    site = gr.read_site(sys.argv[1])
    options = {"site": site, "weather": sys.argv[2:], "gaps": "fill"}
    sizes = gr.size(outlets=["none"], targets=[1000 * site.z_veg], **options)
    record, _ = make_inputs(find_controller("onoff"), options).read_records(site)
    hours = pd.DataFrame(
        {"rain": record.precipitation, "evapotranspiration": record.evapotranspiration / 24},
        pd.date_range(record.first.replace(tzinfo=None), periods=record.hours, freq="h"),
    )
    seasons = {
        year: hours.loc[f"{year}-05-01":f"{year}-10-31"].resample("D").sum()
        for year in sizes.seasons
    }
    table = compare(sizes, seasons, sizes.recommended.target_mm)
    print(table.to_string(index=False, float_format="%.3f"))


if __name__ == "__main__":
    main()
