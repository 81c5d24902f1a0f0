"""Buildings: distributions against scipy's, lists in CSV, adoption, and wrong inputs."""

from __future__ import annotations

import math
import re
import shutil
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
import yaml
from districts import DISTRICT, WEATHER, edit, write_district
from numpy.typing import NDArray
from places import CHECKOUT, CONFIG
from refusals import refusal
from scipy import stats

from greenroof_ros.analysis.district.adoption import Adoption
from greenroof_ros.analysis.district.district_file import read_district
from greenroof_ros.analysis.district.parts import make_sites
from greenroof_ros.analysis.district.run import read_run
from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.physics.pump import maximum_pump_flow

MANY = edit("buildings: 8", "buildings: 4000")


def test_distributions(tmp_path: Path) -> None:
    """By the test of Kolmogorov and Smirnov; the log-normal one has the mean and sd of the file."""
    values = read_run(write_district(tmp_path, MANY)).buildings.values
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
    few = read_run(write_district(tmp_path)).buildings.values
    text = MANY.replace("  cistern_volume: {low: 1.0, high: 6.0}\n", "")
    many = read_run(write_district(tmp_path, text)).buildings.values
    assert list(many["catchment_area"][:8]) == list(few["catchment_area"])
    other = read_run(write_district(tmp_path, DISTRICT + "seed: 2\n")).buildings.values
    assert list(other["catchment_area"]) != list(few["catchment_area"])


def test_times(tmp_path: Path) -> None:
    """A key is a multiple of another drawn key, or of one that the site has."""
    for factor, expected in (("catchment_area", None), ("z_o", 2.0)):
        text = edit("{low: 1.0, high: 6.0}", f"{{values: [0.01], times: {factor}}}")
        values = read_run(write_district(tmp_path, text)).buildings.values
        for a_in, a1 in zip(values["catchment_area"], values["cistern_volume"], strict=True):
            assert a1 == pytest.approx(0.01 * (a_in if expected is None else expected))


def test_adoption_is_nested_and_exact() -> None:
    """Each share of the buildings adopts, and the same share of those has a valve."""
    adoption = Adoption(1000, (0.1, 0.25, 0.5), 0.3)
    ranks = np.random.default_rng(1).permutation(1000)
    groups, valves = adoption.groups(ranks), adoption.have_valve(ranks)
    assert np.bincount(groups).tolist() == [100, 150, 250, 500]
    for group in range(3):
        assert valves[groups <= group].sum() == 0.3 * (groups <= group).sum()
    assert Adoption(1000, (1.0,), 1.0).have_valve(ranks).all()
    assert not Adoption(1000, (1.0,), 0.0).have_valve(ranks).any()


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
    run = read_run(write_district(tmp_path, LISTED))
    buildings = run.buildings
    assert list(buildings.ids) == ["B", "A", "C"]  # by cell
    assert buildings.cells.tolist() == [0, 1, 1]
    assert list(buildings.values["catchment_area"]) == [240.5, 120, 90]
    assert set(buildings.values["substrate_depth"]) <= {0.08, 0.108}
    assert run.notes[-1] == (
        "buildings.csv: these columns are not site keys and are ignored: address"
    )


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
    run = read_run(write_district(tmp_path, yaml.safe_dump(example)))
    write_inputs(run.files, tmp_path)
    areas = [site.a2 for site in make_sites(tmp_path / "site.yaml", run.buildings)]
    assert areas == [60, 150]


def test_cells_with_files_of_several_offsets(tmp_path: Path) -> None:
    """All begin at the same instant, midnight of the first cell: rows at 00:00 and 06:00."""
    for name, offset in (("a", "+00:00"), ("b", "+06:00")):
        rows = "".join(
            f"2021-06-{hour // 24 + 1:02}T{hour % 24:02}:00{offset},0,2\n" for hour in range(96)
        )
        (tmp_path / f"{name}.csv").write_text(
            f"time,precipitation [mm/h],evapotranspiration [mm/day]\n{rows}"
        )
    run = read_run(write_district(tmp_path, """
site: site_valve.yaml
buildings: 2
weather: {cells: {a: a.csv, b: b.csv}, start: 2021-06-02T00:00, hours: 24}
"""))
    expected = datetime(2021, 6, 2, tzinfo=timezone.utc)
    assert [one.start for one in run.runs] == [expected, expected]


