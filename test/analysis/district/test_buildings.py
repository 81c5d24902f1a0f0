"""Buildings: distributions against scipy's, lists in CSV, adoption, and wrong inputs."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from districts import DISTRICT, WEATHER, edit, write_district
from numpy.typing import NDArray
from places import CHECKOUT, CONFIG
from refusals import refusal
from scipy import stats

from greenroof_ros.analysis.district.buildings import Buildings, make_buildings, make_sites
from greenroof_ros.analysis.district.file import read_district
from greenroof_ros.analysis.district.result import simulate_district
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

MANY = edit("buildings: 8", "buildings: 4000")


def make(
    directory: Path, text: str = DISTRICT, draw: int = 0
) -> tuple[Buildings, list[Site], list[str]]:
    """Return the buildings of a district, their sites, and the notes on their list."""
    district, notes = read_district(write_district(directory, text)), list[str]()
    site = read_site(district.find_files("site", district.site)[0], district.ticks)
    buildings = make_buildings(district, site, [*(district.weather.cells or ())], draw, notes)
    return buildings, make_sites(district, buildings), notes


def test_distributions(tmp_path: Path) -> None:
    """By the test of Kolmogorov and Smirnov; the log-normal one has the mean and sd of the file."""
    values = make(tmp_path, MANY)[0].values
    sigma = math.sqrt(math.log(1 + (120 / 200) ** 2))
    whole = stats.lognorm(sigma, scale=200 / math.exp(sigma**2 / 2))
    assert (whole.mean(), whole.std()) == pytest.approx((200, 120))
    below, above = whole.cdf([60, 1000])

    def cut_off(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((whole.cdf(value) - below) / (above - below))

    assert stats.kstest(values["catchment_area"], cut_off).pvalue > 0.05
    assert 60 <= min(values["catchment_area"]) < max(values["catchment_area"]) <= 1000
    assert stats.kstest(values["cistern_volume"], stats.uniform(1.0, 5.0).cdf).pvalue > 0.05
    assert abs(stats.spearmanr(values["catchment_area"], values["cistern_volume"]).statistic) < 0.05
    assert list(values["substrate_depth"]).count(0.08) == pytest.approx(2000, abs=150)


def test_more_buildings_are_the_same_and_others(tmp_path: Path) -> None:
    """Nor does a key depend on which others are drawn."""
    few = make(tmp_path)[0].values
    text = MANY.replace("  cistern_volume: {low: 1.0, high: 6.0}\n", "")
    many = make(tmp_path, text)[0].values
    assert list(many["catchment_area"][:8]) == list(few["catchment_area"])
    other = make(tmp_path, DISTRICT + "seed: 2\n")[0].values
    assert list(other["catchment_area"]) != list(few["catchment_area"])
    assert make(tmp_path, draw=1)[0].values == other


def test_times(tmp_path: Path) -> None:
    """A key is a multiple of another drawn key, or of one that the site has."""
    for factor, expected in (("catchment_area", None), ("z_o", 2.0)):
        text = edit("{low: 1.0, high: 6.0}", f"{{values: [0.01], times: {factor}}}")
        values = make(tmp_path, text)[0].values
        for a_in, a1 in zip(values["catchment_area"], values["cistern_volume"], strict=True):
            assert a1 == pytest.approx(0.01 * (a_in if expected is None else expected))


def test_adoption_is_nested_and_exact(tmp_path: Path) -> None:
    """Each share of the buildings adopts, and the same share of those has a valve."""
    text = edit("[0.25, 0.5, 1.0]", "[0.1, 0.25, 0.5]").replace("buildings: 8", "buildings: 1000")
    for share in (0.3, 1.0, 0.0):
        buildings, *_ = make(tmp_path, text.replace("valve_share: 0.5", f"valve_share: {share}"))
        groups = buildings.groups
        assert np.bincount(groups).tolist() == [100, 150, 250, 500]
        for group in range(3):
            assert buildings.valves[groups <= group].sum() == share * (groups <= group).sum()


CSV = """\
id,cell,catchment_area,a1,address
A,west,120,2.5,Lane 1
B,east,240.5,3,Lane 2
C,west,90,1,-
"""
LISTED = f"""
site: site_valve.yaml
file: buildings.csv
draw: {{substrate_depth: {{values: [0.08, 0.108]}}}}
weather: {{cells: {{east: {WEATHER}, west: {WEATHER}}}, start: 2021-07-07T00:00, hours: 72}}
"""


@pytest.mark.parametrize("form", [
    CSV, f"\ufeff{CSV}", CSV.replace("\n", "\r\n"),
    f"# from a GIS\n{CSV}",
])
def test_listed_buildings(tmp_path: Path, form: str) -> None:
    """As spreadsheets write them: byte order mark, line ends."""
    (tmp_path / "buildings.csv").write_bytes(form.encode())
    buildings, _, notes = make(tmp_path, LISTED)
    assert list(buildings.ids) == ["A", "B", "C"]
    assert buildings.cells.tolist() == [1, 0, 1]
    assert list(buildings.values["catchment_area"]) == [120, 240.5, 90]
    assert set(buildings.values["substrate_depth"]) <= {0.08, 0.108}
    assert notes == ["buildings.csv: these columns are not site keys and are ignored: address"]


def test_the_list_of_the_how_to(tmp_path: Path) -> None:
    """The page's CSV and keys, put into the example, build sites whose targets are in range."""
    page = (CHECKOUT / "doc" / "howto" / "district.md").read_text(encoding="utf-8")
    (listed,) = re.findall(r"```text\n(id,.*?)```", page, re.DOTALL)
    (keys,) = re.findall(r"```yaml\n(file: my_buildings.csv\n.*?)```", page, re.DOTALL)
    (tmp_path / "my_buildings.csv").write_text(listed)
    example = yaml.safe_load((CONFIG / "districts" / "example.yaml").read_text(encoding="utf-8"))
    del example["buildings"]
    example |= yaml.safe_load(keys)
    example["weather"] |= {"file": str(WEATHER), "start": "2021-07-07T00:00", "hours": 1}
    shutil.copy(CONFIG / "districts" / "house.yaml", tmp_path)
    _, sites, _ = make(tmp_path, yaml.safe_dump(example))
    assert [site.a2 for site in sites] == [60, 150]


