"""Runs are named by what differs: no two rows or curves have one name, for any variation."""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from pathlib import Path

from paper import site_file
from studies import WEATHER, archive, grid, record, rows_of, run_here

from greenroof_ros.analysis.report.cases import Report
from greenroof_ros.analysis.report.figures import make_figures
from greenroof_ros.analysis.report.page import make_table
from greenroof_ros.analysis.report.sources import find_runs
from greenroof_ros.analysis.study.grid import read_grid
from greenroof_ros.analysis.study.names import Names

# Windows, forecasts, errors and settings: files with one name in two folders, and numbers that
# differ in late digits.
VARIED = """
site: [north/site.yaml, south/site.yaml]
weather:
  - {file: north/storm.csv, start: 2021-07-07T02:00, hours: 0.01,
     evapotranspiration: [published, fao56]}
  - {file: north/storm.csv, start: 2021-07-07T02:00:01, hours: 0.01, evapotranspiration: published}
  - {file: north/storm.csv, start: 2021-07-07T02:00, hours: 0.01027777777777778}
  - {file: south/storm.csv, start: 2021-07-07T02:00, hours: 0.01}
  - file: north/storm.csv
    start: 2021-07-07T02:00
    hours: 0.01
    forecast: [north/archive.csv, south/archive.csv,
               {model: errors, skill: [real, none], seed: [1, 2]}]
initial: low-low
sensor_and_pump: [{roof_noise: 0.0005}, {roof_noise: 0.00050000001}]
controllers:
  mpc: {weight: [0.001, 0.0010000001], max_command: 1.0}
  onoff: {fraction: 0.5}
"""
WINDOWS = 2 * (2 + 1 + 1 + 1)
RUNS = (2 + 1 + 1 + 1 + 2 + 4) * 2 * 2 * (2 + 1)


def write_inputs(directory: Path) -> None:
    """Write two sites, storms and archives of forecasts with the same names."""
    weather, dry = WEATHER.read_text(), "2021-07-07T02:00-05:00,0.0,"
    assert weather.count(dry) == 1
    for folder, soil, rain in (("north", 0.5, 4.0), ("south", 0.4, 5.0)):
        place = directory / folder
        place.mkdir()
        site_file(place, z_soil=soil)
        (place / "storm.csv").write_text(weather.replace(dry, dry.replace("0.0", str(rain))))
        archive(place, rain)


def distinct(labels: Iterable[Hashable], count: int | None = None) -> None:
    """Check that no label occurs twice, and optionally how many there are."""
    there = list(labels)
    twice = [label for label in set(there) if there.count(label) > 1]
    assert not twice
    assert there and (count is None or len(there) == count)


def test_no_name_occurs_twice(tmp_path: Path) -> None:
    """In the study's table, whose names the terminal shows; in the report's tables and figures."""
    write_inputs(tmp_path)
    run_here(tmp_path, VARIED)
    rows = rows_of(tmp_path / "out" / "results.csv")
    columns = list(rows[0])
    given = columns[4 : columns.index("status")]
    distinct((tuple(row[column] for column in given) for row in rows), RUNS)
    assert {row["site"] for row in rows} == {"site.yaml", "south-site.yaml"}
    assert {row["weather"] for row in rows} == {"storm.csv", "south-storm.csv"}
    assert {row["season"] for row in rows} == {""}
    assert len({row["window"] for row in rows}) == WINDOWS
    # Only seeds share a case.
    cases: dict[tuple[str, ...], set[str]] = {}
    for row in rows:
        key = row["window"], row["initial"], row["case"]
        cases.setdefault(key, set()).add(row["forecast_seed"])
    assert sum(map(len, cases.values())) == RUNS
    assert {frozenset(seeds) for seeds in cases.values()} == {frozenset([""]), frozenset("12")}

    report = Report(find_runs([tmp_path / "out"]))
    distinct((name, window) for name, window, *_ in make_table(report).texts())
    figures = list(make_figures(report))
    distinct(figure.title for figure in figures)
    distinct(figure.name for figure in figures)


def test_the_seasons_of_several_years(tmp_path: Path) -> None:
    """A season of a week or more in two years is one window; of one year it has its own start."""
    record(tmp_path / "record", (2015, 2016))
    grid(tmp_path / "record", """
site: {file: site.yaml, tau: 600.0}
weather:
  - {file: "{year}_*.csv", start: "{year}-05-01T00:00", year: [2015, 2016], hours: [168, 24],
     evapotranspiration: fao56}
  - {file: "2015_*.csv", start: 2015-05-02T00:00, hours: 168, evapotranspiration: fao56}
bound_block: 0
forecast: {model: errors, skill: real, seed: [1, 2]}
initial: low-low
controllers: {onoff: {forecast: perfect}, mpc: }
""")
    cases = read_grid(tmp_path / "record" / "grid.yaml")
    names = [Names(cases).columns(case) for case in cases]
    assert {name["season"] for name in names} == {"from 01 May 00:00", ""}
    assert len({name["window"] for name in names}) == 1 + 2 + 1
    seasons = [name["case"] for name in names if name["season"]]
    assert {case: seasons.count(case) for case in seasons} == {
        "onoff, forecast perfect": 2, "mpc, forecast errors skill real": 4,
    }
