"""Reports of studies: exact results, the data of each figure, seeds, and the command."""

from __future__ import annotations

import dataclasses
import json
import re
import struct
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from inputs import (
    NAMES,
    START,
    Simulated,
    command,
    ended_run,
    figures_of,
    page_of,
    report_of,
    seeded_rows,
    simulate,
    study_of,
    write_study,
)
from paper import PAPER_SITE, exact_flows, smooth_rates

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.metrics import METRICS, NEAR_TARGET
from greenroof_ros.recording.trajectory import Trajectory
from greenroof_ros.report.__main__ import _former_report
from greenroof_ros.report.bags import MOST_POINTS, drawn, near_hours, thin
from greenroof_ros.report.figures import is_figure, make_figures
from greenroof_ros.report.groups import SEEDS, Report
from greenroof_ros.report.pump_figures import pump_smoothing
from greenroof_ros.report.tables import make_tables
from greenroof_ros.report.words import sentences

TOTAL = "total_deviation_m3"


@pytest.fixture(scope="module")
def simulated() -> list[Simulated]:
    """Two settings of each controller from two initial states."""
    return [
        simulate(controller, option, initial)
        for initial in ("low-low", "high-low")
        for controller, options in (("mpc", ("0.00001", "0.001")), ("onoff", ("0.5", "2")))
        for option in options
    ]