def test_what_all_have_in_common_follows_each_building(tmp_path: Path) -> None:
    """Drip irrigation of 5 mm/h is 300 l/h on 60 m2 and 1000 l/h on 200 m2; 6 m3 are 6 m3."""
    (tmp_path / "house.yaml").write_text(
        "extends: site_valve.yaml\nirrigation_rate: 5.0\ncistern_volume: 6.0\n"
    )
    (tmp_path / "buildings.csv").write_text(
        "id,roof_area,cistern_height\nA,60,2.0\nB,200,2.5\n"
    )
    _, sites, _ = make(tmp_path, f"""
site: house.yaml
file: buildings.csv
weather: {{file: {WEATHER}, start: 2021-07-07T00:00, hours: 72}}
""")
    flows = [3.6e6 * maximum_pump_flow(site, site.a1) for site in sites]
    assert flows == pytest.approx([300, 1000], rel=1e-5)
    assert [site.a1 * site.z_o for site in sites] == pytest.approx([6, 6])


WRONG_CSV = [  # what is replaced, and the line and the column that the error names
    ("B,", "A,", 3, "id"),
    ("cell,", "zone,", 1, "'cell'"),
    ("a1", "catchment_area", 1, "'catchment_area'"),
    ("120", "-120", 2, "catchment_area"),
    ("120", "nan", 2, "catchment_area"),
    ("120", "", 2, "catchment_area"),
    ("east", "north", 3, "cell"),
    ("B,", ",", 3, "id"),
]


@pytest.mark.parametrize(("old", "new", "line", "column"), WRONG_CSV)
def test_wrong_lists(tmp_path: Path, old: str, new: str, line: int, column: str) -> None:
    """File, line and column are named."""
    (tmp_path / "buildings.csv").write_text(CSV.replace(old, new))
    refusal(make, tmp_path, LISTED, match=rf"buildings.csv, line {line}: {column}")


WRONG = [  # what is replaced, and the line and the key that the error names
    ("buildings: 8", "buildings: 8.5", 3, "buildings"),
    ("buildings: 8", "seed: 8", 2, "buildings"),
    ("buildings: 8", "buildings: 8\nfile: x.csv", 3, "buildings"),
    ("0.5, 1.0]", "0.5, 1.5]", 11, "adoption.3"),
    ("[0.25, 0.5, 1.0]", "[]", 11, "adoption"),
    ("sewer_capacity:", "sewer_capacty:", 13, "sewer_capacty"),
    ("draws: 1", "draws: 1\noutlets: [drian]", 10, "outlets.1"),
    ("  catchment_area:", "  catchment:", 5, "draw.catchment"),
    ("  cistern_volume:", "  tau:", 6, "draw.tau"),
    ("low: 1.0", "low: 7", 6, "draw.cistern_volume.low"),
    (", high: 6.0", "", 6, "draw.cistern_volume"),
    (", sd: 120", "", 5, "draw.catchment_area"),
    ("mean: 200", "mean: 0", 5, "draw.catchment_area.mean"),
    ("low: 60, high: 1000", "low: 1e8", 5, "draw.catchment_area"),
    ("low: 1.0", "low: -5", 6, "draw.cistern_volume"),
    ("[0.08, 0.108]", "[]", 7, "draw.substrate_depth.values"),
    ("high: 6.0", "high: 6.0, times: cistern_volume", 6, "draw.cistern_volume.times"),
    ("high: 6.0", "high: 6.0, times: roof", 6, "draw.cistern_volume.times"),
    ("values: [0.08, 0.108]", "names: [deep]", 7, "draw.substrate_depth"),
    ("substrate_depth: {values: [0.08, 0.108]}", "substrate: {names: [turf]}", 7, "draw.substrate"),
    (", hours: 72", "", 8, "weather"),
    (", hours: 72", ", hours: 72, season: 05-01/10-31", 8, "weather.season"),
    ("2021-07-07T00:00", "noon", 8, "weather.start"),
    (str(WEATHER), "gone.csv", 8, "weather.file"),
    (f"file: {WEATHER}, ", "", 8, "weather"),
    ("site_valve.yaml", "gone.yaml", 2, "site"),
    ("site_valve.yaml", "site_catchment.yaml", 2, "site"),
]


@pytest.mark.parametrize(("old", "new", "line", "key"), WRONG)
def test_wrong_districts(tmp_path: Path, old: str, new: str, line: int, key: str) -> None:
    """File, line and key are named."""
    refusal(
        simulate_district, write_district(tmp_path, edit(old, new)),
        match=rf"district.yaml, line {line}: {re.escape(key)}( =|:)",
    )


def test_sd_larger_than_the_mean(tmp_path: Path) -> None:
    """A few large buildings among many small ones; none is negative."""
    district = read_district(write_district(
        tmp_path, MANY.replace("sd: 120, low: 60, high: 1000", "sd: 400")
    ))
    site = read_site(CONFIG / district.site, district.ticks)
    values = np.array(make_buildings(district, site, [], 0, []).values["catchment_area"])
    assert values.min() > 0
    assert values.mean() == pytest.approx(200, rel=0.1)
