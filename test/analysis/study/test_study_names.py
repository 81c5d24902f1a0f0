"""Runs are named by what differs: no two rows or curves have one name, for any variation."""

from __future__ import annotations

import shutil
from collections.abc import Hashable, Iterable
from pathlib import Path

import pytest
from paper import site_file
from studies import WEATHER, archive, rows_of, run_here

from greenroof_ros.analysis.report.figures import make_figures
from greenroof_ros.analysis.report.groups import Report
from greenroof_ros.analysis.report.run import Assumptions
from greenroof_ros.analysis.report.sources import find_runs
from greenroof_ros.analysis.report.tables import make_tables
from greenroof_ros.commands.study import Names, show

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
    forecast: [persistence, north/archive.csv, south/archive.csv,
               {model: errors, skill: [real, worse], seed: [1, 2]}]
initial: low-low
sensor_pump_errors: [{roof_noise: 0.0005}, {roof_noise: 0.00050000001}]
controllers:
  mpc: {weight: [0.001, 0.0010000001], max_command: 1.0, site: north/site.yaml}
  onoff: {fraction: 0.5}
"""
WINDOWS = 2 * (2 + 1 + 1 + 1 + 3) * 2  # without the windows of many seeds
RUNS = (2 + 1 + 1 + 1 + 3 + 4) * 2 * (3 + 1)


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


def judged(*paths: Path) -> Report:
    """Read and judge runs."""
    return Report(find_runs(list(paths), None), Assumptions())


# The cells that are names in the rows of a figure's data: by the start of the data's name.
NAMES = {
    "balance": ("run", "term"), "forecast": ("series", "skill", "amount"),
    **dict.fromkeys(("total", "time", "energy", "pump-starts"), ("setting",)),
}


def test_no_name_occurs_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the study's table and on the terminal; in the report's tables, figures and headings."""
    write_inputs(tmp_path)
    store = run_here(tmp_path, VARIED)
    rows = rows_of(tmp_path / "out" / "results.csv")
    columns = list(rows[0])
    given = columns[1 : columns.index("status")]
    distinct((tuple(row[column] for column in given) for row in rows), RUNS)
    assert {row["site"] for row in rows} == {"site.yaml", "south-site.yaml"}
    assert {row["weather"] for row in rows} == {"storm.csv", "south-storm.csv"}
    distinct(map(Names(store.cases).name, store.cases), RUNS)

    monkeypatch.setenv("COLUMNS", "400")
    show(store.cases, store.write_tables(), store.directory)
    printed = capsys.readouterr().out.split("Mean deviation")[1:]
    # Titles wrap.
    distinct((" ".join(table.partition("┏")[0].split()) for table in printed), 2 * 5)
    for table in printed:
        lines = [line.split("│")[1:3] for line in table.splitlines() if line.startswith("│")]
        distinct(map(tuple, lines))

    report = judged(tmp_path / "out")
    tables = make_tables(report)
    distinct((table.name for table in tables), 9)
    for table in tables:
        named = [
            place for place, name in enumerate(table.header)
            if name not in ("run", "seeds") and not name.endswith(")")
        ]
        distinct(tuple(row[place].text for place in named) for row in table.rows)
    distinct(map(report.heading, report.windows()), WINDOWS)

    figures = list(make_figures(report))
    distinct(figure.title for figure in figures)
    for figure in figures:
        distinct(str(panel.title) for panel in figure.panels)
        for dataset, drawn in figure.data.items():
            if dataset.startswith(("command", "pump_flow", "cistern", "roof")):  # one curve a run
                shown = {row["setting"] for row in drawn}
                assert len(shown) == (2 if dataset.endswith("mpc") else 1)
            for name in filter(dataset.startswith, NAMES):
                distinct(tuple(row[key] for key in NAMES[name]) for row in drawn)


def test_two_studies_that_use_one_name_for_two_things(tmp_path: Path) -> None:
    """Site, weather, forecasts and a state with equal names differ: the study's name is added."""
    text = """
site: site.yaml
weather: {file: storm.csv, start: 2021-07-07T02:00, hours: 0.01, forecast: archive.csv}
initial: [low-low, {name: dry, cistern: 40.0, roof: 0.5}]
controllers: {onoff: }
"""
    write_inputs(tmp_path)
    for folder, roof in (("north", "0.5"), ("south", "0.6")):
        place = tmp_path / folder
        run_here(place, text.replace("roof: 0.5", f"roof: {roof}"))
        place.joinpath("out").rename(place.with_name(f"of-{folder}"))
    both = judged(tmp_path / "of-north", tmp_path / "of-south")
    named = [
        [window[fact] for fact in ("site", "weather", "forecast")] for window in both.windows()
    ]
    assert named == [
        [f"{name} (of-{folder})" for name in ("site.yaml", "storm.csv", "archive.csv")]
        for folder in ("north", "south")
    ]
    assert both.initials == ["low-low", "dry (of-north)", "dry (of-south)"]
    # What is equal in both is compared.
    shutil.copytree(tmp_path / "of-north", tmp_path / "again")
    again = judged(tmp_path / "of-north", tmp_path / "again")
    assert len(again.windows()) == 1
    assert again.initials == ["low-low", "dry"]
