"""The sums over a district: against runs of single sites, by hand, and in any order."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from districts import WEATHER, edit, simulate_here, write_district
from places import CONFIG

from greenroof_ros.analysis.district.page import (
    describe_valves,
    name_share,
    percent,
    summarise,
    warn,
)
from greenroof_ros.analysis.district.parts import simulate_part
from greenroof_ros.analysis.district.result import DistrictResult
from greenroof_ros.analysis.district.run import DistrictRun, read_run
from greenroof_ros.analysis.district.totals import AS_IS, Flow, Totals, find_peak
from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DistrictRun, Totals]:
    """Simulate the district once; return the directory, too."""
    directory = tmp_path_factory.mktemp("district")
    run, totals = simulate_here(directory)
    write_inputs(run.files, directory)
    return directory, run, totals


Simulated = tuple[Path, DistrictRun, Totals]


def site_of(run: DistrictRun, directory: Path, place: int, outlet: str) -> Site:
    """Return the site of a building with a kind of outlet."""
    changes = {key: values[place] for key, values in run.buildings.values.items()}
    site = read_site(directory / "site.yaml", changes)
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


def test_sums_of_single_runs(simulated: Simulated) -> None:
    """Half of the buildings with a green roof, half of these with a valve; the others as they are.

    Each building is simulated alone, and the sums are made here.
    """
    directory, run, totals = simulated
    rows = {(row["outlet"], row["adoption"]): row for row in totals.rows()}
    order = np.argsort(run.buildings.ranks)
    for outlet in ("none", "orifice", "drain", "plan"):
        sums: Counter[str] = Counter()
        for rank, place in enumerate(order.tolist()):
            site = site_of(run, directory, place, outlet)
            area = site.a2 + site.a_in * site.runoff_coefficient
            if rank >= 4:
                for name in ("discharge_m3", "wet_discharge_m3"):
                    sums[name] += area * totals.rain.sum()
                continue
            own = outlet if rank % 2 else "none"  # every other one has a valve
            results = results_of(site_of(run, directory, place, own), own)
            for name in ("discharge_m3", "wet_discharge_m3", "mains_m3", "pumped_m3"):
                sums[name] += results[name] or 0.0
            sums["rain_m3"] += results["pumped_m3"] * results.get("demand_met_share", 0.0)
        row = rows[outlet, 0.5]
        assert row["demand_met_share"] == pytest.approx(sums.pop("rain_m3") / sums["pumped_m3"])
        assert row["buildings"] == 4
        for name, value in sums.items():
            assert row[name] == pytest.approx(value, rel=1e-6), (outlet, name)


def test_water_to_fill_up_is_no_irrigation(tmp_path: Path) -> None:
    """Dry days from nearly empty cisterns: the mains meet the whole demand, and also fill up."""
    text = edit("draw:\n", "draw:\n  initial_cistern: {values: [0.02]}\n")
    text = text.replace("2021-07-07T00:00, hours: 72", "2021-07-04T00:00, hours: 48")
    _, totals = simulate_here(tmp_path, text)
    row = totals.rows()[-1]
    assert row["mains_m3"] > row["pumped_m3"] > 0
    assert row["demand_met_share"] == pytest.approx(0.0, abs=1e-9)


def test_without_mains_water(tmp_path: Path) -> None:
    """Neither its volume nor the share of the demand that needs none is a result."""
    (tmp_path / "dry.yaml").write_text("".join(
        line for line in (CONFIG / "site_valve.yaml").read_text().splitlines(keepends=True)
        if not line.startswith("mains_")
    ) + "valve_moves_per_hour: 4\n")
    run, totals = simulate_here(tmp_path, edit("site_valve.yaml", "dry.yaml"))
    for row in totals.rows():
        assert "mains_m3" not in row and "demand_met_share" not in row
    assert totals.rows()[-1]["pumped_m3"] > 0
    result = DistrictResult(run, totals)
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
        assert find_peak(volumes, seconds, minutes) == pytest.approx(expected)


def test_valves_are_closed_in_wet_weather(simulated: Simulated) -> None:
    """An orifice is not; what valves let out is what leaves besides overflow and drainage."""
    _, _, totals = simulated
    rows = {(row["outlet"], row["adoption"]): row for row in totals.rows()}
    assert rows["none", 1.0]["low_outlet_m3"] == 0
    assert 0 < rows["orifice", 1.0]["wet_low_outlet_m3"] < rows["orifice", 1.0]["low_outlet_m3"]
    for outlet in ("drain", "plan"):
        row = rows[outlet, 1.0]
        assert row["low_outlet_m3"] > 1
        assert row["wet_low_outlet_m3"] == 0
        flow = totals.let_out(Flow(outlet, 1.0))
        assert (flow[totals.wet] == 0).all()
        sums = flow.reshape(-1, 5).sum(axis=1)  # at most a fifth above whole five minutes
        peak = 12 * 1000 * sums.max() / totals.area
        assert peak * (1 - 1e-9) <= row["low_outlet_peak_5min_mm_h"] <= 1.2 * peak


def test_a_warning_of_valves_that_are_too_large(simulated: Simulated) -> None:
    """Four valves of 8.5 mm let out at most what Eq. (2) gives at the overflow's level."""
    _, run, totals = simulated
    rows = totals.rows()
    drain = next(row for row in rows if (row["outlet"], row["adoption"]) == ("drain", 1.0))
    each = 0.61 * math.pi * 0.0085**2 * math.sqrt(2 * 9.81 * (2.0 - 0.1))  # m3/s
    highest = 3.6e6 * 4 * each / totals.area
    assert 2.0 < drain["low_outlet_peak_5min_mm_h"] < highest
    (warning,) = warn(run, rows)
    assert warning.startswith(
        "the cisterns empty at the same time: in dry weather they release up to "
        f"{drain['dry_peak_5min_mm_h']:.3g} mm/h (valve, drain, all 8 buildings), which exceeds "
        "the sewer's capacity of 2 mm/h"
    )
    (of_drain, of_plan) = describe_valves(rows, 8)
    assert of_drain.startswith(
        "Valve, drain, all 8 buildings: none of the water from the valves is released in "
        "wet weather."
    )
    assert of_plan.startswith("Valve, plan")


