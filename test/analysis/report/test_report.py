"""Reports of studies: cases and their order, means and ranges by hand, figures, the command."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path
from typing import Any

from inputs import command, figures_of, page_of, report_of, simulate, study_of, write_study
from places import CONFIG

import greenroof_ros as gr
from greenroof_ros.analysis.report.page import (
    _columns,
    answer,
    make_full_table,
    make_notes,
    make_table,
)
from greenroof_ros.analysis.report.runs import TOTAL

ONOFF = {year: 100.0 + 10 * (year - 2015) for year in range(2015, 2026)}


def rows(case: str, seed: int | None, totals: dict[int, float], **more: Any) -> list[Any]:
    """Return runs of 16 days, one for each year."""
    return [
        {
            "site": "site.yaml", "start": f"{year}-05-01T00:00:00-05:00", "window": "May",
            "season": "from 01 May", "initial": "low-low", "case": case, "forecast_seed": seed,
            "status": "done", "error": "", TOTAL: total, "mains_m3": 2.0 + (seed or 0),
            "near_target_hours": 96.0, "pumped_m3": 7.0, "bound_m3": 50.0, **more,
        } for year, total in totals.items()
    ]


def test_means_by_hand(tmp_path: Path) -> None:
    """Over years, in each over its seeds; ranges over all runs; the better case first."""
    lower = {year: total - 20 for year, total in ONOFF.items()}
    onoff = rows("on/off", None, ONOFF)
    onoff[0]["roof_retention_share"], onoff[1]["roof_retention_share"] = 0.5, 0.75
    report = study_of(
        tmp_path / "study", *onoff, *rows("other", 1, ONOFF), *rows("other", 2, lower)
    )
    table = make_table(report, _columns(report))
    assert table.headings() == ["case", "total deviation (m³)", "runs"]
    assert table.texts() == [
        ["other", "140 (80 to 200)", "22"], ["on/off", "150 (100 to 200)", "11"],
        ["minimum possible", "50", ""],
    ]
    assert table.marked == {0}
    # The mean is over years with a share; without one there is no number.
    full = {name: texts for name, *texts in make_full_table(report).texts()}
    assert full["retention of the roof (%)"] == ["none", "62 (50 to 75)"]
    assert answer(report) == (
        "Best by total deviation: other. For other: total deviation 140 (80 to 200) m³. "
        "For on/off: total deviation 150 (100 to 200) m³. Site: site.yaml; period: May; "
        "seasons: 2015 to 2025."
    )
    (figure,) = figures_of(report).values()
    assert figure.name == "comparison"
    figure.save(tmp_path)
    assert "\N{MINUS SIGN}" not in (tmp_path / "comparison.svg").read_text()  # axes begin at 0


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
    table = make_table(report, _columns(report))
    assert table.headings()[1:5] == [
        "discharge in wet weather (m³)", "discharge (m³)", "retention (%)", "mains water used (m³)",
    ]
    assert [texts[:5] for texts in table.texts()] == [
        ["drain", "10", "80", "27", "7 (6 to 8)"], ["closed", "30", "80", "27", "2"],
        ["worse", "40", "none", "none", "9"], ["minimum possible", "8", "", "", "5"],
    ]
    assert table.marked == {0, 1}
    data = figures_of(report)["comparison"].panels[0].chart.to_dict()["datasets"]
    points = [row for values in data.values() for row in values]
    assert {"case": "minimum possible", "wet_discharge_m3": 8, "mains_m3": 5} in points
    asked = tmp_path / "study" / "configuration" / "study.json"
    asked.write_text('{"show": ["near_target_hours"]}')
    report = report_of(tmp_path / "study")
    names = [name for name, *_ in make_table(report, report.show).texts()]
    assert names == ["worse", "closed", "drain"]


def test_water_stress_is_shown_where_it_differs(tmp_path: Path) -> None:
    """A case that lets the plants dry out does not win without a word about it."""
    dry = rows("dry", None, {2020: 1.0}, stress_hours=3155.0, rain_roof_m3=6.88)
    wet = rows("wet", None, {2020: 2.0}, stress_hours=0.0)
    report = study_of(tmp_path / "study", *wet, *dry)
    assert answer(report) == (  # 6.88 m3 on the 68.8 m2 of the paper's roof
        "Best by total deviation: dry. For dry: total deviation 1 m³; water stress 3155 h. "
        "For wet: total deviation 2 m³; water stress 0 h. Site: site.yaml; period: May; "
        "seasons: 2020 to 2020; "
        "rain on the roof: 100 mm."
    )
    assert [texts[2] for texts in make_table(report, _columns(report)).texts()[:2]] == ["3155", "0"]
    assert "--trajectory-every 600" in page_of(report)
    alike = study_of(tmp_path / "alike", *wet, *rows("dry", None, {2020: 1.0}, stress_hours=0.0))
    assert "water stress" not in answer(alike)


def test_places_are_named_by_what_differs(tmp_path: Path) -> None:
    """Windows and initial states, each of which has a best case; assumptions have both ends."""
    a, b = rows("a", None, {2020: 1.0}), rows("b", None, {2020: 2.0}, limited_steps=4)
    report = study_of(
        tmp_path / "study", *a, *b,
        *rows("a", None, {2020: 4.0}, window="June", initial="half"),
        *rows("b", None, {2020: 3.0}, window="June", initial="half"),
        *rows("b", None, {2020: 3.0}, window="July", status="failed", error="no <solution>"),
    )
    assert answer(report).startswith(
        "Best by total deviation: a (May, initial state low-low), b (June, initial state half). "
        "For May, initial state low-low: total deviation 1 m³. Site: site.yaml; "
        "period: May, June; "
    )
    assert make_notes(report)[1:] == ["forecast: not known (4 of 4 runs)", (
        "time steps in which a tank contained less water than was demanded (1 of 4 runs)"
    )]
    text = page_of(report)
    for words in (
        "b, July, initial state low-low</th><td>no &lt;solution&gt;",
        "coefficient of the solar radiation that was not measured</th><td>0.16</td><td>0.19</td>",
    ):
        assert words in text


def test_a_study_of_seasons(tmp_path: Path) -> None:
    """A case has the seeds of its forecasts in every year."""
    gr.study({
        "site": gr.read_site(tau=600.0), "evapotranspiration": "monthly", "hours": 192,
        "weather": str(CONFIG / "weather" / "toronto_2014-2025.csv.gz"), "gaps": "fill",
        "start": ["2015-05-01", "2016-05-01"], "controller": ["onoff", "anticipating_onoff"],
        "forecast": "errors", "forecast_seed": [1, 2],
    }, output=tmp_path / "study")
    report = report_of(tmp_path / "study")
    assert list(figures_of(report)) == ["comparison"]
    (place,) = report.places
    assert sorted(place["runs"]) == [2, 4]
    assert sorted(report.years["year"]) == [2015, 2015, 2016, 2016]


def test_the_command(tmp_path: Path) -> None:
    """A page, each figure twice, the runs without results; a previous report is replaced."""
    example = simulate("onoff", "2", "low-low", "0.01")
    failed = {**example.row, "status": "failed", "error": "no solution", TOTAL: ""}
    report = write_study(tmp_path / "study", [
        (example.row, example.trajectory), (failed, None),
    ]) / "report"
    (report / "figures").mkdir(parents=True)
    (report / "figures" / "water-7.svg").touch()
    done = command("study", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(report / "report.html") in done.stdout
    assert "For onoff fraction 2: total deviation" in done.stdout
    assert "failed or did not finish: 1" in done.stdout
    assert "<td>no solution</td>" in (report / "report.html").read_text()
    assert {path.name for path in (report / "figures").iterdir()} == {"time.svg", "time.png"}
    picture = (report / "figures" / "time.png").read_bytes()
    width, height = struct.unpack(">II", picture[16:24])
    assert 800 < width <= 2800 and height > 300
