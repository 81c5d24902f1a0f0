"""The command; the sums of a district against runs of single sites, and by hand."""

from __future__ import annotations

import csv
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from browsers import drawn_page
from commands import run_command
from numpy.typing import NDArray
from places import CONFIG
from studies import DISTRICT, JULY, edit_district, write_district

import greenroof_ros as gr
from greenroof_ros.analysis.district.result import DistrictResult
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.file import read_site


def simulate(directory: Path, text: str = DISTRICT) -> DistrictResult:
    """Simulate a district."""
    return gr.district(write_district(directory, text))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> DistrictResult:
    """Simulate the district once."""
    return simulate(tmp_path_factory.mktemp("district"))


def rows_of(result: DistrictResult) -> dict[tuple[str, float], dict[str, Any]]:
    """Return the results of the only draw and season, by outlet and adoption."""
    return {(row["outlet"], row["adoption"]): row for row in result.all_rows.to_dicts()}


def simulate_alone(building: dict[str, Any], outlet: str) -> dict[str, Any]:
    """Return the summary of the run of one building, tick by tick."""
    keys = ("catchment_area", "cistern_volume", "substrate_depth")
    site = read_site(CONFIG / "site_valve.yaml", {
        "tau": 60.0, "M": 1, **{key: building[key] for key in keys}
    })
    if outlet in ("none", "orifice"):
        site = replace(site, low_outlet_valve=False)
    if outlet == "none":
        site = replace(site, low_outlet_level=None, low_outlet_radius=None)
    simulation = Simulation(make_inputs(find_controller("onoff"), {
        "site": site, "weather": JULY, "start": "2021-07-07T00:00", "hours": 72.0,
        **({"outlet": outlet} if site.low_outlet_valve else {}),
    }).build())
    for _ in simulation.ticks():
        pass
    return simulation.summary()


def read_rain() -> NDArray[np.float64]:
    """Return the rain of the three days (mm/h)."""
    record, days = pl.read_csv(JULY, infer_schema_length=None), pl.col("Day").is_between(7, 9)
    return record.filter(days)["Precip. Amount (mm)"].cast(float).fill_null(0.0).to_numpy()


def test_sums_of_single_runs(simulated: DistrictResult) -> None:
    """Half of the buildings with a green roof, the others as they are.

    Each building is simulated alone, and the sums are made here.
    """
    rows, buildings = rows_of(simulated), simulated.buildings.to_dicts()
    assert sum(each["adopts_at"] <= 0.5 for each in buildings) == 4
    for outlet in ("none", "orifice", "drain", "plan"):
        sums = dict.fromkeys(("discharge_m3", "wet_discharge_m3", "mains_m3", "pumped_m3"), 0.0)
        for building in buildings:
            rain = building["connected_area_m2"] * read_rain().sum() / 1000
            results: dict[str, Any] = {"discharge_m3": rain, "wet_discharge_m3": rain}
            if building["adopts_at"] <= 0.5:
                results = simulate_alone(building, outlet)
            for name in sums:
                sums[name] += results.get(name) or 0.0
        row = rows[outlet, 0.5]
        assert row["buildings"] == 4
        for name, value in sums.items():
            assert row[name] == pytest.approx(value, rel=1e-6), (outlet, name)
        assert row["retention_share"] == pytest.approx(1 - sums["discharge_m3"] / row["rain_m3"])


def test_valves_that_are_too_large_together(simulated: DistrictResult) -> None:
    """A warning names the water beyond the capacity in dry weather; as it is, all is wet."""
    dry = simulated.all_rows["dry_sewer_overflow_m3"].to_numpy()
    assert dry[0] == 0
    (warning,) = simulated.warnings
    assert f"{dry.max():.3g} m³ a season" in warning


def test_no_green_roof(simulated: DistrictResult) -> None:
    """All rain runs off at once, in wet weather; its excess is that of the rain."""
    row, hourly = rows_of(simulated)["none", 0.0], read_rain()
    area = simulated.buildings["connected_area_m2"].sum() / 1000
    for name in ("rain_m3", "discharge_m3", "wet_discharge_m3"):
        assert row[name] == pytest.approx(hourly.sum() * area)
    assert row["buildings"] == row["retention_share"] == 0
    excess = np.maximum(hourly - 2.0, 0.0).sum()
    assert excess > 10
    assert row["sewer_overflow_m3"] == pytest.approx(excess * area)