def test_sentences_of_one_building_and_of_none_all_and_the_same(simulated: Simulated) -> None:
    """The numbers are those of the rows; what is none, the same or new is said in words."""
    _, run, totals = simulated
    before, *_ = totals.rows()
    of_one = replace(run, buildings=run.buildings.part(slice(1)))

    def row(
        adoption: float, buildings: int, wet: float, over: float, peak: float
    ) -> dict[str, Any]:
        return {
            **before, "outlet": "drain", "adoption": adoption, "buildings": buildings,
            "wet_discharge_m3": wet * before["wet_discharge_m3"],
            "sewer_overflow_m3": over * before["sewer_overflow_m3"],
            "peak_60min_l_s": peak * before["peak_60min_l_s"],
        }

    space = "\N{NO-BREAK SPACE}"
    rows = [before, row(0.4, 3, 1, 1, 1.001), row(1.0, 8, 0.004, 0, 0.5)]
    assert summarise(run, rows) == (
        f"With green roofs and cisterns on all 8 buildings (valve, drain), 99.6{space}% less storm "
        "water reaches the sewer in wet weather, the sewer no longer overflows and the peak over "
        f"an hour is 50{space}% lower. On 40{space}% of them, just as much storm water reaches the "
        "sewer in wet weather, the sewer overflows just as much and the peak over an hour is "
        f"0.1{space}% higher."
    )
    assert summarise(of_one, [before, row(0.4, 0, 1, 1, 1), row(1.0, 1, 0, 0, 0)]) == (
        "With a green roof and a cistern on the only building (valve, drain), no storm water "
        "reaches the sewer in wet weather, the sewer no longer overflows and no water reaches the "
        "sewer in any hour."
    )
    assert summarise(of_one, [before, row(0.4, 0, 1, 1, 1)]).startswith("No building has a green")
    assert name_share(0.5, 1) == "the only building"
    assert name_share(0.9999, 1000) == "all 1,000 buildings"
    dry = {**before, "sewer_overflow_m3": 0.0}
    assert summarise(run, [dry, {**row(0.5, 4, 1, 1, 1)}]).endswith(
        "is the same and the sewer, which is large enough for the buildings as they are, overflows."
    )
    assert [percent(share).replace(space, "") for share in (0, 1e-9, 0.004, -0.003, 0.9996, 1)] == [
        "0%", "0%", "0.4%", "-0.3%", "100%", "100%"
    ]


