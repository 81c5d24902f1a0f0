"""Grids of studies: the packaged ones, and wrong ones."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CONFIG, DATA, refusal
from studies import (
    GRID,
    WEATHER,
    archive,
    cases_of,
    edit_grid,
    grid,
    run_here,
    study,
    write_inputs,
)

from greenroof_ros.analysis.case import run_case
from greenroof_ros.analysis.grid import read_grid
from greenroof_ros.base.parameter import parameters_of
from greenroof_ros.forecast.issue import read_archive
from greenroof_ros.simulation.inputs import RunInputs
from greenroof_ros.site.file import read_site

SITE = f"site: {CONFIG / 'site.yaml'}"
HOURS = "    hours: 0.25\n"


@pytest.mark.parametrize(("text", "expected"), [
    (edit_grid(f"  - file: {WEATHER}\n", "  - 5\n  - file: x\n"), "line 3: weather"),
    # The error is in the grid, not in the site file with the value.
    (edit_grid(SITE, "site: {file: site.yaml, tau: [1.0, 0.0]}"), "grid.yaml, line 2: tau = 0.0"),
    (GRID + "show: [mains]\n", "line 14: show = 'mains'"),
])
def test_wrong_grid(tmp_path: Path, text: str, expected: str) -> None:
    """The error reports where and what."""
    assert expected in refusal(read_grid, tmp_path / grid(tmp_path, text))


def test_what_is_wrong_ends_before_anything_runs(tmp_path: Path) -> None:
    """Exit code 2, and nothing is written."""
    result = study(tmp_path, grid(tmp_path, edit_grid("0.1]", "-0.1]")), "--output", "out")
    assert result.returncode == 2, result.stderr
    assert "line 11: weight = -0.1" in result.stderr.splitlines()[-1]
    assert [file.name for file in tmp_path.iterdir()] == ["grid.yaml"]


def test_window_of_several_files(tmp_path: Path) -> None:
    """A list or a pattern is one window; the runs equal the runs of the complete file."""
    lines = WEATHER.read_text().splitlines(keepends=True)
    header = next(index for index, line in enumerate(lines) if line.startswith("time,"))
    hours = lines[header + 1 :]
    for name, part in (("part-1.csv", hours[:5]), ("part-2.csv", hours[5:])):
        (tmp_path / name).write_text("".join([lines[header], *part]))
    whole = read_grid(tmp_path / grid(tmp_path))
    for files in ("[part-2.csv, part-1.csv]", "part-?.csv"):
        parts = read_grid(tmp_path / grid(tmp_path, edit_grid(str(WEATHER), files)))
        assert len(parts.cases) == len(whole.cases)
        assert [*parts.cases[-1].files] == ["part-1.csv", "part-2.csv"]
    write_inputs(parts.files.contents | whole.files.contents, tmp_path)
    results = [run_case(tmp_path, some.cases[-1], None).results for some in (parts, whole)]
    assert results[0] == results[1]


# The number of runs of each packaged grid, in one of its years, and the sites and ticks (s) of
# those that simulate seasons.
RUNS = {
    "paper.yaml": (3 * (5 + 5), 1, {1}),
    "forecasts.yaml": (2 + 2 * 50, 1, {1}),
    # On/off that drains, and two that plan with three forecasts.
    "seasons.yaml": (1 + 2 * 3, 1, {300}),
    # Two roofs with four cisterns each; closed, open, plan, and three reserves.
    "storm_water.yaml": (8 * 6, 8, {300}),
    "storm_water_orifice.yaml": (8, 8, {300}),
    # Five reaches.
    "reach.yaml": (5, 1, {300}),
    # The valve follows every command, or makes whole openings.
    "whole_openings.yaml": (2 * 3, 2, {60}),
}


@pytest.mark.parametrize("file", RUNS)
def test_grids_that_come_with_it(tmp_path: Path, file: str) -> None:
    """A copy of each in an empty directory runs with the package's files; here in one year."""
    text = (CONFIG / "studies" / file).read_text()
    text = re.sub(r"year: \{from: \d+, to: (\d+)\}", r"year: \1", text)
    cases = cases_of(tmp_path / grid(tmp_path, text.replace("hours: 4416", "hours: 24")))
    runs, sites, ticks = RUNS[file]
    assert len(cases) == runs
    assert len({case.site for case in cases}) == sites
    assert {case.site.tau for case in cases} == ticks


