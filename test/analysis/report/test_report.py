"""Reports of studies: cases and their order, means and ranges by hand, figures, the command."""

from __future__ import annotations

import math
import shutil
import struct
from collections import Counter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from commands import run_command
from graphs import environment
from inputs import NAMES, START, figures_of, report_of, simulate, study_of, write_study
from paper import PAPER_SITE
from places import CONFIG

from greenroof_ros.analysis.figures import COLOURS, Figure
from greenroof_ros.analysis.report.figures import (
    MAX_POINTS,
    draw_over_time,
    overlay_simulations,
    select_samples,
)
from greenroof_ros.analysis.report.page import (
    _columns,
    answer,
    make_full_table,
    make_table,
)
from greenroof_ros.analysis.report.runs import TOTAL
from greenroof_ros.results.trajectory import Trajectory

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
    assert table.texts() == [
        ["other", "140 (80 to 200)", "22"], ["on/off", "150 (100 to 200)", "11"],
        ["minimum possible", "50", ""],
    ]
    assert table.marked == {0}
    # The mean is over years with a share; without one there is no number.
    full = {name: texts for name, *texts in make_full_table(report).texts()}
    assert full["retention of the roof (%)"] == ["none", "62 (50 to 75)"]
    assert answer(report).startswith("Best by total deviation: other. ")
    assert list(figures_of(report)) == ["comparison"]


def test_cases_that_are_alike_are_counted(tmp_path: Path) -> None:
    """Without those of which the result is not known."""
    values = {"a": 1.0, "b": 1.0 + 1e-9, "c": 2.0, "unknown": None}
    cases = [row for name, value in values.items() for row in rows(name, None, {2020: value})]
    report = study_of(tmp_path / "study", *cases)
    assert answer(report).startswith("Best by total deviation: a (and 1 other alike). ")


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
        "seasons: 2020 to 2020; rain on the roof: 100 mm; forecasts, if used: not known."
    )
    assert [texts[2] for texts in make_table(report, _columns(report)).texts()[:2]] == ["3155", "0"]
    alike = study_of(tmp_path / "alike", *wet, *rows("dry", None, {2020: 1.0}, stress_hours=0.0))
    assert "water stress" not in answer(alike)


def test_the_command(tmp_path: Path) -> None:
    """A page, each figure twice, the runs without results; a previous report is replaced."""
    example = simulate("onoff", "2", "low-low", "0.01")
    failed = {**example.row, "status": "failed", "error": "no solution", TOTAL: ""}
    report = write_study(tmp_path / "study", [
        (example.row, example.trajectory), (failed, None),
    ]) / "report"
    (report / "figures").mkdir(parents=True)
    (report / "figures" / "water-7.svg").touch()
    done = run_command("report", "study", cwd=tmp_path, env=environment(0))
    assert done.returncode == 0, done.stderr
    assert str(report / "report.html") in done.stdout
    assert "For onoff fraction 2: total deviation" in done.stdout
    assert "failed or did not finish: 1" in done.stdout
    assert "<td>no solution</td>" in (report / "report.html").read_text()
    assert {path.name for path in (report / "figures").iterdir()} == {"time.svg", "time.png"}
    picture = (report / "figures" / "time.png").read_bytes()
    width, height = struct.unpack(">II", picture[16:24])
    assert 800 < width <= 2800 and height > 300


VALUES: dict[str, list[float]] = {
    "zeros": [0.0] * 3, "constant": [2.0] * 3,
    "some missing": [1.0, math.nan, math.inf], "all missing": [math.nan] * 3,
}


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES.keys())
def test_runs_of_any_values(tmp_path: Path, values: list[float]) -> None:
    """Every figure is drawn: of a run in which it neither rained nor pumped, for one."""
    trajectory = Trajectory(start=START, **{
        **{name: np.array(values) for name in NAMES}, "time": np.arange(float(len(values))),
    })
    runs = {"mpc": (PAPER_SITE, trajectory)}
    Figure("time", "", "", tuple(draw_over_time(runs)), 2).save(tmp_path)
    assert (tmp_path / "time.svg").read_text().startswith("<svg")
    flows = any(value > 0 for value in values[:-1])  # the last one never held
    # What reaches the sewer, and the opening of the valve.
    assert len(overlay_simulations(runs).vconcat) == 4 + 2 * flows


@pytest.mark.parametrize("names", [["onoff"], ["onoff", "mpc"]])
def test_every_run_has_a_visible_line(tmp_path: Path, names: list[str]) -> None:
    """Each line has a colour in the drawing, also that of a single run, and none is shared."""
    trajectory = Trajectory(start=START, **{
        **{name: np.array([1.0, 2.0, 3.0]) for name in NAMES}, "time": np.arange(3.0),
    })
    runs = dict.fromkeys(names, (PAPER_SITE, trajectory))
    Figure("time", "", "", tuple(draw_over_time(runs)), 2).save(tmp_path)
    overlay_simulations(runs).save(tmp_path / "chart.svg")
    for file in tmp_path.glob("*.svg"):
        groups = [each for each in ElementTree.parse(file).iter() if (
            each.get("class", "").startswith("mark-line")
        )]
        _, *strokes = (path.get("stroke") for group in groups for path in group)  # first the rain's
        # In roof, cistern, pump, sewer and valve.
        assert Counter(strokes) == dict.fromkeys(COLOURS[: len(names)], 5), file


def test_thinning_keeps_extremes() -> None:
    """A peak of one sample among 43,200 is drawn, and so are both ends; of few, all are."""
    values = np.sin(np.arange(43_200) / 1000)
    values[12_345], values[20_001] = 7.0, -7.0
    index = select_samples(values)
    assert len(index) <= MAX_POINTS + 2
    assert {0, 12_345, 20_001, 43_199} <= set(index.tolist())
    assert select_samples(np.arange(499.0)).tolist() == list(range(499))
