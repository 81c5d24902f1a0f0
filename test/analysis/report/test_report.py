"""Reports of studies: cases and their order, means and ranges by hand, figures, the command."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path
from typing import Any

from inputs import command, figures_of, report_of, seeded_rows, simulate, study_of, write_study
from places import CONFIG
from refusals import refusal
from studies import record, run_here

from greenroof_ros.analysis.report.cases import BOUND, TOTAL
from greenroof_ros.analysis.report.page import answer, make_full_table, make_notes, make_table

YEARS = range(2015, 2026)
ONOFF = {year: 100.0 + 10 * (year - 2015) for year in YEARS}


def rows(case: str, seed: int | None, totals: dict[int, float], **more: Any) -> list[Any]:
    """Return runs of 16 days, one for each year."""
    forecast: dict[str, Any] = {"forecast": "perfect"}
    if seed is not None:
        forecast = {"forecast": "errors", "forecast_skill": "real", "forecast_seed": seed}
    return [
        {
            "site": "site.yaml", "weather": f"{year}.csv", "start": f"{year}-05-01T00:00:00-05:00",
            "hours": 384.0, "evapotranspiration": "fao56", **forecast, "controller": "onoff",
            "initial": "low-low", "cistern_m3": 57.7, "roof_m3": 2.4, "status": "done",
            TOTAL: total, "near_target_hours": 96.0, "mains_m3": 2.0 + (seed or 0),
            "bound_m3": 50.0, "window": "May", "season": "from 01 May", "case": case, **more,
        }
        for year, total in totals.items()
    ]


def test_means_by_hand(tmp_path: Path) -> None:
    """Over years, in each over its seeds; ranges over all runs; the better case first."""
    lower = {year: total - 20 for year, total in ONOFF.items()}
    onoff = rows("on/off", None, ONOFF)
    onoff[0]["roof_retention_share"], onoff[1]["roof_retention_share"] = 0.5, 0.75
    report = study_of(
        tmp_path / "study", *onoff, *rows("other", 1, ONOFF), *rows("other", 2, lower)
    )
    table = make_table(report)
    assert table.headings() == [
        "case", "total deviation (m³)", "runs", "difference from on/off (m³)",
        "years in which it is better",
    ]
    assert table.texts() == [
        ["other", "140 (80 to 200)", "22", "-10", "11 of 11"],
        ["on/off", "150 (100 to 200)", "11", "", ""], [BOUND, "50", "", "", ""],
    ]
    assert table.marked == {0}
    # The mean is over years with a share; without one there is no number.
    full = {name: texts for name, *texts in make_full_table(report).texts()}  # type: ignore[union-attr]
    assert full["retention of the roof (%)"] == ["none", "62 (50 to 75)"]
    assert answer(report) == (
        "Best by total deviation: other. Means: total deviation 140 (80 to 200) m³. With on/off: "
        "total deviation 150 (100 to 200) m³."
    )
    assert list(figures_of(report)) == ["comparison", "seasons"]


def test_a_study_shows_what_it_asks(tmp_path: Path) -> None:
    """By default the wet-weather discharge, with all that reaches the sewer, and mains water.

    A study can ask for something else; more is better for some metrics.
    """
    results = {"discharge_m3": 80.0, "retention_share": 0.27}
    runs = [
        *rows("closed", None, {2020: 1.0, 2021: 1.0}, wet_discharge_m3=30.0, **results),
        *rows("drain", None, {2020: 2.0, 2021: 2.0}, wet_discharge_m3=10.0, **results),
        *rows("worse", None, {2020: 2.0}, wet_discharge_m3=40.0, near_target_hours=99.0),
    ]
    for run, mains in zip(runs, (2.0, 2.0, 6.0, 8.0, 9.0), strict=True):
        run |= {"mains_m3": mains, "bound_wet_discharge_m3": 8.0, "bound_mains_m3": 5.0}
    study_of(tmp_path / "study", *runs)
    shutil.copy(CONFIG / "site_valve.yaml", tmp_path / "study" / "configuration" / "site.yaml")
    report = report_of(tmp_path / "study")
    table = make_table(report)
    assert table.headings()[:5] == [
        "case", "discharge in wet weather (m³)", "discharge (m³)", "retention (%)",
        "mains water used (m³)",
    ]
    assert [texts[:5] for texts in table.texts()] == [
        ["drain", "10", "80", "27", "7 (6 to 8)"], ["closed", "30", "80", "27", "2"],
        ["worse", "40", "none", "none", "9"], [BOUND, "8", "", "", "5"],
    ]
    assert table.marked == {0, 1}
    asked = tmp_path / "study" / "configuration" / "study.json"
    asked.write_text('{"show": ["near_target_hours"]}')
    report = report_of(tmp_path / "study")
    assert [name for name, *_ in make_table(report).texts()] == ["worse", "closed", "drain"]
    asked.write_text('{"show": ["nothing"]}')
    refusal(report_of, tmp_path / "study", match="show = 'nothing'")


def test_seeds_belong_together(tmp_path: Path) -> None:
    """A case of 25 seeds in each of four places: mean and range by hand."""
    seeded = seeded_rows(simulate("onoff", "0.5", "low-low").row)
    seeded[0] |= {"status": "failed", "error": "no solution", TOTAL: ""}
    report = study_of(tmp_path / "study", *seeded)
    assert (len(report.cases), len(report.places), len(report.sources.failed)) == (24, 4, 1)
    (text,) = (
        texts for texts in make_table(report).texts()
        if texts[0] == "onoff fraction 0.5 skill none" and "from low-low" in texts[1]
        and "07-07" in texts[1]
    )
    assert text[2:] == ["1013 (1001 to 1025)", "25"]
    assert "in 4 of 4 comparisons" in answer(report)
    assert isinstance(make_full_table(report), str)
    (note,) = (note for note in make_notes(report) if "solver" in note)
    assert note.endswith("up to 25 (599 of 599 runs)")
    (panel, *_) = figures_of(report)["comparison"].panels
    shown = panel.chart.to_dict()["datasets"]
    assert {"case": "onoff fraction 0.5 skill none", "x": 1013, "x_low": 1001, "x_high": 1025} in [
        row for data in shown.values() for row in data
    ]


def test_what_no_real_pump_achieves_is_marked(tmp_path: Path) -> None:
    row = {**simulate("onoff", "0.5", "low-low").row, "max_command": 2.0}
    texts = dict(make_full_table(study_of(tmp_path / "study", row)).texts())  # type: ignore[union-attr]
    assert texts["maximum command"] == "2 ⚠"


def test_a_study_of_seasons(tmp_path: Path) -> None:
    """A case has the seeds of its forecasts in every year."""
    record(tmp_path / "record", (2015, 2016))
    run_here(tmp_path / "record", """