def test_seasons_and_draws(tmp_path: Path) -> None:
    """Every season with every draw; missing rain is noted; the range is that of all results."""
    dry = tmp_path / "record.csv"
    dry.write_text("time,precipitation [mm/h],evapotranspiration [mm/day]\n" + "".join(
        f"{year}-06-{1 + n // 24:02}T{n % 24:02}:00+00:00,"
        f"{'' if year == 2022 and 100 <= n < 200 else (year - 2019) * (n % 50 == 0)},3\n"
        for year in (2020, 2021, 2022) for n in range(240)
    ))
    text = edit_district(f"file: {JULY}, season: 07-07/07-09",
                "file: record.csv, season: 06-02/06-09, gaps: fill").replace("draws: 1", "draws: 2")
    result = simulate(tmp_path, text)
    rows = result.all_rows.filter(outlet="plan", adoption=1.0)
    assert rows["season"].to_list() == ["2020", "2021", "2022"] * 2
    assert rows["draw"].to_list() == [1] * 3 + [2] * 3
    values, table = rows["discharge_m3"].to_numpy(), result.table.row(-1, named=True)
    assert table["discharge_m3"] == pytest.approx(values.mean())
    ends = np.percentile(values, (5, 95))
    assert [table[f"discharge_m3_p{end}"] for end in (5, 95)] == pytest.approx(ends)
    assert any("rain" in note and "100 in 2022" in note for note in result.notes), result.notes
    assert "3 seasons" in result.sentence
    assert "2 draws" in result.sentence
    ends = result.assumptions.filter(pl.col("assumption").str.contains("runoff coefficient"))
    assert ends["value"].to_list() == ["0.75"] * 3 + ["0.95"] * 3


def test_nobody_adopts(tmp_path: Path) -> None:
    """A share of less than half a building is none: the district is as it is, and all are alike."""
    drawn = DISTRICT[DISTRICT.index("draw:") : DISTRICT.index("weather:")]
    result = simulate(tmp_path, edit_district("[0.25, 0.5, 1.0]", "[0.05]").replace(drawn, ""))
    assert set(result.all_rows["buildings"]) == {0}
    assert "No green roofs" in result.sentence
    result.save(tmp_path / "out")


def test_command(tmp_path: Path) -> None:
    """Tables and page agree with each other, and with Python with one thread."""
    write_district(tmp_path, edit_district("07-07/07-09", "07-08/07-08"))
    command = "district", "district.yaml", "--output", "out", "--jobs", "2"
    result = run_command(*command, cwd=tmp_path, env=dict(os.environ))
    assert result.returncode == 0, result.stderr
    out = tmp_path / "out"
    rows = list(csv.DictReader((out / "results.csv").open()))
    assert len(rows) == 1 + 5 * 3
    buildings = list(csv.DictReader((out / "buildings.csv").open()))
    half = [row for row in buildings if float(row["adopts_at"]) <= 0.5]
    assert (len(buildings), len(half)) == (8, 4)
    of_half = next(row for row in rows if (row["outlet"], row["adoption"]) == ("drain", "0.5"))
    mains = sum(float(row["drain:mains_m3"]) for row in half)
    assert float(of_half["mains_m3"]) == pytest.approx(mains)
    assert of_half["discharge_m3"] == of_half["discharge_m3_p5"] == of_half["discharge_m3_p95"]
    assert "<script" not in (out / "page.html").read_text()
    with drawn_page(out / "page.html") as page:
        assert "8 buildings" in page.inner_text("h1")
        assert page.locator("table").first.locator("tbody tr").count() == len(rows)
        titles = page.locator("h2").all_inner_texts()
        assert {"What it rests on", "What was read", "How it was made"} <= {*titles}
    in_python = gr.district(tmp_path / "district.yaml")
    assert in_python.table.write_csv() == (out / "results.csv").read_text()
    assert in_python.buildings.write_csv() == (out / "buildings.csv").read_text()
    assert in_python.sentence in " ".join(result.stdout.split())
    (out / "own.txt").touch()
    again = run_command(*command, cwd=tmp_path, env=dict(os.environ))
    assert again.returncode == 2
    assert "--output = 'out': exists and is not empty" in again.stderr
