"""A scene of a district: against runs of single sites, and by hand."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from districts import DISTRICT, WEATHER, edit, write_district
from places import CONFIG

from greenroof_ros.analysis.district.result import DistrictResult, simulate_district
from greenroof_ros.analysis.district.scene import AS_IS, Flow, find_peak
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site


def simulate(directory: Path, text: str = DISTRICT) -> DistrictResult:
    """Simulate a district."""
    return simulate_district(write_district(directory, text))


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> DistrictResult:
    """Simulate the district once."""
    return simulate(tmp_path_factory.mktemp("district"))


def rows_of(result: DistrictResult) -> dict[tuple[str, float], dict[str, Any]]:
    """Return the results of the only draw and season, by outlet and adoption."""
    return {(row["outlet"], row["adoption"]): row for row in result.all_rows.to_dicts()}


def site_of(result: DistrictResult, place: int, outlet: str) -> Site:
    """Return the site of a building with a kind of outlet."""
    changes = {
        key: result.buildings[key][place]
        for key in ("catchment_area", "cistern_volume", "substrate_depth")
    }
    site = read_site(CONFIG / "site_valve.yaml", {"tau": 60.0, "M": 1, **changes})
    if outlet == "none":
        return replace(
            site, low_outlet_level=None, low_outlet_radius=None, low_outlet_valve=False
        )
    return replace(site, low_outlet_valve=False) if outlet == "orifice" else site


def results_of(site: Site, outlet: str) -> dict[str, Any]:
    """Return the summary of the run of one site."""
    given = {"outlet": outlet} if site.low_outlet_valve else {}
    simulation = Simulation(make_inputs(find_controller("onoff"), {
        "site": site, "weather": WEATHER, "start": "2021-07-07T00:00", "hours": 72.0, **given,
    }).build())
    for _ in simulation.ticks():
        pass
    return simulation.summary()


def test_sums_of_single_runs(simulated: DistrictResult) -> None:
    """Half of the buildings with a green roof, half of these with a valve; the others as they are.

    Each building is simulated alone, and the sums are made here.
    """
    rows, buildings = rows_of(simulated), simulated.buildings.to_dicts()
    assert sum(each["adopts_at"] <= 0.5 for each in buildings) == 4
    assert sum(each["low_outlet"] for each in buildings if each["adopts_at"] <= 0.5) == 2
    for outlet in ("none", "orifice", "drain", "plan"):
        sums: Counter[str] = Counter()
        for place, building in enumerate(buildings):
            own = outlet if building["low_outlet"] else "none"
            site = site_of(simulated, place, own)
            if building["adopts_at"] > 0.5:
                area = site.a2 + site.a_in * site.runoff_coefficient
                for name in ("discharge_m3", "wet_discharge_m3"):
                    sums[name] += area * simulated.storm.rain.sum()
                continue
            results = results_of(site, own)
            for name in ("discharge_m3", "wet_discharge_m3", "mains_m3", "pumped_m3"):
                sums[name] += results[name] or 0.0
            sums["met_m3"] += results["pumped_m3"] * results.get("demand_met_share", 0.0)
        row = rows[outlet, 0.5]
        assert row["demand_met_share"] == pytest.approx(sums.pop("met_m3") / sums["pumped_m3"])
        assert row["buildings"] == 4
        for name, value in sums.items():
            assert row[name] == pytest.approx(value, rel=1e-6), (outlet, name)
        assert row["retention_share"] == pytest.approx(1 - sums["discharge_m3"] / row["rain_m3"])


def test_water_to_fill_up_is_no_irrigation(tmp_path: Path) -> None:
    """Dry days from nearly empty cisterns: the mains meet the whole demand, and also fill up."""
    text = edit("draw:\n", "draw:\n  initial_cistern: {values: [0.02]}\n")
    text = text.replace("2021-07-07T00:00, hours: 72", "2021-07-04T00:00, hours: 48")
    row = simulate(tmp_path, text).all_rows.row(-1, named=True)
    assert row["mains_m3"] > row["pumped_m3"] > 0
    assert row["demand_met_share"] == pytest.approx(0.0, abs=1e-9)


def test_without_mains_water(tmp_path: Path) -> None:
    """Neither its volume nor the share of the demand that needs none is a result."""
    (tmp_path / "dry.yaml").write_text("".join(
        line for line in (CONFIG / "site_valve.yaml").read_text().splitlines(keepends=True)
        if not line.startswith("mains_")
    ) + "valve_moves_per_hour: 4\n")
    result = simulate(tmp_path, edit("site_valve.yaml", "dry.yaml"))
    assert not {"mains_m3", "demand_met_share"} & {*result.all_rows.columns}
    assert result.all_rows["pumped_m3"][-1] > 0
    result.save(tmp_path / "out")
    assert "mains water" not in (tmp_path / "out" / "page.html").read_text()


@pytest.mark.parametrize("seconds", [60.0, 90.0, 300.0])
def test_peak(seconds: float) -> None:
    """A moving mean, second by second; before and after the run nothing flows."""
    volumes = np.random.default_rng(7).choice([0.0, 0.0, 1.0, 5.0], 40)
    flow = np.repeat(volumes / seconds, int(seconds))
    for minutes in (5, 15, 60):
        window = np.ones(60 * minutes) / (60 * minutes)
        expected = np.convolve(flow, window).max()
        durations = np.full(40, seconds)
        assert find_peak(volumes, durations, minutes) == pytest.approx(expected)


def test_valves_are_closed_in_wet_weather(simulated: DistrictResult) -> None:
    """An orifice is not; valves that are too large together cause a warning."""
    rows = rows_of(simulated)
    assert rows["none", 1.0]["low_outlet_m3"] == 0
    assert 0 < rows["orifice", 1.0]["wet_low_outlet_m3"] < rows["orifice", 1.0]["low_outlet_m3"]
    for outlet in ("drain", "plan"):
        assert rows[outlet, 1.0]["low_outlet_m3"] > 1
        assert rows[outlet, 1.0]["wet_low_outlet_m3"] == 0
    (warning,) = simulated.warnings
    assert "exceeds the sewer's capacity of 2 mm/h" in warning


def test_no_green_roof(simulated: DistrictResult) -> None:
    """All rain runs off at once, in wet weather; its peak and its excess are those of the rain."""
    row, scene = rows_of(simulated)["none", 0.0], simulated.storm
    hourly = 1000 * scene.rain[0].reshape(-1, 60).sum(axis=1)  # the record is hourly
    volume = hourly.sum() / 1000 * scene.areas.sum()
    for name in ("rain_m3", "discharge_m3", "wet_discharge_m3"):
        assert row[name] == pytest.approx(volume)
    assert row["buildings"] == row["dry_peak_5min_mm_h"] == 0
    for minutes in (5, 60):
        assert row[f"peak_{minutes}min_mm_h"] == pytest.approx(hourly.max())
    excess = np.maximum(hourly - 2.0, 0.0)
    assert excess.sum() > 10
    assert row["sewer_overflow_m3"] == pytest.approx(excess.sum() / 1000 * scene.areas.sum())
    assert row["sewer_overflow_hours"] == pytest.approx((excess > 0).sum())


def test_cells(tmp_path: Path) -> None:
    """Half of the buildings have each weather; wet weather is that of either."""
    later, columns = tmp_path / "later.csv", "temperature [degC],evapotranspiration [mm/day]"
    later.write_text(f"time,precipitation [mm/h],{columns}\n" + "".join(
        f"2021-07-{1 + n // 24:02}T{n % 24:02}:00-05:00,{5 * (n == 500)},20,4\n"
        for n in range(744)
    ))
    text = edit(f"file: {WEATHER}", f"cells: {{north: {WEATHER}, south: {later}}}")
    text = text.replace("2021-07-07T00:00, hours: 72", "2021-07-20T00:00, hours: 48")
    result = simulate(tmp_path, text)
    scene, areas = result.storm, result.storm.areas
    assert result.buildings["cell"].to_list() == ["north"] * 4 + ["south"] * 4
    expected = np.array([areas[:4].sum(), areas[4:].sum()]) @ scene.rain
    assert scene.group_discharges(AS_IS).sum(axis=0) == pytest.approx(expected)
    assert scene.rain[0].sum() != scene.rain[1].sum() == pytest.approx(0.005)
    rains = np.flatnonzero(scene.rain[1])
    assert scene.wet[rains[0] : rains[-1] + 121].all()


def test_the_last_interval_is_shorter(tmp_path: Path) -> None:
    """With ticks of 25 s, intervals of 75 s; a run of 4319 ticks ends with 50 s."""
    text = edit("hours: 72", "hours: 29.993055555555557").replace("draws: 1", "draws: 1\ntau: 25")
    result = simulate(tmp_path, text.replace("T00:00", "T18:00"))
    durations = result.storm.durations
    assert (durations[0], durations[-1], durations.sum()) == (75, 50, 4319 * 25)
    flows = result.hydrographs["plan_100_m3_s"].to_numpy()
    assert flows @ durations == pytest.approx(result.all_rows["discharge_m3"][-1])


def test_seasons_and_draws(tmp_path: Path) -> None:
    """Every season with every draw; missing rain is noted; the range is that of all results."""
    dry = tmp_path / "record.csv"
    dry.write_text("time,precipitation [mm/h],evapotranspiration [mm/day]\n" + "".join(
        f"{year}-06-{1 + n // 24:02}T{n % 24:02}:00+00:00,"
        f"{'' if year == 2022 and 100 <= n < 200 else (year - 2019) * (n % 50 == 0)},3\n"
        for year in (2020, 2021, 2022) for n in range(240)
    ))
    text = edit(f"file: {WEATHER}, start: 2021-07-07T00:00, hours: 72",
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


def test_nothing_to_adopt(tmp_path: Path) -> None:
    """With adoption 0 alone there is only the district as it is."""
    result = simulate(tmp_path, edit("[0.25, 0.5, 1.0]", "[0]"))
    assert result.all_rows["adoption"].to_list() == [0]
    assert "No green roofs" in result.sentence
    result.save(tmp_path / "out")
    assert Flow("none", 0.0) == AS_IS