site: {file: site.yaml, tau: 600.0}
weather:
  - {file: "{year}_*.csv", start: "{year}-05-01T00:00", year: {from: 2015, to: 2016}, hours: 192,
     evapotranspiration: fao56}
bound_block: 0
forecast: {model: errors, skill: real, seed: {from: 1, to: 2}}
initial: low-low
controllers:
  onoff: {forecast: perfect}
  mpc: {weight: 0.01}
""")
    report = report_of(tmp_path / "record" / "out")
    assert list(figures_of(report)) == ["comparison", "seasons"]
    assert sorted(len(case.runs) for case in report.cases) == [2, 4]
    for case in report.cases:
        assert [*case.years] == [2015, 2016]


def test_the_command(tmp_path: Path) -> None:
    """A page, each figure twice, the runs without results with their errors.

    A previous report is replaced.
    """
    example = simulate("onoff", "2", "low-low", "0.01")
    failed = {**example.row, "status": "failed", "error": "solver: <gave up>", TOTAL: ""}
    not_run = {**failed, "parameter:fraction": "3", "status": "not run", "error": ""}
    runs = (example.row, example.trajectory), (failed, None), (not_run, None)
    report = write_study(tmp_path / "study", runs) / "report"
    (report / "figures").mkdir(parents=True)
    (report / "figures" / "water-7.svg").touch()
    done = command("study", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(report / "report.html") in done.stdout
    assert "failed or were not started: 2" in done.stdout
    text = (report / "report.html").read_text()
    for words in ("solver: &lt;gave up&gt;", "2 of 3 runs have no results", "<td>not run</td>"):
        assert words in text
    assert {path.name for path in (report / "figures").iterdir()} == {"time-1.svg", "time-1.png"}
    picture = (report / "figures" / "time-1.png").read_bytes()
    width, height = struct.unpack(">II", picture[16:24])
    assert 800 < width <= 2800 and height > 300