def test_a_grid_of_records_that_users_bring(tmp_path: Path) -> None:
    """A gauge, and archives of services; what is missing is named with its places."""
    text = (CONFIG / "studies" / "storm_water_issued.yaml").read_text()
    name = tmp_path / grid(tmp_path, text.replace(
        "2024-03-01T00:00, hours: 7296", "2024-03-05T12:00, hours: 24"
    ))
    assert f"there is no gauge.csv in {tmp_path}, {CONFIG}" in refusal(read_grid, name)
    (tmp_path / "gauge.csv").write_text("time,precipitation [mm/h]\n" + "".join(
        f"2024-03-{day:02}T{hour:02}:00+00:00,0.5\n" for day in range(1, 31) for hour in range(24)
    ))
    archive = (DATA / "gem_global_previous_runs_2024-03.csv").read_bytes()
    for file in ("gem", "knmi", "gfs", "together", "week_late"):
        (tmp_path / f"{file}.csv").write_bytes(archive)
    # Only plan uses the forecasts.
    assert len(cases_of(name)) == 8 * (2 + 4 + 2 * 6)


def test_settings_and_whole_numbers(tmp_path: Path) -> None:
    """A list contains settings, each with its combinations and forecasts; years and seeds."""
    text = edit_grid("2021-07-07T02:00", "2021-07-0{year}T02:00")
    text = text.replace(HOURS, f"{HOURS}    year: {{from: 7, to: 9}}\n")
    text = text[: text.index("    weight:")] + """
    - {weight: [0.001, 0.01], forecast: perfect}
    - {weight: 0.1, forecast: {model: errors, skill: real, seed: {from: 1, to: 2}}}
"""
    cases = cases_of(tmp_path / grid(tmp_path, text))
    assert {case.inputs.start[:10] for case in cases} == {f"2021-07-0{day}" for day in (7, 8, 9)}
    assert {
        (inputs.parameters["weight"], str(inputs.forecast), inputs.forecast.options().get("seed"))
        for inputs in (case.inputs for case in cases)
    } == {(0.001, "perfect", None), (0.01, "perfect", None), (0.1, "errors", 1), (0.1, "errors", 2)}
    assert len(cases) == 3 * 2 * 2 * 4  # years, methods, initial states, settings


def test_sites_with_other_values(tmp_path: Path) -> None:
    """Every combination is a site, of which dependent values and volumes follow."""
    text = (CONFIG / "site.yaml").read_text() + "initial_cistern: 50.0\ninitial_roof: 1.0\n"
    (tmp_path / "mine.yaml").write_text(text)
    own = "[{file: mine.yaml, a1: [5.0, 25.0], a2: 137.6, runoff_coefficient: 0.9}, mine.yaml]"
    text = GRID.replace(str(CONFIG / "site.yaml"), own).replace("[low-low, ", "[site, ")
    text = text.replace("cistern: 40.0, roof: 0.5", "cistern_level: 3.0, roof_level: 0.01")
    store = run_here(tmp_path, text.replace(HOURS, "    hours: 0.01\n"))
    names = [
        "cistern_15_m3.yaml", "cistern_75_m3_runoff_coefficient_0.9.yaml",
        "cistern_75_m3_runoff_coefficient_1.yaml",
    ]
    sites = [read_site(store.inputs / name) for name in names]
    # A fifth of the cistern and twice the roof area: their volumes scale, not their levels.
    assert [(site.a1, site.a2, site.z_o) for site in sites] == [
        (5.0, 137.6, 3.0), (25.0, 137.6, 3.0), (25.0, 68.8, 3.0)
    ]
    rows = {(row["initial"], row["site"]): row for row in store.write_table()}
    for initial, expected in (
        ("site", [(10.0, 2.0), (50.0, 2.0), (50.0, 1.0)]),
        ("dry", [(15.0, 1.376), (75.0, 1.376), (75.0, 0.688)]),
    ):
        there = [rows[initial, name] for name in names]
        np.testing.assert_allclose([(row["cistern_m3"], row["roof_m3"]) for row in there], expected)


