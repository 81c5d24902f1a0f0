"""Design storms on a house: beside counts of their own, and as a user computes them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from commands import run_command
from places import CONFIG, DATA

import greenroof_ros as gr
from greenroof_ros.site.site import Site

VALVE, DEPTHS = CONFIG / "site_valve.yaml", DATA / "eccc_idf_charlottetown.yaml"
PEAK, LESS, VOLUME = "peak_l_s", "peak_reduction_percent", "volume_m3"


def house(**changes: float) -> Site:
    """Return the house with a cistern of 8 m3."""
    return gr.read_site(VALVE, a1=4.0, **changes)


def column(table: pl.DataFrame, case: str, name: str) -> list[float]:
    """Return a column of the rows of a case, by return period."""
    return table.filter(case=case).sort("return_period_years")[name].to_list()


def test_the_storm_as_weather() -> None:
    """Two days and three are dry; the storm has the table's 42.8 mm, and 20 % more in a factor."""
    storm = gr.design_storm(DEPTHS, 10, rain_factor=1.2)
    rain = storm["precipitation [mm/h]"].to_numpy()
    assert len(rain) == 12 * (48 + 2 + 72) and rain.sum() / 12 == pytest.approx(1.2 * 42.8)
    assert storm["time"][int(np.flatnonzero(rain)[0])] == "2001-07-03T00:00"
    run = gr.simulate(site=VALVE, weather=storm, start="2001-07-01", hours=60, outlet="plan")
    assert run.events["rain_mm"].to_list() == pytest.approx([1.2 * 42.8], rel=1e-6)
    assert run.metrics["evapotranspiration_m3"] == 0


def test_an_ordinary_roof_has_the_rain() -> None:
    """300 m2 of roof at 0.9 and the green roof's area; all rain of the wettest 5 min at once."""
    site = house()
    table = gr.storms(site, DEPTHS, kind="chicago", outlets=["closed"]).table
    area = 0.9 * 300 + site.a2
    depths = np.array([[5.1, 8.9, 13.7], [27.1, 42.8, 62.4]])  # in 5 min and in 2 h, from table 2a
    assert column(table, "no green roof", PEAK) == pytest.approx(area * depths[0] / 300, rel=1e-6)
    volumes = column(table, "no green roof", VOLUME)
    assert volumes == pytest.approx(area * depths[1] / 1000, rel=1e-6)


def test_valves_make_room_for_storms() -> None:
    """Peaks are lower by 7 to 25, 12 to 76, and 31 to 86 % in a count with another table of depths.

    The cistern holds 8 m3 and is full two days before, and the storms are Chicago's of two hours.
    """
    table = gr.storms(house(), DEPTHS, kind="chicago", state="dry").table
    ranges = {"closed": (7, 25), "drain": (12, 100), "plan": (31, 100)}
    reductions = [column(table, f"valve {outlet}", LESS) for outlet in ranges]
    for found, (low, high) in zip(reductions, ranges.values(), strict=True):
        assert found == sorted(found, reverse=True)  # rarer storms are kept back less
        assert all(low <= each <= high for each in found)
    for closed, drain, plan in zip(*reductions, strict=True):
        assert closed < drain <= plan + 1e-9
    more = gr.storms(house(), DEPTHS, kind="chicago", state="dry", rain_factor=1.2).table
    assert column(more, "valve plan", PEAK)[2] > column(table, "valve plan", PEAK)[2]


def test_a_dry_roof_keeps_what_its_soil_can_hold() -> None:
    """A wet roof drains all rain on it within the day; a dry one holds back its available water."""
    site, total = house(), "discharge_m3"
    wet, dry = (
        gr.storms(site, DEPTHS, return_periods=[100], state=state, outlets=[]).table
        for state in ("wet", "dry")
    )
    case = "green roof without irrigation"
    kept = np.subtract(*(column(each, case, total) for each in (wet, dry)))
    fallen = 0.0624 * site.a2
    assert 0.5 * fallen < kept[0] <= min(fallen, site.available_volume)


