"""Sizes compared with a rainwater tank's balance in daily and monthly steps, in pandas.

``doc/explanation/sizing.md`` explains the differences.
"""

from __future__ import annotations

from datetime import timedelta, timezone

import pandas as pd
import pytest
from places import CONFIG, DATA
from water_balance import compare, find_yield

import greenroof_ros as gr

YEARS = range(2016, 2019)
# mm/day, of July in config/site.yaml.
EVAPOTRANSPIRATION = 4.02


@pytest.fixture(scope="module")
def weather() -> pd.DataFrame:
    """Toronto's rain of three years, with the evapotranspiration of July."""
    rain = pd.read_csv(DATA / "toronto_rain.csv", comment="#", index_col=0)["precipitation [mm]"]
    rain.index = pd.to_datetime(rain.index, format="%Y-%m-%dT%H")
    hours = pd.date_range(f"{YEARS[0]}-07-01", f"{YEARS[-1]}-07-31T23:00", freq="h")
    table = pd.DataFrame({"precipitation [mm/h]": rain.reindex(hours, fill_value=0.0)}, hours)
    table["evapotranspiration [mm/day]"] = EVAPOTRANSPIRATION
    return table


def test_yield_rules() -> None:
    """By hand: a tank of 3 m3 with 1 m3 in it; 5 m3 arrive when 2 are needed, then nothing."""
    inflow, demand = pd.Series([5.0, 0.0]), pd.Series([2.0, 2.0])
    # After spillage: 1 is used, then 2 of what is left by a full tank of 3 - 1. Before: 2, and 2.
    assert find_yield(inflow, demand, 3.0, 1.0, after_spillage=True) == 1.0 + 2.0
    assert find_yield(inflow, demand, 3.0, 1.0, after_spillage=False) == 2.0 + 2.0
    # Of what is used here, 1 was there at the start.
    assert find_yield(inflow / 10, demand, 3.0, 1.0, after_spillage=True) == 0.5


def test_sizes_agree_with_daily_balances(weather: pd.DataFrame) -> None:
    """Within 3 points of a daily balance with the same soil; a bucket or months are far off.

    It takes ten seconds: hundreds of thousands of ticks of a minute, to compare seasons with days.
    """
    sizes = gr.size(
        site=CONFIG / "site_valve.yaml", season="07-01/07-31", volumes=[1, 2.5, 5, 10],
        targets=[39], outlets=["none"],
        weather=weather.tz_localize(timezone(timedelta(hours=-5))),
    )
    daily = weather.rename(columns=lambda name: name.partition(" ")[0]).rename(
        columns={"precipitation": "rain"}
    )
    daily["evapotranspiration"] /= 24
    seasons = {
        f"{year}": daily.loc[f"{year}-07-01":f"{year}-07-31"].resample("D").sum() for year in YEARS
    }
    assert sizes.seasons == [*seasons]
    table = compare(sizes, seasons, 39.0)
    print(table.to_string())
    for rule in ("daily YAS, percolation", "daily YBS, percolation"):
        assert ((table["size"] - table[rule]).abs() < 0.03).all(), rule
    smallest = table.iloc[0]
    assert 0.2 < smallest["daily YAS, bucket"] - smallest["size"] < 0.35
    assert 0.25 < smallest["size"] - smallest["monthly YAS"] < 0.45
    assert (table["daily YAS, percolation"] <= table["daily YBS, percolation"]).all()
