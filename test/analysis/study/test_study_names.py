"""Runs are named by what differs: no two rows or curves have one name, for any variation."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from paper import site_file
from studies import WEATHER, archive, cases_of, grid, record, rows_of, run_here

from greenroof_ros.analysis.case import name_cases

# Windows, forecasts and settings: files with one name in two folders, and numbers that
# differ in late digits.
VARIED = """
site: [north/site.yaml, south/site.yaml]
weather:
  - {file: north/storm.csv, start: 2021-07-07T02:00, hours: 0.01,
     evapotranspiration: [published, fao56]}
  - {file: north/storm.csv, start: 2021-07-07T02:00:01, hours: 0.01, evapotranspiration: published}
  - {file: north/storm.csv, start: 2021-07-07T02:00, hours: 0.01027777777777778}
  - {file: south/storm.csv, start: 2021-07-07T02:00, hours: 0.01}
forecast: [north/archive.csv, south/archive.csv,
           {model: errors, skill: [real, none], seed: [1, 2]}]
initial: low-low
controllers:
  mpc: {weight: [0.001, 0.0010000001], max_command: 1.0}
  onoff: {fraction: 0.5}
"""
# On/off control uses no forecast.
WINDOWS = 2 * (2 + 1 + 1 + 1)
RUNS = WINDOWS * (2 * (2 + 4) + 1)


def test_no_name_occurs_twice(tmp_path: Path) -> None:
    for folder, soil, rain in (("north", 0.5, 4.0), ("south", 0.4, 5.0)):
        place = tmp_path / folder
        place.mkdir()
        site_file(place, z_soil=soil)
        text = WEATHER.read_text().replace("02:00-05:00,0.0,", f"02:00-05:00,{rain},")
        (place / "storm.csv").write_text(text)
        archive(place, rain)
    run_here(tmp_path, VARIED)
    rows = rows_of(tmp_path / "out" / "results.csv")
    assert len(rows) == RUNS
    assert len({row["window"] for row in rows}) == WINDOWS
    # Only seeds share a case.
    seeds: dict[tuple[str, ...], list[str]] = {}
    for row in rows:
        key = row["window"], row["initial"], row["case"]
        seeds.setdefault(key, []).append(row["forecast_seed"])
    assert {frozenset(each) for each in seeds.values()} == {frozenset([""]), frozenset("12")}
    assert all(len(each) == len(set(each)) for each in seeds.values())


def test_the_seasons_of_several_years(tmp_path: Path) -> None:
    """The same days of two years are one window, of each city."""
    for city in ("here", "there"):
        (tmp_path / city).mkdir()
        record(tmp_path / city / "record", (2015, 2016))
    grid(tmp_path, """
site: {file: site.yaml, tau: 600.0}
weather:
  - {file: "here/record/*.csv", start: "{year}-05-01T00:00", year: [2015, 2016],
     hours: [168, 24], evapotranspiration: fao56}
  - {file: "there/record/*.csv", start: "{year}-05-01T00:00", year: [2015, 2016], hours: 168,
     evapotranspiration: fao56}
  - {file: "here/record/2015_*.csv", start: 2015-05-02T00:00, hours: 168, evapotranspiration: fao56}
initial: low-low
controllers: {onoff: , mpc: {forecast: {model: errors, seed: [1, 2]}}}
""")
    names = name_cases(cases_of(tmp_path / "grid.yaml"))
    of_cities = Counter(name["window"] for name in names if name["season"])
    assert [*of_cities.values()] == [2 * 3] * 3
    assert len({name["window"] for name in names}) == 3 + 1
    assert len({name["case"] for name in names}) == 2  # the seeds share one


def test_a_leap_year_does_not_take_the_last_day_of_a_season(tmp_path: Path) -> None:
    hours = "\n".join(
        f"{year}-{month:02}-{day:02}T{hour:02}:00Z,0"
        for year, last in ((2015, 28), (2016, 29)) for month, days in ((2, last), (3, 12))
        for day in range(1, days + 1) for hour in range(24)
    )
    (tmp_path / "rain.csv").write_text(f"time,precipitation [mm/h]\n{hours}\n")
    cases = cases_of(tmp_path / grid(tmp_path, """
site: {file: site.yaml, tau: 3600.0, M: 1, utc_offset: 0.0, monthly_evapotranspiration:
       [[1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]]}
weather: {file: rain.csv, year: [2015, 2016], start: "{year}-02-20T00:00", hours: 480, gaps: fill}
initial: low-low
controllers: {onoff: }
"""))
    assert [case.hours for case in cases] == [480, 504]  # until 11 March
    assert len({name["season"] for name in name_cases(cases)}) == 1