def test_no_green_roof(simulated: Simulated) -> None:
    """All rain runs off at once, in wet weather; its peak is the rain's."""
    *_, totals = simulated
    row = totals.rows()[0]
    assert (row["outlet"], row["adoption"], row["buildings"]) == ("none", 0.0, 0)
    rain = totals.rain[0]
    assert row["rain_m3"] == pytest.approx(rain.sum() * totals.area)
    assert row["discharge_m3"] == pytest.approx(row["rain_m3"])
    assert row["wet_discharge_m3"] == pytest.approx(row["rain_m3"])
    hourly = rain.reshape(-1, 60).sum(axis=1)  # the record is hourly
    assert row["peak_60min_mm_h"] == pytest.approx(1000 * hourly.max())
    assert row["peak_5min_mm_h"] == pytest.approx(1000 * hourly.max())
    assert row["dry_peak_5min_mm_h"] == 0


def test_sewer(simulated: Simulated, tmp_path: Path) -> None:
    """What exceeds the capacity overflows: of hourly rain it is the sum of the excesses."""
    *_, totals = simulated
    row = totals.rows()[0]
    hourly = 1000 * totals.rain[0].reshape(-1, 60).sum(axis=1)
    excess = np.maximum(hourly - 2.0, 0.0)
    assert excess.sum() > 10
    assert row["sewer_overflow_m3"] == pytest.approx(excess.sum() / 1000 * totals.area)
    assert row["sewer_overflow_hours"] == pytest.approx((excess > 0).sum())
    file = write_district(tmp_path, edit("sewer_capacity: 2.0\n", ""))
    without = read_run(file).make_totals()
    without.areas[:] = totals.areas
    assert "sewer_overflow_m3" not in without.rows()[0]


def test_parts_in_any_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bits of the sums are the same in any order of the parts."""
    monkeypatch.setattr("greenroof_ros.analysis.district.run._PART", 3)
    run = read_run(write_district(tmp_path))
    write_inputs(run.files, tmp_path)
    results = [(part.places, simulate_part(tmp_path, part)) for part in run.parts()]
    assert len(results) == 3
    found = []
    for order in (results, results[::-1], [*results[1:], results[0]]):
        totals = run.make_totals()
        for places, result in order:
            totals.add(places, result)
        found.append((totals.rows(), totals.discharge(Flow("plan", 0.5)).tobytes()))
    assert found[0] == found[1] == found[2]


def test_cells(tmp_path: Path) -> None:
    """Half of the buildings have each weather; wet weather is that of either."""
    later, columns = tmp_path / "later.csv", "temperature [degC],evapotranspiration [mm/day]"
    later.write_text(f"time,precipitation [mm/h],{columns}\n" + "".join(
        f"2021-07-{1 + n // 24:02}T{n % 24:02}:00-05:00,{5 * (n == 500)},20,4\n"
        for n in range(744)
    ))
    text = edit(f"file: {WEATHER}", f"cells: {{north: {WEATHER}, south: {later}}}")
    text = text.replace("2021-07-07T00:00, hours: 72", "2021-07-20T00:00, hours: 48")
    run, totals = simulate_here(tmp_path, text)
    assert run.buildings.cells.tolist() == [0] * 4 + [1] * 4
    areas = [totals.areas[:4].sum(), totals.areas[4:].sum()]
    expected = areas @ totals.rain
    assert totals.discharge(AS_IS) == pytest.approx(expected)
    assert totals.rain[0].sum() != totals.rain[1].sum() == pytest.approx(0.005)
    rains = np.flatnonzero(totals.rain[1])
    assert totals.wet[rains[0] : rains[-1] + 121].all()


def test_nothing_to_adopt(tmp_path: Path) -> None:
    """With adoption 0 alone there is only the district as it is."""
    _, totals = simulate_here(tmp_path, edit("[0.25, 0.5, 1.0]", "[0]"))
    assert [row["adoption"] for row in totals.rows()] == [0]