@pytest.fixture(scope="module")
def study(simulated: list[Simulated], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of these runs."""
    return write_study(
        tmp_path_factory.mktemp("study") / "study",
        [(example.row, example.trajectory) for example in simulated],
    )


# --- exact results -------------------------------------------------------------------------------


def test_results_are_those_of_the_table(tmp_path: Path) -> None:
    """Only a sample a minute is kept, although the command exceeds 1 for a second in between."""
    example = simulate("onoff", "0.5", "low-low")
    row = {**example.row, "max_command": 2.0, "beyond_hours": 1 / 3600, "pump_starts": 31,
           "excess_starts": 11, "limited_steps": 3}
    report = report_of(write_study(tmp_path / "study", [(row, example.trajectory.thinned(60))]))
    (judged,), results = report.single, [name for name in row if name.endswith("_m3")]
    assert [judged[name] for name in results] == [row[name] for name in results]
    text = page_of(report)
    assert "The command was above 1" in text and "no real pump can follow it." in text
    assert "The pumps started more than 20 times in an hour" in text
    assert "A tank ran empty in 3 ticks" in text
    assert re.search(r"pump starts \(1\)</th> <td [^>]*>31<", text)


def test_what_follows_from_results(tmp_path: Path) -> None:
    """By hand: storage, unexplained volume, and money; the last sample counts for a tick."""
    row = {
        **simulate("onoff", "0.5", "low-low").row, "cistern_m3": 60.0, "roof_m3": 2.0,
        "final_cistern_m3": 55.0, "final_roof_m3": 3.5, "rain_cistern_m3": 1.0, "pumped_m3": 4.0,
        "outflow_m3": 2.5, "rain_roof_m3": 0.5, "evapotranspiration_m3": 2.0, "drainage_m3": 0.75,
        "electric_energy_kwh": 2.0, "near_target_hours": 0.1, "hours": 0.2, "bound_m3": 100.0,
        TOTAL: 150.0,
    }
    (judged,) = study_of(tmp_path / "study", row, energy_price=0.2, water_price=5.0).single
    assert (judged["cistern_change_m3"], judged["roof_change_m3"]) == (-5, 1.5)
    assert judged["cistern_residual_m3"] == pytest.approx(-5 - (1 - 4 - 2.5))
    assert judged["roof_residual_m3"] == pytest.approx(1.5 - (0.5 + 4 - 2 - 0.75))
    assert (judged["energy_cost"], judged["water_value"], judged["ratio"]) == (0.4, 20, 1.5)
    assert judged["near_share"] == pytest.approx(0.1 / (0.2 + 1 / 3600))


def test_another_band_needs_what_happened(tmp_path: Path) -> None:
    """Unknown without a trajectory, or if it has not every tick; then a note says why."""
    example = simulate("onoff", "0.5", "low-low")
    every_tick = example.trajectory
    trajectories = (every_tick, every_tick.thinned(60), None)
    path = write_study(tmp_path / "study", [(example.row, kept) for kept in trajectories])
    report = report_of(path, band=0.2)
    assert [run["near_target_hours"] for run in report.single] == [
        near_hours(PAPER_SITE, every_tick, 0.2), None, None
    ]
    notes = [report.runs[run["run"]].notes for run in report.single]
    unknown = "time near the target is unknown: only samples every 60 s were kept"
    assert [unknown in " ".join(note.text for note in of_run) for of_run in notes] == [
        False, True, False
    ]
    text = page_of(report)
    assert unknown in text
    assert len(re.findall(r"<td [^>]*>unknown<", text)) == 4  # the time and its share, of two runs
    for usual in report_of(path, band=NEAR_TARGET).single:
        assert usual["near_target_hours"] == example.row["near_target_hours"]


def test_a_study_without_trajectories(tmp_path: Path) -> None:
    """All its tables, and the figures of results; the page says what is left out."""
    rows = [simulate("onoff", option, "low-low").row for option in ("0.5", "2")]
    report = study_of(tmp_path / "study", *rows)
    assert list(figures_of(report)) == [
        "total-deviation-1", "time-in-band-1", "energy-1", "pump-starts-1", "water-balance-1",
        "pump-curve-1", "pump-smoothing-1",
    ]
    text = page_of(report)
    assert "Results of each run" in text and f">{rows[0][TOTAL]:.2f}<" in text
    assert "No trajectory was kept" in text


# --- figures -------------------------------------------------------------------------------------


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=3000))
def test_thinning_keeps_ends_and_extremes(values: list[float]) -> None:
    """For any line, its peaks are drawn, in order, with few points."""
    column = np.array(values)
    kept = thin(column, 100)
    assert len(kept) <= 102
    assert (np.diff(kept) > 0).all()
    assert {0, len(values) - 1} <= set(kept.tolist())
    assert column[kept].max() == column.max() and column[kept].min() == column.min()


def test_frost_is_shaded(tmp_path: Path) -> None:
    """From its beginning to its end."""
    frost = np.array([0, 0, 1, 1, 0, 1, 1.0])
    columns = {**dict.fromkeys(NAMES, np.ones(7)), "time": np.arange(7.0), "frost": frost}
    trajectory = Trajectory(start=START, **columns)
    assert drawn(trajectory).frost == [(2, 4), (5, 6)]
    row = simulate("onoff", "0.5", "low-low").row
    path = write_study(tmp_path / "study", [({**row, "frost_hours": 3 / 3600}, trajectory)])
    report = report_of(path)
    assert "Grey: frost" in figures_of(report)["weather-1"].caption
    assert "There was frost; nothing was pumped during it." in page_of(report)


def test_pump_curve(study: Path, tmp_path: Path) -> None:
    """Curve and head loss by Table I's numbers; they meet at the root of the quadratic.

    Two points of a data sheet define a curve: 50 m at no flow and 46 m at 2 L/s give -1e6 and 50.
    """
    figure = figures_of(report_of(study))["pump-curve-1"]
    friction = (3.56 * 18.4 / 0.2 + 0.6) / (2 * 9.81 * (0.01 * np.pi) ** 2)
    expected = {
        "pump curve of the site": (55.2, -5.78e5),
        "head loss, cistern at 0.75 m": (16 - 0.75, friction),
        "head loss, cistern at 3 m": (16 - 3, friction),
    }
    assert {row["line"] for row in figure.data["pump-curve-1"]} == set(expected)
    for row in figure.data["pump-curve-1"]:
        head, slope = expected[row["line"]]
        assert row["head"] == pytest.approx(
            head + slope * (row["flow"] / 1000) ** 2, rel=1e-5, abs=1e-4
        )
    points = sorted(
        (row["flow"], row["head"])
        for rows in figure.panels[0].specification()["datasets"].values()
        for row in rows if len(row) == 2
    )
    roots = [np.roots([friction + 5.78e5, 0, 16 - level - 55.2]).max() for level in (0.75, 3)]
    assert [flow / 1000 for flow, _ in points] == pytest.approx(roots, rel=1e-9)
    (tmp_path / "pump.csv").write_text("flow [m3/s],head [m]\n0,50\n0.002,46\n")
    *_, figure, _ = make_figures(report_of(study), tmp_path / "pump.csv")
    assert "a_hat = -1e+06 s2/m5, c_hat = 50 m" in figure.caption


def test_pump_smoothing(study: Path) -> None:
    """Both models follow the paper's text, and the exact model's jumps are drawn vertically."""
    figure = figures_of(report_of(study))["pump-smoothing-1"]
    for number, roof_sweep in ((1, False), (2, False), (3, True)):
        rows = figure.data[f"pump-smoothing-1-{number}"]
        for row in rows:
            x1, x2 = (100.0, row["x"]) if roof_sweep else (row["x"], 0.0)
            if row["model"].startswith("exact"):
                expected = exact_flows(PAPER_SITE, x1, x2, 0.5)[1]
            else:
                pumping, resting = (
                    smooth_rates(PAPER_SITE, x1, x2, u, 0.0, 0.0).real[1] for u in (0.5, 0.0)
                )
                expected = pumping - resting
            assert row["q"] / 1000 == pytest.approx(expected, rel=1e-5, abs=1e-9)
        exact = [row for row in rows if row["model"].startswith("exact")]
        steps = np.abs(np.diff([row["q"] for row in exact]))
        assert np.diff([row["x"] for row in exact])[steps.argmax()] < 1e-12
    # On a measured roof the pumps' flow is the same, whatever its soil keeps.
    measured = dataclasses.replace(
        PAPER_SITE, field_capacity=0.2, wilting_point=0.01, depletion_fraction=0.5,
        z_cap=PAPER_SITE.z_cap * 0.2,
    )
    assert pump_smoothing(measured, 1, "").data == pump_smoothing(PAPER_SITE, 1, "").data


def test_figures_of_single_runs(study: Path, simulated: list[Simulated]) -> None:
    """Weather from the file, lines from samples, totals at each setting, bars that add up."""
    figures = figures_of(report_of(study))
    weather = figures["weather-1"].data
    assert {row["v"] for row in weather["rain-1"]} == {0.0}
    rows = weather["evapotranspiration-1"]
    assert {row["method"] for row in rows} == {"published"}
    assert [row["v"] for row in rows] == pytest.approx([2.77537901] * len(rows), rel=1e-6)
    # Local time as if it were UTC, so the axis is the same in every reader's browser.
    assert rows[0]["t"] == datetime.fromisoformat("2021-07-07T02:00+00:00").timestamp() * 1000

    lines = figures["trajectories-1-1"]
    assert len(lines.panels) == 6 and lines.columns == 2
    for example in simulated[:4]:
        name = example.row["controller"]
        label = example.row[f"parameter:{'weight' if name == 'mpc' else 'fraction'}"]
        for quantity in ("command", "cistern", "roof"):
            rows = [
                row for row in lines.data[f"{quantity}-1-1-{name}"] if row["setting"] == label
            ]
            values = getattr(example.trajectory, quantity)
            if quantity == "command":
                values = np.append(values[:-1], values[-2])  # the last is not applied, nor drawn
            assert 100 < len(rows) <= MOST_POINTS
            ticks = [round(row["t"] * 3600) for row in rows]
            assert [row["v"] for row in rows] == pytest.approx(values[ticks], rel=1e-6, abs=1e-12)
            assert max(row["v"] for row in rows) == pytest.approx(values.max(), rel=1e-6)

    totals = {
        (name, row["x"], row["initial"]): row["v"]
        for name in ("mpc", "onoff")
        for row in figures["total-deviation-1"].data[f"total-deviation-1-{name}"]
    }
    assert totals == pytest.approx({
        (example.row["controller"],
         float(example.row.get("parameter:weight") or example.row["parameter:fraction"]),
         example.row["initial"]): example.row[TOTAL]
        for example in simulated
    }, rel=1e-6)
    # A fifth of an hour is not the paper's window.
    data = figures["total-deviation-1"].data
    assert not any(name.startswith("published") for name in data)
    # Deviation is the paper's fifth figure, after schematic, two of the pump, and weather.
    assert "(paper: Fig. 5)" in figures["total-deviation-1"].caption
    assert "(Fig. 5)" in METRICS[0].meaning

    for tank in ("cistern", "roof"):
        sums: dict[str, float] = {}
        for row in figures["water-balance-1"].data[f"balance-1-{tank}"]:
            sums[row["run"]] = sums.get(row["run"], 0) + row["v"]
        changes = [np.ptp(getattr(example.trajectory, tank)[[0, -1]]) for example in simulated]
        assert sorted(map(abs, sums.values())) == pytest.approx(sorted(changes), abs=1e-5)


def test_published_totals_stand_beside_the_papers_window(tmp_path: Path) -> None:
    """Only for 12 h from its start, with its site and its evapotranspiration."""
    row = {**simulate("onoff", "0.5", "low-low").row, "hours": 12.0}
    for name, changes, there in (
        ("published", {}, True),
        ("fao56", {"evapotranspiration": "fao56"}, False),
        ("offset", {"roof_offset": "0.005"}, False),
        ("forecast", {"forecast": "persistence"}, False),
        ("start", {"start": "2021-07-07T02:00-04:00"}, False),
    ):
        report = study_of(tmp_path / name, *(
            {**row, **changes, "parameter:fraction": fraction} for fraction in ("0.2", "0.5")
        ))
        data = next(
            figure for figure in make_figures(report, None) if figure.name == "total-deviation-1"
        ).data
        assert ("published-1-onoff" in data) == there
        if there:
            totals = {mark["x"]: mark["v"] for mark in data["published-1-onoff"]}
    assert totals == {2: 9599.6557, 1.5: 9780.0045, 1: 9611.9628, 0.5: 9635.5272, 0.2: 9725.43}


@pytest.mark.parametrize(("old", "new", "there"), [
    ("latitude: 43.63", "latitude: 45.5", True),
    ("g: 9.81", "mains_level: 1.0\nmains_flow: 0.001\ng: 9.81", False),
    ("g: 9.81", "low_outlet_level: 1.0\nlow_outlet_radius: 0.02\ng: 9.81", False),
    ("g: 9.81", "runoff_coefficient: 0.9\ng: 9.81", False),
    ("g: 9.81", 'quiet_hours: ["01:00-02:00"]\ntime_zone: America/Toronto\ng: 9.81', False),
])
def test_published_totals_are_of_the_papers_site_alone(
    tmp_path: Path, old: str, new: str, there: bool
) -> None:
    """It may be elsewhere, since the weather is given; but nothing that Table I lacks is added."""
    row = {**simulate("onoff", "0.5", "low-low").row, "hours": 12.0}
    study = write_study(tmp_path / "study", [
        ({**row, "parameter:fraction": fraction}, None) for fraction in ("0.2", "0.5")
    ])
    site = study / "configuration" / "site.yaml"
    text = site.read_text(encoding="utf-8")
    assert text.count(f"\n{old}") == 1
    site.write_text(text.replace(f"\n{old}", f"\n{new}"), encoding="utf-8")
    data = figures_of(report_of(study))["total-deviation-1"].data
    assert ("published-1-onoff" in data) == there


def test_any_controller_with_any_parameters(tmp_path: Path) -> None:
    """Controllers and parameters that this package does not know, with numbers and words."""
    example = simulate("mpc", "0.001", "low-low")
    base = {key: value for key, value in example.row.items() if not key.startswith("parameter:")}
    few = example.trajectory.thinned(60)
    rows = [
        ({**base, "controller": name, **{f"parameter:{key}": text for key, text in given.items()}},
         few)
        for name, given in (
            ("lookahead", {"horizon": "60", "forecast": "hourly"}),
            ("lookahead", {"horizon": "9", "forecast": "perfect"}),
            ("anticipating_onoff", {"threshold": "0.5"}),
            ("anticipating_onoff", {"threshold": "inf"}),
            ("proportional", {}),
            ("proportional", {}),
        )
    ]
    report = report_of(write_study(tmp_path / "study", rows))
    assert report.controllers == ["lookahead", "anticipating_onoff", "proportional"]
    assert report.settings["lookahead"].labels == [
        "horizon 9, forecast perfect", "horizon 60, forecast hourly"
    ]
    assert report.settings["anticipating_onoff"].labels == ["0.5", "none"]
    assert report.settings["proportional"].labels == ["005", "006"]
    assert "trajectories-1-1" in figures_of(report)
    assert [row["setting"] for row in report.best()] == ["all alike"] * 3  # their totals are equal


def test_the_least_possible(tmp_path: Path, simulated: list[Simulated]) -> None:
    """A line for each initial state in the figure, and a column in the tables."""
    rows = [
        {**example.row, "bound_m3": {"low-low": 200.0, "high-low": 100.0}[example.row["initial"]]}
        for example in simulated
    ]
    # Two of the rows have no bound.
    rows[0]["bound_m3"] = rows[7]["bound_m3"] = ""
    report = study_of(tmp_path / "study", *rows)
    figure = figures_of(report)["total-deviation-1"]
    assert {row["initial"]: row["v"] for row in figure.data["bound-1"]} == {
        "low-low": 200, "high-low": 100
    }
    text = page_of(report)
    assert text.count("over the least possible (1)</button>") == 2
    assert f">{simulated[1].row[TOTAL] / 200:.4f}<" in text
    assert ">unknown<" in text
    assert "<strong>Least possible</strong>" in text


def test_both_methods_stand_side_by_side(tmp_path: Path) -> None:
    """With their difference in %, by hand: 3 % more."""
    row = simulate("mpc", "0.001", "low-low").row
    more = {**row, "evapotranspiration": "fao56", TOTAL: 1.03 * row[TOTAL]}
    few = simulate("mpc", "0.001", "low-low").trajectory.thinned(60)
    path = write_study(tmp_path / "study", [(row, few), (more, few)])
    report = report_of(path)
    assert [window["evapotranspiration"] for window in report.windows()] == ["published", "fao56"]
    (table,) = [table for table in make_tables(report) if "both kinds" in table.name]
    assert [cell.text for cell in table.rows[0]][2:] == [
        f"{row[TOTAL]:.2f}", f"{1.03 * row[TOTAL]:.2f}", "+3.00"
    ]
    assert {row["method"] for row in figures_of(report)["weather-1"].data["evapotranspiration-1"]
            } == {"published", "fao56"}


# --- many seeds ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """A study of forecast errors: a table without trajectories."""
    rows = seeded_rows(simulate("onoff", "0.5", "low-low").row)
    return study_of(tmp_path_factory.mktemp("seeds") / "study", *rows)


def test_seeds_belong_together(seeds: Report) -> None:
    """A case of 25 seeds in the table and in the figure: by hand."""
    cases = seeds.of(SEEDS)
    assert seeds.single == [] and len(cases) == 2 * 2 * 3 * 2
    assert [(row["controller"], row["setting"], row["skill"]) for row in cases[:6]] == [
        (name, setting, skill)
        for name, setting in (
            ("mpc", "weight 0.01"), ("onoff", "fraction 0.5"), ("onoff", "fraction 2")
        )
        for skill in ("better", "real")
    ]
    figures = figures_of(seeds)
    assert list(figures) == ["forecast-errors", "pump-curve-1", "pump-smoothing-1"]
    figure = figures["forecast-errors"]
    assert [panel.title for panel in figure.panels] == [
        [f"{window}", f"from {initial}"]
        for window in ("2021-07-07 02:00-05:00, 12 h", "2021-07-20 02:00-05:00, 24 h")
        for initial in ("low-low", "high-low")
    ]
    assert {
        row["amount"]: row["v"] for row in figure.data["forecast-errors-2"]
        if row["series"] == "on/off fraction 0.5" and row["skill"] == "better"
    } == {"mean": 1013, "mean of the worst tenth": 1024.2}
    colour = figure.panels[0].specification()["layer"][-1]["encoding"]["color"]["scale"]
    # The colour depends on the controller, not on its setting.
    assert colour["domain"] == ["MPC weight 0.01", "on/off fraction 0.5", "on/off fraction 2"]
    assert colour["range"][0] != colour["range"][1] == colour["range"][2]


def test_seeds_page(seeds: Report) -> None:
    """Mean of 25 seeds, mean of the worst two and a half, worst; what the page leaves out."""
    text = page_of(seeds)
    table = text.partition("over their seeds</h3>")[2].partition("</table>")[0]
    assert table.count("<tr>") == 1 + 24
    row = next(row for row in table.split("<tr>") if "fraction 0.5<" in row and ">better<" in row)
    assert [cell.partition("<")[0] for cell in row.split('">')[1:]] == [
        "on/off", "fraction 0.5", "25", "better", "2021-07-07 02:00-05:00", "12 h", "low-low",
        "1013.00", "1024.20", "1025.00", "2.0260", "2.0484", "2.0500",
    ]
    assert "Results of each run" not in text
    assert "are one case for each controller" in text
    # 25 different numbers of ticks give one note.
    assert text.count("found no solution in some ticks") == 1
    assert (
        "toronto_2021-07.csv, 2021-07-20 02:00-05:00, 24 h, evapotranspiration published, forecast "
        "ensemble members 10 skill real, 25 seeds"
    ) in text


def test_seeds_beside_other_runs(tmp_path: Path) -> None:
    """A perfect forecast and a single seed are shown as before, complete in their tables."""
    example = simulate("mpc", "0.001", "low-low")
    few = example.trajectory.thinned(60)
    errors = {**example.row, "forecast": "errors", "forecast_skill": "real"}
    report = report_of(write_study(tmp_path / "study", [
        (example.row, few),
        ({**errors, "forecast_skill": "worse", "forecast_seed": "7"}, few),
        *(({**errors, "forecast_seed": seed, "max_command": 2}, None) for seed in ("1", "2")),
    ]))
    assert [window["forecast"] for window in report.windows()] == [
        "perfect", "errors skill worse seed 7"
    ]
    assert [row["seeds"] for row in report.of(SEEDS)] == [2]
    names = list(figures_of(report))
    assert names.count("forecast-errors") == 1 and "trajectories-2-1" in names
    assert "trajectories-3-1" not in names
    text = page_of(report)
    assert "Results of each run" in text
    assert "over the least" not in text
    warned = text.partition("The command was above 1")[2].partition("</li>")[0]
    assert "</summary>003, 004</details>" in warned
    words = "nly 2 seeds: with fewer than 10, the worst tenth is a single run"
    assert words in text.partition("</header>")[0]
    assert words in text.partition('id="warnings"')[2]


@pytest.mark.parametrize(("forecast", "seeds"), [("perfect", ("",)), ("errors", (1, 2))])
def test_a_tie_is_no_win(tmp_path: Path, forecast: str, seeds: tuple[object, ...]) -> None:
    row = {**simulate("onoff", "0.5", "low-low").row, "parameter:fraction": ""}
    totals = {1: (5, 6), 2: (5, 6), 3: (5, 5), 4: (5, 5), 5: (7, 6)}
    report = study_of(tmp_path / "study", *(
        {
            **row, "start": f"2021-07-0{day}T02:00:00-05:00", "controller": controller,
            "forecast": forecast, "forecast_seed": seed, TOTAL: total,
            "forecast_skill": "real" if seed else "",
        }
        for seed in seeds for day, both in totals.items()
        for controller, total in zip(("mpc", "onoff"), both, strict=True)
    ))
    assert "MPC's in 2, shared in 2 and on/off's in 1." in sentences(report)[1]


# --- the command ---------------------------------------------------------------------------------


def test_nothing_is_written_over(tmp_path: Path) -> None:
    """Neither an old report, without --force, nor a file that is not a report's."""
    (tmp_path / "figures").mkdir()
    files = [tmp_path / "report.html", tmp_path / "figures" / "energy-1.svg"]
    for file in files:
        file.touch()
    assert _former_report(tmp_path, is_figure, force=True) == files
    assert _former_report(tmp_path / "new", is_figure, force=False) == []
    with pytest.raises(ConfigurationError, match="replace it with --force"):
        _former_report(tmp_path, is_figure, force=False)
    for name in ("notes.txt", "figures/mine.svg", "figures/energy-2.svg/x"):
        foreign = tmp_path / name
        foreign.parent.mkdir(exist_ok=True)
        foreign.touch()
        with pytest.raises(ConfigurationError, match=f"{name.removesuffix('/x')} does not belong"):
            _former_report(tmp_path, is_figure, force=True)
        foreign.unlink()


def test_study(tmp_path: Path) -> None:
    """A page, each figure twice, the failed runs with their errors, and where the page is.

    With --force the previous report is removed.
    """
    example = simulate("onoff", "2", "low-low")
    failed = {**example.row, "status": "failed", "error": "solver: <gave up>", TOTAL: ""}
    not_run = {**failed, "parameter:fraction": "3", "status": "not run", "error": ""}
    done_row = (example.row, example.trajectory.thinned(60))
    report = write_study(
        tmp_path / "study", [done_row, (failed, None), (not_run, None)]
    ) / "report"
    (report / "figures").mkdir(parents=True)
    (report / "figures" / "energy-7.svg").touch()
    done = command("study", "--force", "--water-price", "5", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(report / "report.html") in done.stdout
    assert "fraction 2" in done.stdout
    text = (report / "report.html").read_text()
    assert "5 CAD/m³" in text
    assert "solver: &lt;gave up&gt;" in text
    assert "2 runs failed" in text
    assert "<td>not run</td>" in text
    assert "over the least" not in text
    names = {path.stem for path in (report / "figures").iterdir()}
    assert names == {
        "weather-1", "trajectories-1-1", "water-balance-1", "pump-curve-1", "pump-smoothing-1"
    }
    for name in names:
        svg = (report / "figures" / f"{name}.svg").read_text()
        png = (report / "figures" / f"{name}.png").read_bytes()
        assert svg.startswith("<svg") and "<text" in svg
        assert png.startswith(b"\x89PNG")
        width, height = struct.unpack(">II", png[16:24])
        assert width > 800 and height > 400
    payload: dict[str, Any] = json.loads(
        text.partition('id="payload">')[2].partition("</script>")[0]
    )
    assert {panel["figure"] for panel in payload["panels"]} == names


def test_a_page_begins_with_what_came_out(tmp_path: Path, study: Path, seeds: Report) -> None:
    """Three sentences and a figure come before the results; versions are last."""
    pages = {
        "A run of MPC (weight 0.001): ": page_of(ended_run(tmp_path / "run")),
        "8 runs of MPC (2 settings) and on/off (2 settings), from low-low and high-low: ":
        page_of(study),
        "600 runs of MPC and on/off (2 settings), from low-low and high-low: 4 sets of conditions.":
        page_of(seeds),
    }
    for first, text in pages.items():
        lead = text.partition('class="lead">')[2].partition("</p>")[0]
        assert lead.startswith(first)
        assert len(re.findall(r"\.(?= [A-Z]|$)", lead)) == 3
        order = ['<section id="results">', '<section id="figures">', '<section id="numbers">',
                 '<section id="configuration">', "Made with greenroof_ros"]
        places = list(map(text.index, order))
        assert places == sorted(places)
        warnings = text.find('<section id="warnings">')
        assert warnings == -1 or places[1] < warnings < places[2]