def test_what_all_have_in_common_follows_each_building(tmp_path: Path) -> None:
    """Drip irrigation of 5 mm/h is 300 l/h on 60 m2 and 1000 l/h on 200 m2; 6 m3 are 6 m3."""
    (tmp_path / "house.yaml").write_text(
        "extends: site_valve.yaml\nirrigation_rate: 5.0\ncistern_volume: 6.0\n"
    )
    (tmp_path / "buildings.csv").write_text(
        "id,roof_area,cistern_height\nA,60,2.0\nB,200,2.5\n"
    )
    run = read_run(write_district(tmp_path, f"""
site: house.yaml
file: buildings.csv
weather: {{file: {WEATHER}, start: 2021-07-07T00:00, hours: 72}}
"""))
    write_inputs(run.files, tmp_path)
    sites = [*make_sites(tmp_path / "site.yaml", run.buildings)]
    flows = [3.6e6 * maximum_pump_flow(site, site.a1) for site in sites]
    assert flows == pytest.approx([300, 1000], rel=1e-5)
    assert [site.a1 * site.z_o for site in sites] == pytest.approx([6, 6])


WRONG_CSV = {
    "line 3: id = 'A': is also the name of the building in line 2": CSV.replace("B,", "A,"),
    "line 1: 'id': must be the name of one column of the file": CSV.replace("id,", "name,"),
    "line 1: 'cell': must be the name of one column of the file": CSV.replace("cell,", "zone,"),
    "line 1: 'catchment_area': must be the name of one column of the file; occurs more":
        CSV.replace("a1", "catchment_area"),
    "line 2: catchment_area = '-120': must be a number from": CSV.replace("120", "-120"),
    "line 2: catchment_area = 'wide': must be a number from": CSV.replace("120", "wide"),
    "line 2: catchment_area = '': must be a number from": CSV.replace("120", ""),
    "line 2: catchment_area = 'nan': must be a number from": CSV.replace("120", "nan"),
    "line 3: cell = 'north': must be one of the cells east, west": CSV.replace("east", "north"),
    "line 3: id = '': must contain a name or number": CSV.replace("B,", ","),
    "line 3: must have 5 cells, like the header, but has 4": CSV.replace(",Lane 2", ""),
    "has a header but no rows": CSV.partition("\n")[0] + "\n",
    "is empty": "",
    "is not text in UTF-8: unpack a compressed file": "PK\x03\x04\0",
}


@pytest.mark.parametrize("expected", WRONG_CSV)
def test_wrong_lists(tmp_path: Path, expected: str) -> None:
    """File, line, column and value are named."""
    (tmp_path / "buildings.csv").write_text(WRONG_CSV[expected])
    district = write_district(tmp_path, LISTED)
    assert "buildings.csv" in refusal(
        read_run, district, match=re.escape(expected)
    )


