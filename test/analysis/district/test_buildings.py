"""Buildings: distributions against scipy's, lists in CSV, adoption, and wrong inputs."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from places import refusal
from scipy import stats
from studies import DISTRICT, JULY, edit_district, write_district

import greenroof_ros as gr
from greenroof_ros.analysis.district.buildings import list_buildings, make_buildings, make_sites
from greenroof_ros.analysis.district.file import read_district
from greenroof_ros.site.file import read_site

MANY = edit_district("buildings: 8", "buildings: 4000")
NOTES: list[str] = []
VOLUME = "{mean: 3, sd: 2, low: 1.0, high: 6.0}"


def make(directory: Path, text: str = DISTRICT, draw: int = 0) -> pl.DataFrame:
    """Return the buildings of a draw whose sites are right, and keep the notes on their list."""
    district = read_district(write_district(directory, text))
    site = read_site(district.find_files("site", district.site)[0], {"tau": 60.0, "M": 1})
    NOTES.clear()
    buildings = make_buildings(district, site, list_buildings(district, NOTES), draw)
    make_sites(district, buildings[:10])
    return buildings


def test_distributions(tmp_path: Path) -> None:
    """By the test of Kolmogorov and Smirnov; the log-normal one has the mean and sd of the file."""
    values = make(tmp_path, MANY)
    sigma = math.sqrt(math.log(1 + (120 / 200) ** 2))
    whole = stats.lognorm(sigma, scale=200 / math.exp(sigma**2 / 2))
    assert (whole.mean(), whole.std()) == pytest.approx((200, 120))
    below, above = whole.cdf([60, 1000])
    areas = values["catchment_area"].to_numpy()
    cut_off = stats.kstest(areas, lambda area: (whole.cdf(area) - below) / (above - below))
    assert cut_off.pvalue > 0.05
    assert 60 <= areas.min() < areas.max() <= 1000
    assert abs(stats.spearmanr(areas, values["cistern_volume"]).statistic) < 0.05
    assert (values["substrate_depth"] == 0.08).sum() == pytest.approx(2000, abs=150)


def test_more_buildings_are_the_same_and_others(tmp_path: Path) -> None:
    """Nor does a key depend on which others are drawn; the next draw has the next seed."""
    few = make(tmp_path)["catchment_area"]
    many = make(tmp_path, MANY.replace(f"  cistern_volume: {VOLUME}\n", ""))
    assert many["catchment_area"][:8].equals(few)
    other = make(tmp_path, DISTRICT + "seed: 2\n")
    assert not other["catchment_area"].equals(few)
    assert make(tmp_path, draw=1).equals(other)


def test_times(tmp_path: Path) -> None:
    """A key is a multiple of another drawn key, or of one that the site has."""
    for factor, height in (("catchment_area", None), ("z_o", 2.0)):
        values = make(tmp_path, edit_district(VOLUME, f"{{values: [0.02], times: {factor}}}"))
        volumes = 0.02 * (height or values["catchment_area"].to_numpy())
        assert values["cistern_volume"].to_numpy() == pytest.approx(volumes)


def test_adoption_is_nested_and_exact(tmp_path: Path) -> None:
    """Each share of the buildings adopts."""
    text = edit_district("[0.25, 0.5, 1.0]", "[0.1, 0.25, 0.5]")
    buildings = make(tmp_path, text.replace("buildings: 8", "buildings: 1000"))
    assert np.bincount(buildings["group"]).tolist() == [100, 150, 250, 500]
    for level, count in ((0.1, 100), (0.25, 250), (0.5, 500)):
        assert len(buildings.filter(pl.col("adopts_at") <= level)) == count


CSV = "id,catchment_area,a1,address\nA,120,2.5,Lane 1\nB,240.5,3,Lane 2\nC,90,1,-\n"
LISTED = edit_district("buildings: 8", "file: buildings.csv").replace(
    "  catchment_area: {mean: 200, sd: 120, low: 60, high: 1000}\n"
    f"  cistern_volume: {VOLUME}\n", ""
)


def test_listed_buildings(tmp_path: Path) -> None:
    """As a spreadsheet writes them, with a byte order mark; a key that is not listed is drawn."""
    (tmp_path / "buildings.csv").write_bytes(f"\ufeff{CSV}".replace("\n", "\r\n").encode())
    buildings = make(tmp_path, LISTED)
    assert buildings["id"].to_list() == ["A", "B", "C"]
    assert buildings["catchment_area"].to_list() == [120, 240.5, 90]
    assert set(buildings["substrate_depth"]) <= {0.08, 0.108}
    assert NOTES == [
        "buildings.csv: these columns are not keys of a building and are ignored: address"
    ]
    (tmp_path / "buildings.csv").write_text(CSV.replace("B,", "A,"))
    refusal(make, tmp_path, LISTED, match=r"buildings.csv, line 3: id")


@pytest.mark.parametrize(("old", "new", "line", "key"), [
    ("  cistern_volume:", "  tau:", 6, "draw.tau"),
    ("mean: 3, ", "", 6, "draw.cistern_volume"),
    ("low: 1.0", "low: 7", 6, "draw.cistern_volume"),
    ("high: 6.0", "high: 6.0, times: cistern_volume", 6, "draw.cistern_volume.times"),
    ("site_valve.yaml", "site_catchment.yaml", 2, "site"),
])
def test_wrong_districts(tmp_path: Path, old: str, new: str, line: int, key: str) -> None:
    """File, line and key are named."""
    refusal(
        gr.district, write_district(tmp_path, edit_district(old, new)),
        match=rf"district.yaml, line {line}: {re.escape(key)}( =|:)",
    )


@pytest.mark.parametrize(("row", "keys", "message"), [
    # What two listed values together make wrong is found when the building's site is made.
    ("cistern_volume,cistern_height\nA,5,0.1", "{}", "houses.csv, line 2: low_outlet_level = 0.1:"),
    # The soil holds 63 % of 0.108 m.
    ("a1\nA,3", "{z_veg: {values: [0.07]}}", "line 4: draw.z_veg = 0.07: .*building A"),
])
def test_a_wrong_building_is_named(tmp_path: Path, row: str, keys: str, message: str) -> None:
    """The error names the file from which the value is."""
    (tmp_path / "houses.csv").write_text(f"id,{row}\n")
    text = f"site: site_valve.yaml\nfile: houses.csv\ndraws: 1\ndraw: {keys}\n"
    refusal(make, tmp_path, f"{text}weather: {{file: {JULY}}}", match=message)