@pytest.mark.parametrize(("outlet", "level"), [("closed", 2.0), ("drain", 0.1)])
@pytest.mark.parametrize("period", [2, 100])
def test_peak_and_volume_counted_by_the_second(outlet: str, level: float, period: float) -> None:
    """A house with hardly any green roof; drain has emptied the cistern down to the valve.

    The cistern of 4 m2 gets the rain of 0.9 x 300 m2; what is above 2 m leaves by Eq. (2).
    test_swmm.py compares such a count with SWMM.
    """
    site, storm = house(a2=0.01), gr.design_storm(DEPTHS, period, rain_factor=1.5)
    rain = storm["precipitation [mm/h]"].to_numpy()[12 * 48 : 12 * 52] / 3.6e6
    flows = np.repeat(rain, 300)[:, None] * [0.0, 270.01]
    for second, fallen in enumerate(np.repeat(rain, 300)):
        head = max(0.0, level - 2.0)
        flows[second, 0] = 0.61 * np.pi * site.r_o**2 * np.sqrt(2 * 9.81 * head)
        level += (270 * fallen - flows[second, 0]) / 4
    minutes = flows.reshape(-1, 60, 2).mean(axis=1)  # peaks are of five whole minutes
    fives = np.apply_along_axis(np.convolve, 0, minutes, np.ones(5), "valid") / 5
    table = gr.storms(
        site, DEPTHS, return_periods=[period], outlets=[outlet], rain_factor=1.5
    ).table
    for case, peak, volume in zip(
        (f"valve {outlet}", "no green roof"), 1000 * fives.max(axis=0), flows.sum(axis=0),
        strict=True,
    ):
        assert column(table, case, PEAK) == pytest.approx([peak], rel=0.02)
        assert column(table, case, VOLUME) == pytest.approx([volume], rel=0.02)


def storm(directory: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the command until it ends."""
    return run_command(
        "storm", "--depths", str(DEPTHS), *options, cwd=directory, env=dict(os.environ)
    )


def test_the_command_prints_a_weather_file(tmp_path: Path) -> None:
    done = storm(tmp_path, "--return-periods", "10", "--kind", "block", "--duration", "60")
    assert done.returncode == 0, done.stderr
    file = tmp_path / "storm.csv"
    file.write_text(done.stdout)
    run = gr.simulate(site=VALVE, weather=file, start="2001-07-02", hours=30)
    assert run.events["rain_mm"].to_list() == pytest.approx([28.4], rel=1e-6)


def test_the_command_writes_a_page(tmp_path: Path) -> None:
    for options in ((), ("--rain-factor", "1.2")):  # a second result replaces the first
        done = storm(tmp_path, "--site", str(VALVE), "--run", "council", *options)
        assert done.returncode == 0, done.stderr
    printed = " ".join(done.stdout.split())
    assert "2 h after the last" in printed
    # The result with a perfect forecast is not given without the one that needs none.
    drained, _, foreseen = printed.partition("With valve plan, which has a perfect forecast here:")
    assert "With valve drain: a storm of 2 years (33 mm in 120 min) by " in drained
    assert foreseen.startswith(" a storm of 2 years (33 mm in 120 min) by ")
    assert (tmp_path / "council" / "storms.html").is_file()
    table = pl.read_csv(tmp_path / "council" / "storms.csv")
    assert table["rain_mm"].unique().sort().to_list() == pytest.approx([32.52, 51.36, 74.88])


def test_the_command_refuses(tmp_path: Path) -> None:
    done = storm(tmp_path, "--run", "--state", "damp")
    assert done.returncode == 2 and "--state" in done.stderr and "Traceback" not in done.stderr


def test_sites_of_all_kinds() -> None:
    """A site without a valve has one case of its own, and one without mains has no unknown key."""
    for name in ("site.yaml", "site_catchment.yaml", "site_neubrandenburg.yaml"):
        cases = gr.storms(CONFIG / name, DEPTHS, return_periods=[10]).table["case"].to_list()
        assert cases == ["no green roof", "green roof without irrigation", "no valve"]