def two_sites(directory: Path, weather: str, *lines: str) -> Path:
    """Write a grid with sites that differ in a line, and a day of weather whose times say no zone.

    Args:
        directory: where it is written.
        weather: header and cells of the weather, besides the time.
        lines: of each site.
    """
    paper = (CONFIG / "site.yaml").read_text()
    (directory / "paper.yaml").write_text(re.sub("(utc_offset|monthly_.*):.*\n", "", paper))
    for name, line in zip(("here", "there"), lines, strict=True):
        (directory / f"{name}.yaml").write_text(f"extends: paper.yaml\n{line}\n")
    header, cells = weather.split("\n")
    (directory / "weather.csv").write_text(f"time,{header}\n" + "".join(
        f"2021-07-07T{hour:02}:00,{cells}\n" for hour in range(24)
    ))
    return directory / grid(directory, """
site: [here.yaml, there.yaml]
weather: {file: weather.csv, start: 2021-07-07T02:00, hours: 0.1}
initial: low-low
controllers: {onoff: }
""")


def test_weather_is_shared_by_sites_only_if_it_is_the_same(tmp_path: Path) -> None:
    """Sites that differ in their clock, or in their monthly means, read a file differently."""
    file = two_sites(
        tmp_path, "precipitation [mm/h],my evapotranspiration [mm/day]\n0,1",
        "time_zone: America/Toronto", "time_zone: America/Winnipeg",
    )
    assert [case.inputs.start for case in cases_of(file)] == [
        "2021-07-07T02:00:00-04:00", "2021-07-07T02:00:00-05:00",
    ]
    months = ", ".join(map(str, range(1, 13)))
    zone = "time_zone: America/Toronto"
    file = two_sites(
        tmp_path, "precipitation [mm/h]\n0", f"{zone}\nmonthly_evapotranspiration: [{months}]", zone
    )
    refusal(read_grid, file, match="set monthly_evapotranspiration in the")
    text = file.read_text().replace("there.yaml", "{file: here.yaml, crop_coefficient: 2}")
    store = run_here(tmp_path, text)
    # 7 mm/day in July.
    taken = [row["evapotranspiration_m3"] for row in store.write_table()]
    assert taken == pytest.approx([68.8 * 0.007 / 240, 2 * 68.8 * 0.007 / 240])


def test_a_directory_of_forecasts_with_two_delays(tmp_path: Path) -> None:
    """With a delay it does not matter when its forecasts were available, without one it does."""
    (tmp_path / "issued").mkdir()
    rows = [f"2021-07-07T0{hour}:00-05:00,0\n" for hour in range(9)]
    header = "issued,available,time,precipitation [mm/h]\n"
    (tmp_path / "issued" / "a.csv").write_text(header + "".join(
        f"2021-07-07T00:00-05:00,2021-07-07T01:30-05:00,{row}" for row in rows
    ))
    file = tmp_path / grid(tmp_path, edit_grid("[published, fao56]", "published").replace(
        "  onoff:\n", ""
    ) + "forecast: [{model: issued, delay: 1}, issued]\n")
    read = read_grid(file)
    write_inputs(read.files.contents, tmp_path)
    known = {}
    for case in read.cases:
        choice = case.inputs.forecast
        (issue,) = read_archive(tmp_path / str(choice.file), case.site, choice.delay)
        known[choice] = f"{issue.available:%H:%M}"
    assert [*known.values()] == ["01:00", "01:30"]