WRONG = {
    "buildings = 0: must be a whole number from 1 to 1000000": ("buildings: 8", "buildings: 0"),
    "buildings = 2000000: must be": ("buildings: 8", "buildings: 2000000"),
    "buildings = 8.5: must be a whole": ("buildings: 8", "buildings: 8.5"),
    "buildings: is missing; set it, or set file": ("buildings: 8", "seed: 8"),
    "line 3: buildings = 8: cannot be combined with file": (
        "buildings: 8", "buildings: 8\nfile: x.csv",
    ),
    "adoption.3 = 1.5: must be a number from 0 to 1": ("0.5, 1.0]", "0.5, 1.5]"),
    "adoption.1 = -0.25: must be": ("[0.25", "[-0.25"),
    "adoption: must list at least one share": ("[0.25, 0.5, 1.0]", "[]"),
    "adoption: lists 0.1 and 0.10000001, which are too close": ("0.25,", "0.1, 0.10000001,"),
    "valve_share = 2: must be": ("valve_share: 0.5", "valve_share: 2"),
    "sewer_capacity = 0: must be": ("sewer_capacity: 2.0", "sewer_capacity: 0"),
    "sewer_capacity = 'five': must be": ("sewer_capacity: 2.0", "sewer_capacity: five"),
    "a valid key; did you mean sewer_capacity?": ("sewer_capacity:", "sewer_capacty:"),
    "outlets.1 = 'drian': is unknown; did you mean drain?": (
        "buildings: 8", "buildings: 8\noutlets: [drian]",
    ),
    "draw.catchment: cannot differ between buildings; did you mean catchment_area": (
        "catchment_area:", "catchment:",
    ),
    "draw.tau: cannot differ between buildings; all buildings share this key":
        ("  cistern_volume:", "  tau:"),
    "draw.cistern_volume.low = 7: must be below high = 6": ("low: 1.0", "low: 7"),
    "draw.cistern_volume.low = 1.0: needs low and high, or mean and sd": (", high: 6.0", ""),
    "draw.catchment_area.mean = 200: also needs sd": (", sd: 120", ""),
    "draw.catchment_area.mean = 0: must be": ("mean: 200", "mean: 0"),
    "draw.catchment_area.sd = -120: must be": ("sd: 120", "sd: -120"),
    "draw.catchment_area: has a distribution of which only a share of 0":
        ("low: 60, high: 1000", "low: 1e8"),
    "draw.cistern_volume: must be a number from 0.01 to 100000 m3, but": ("low: 1.0", "low: -5"),
    "draw.substrate_depth.values: must list at least one": ("[0.08, 0.108]", "[]"),
    "draw.substrate_depth.values.2 = 'deep': must be": ("0.108", "deep"),
    "draw.cistern_volume.times = 'cistern_volume': "
    "must be a key whose value is not itself multiplied": (
        "high: 6.0", "high: 6.0, times: cistern_volume",
    ),
    "draw.cistern_volume.times = 'roof': did you mean roof_area": (
        "high: 6.0", "high: 6.0, times: roof",
    ),
    "draw.substrate_depth: must be numbers, not names": ("values: [0.08, 0.108]", "names: [deep]"),
    "draw.substrate.names = 'turf': must be one of": (
        "substrate_depth: {values: [0.08, 0.108]}", "substrate: {names: [extensive, turf]}",
    ),
    "weather.hours = -1: must be": ("hours: 72", "hours: -1"),
    "line 8: weather.start = 'noon': must be a time": ("2021-07-07T00:00", "noon"),
    "weather.file = 'gone.csv': there is no such file in": (str(WEATHER), "gone.csv"),
    "but the run starts at 2021-08-07": ("2021-07-07T00:00", "2021-08-07T00:00"),
    "weather: must contain either file, for all buildings, or cells": (f"file: {WEATHER}, ", ""),
    "site = 'gone.yaml': there is no such file in": ("site_valve.yaml", "gone.yaml"),
    "needs a valve for drain and plan": ("site_valve.yaml", "site_catchment.yaml"),
}


@pytest.mark.parametrize("expected", WRONG)
def test_wrong_districts(tmp_path: Path, expected: str) -> None:
    """File, line, key and value are named."""
    old, new = WRONG[expected]
    text = refusal(read_run, write_district(tmp_path, edit(old, new)), match=re.escape(expected))
    assert text.startswith(str(tmp_path / "district.yaml")) or "run starts" in text


def test_sd_larger_than_the_mean(tmp_path: Path) -> None:
    """A few large buildings among many small ones; none is negative."""
    text = MANY.replace("sd: 120, low: 60, high: 1000", "sd: 400")
    values = np.array(read_run(write_district(tmp_path, text)).buildings.values["catchment_area"])
    assert values.min() > 0
    assert values.mean() == pytest.approx(200, rel=0.1)
    assert read_district(tmp_path / "district.yaml")[0].draw["catchment_area"].sd == 400
