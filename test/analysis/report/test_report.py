"""Reports of studies: exact results, cases, the data of each figure, and the command."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from inputs import (
    Simulated,
    command,
    figures_of,
    report_of,
    seeded_rows,
    simulate,
    study_of,
    write_study,
)

from greenroof_ros.analysis.report.groups import TOTAL
from greenroof_ros.analysis.report.tables import make_notes, make_tables
from greenroof_ros.analysis.report.trajectories import MAX_POINTS


@pytest.fixture(scope="module")
def simulated() -> list[Simulated]:
    """Two settings of each controller from two initial states."""
    return [
        simulate(controller, option, initial)
        for initial in ("low-low", "high-low")
        for controller, options in (("mpc", ("0.00001", "0.001")), ("onoff", ("0.5", "2")))
        for option in options
    ]


def test_what_follows_from_results(tmp_path: Path) -> None:
    """By hand: storage and unexplained volume; the last sample counts for a tick."""
    row = {
        **simulate("onoff", "0.5", "low-low").row, "cistern_m3": 60.0, "roof_m3": 2.0,
        "final_cistern_m3": 55.0, "final_roof_m3": 3.5, "rain_cistern_m3": 1.0, "pumped_m3": 4.0,
        "outflow_m3": 2.5, "rain_roof_m3": 0.5, "evapotranspiration_m3": 2.0, "drainage_m3": 0.75,
        "electric_energy_kwh": 2.0, "near_target_hours": 0.1, "hours": 0.2, "bound_m3": 100.0,
        "max_command": 2.0, "fallbacks": 3, "excess_starts": 11, TOTAL: 150.0,
    }
    report = study_of(tmp_path / "study", row)
    judged = report.cases[0].row
    assert (judged["cistern_change_m3"], judged["roof_change_m3"]) == (-5, 1.5)
    assert judged["cistern_residual_m3"] == pytest.approx(-5 - (1 - 4 - 2.5))
    assert judged["roof_residual_m3"] == pytest.approx(1.5 - (0.5 + 4 - 2 - 0.75))
    assert judged["ratio"] == 1.5
    # A single run has a row for each quantity; what no real pump achieves is marked.
    shown = {cell[""]: cell["value"] for rows in make_tables(report).values() for cell in rows}
    assert shown["relative to the minimum possible (1)"] == "1.5000"
    assert shown["maximum command (1)"] == "2 ⚠"
    assert {"001: 3", "001: 11"} <= {
        listed for runs in make_notes(report).values() for listed in runs
    }


def test_figures_of_a_study(tmp_path: Path, simulated: list[Simulated]) -> None:
    """Lines from samples, totals at each setting with their bound."""
    bounds = {"low-low": 200.0, "high-low": 100.0}
    report = report_of(write_study(tmp_path / "study", [
        ({**example.row, "bound_m3": bounds[example.row["initial"]]}, example.trajectory)
        for example in simulated
    ]))
    figures = figures_of(report)
    # Four lines in each panel.
    assert list(figures) == ["deviation-1", "water-1", "flows-1", "water-2", "flows-2"]
    for example in simulated[:4]:
        name = example.row["controller"]
        key = "weight" if name == "mpc" else "fraction"
        label = f"{name} {key} {example.row[f'parameter:{key}']}"
        for figure, quantity, factor in (
            ("water", "roof", 1000 / 68.8), ("water", "cistern", 1 / 25.0),
            ("flows", "command", 1.0), ("flows", "pump_flow", 1000.0),
        ):
            rows = figures[f"{figure}-1"].data[f"{quantity}-1"]
            rows = [row for row in rows if row["controller"] == label]
            values = factor * getattr(example.trajectory, quantity)
            if figure == "flows":
                values = np.append(values[:-1], values[-2])  # the last is not applied, nor drawn
            assert 100 < len(rows) <= MAX_POINTS
            ticks = [round((row["t"] - rows[0]["t"]) / 1000) for row in rows]
            assert [row["v"] for row in rows] == pytest.approx(values[ticks], rel=1e-6, abs=1e-12)
            assert max(row["v"] for row in rows) == pytest.approx(values.max(), rel=1e-6)
    totals = [row["v"] for rows in figures["deviation-1"].data.values() for row in rows]
    assert totals == pytest.approx([example.row[TOTAL] for example in simulated], rel=1e-6)
    for panel, bound in zip(figures["deviation-1"].panels, (200.0, 100.0), strict=True):
        assert [{"v": bound}] in panel.sized().to_dict()["datasets"].values()


def test_seeds_belong_together(tmp_path: Path) -> None:
    """A case of 25 seeds: their mean and worst, by hand.

    The runs of another that failed are counted, and a perfect forecast is a case of one.
    """
    rows = seeded_rows(simulate("onoff", "0.5", "low-low").row)
    rows[0] |= {"status": "failed", "error": "no solution", TOTAL: ""}
    report = study_of(tmp_path / "study", *rows)
    assert len(report.cases) == 24
    tables = make_tables(report)
    (cells,) = [
        row for row in tables["Over seeds and years"]
        if row["case"] == "onoff fraction 0.5 skill none" and row["from"] == "low-low"
        and "07-07" in row["window"]
    ]
    assert list(cells.values())[3:] == ["25", "1013.00", "1025.00"]
    assert tables["Over seeds and years"][0]["runs"] == "24, 1 failed ⚠"
    shown = next(row for row in tables["Results"] if row["case"] == cells["case"])
    assert shown["relative to the minimum possible (1)"] == "2.0260"
    figure = figures_of(report)["deviation-1"]
    assert {
        (row["v"], row["low"], row["high"])
        for row in figure.data["deviation-1-1"] if row["case"] == cells["case"]
    } == {(1013, 1001, 1025)}
    # A case without its bound in one run has no ratio.
    for row in rows[:3]:
        row["bound_m3"] = ""
    report = study_of(tmp_path / "other", *rows)
    assert report.cases[0].row["ratio"] is None and report.cases[1].row["ratio"] is not None


def test_any_controller_with_any_parameters(tmp_path: Path) -> None:
    """With numbers and words, or without any; more lines than colours are drawn apart."""
    example = simulate("mpc", "0.001", "low-low", "0.01")
    report = report_of(write_study(tmp_path / "study", [
        ({**example.row, "parameter:weight": "", "controller": name, "case": case},
         example.trajectory)
        for name, case in (("mine", "mine"), *(("mpc", f"mpc {number}") for number in range(7)))
    ]))
    assert [name for name in figures_of(report) if "water" in name] == [
        "water-1-mine", "water-1-mpc"
    ]
    assert report.cases[0].label == "mine"


# --- the command ---------------------------------------------------------------------------------


def test_study(tmp_path: Path) -> None:
    """A page, each figure twice, the failed runs with their errors, and where the page is.

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
    for words in ("solver: &lt;gave up&gt;", "2 of 3 runs failed", "<td>not run</td>"):
        assert words in text
    names = {path.stem for path in (report / "figures").iterdir()}
    assert names == {"water-1", "flows-1"}
    for name in names:
        assert (report / "figures" / f"{name}.svg").read_text().startswith("<svg")
        picture = (report / "figures" / f"{name}.png").read_bytes()
        width, height = struct.unpack(">II", picture[16:24])
        assert 800 < width <= 2800 and height > 300
    payload = json.loads(text.partition('id="payload">')[2].partition("</script>")[0])
    assert {panel["figure"] for panel in payload["panels"]} == names