def test_each_input_makes_another_case(tmp_path: Path) -> None:
    """A new input is in the identity without being named there; so are the contents of files."""
    usual = cases_of(tmp_path / grid(tmp_path))[0]
    for parameter in parameters_of(RunInputs):
        other: Any = {parameter.name: "another"}
        case = replace(usual, inputs=replace(usual.inputs, **other))
        assert case.identity != usual.identity, parameter.name
    assert replace(usual, files=dict.fromkeys(usual.files, "another")).identity != usual.identity


def test_only_runs_with_an_archive_depend_on_what_it_contains(tmp_path: Path) -> None:
    text = f"{edit_grid('  onoff:', '  lookahead:')}forecast: [perfect, archive.csv]\n"
    found = []
    for rain in (4.0, 5.0):
        archive(tmp_path, rain)
        found.append(cases_of(tmp_path / grid(tmp_path, text)))
    same = [one.identity == other.identity for one, other in zip(*found, strict=True)]
    assert same == ["archive.csv" not in case.files for case in found[0]]
    assert {*same} == {True, False}


def test_names_of_files(tmp_path: Path) -> None:
    """Next to the grid first, then the package's config/."""
    text = GRID.replace(str(CONFIG / "site.yaml"), "site.yaml")
    text = text.replace(str(WEATHER), "[weather/toronto_2021-*.csv, toronto_2021-07.csv]")
    copy = tmp_path / grid(tmp_path, text)
    assert cases_of(copy)[0].site.a1 == 25.0
    mine = (CONFIG / "site.yaml").read_text().replace("a1: 25.0", "a1: 26.0")
    (tmp_path / "site.yaml").write_text(mine)
    (case, *_) = cases_of(copy)
    assert (case.site.a1, [*case.files]) == (26.0, ["toronto_2021-07.csv"])


def test_gaps_of_a_window(tmp_path: Path) -> None:
    """21 July 2022 lacks an hour of rain: refused, unless the window is set to fill it."""
    july = edit_grid(str(WEATHER), str(DATA / "en_climate_hourly_07-2022.csv"))
    july = july.replace("2021-07-07T02:00", "2022-07-21T11:00").replace("published, ", "")
    file = tmp_path / grid(tmp_path, july)
    refusal(read_grid, file, match="is missing at 2022-07-21T11:00-05:00")
    july = july.replace("hours: 0.25", "hours: 0.02\n    gaps: fill")
    rows = run_here(tmp_path, f"{july}show: [pumped_m3]\n").write_table()
    assert {row["rain_m3"] for row in rows} == {0}
    assert all("2022-07-21T11:00-05:00" in row["weather_notes"] for row in rows)


def test_minimum_discharge_of_a_site_with_a_valve(tmp_path: Path) -> None:
    """It is one for all controllers of a site and weather.

    No run with the irrigation of on/off control has less; another controller irrigates otherwise.
    """
    done = run_here(tmp_path, f"""
site: {{file: {CONFIG / "site_valve.yaml"}, tau: 300.0, M: 1}}
weather: {{file: {WEATHER}, start: 2021-07-07T02:00, hours: 24, evapotranspiration: published}}
initial: {{name: full, cistern: 9.9, roof: 2.6}}
show: [wet_discharge_m3]
controllers:
  onoff: {{outlet: [closed, drain, plan]}}
  anticipating_onoff: {{outlet: plan}}
""")
    assert len(done.bounds) == 1
    for row in done.write_table():
        bound = row["bound_wet_discharge_m3"]
        assert bound >= 0
        assert row["controller"] != "onoff" or bound <= row["wet_discharge_m3"] + 1e-6
        assert row["bound_mains_m3"] == pytest.approx(0.0, abs=1e-6)
