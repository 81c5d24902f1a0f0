"""Reports: from studies, run directories and bags; the data of each figure; wrong inputs."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from commands import run_command
from graphs import bring_up, environment
from hypothesis import given
from hypothesis import strategies as st
from paper import PAPER_SITE, exact_flows, paper_run, smooth_rates
from places import CONFIG
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.experiment.clairvoyant import clairvoyant_bound
from greenroof_ros.experiment.closed_loop import closed_loop, record
from greenroof_ros.model.metrics import METRICS, Metrics
from greenroof_ros.recording.bag_reader import Recorded
from greenroof_ros.recording.trajectory import Trajectory, read_parquet
from greenroof_ros.report.assessment import Assumptions, assess
from greenroof_ros.report.drawing import Figure
from greenroof_ros.report.entries import RunEntry
from greenroof_ros.report.figures import make_figures
from greenroof_ros.report.page import render
from greenroof_ros.report.pump_figures import pump_smoothing
from greenroof_ros.report.results import MOST_POINTS, Report, result, thin
from greenroof_ros.report.runs import find_runs
from greenroof_ros.report.seeds import split_by_seeds, spreads
from greenroof_ros.report.tables import make_tables

START = datetime.fromisoformat("2021-07-07T02:00-05:00")
START_NS = 1_625_641_200 * 10**9  # date -d 2021-07-07T02:00-05:00 +%s
TYPES = get_typestore(Stores.ROS2_JAZZY)
NAMES = [one.name for one in dataclasses.fields(Trajectory)][1:]
HEADER = [
    "run", "site", "weather", "start", "hours", "evapotranspiration", "controller", "initial",
    "cistern_m3", "roof_m3", "parameter:weight", "parameter:max_command", "parameter:fraction",
    "status", "error",
    "total_deviation_m3", "limited_steps", "fallbacks", "filled_hours", "filled",
    "forecast_repeats_from", "bound_m3",
]


class Simulated(NamedTuple):
    """A run done in this process."""

    trajectory: Trajectory
    metrics: Metrics
    row: dict[str, Any]


def simulate(controller: str, option: str, initial: str, hours: str = "0.2") -> Simulated:
    """Do a run of the paper, shorter."""
    key = {"mpc": "weight", "onoff": "fraction"}[controller]
    run = paper_run(
        "--controller", controller, f"--{key}", option, "--initial", initial, "--hours", hours
    )
    metrics = Metrics()
    controller_ = run.make_controller()
    trajectory = record(run, closed_loop(run, controller_, metrics))
    row = {
        "site": "site.yaml", "weather": "toronto_2021-07.csv", "start": run.start.isoformat(),
        "hours": hours, "evapotranspiration": "published", "controller": controller,
        "initial": initial, "cistern_m3": run.x1, "roof_m3": run.x2, f"parameter:{key}": option,
        "status": "done", "total_deviation_m3": metrics["total_deviation_m3"],
    }
    return Simulated(trajectory, metrics, row)


def write_study(
    directory: Path, runs: Sequence[tuple[dict[str, Any], Trajectory | None]],
    header: Sequence[str] = HEADER,
) -> Path:
    """Write a study's directory; a run without a trajectory failed."""
    configuration = directory / "configuration"
    configuration.mkdir(parents=True)
    shutil.copy(CONFIG / "site.yaml", configuration / "site.yaml")
    (configuration / "study.json").write_text('{"versions": {"greenroof_ros": "0.2.0"}}')
    with (directory / "results.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, header, restval="")
        writer.writeheader()
        for number, (row, trajectory) in enumerate(runs, start=1):
            name = f"{number:03}"
            writer.writerow({"run": name, **row})
            if trajectory is not None:
                (directory / "runs" / name).mkdir(parents=True)
                (directory / "runs" / name / "trajectory.parquet").write_bytes(
                    trajectory.to_parquet()
                )
    return directory


def report_of(path: Path) -> Report:
    """Read and judge what is under a path."""
    single, seeded = split_by_seeds(find_runs([path], None).runs)
    return Report([result(entry, Assumptions()) for entry in single], seeded)


def page_of(path: Path) -> str:
    """Return the text of the page on what is under a path, without figures and blanks."""
    html = render(report_of(path), [], find_runs([path], None), Assumptions())
    return " ".join(html.partition("<body>")[2].partition("</main>")[0].split()).replace("<br>", "")


def drawn(report: Report, name: str) -> Figure:
    """Return the figure of a name."""
    return {figure.name: figure for figure in (make() for make in make_figures(report, None))}[name]


def command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run the report as a user would."""
    return run_command("report", *arguments, cwd=cwd, env=environment(0))


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
    """A study of them, and of a run that failed."""
    failed = {
        **simulated[0].row, "parameter:weight": "0.5", "status": "failed",
        "error": "solver: <gave up>", "total_deviation_m3": "",
    }
    not_run = {**failed, "parameter:weight": "0.6", "status": "not run", "error": ""}
    return write_study(
        tmp_path_factory.mktemp("study") / "study",
        [
            *((one.row, one.trajectory) for one in simulated), (failed, None), (not_run, None),
        ],
    )


# --- trajectories ------------------------------------------------------------------------------


def test_parquet_keeps_every_bit(tmp_path: Path) -> None:
    """Of random bit patterns, NaN and the sign of 0 among them."""
    random = np.random.default_rng(1)
    columns = random.integers(-(2**63), 2**63, size=(len(NAMES), 500)).view(np.float64)
    columns[:, :3] = [-0.0, np.nan, np.inf]
    written = Trajectory(start=START, **dict(zip(NAMES, columns, strict=True)))
    (tmp_path / "file").write_bytes(written.to_parquet())
    found = read_parquet(tmp_path / "file")
    assert found.start == START
    assert found.start.isoformat() == START.isoformat()
    for name in NAMES:
        bits = (getattr(one, name).view(np.int64) for one in (found, written))
        np.testing.assert_array_equal(*bits)


@pytest.mark.parametrize("keep", [0, 3, 100, -1])
def test_parquet_damaged(tmp_path: Path, keep: int) -> None:
    """Empty, or cut anywhere."""
    column = np.arange(100.0)
    whole = Trajectory(start=START, **dict.fromkeys(NAMES, column)).to_parquet()
    (tmp_path / "file").write_bytes(whole[:keep])
    with pytest.raises(ConfigurationError, match="file: is empty, cut short or no parquet"):
        read_parquet(tmp_path / "file")


def test_parquet_of_something_else(tmp_path: Path) -> None:
    """Another table names the columns that it lacks; no start and no samples are refused, too."""
    import polars

    polars.DataFrame({"time_s": [1.0], "frost": [1]}).write_parquet(tmp_path / "other")
    with pytest.raises(ConfigurationError, match=r"cistern_m3.*frost"):
        read_parquet(tmp_path / "other")
    whole = Trajectory(start=START, **dict.fromkeys(NAMES, np.arange(2.0))).to_parquet()
    polars.read_parquet(whole).write_parquet(tmp_path / "no-start")
    with pytest.raises(ConfigurationError, match="'start'"):
        read_parquet(tmp_path / "no-start")
    none = Trajectory(start=START, **dict.fromkeys(NAMES, np.array([])))
    (tmp_path / "none").write_bytes(none.to_parquet())
    with pytest.raises(ConfigurationError, match="no samples"):
        read_parquet(tmp_path / "none")
    with pytest.raises(ConfigurationError, match="No such file"):
        read_parquet(tmp_path / "nowhere")


# --- drawing -----------------------------------------------------------------------------------


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=3000))
def test_thinning_keeps_ends_and_extremes(values: list[float]) -> None:
    """Whatever the line, its peaks are drawn, in order, and few points are."""
    column = np.array(values)
    kept = thin(column, 100)
    assert len(kept) <= 102
    assert (np.diff(kept) > 0).all()
    assert {0, len(values) - 1} <= set(kept.tolist())
    assert column[kept].max() == column.max() and column[kept].min() == column.min()


def test_thinning_keeps_one_spike_in_a_day() -> None:
    """A pump that runs for a second is seen, at its second."""
    column = np.zeros(86401)
    column[54321] = 1.0
    kept = thin(column)
    assert len(kept) <= MOST_POINTS
    assert 54321 in kept


def test_pump_curve(study: Path) -> None:
    """Curve and head loss by Table I's numbers; they meet where the quadratic has its root."""
    figure = drawn(report_of(study), "pump-curve-1")
    rows = figure.data["pump-curve-1"]
    friction = (3.56 * 18.4 / 0.2 + 0.6) / (2 * 9.81 * (0.01 * np.pi) ** 2)
    assert {row["line"] for row in rows} == {
        "pump curve of the site", "head loss, cistern at 0.75 m", "head loss, cistern at 3 m"
    }
    for row in rows:
        flow = row["flow"] / 1000
        expected = {
            "pump curve of the site": 55.2 - 5.78e5 * flow**2,
            "head loss, cistern at 0.75 m": friction * flow**2 + 16 - 0.75,
            "head loss, cistern at 3 m": friction * flow**2 + 16 - 3,
        }[row["line"]]
        assert row["head"] == pytest.approx(expected, rel=1e-5, abs=1e-4)
    specification = figure.panels[0].specification()
    points = sorted(
        (row["flow"], row["head"])
        for rows in specification["datasets"].values() for row in rows if len(row) == 2
    )
    roots = [np.roots([friction + 5.78e5, 0, 16 - level - 55.2]).max() for level in (0.75, 3)]
    assert [flow / 1000 for flow, _ in points] == pytest.approx(roots, rel=1e-9)
    assert [head for _, head in points] == pytest.approx(
        [friction * flow**2 + 16 - level for flow, level in zip(roots, (0.75, 3), strict=True)]
    )


def test_pump_data_are_drawn_and_fitted(study: Path, tmp_path: Path) -> None:
    """Two points fix the curve: 50 m at no flow and 46 m at 2 L/s give -1e6 and 50."""
    (tmp_path / "pump.csv").write_text("flow [m3/s],head [m]\n0,50\n0.002,46\n")
    figure = make_figures(report_of(study), tmp_path / "pump.csv")[-2]()
    assert "a_hat = -1e+06 s2/m5, c_hat = 50 m" in figure.caption
    rows = [row for row in figure.data["pump-curve-1"] if row["line"] == "fit to the data sheet"]
    for row in rows:
        assert row["head"] == pytest.approx(50 - row["flow"] ** 2, abs=1e-4)


def test_pump_smoothing(study: Path) -> None:
    """Both models as the paper's text has them, and the exact one's jumps drawn upright."""
    figure = drawn(report_of(study), "pump-smoothing-1")
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
        exact = [row["q"] for row in rows if row["model"].startswith("exact")]
        steps = np.abs(np.diff(exact))
        places = [row["x"] for row in rows if row["model"].startswith("exact")]
        assert np.diff(places)[steps.argmax()] < 1e-12


def test_the_soil_is_none_of_the_pumps_business() -> None:
    """On a measured roof as many litres a second leave the pumps, whatever its soil keeps."""
    measured = dataclasses.replace(
        PAPER_SITE, field_capacity=0.2, wilting_point=0.01, depletion_fraction=0.5,
        z_cap=PAPER_SITE.z_cap * 0.2,
    )
    assert pump_smoothing(measured, 1, "").data == pump_smoothing(PAPER_SITE, 1, "").data


def test_weather(study: Path) -> None:
    """The file's own figures of the hour: 0 mm/h and 2.77537901 mm/day at 02:00."""
    figure = drawn(report_of(study), "weather-1")
    assert {row["v"] for row in figure.data["rain-1"]} == {0.0}
    rows = figure.data["evapotranspiration-1"]
    assert {row["method"] for row in rows} == {"published"}
    assert [row["v"] for row in rows] == pytest.approx([2.77537901] * len(rows), rel=1e-6)
    # Local time as if it were UTC, for an axis that is the same in every reader's browser.
    assert rows[0]["t"] == datetime.fromisoformat("2021-07-07T02:00+00:00").timestamp() * 1000


def test_frost_is_shaded() -> None:
    """From where it begins to where it ends."""
    frost = np.array([0, 0, 1, 1, 0, 1, 1.0])
    columns = {**dict.fromkeys(NAMES, np.ones(7)), "time": np.arange(7.0), "frost": frost}
    trajectory = Trajectory(start=START, **columns)
    entry = RunEntry(
        name="1", site_name="s", site=PAPER_SITE, weather="w", method="v", controller="onoff",
        parameters={}, initial="low", notes=(), load=lambda: Recorded(trajectory),
    )
    one = result(entry, Assumptions())
    assert one.frost == ((2, 4), (5, 6))
    report = Report([one])
    assert "Grey: frost" in drawn(report, "weather-1").caption


def test_lines_are_samples_of_the_runs(study: Path, simulated: list[Simulated]) -> None:
    """Each drawn point is a sample of its run, and each run's largest command is drawn."""
    figure = drawn(report_of(study), "trajectories-1-1")
    assert len(figure.panels) == 6 and figure.columns == 2
    for one in simulated[:4]:
        controller = one.row["controller"]
        label = one.row[f"parameter:{'weight' if controller == 'mpc' else 'fraction'}"]
        for quantity in ("command", "cistern", "roof"):
            rows = [
                row for row in figure.data[f"{quantity}-1-1-{controller}"]
                if row["setting"] == label
            ]
            values = getattr(one.trajectory, quantity)
            if quantity == "command":
                values = np.append(values[:-1], values[-2])  # the last is not applied, nor drawn
            assert len(rows) > 100
            ticks = [round(row["t"] * 3600) for row in rows]
            assert [row["v"] for row in rows] == pytest.approx(values[ticks], rel=1e-6, abs=1e-12)
            assert max(row["v"] for row in rows) == pytest.approx(values.max(), rel=1e-6)


def test_totals_by_setting(study: Path, simulated: list[Simulated]) -> None:
    """The simulation's own totals, at the parameter's value, by initial state."""
    figure = drawn(report_of(study), "total-deviation-1")
    found = {
        (controller, row["x"], row["initial"]): row["v"]
        for controller in ("mpc", "onoff")
        for row in figure.data[f"total-deviation-1-{controller}"]
    }
    expected = {
        (one.row["controller"],
         float(one.row.get("parameter:weight") or one.row["parameter:fraction"]),
         one.row["initial"]): one.metrics["total_deviation_m3"]
        for one in simulated
    }
    assert found == pytest.approx(expected, rel=1e-6)
    # A fifth of an hour is not the paper's window.
    assert not any(name.startswith("published") for name in figure.data)


def test_published_totals_stand_beside_the_papers_window(tmp_path: Path) -> None:
    """12 h from its start, its site, its evapotranspiration: and nowhere else."""
    column = np.linspace(2.4, 3.5, 43201)
    columns = {
        **dict.fromkeys(NAMES, np.zeros(43201)), "time": np.arange(43201.0),
        "cistern": column + 55, "roof": column,
    }
    trajectory = Trajectory(start=START, **columns)
    row = simulate("onoff", "0.5", "low-low", "0.1").row
    for name, changes, there in (
        ("published", {}, True),
        ("fao56", {"evapotranspiration": "fao56"}, False),
        ("offset", {"roof_offset": "0.005"}, False),
        ("forecast", {"forecast": "persistence"}, False),
    ):
        path = write_study(
            tmp_path / name,
            [
                ({**row, **changes, "parameter:fraction": fraction}, trajectory)
                for fraction in ("0.2", "0.5")
            ],
            [*HEADER, *(key for key in changes if key not in HEADER)],
        )
        data = drawn(report_of(path), "total-deviation-1").data
        assert ("published-1-onoff" in data) == there
    found = {one["x"]: one["v"] for one in drawn(
        report_of(tmp_path / "published"), "total-deviation-1").data["published-1-onoff"]}
    assert found == {2: 9599.6557, 1.5: 9780.0045, 1: 9611.9628, 0.5: 9635.5272, 0.2: 9725.43}


def test_balance_bars_add_up(study: Path, simulated: list[Simulated]) -> None:
    """The bars of a run are the change of what the tank holds."""
    data = drawn(report_of(study), "water-balance-1").data
    for tank, column in (("cistern", "cistern"), ("roof", "roof")):
        rows = data[f"balance-1-{tank}"]
        sums: dict[str, float] = {}
        for row in rows:
            sums[row["run"]] = sums.get(row["run"], 0) + row["v"]
        changes = [np.ptp(getattr(one.trajectory, column)[[0, -1]]) for one in simulated]
        assert sorted(map(abs, sums.values())) == pytest.approx(sorted(changes), abs=1e-5)


def test_any_controller_with_any_parameters(tmp_path: Path, simulated: list[Simulated]) -> None:
    """Controllers and parameters that this package does not know yet, numbers and words."""
    header = [name for name in HEADER if not name.startswith("parameter:")]
    # Wherever they stand, and whatever other column has their name.
    header += [f"parameter:{name}" for name in ("horizon", "forecast", "threshold")]
    rows = []
    for name, parameters in (
        ("lookahead", {"horizon": "10", "forecast": "perfect"}),
        ("lookahead", {"horizon": "60", "forecast": "hourly"}),
        ("anticipating_onoff", {"threshold": "0.5"}),
        ("anticipating_onoff", {"threshold": "inf"}),
        ("proportional", {}),
        ("proportional", {}),
    ):
        row = {key: value for key, value in simulated[0].row.items() if key in header}
        given = {f"parameter:{key}": value for key, value in parameters.items()}
        rows.append(({**row, "controller": name, **given}, simulated[0].trajectory))
    report = report_of(write_study(tmp_path / "study", rows, header))
    assert report.controllers == ["lookahead", "anticipating_onoff", "proportional"]
    assert report.settings["lookahead"].labels == [
        "horizon 10, forecast perfect", "horizon 60, forecast hourly"
    ]
    assert report.settings["anticipating_onoff"].labels == ["0.5", "none"]
    assert report.settings["proportional"].labels == ["005", "006"]
    for make in make_figures(report, None):
        make().save(tmp_path)
    assert len(list(tmp_path.glob("*.png"))) == len(make_figures(report, None))


def test_figure_numbers_are_the_papers(study: Path) -> None:
    """Deviation is its fifth figure, after schematic, two of the pump, and weather."""
    assert "(paper: Fig. 5)" in drawn(report_of(study), "total-deviation-1").caption
    assert "(Fig. 5)" in METRICS[0].meaning


def test_a_studys_notes_name_the_hours(tmp_path: Path, simulated: list[Simulated]) -> None:
    """Those that were filled; and what the table knows beyond them."""
    named = "dew point: 2021-07-20T12:00-05:00 to 2021-07-21T03:00-05:00 (16 hours)"
    row = {**simulated[0].row, "filled_hours": "16", "filled": named, "fallbacks": "2",
           "suspicious": "79.2 mm", "forecast_repeats_from": "2021-07-31T23:00-05:00"}
    few = simulated[0].trajectory.thinned(60)
    text = page_of(
        write_study(tmp_path / "study", [(row, few)], [*HEADER, "suspicious"])
    )
    assert "Suspicious, and taken as it is: 79.2 mm." in text
    assert "Samples every 60 s were kept, of ticks of 1 s: its sums, counts and times" in text
    assert "16 hours of the weather from 2021-07-07 02:00-05:00 were missing and filled" in text
    assert f"<details><summary>which</summary>{named}</details>" in text
    assert "The controller&#39;s solver found no answer in 2 ticks." in text
    assert "A forecast ends at 2021-07-31T23:00-05:00, and what follows is assumed." in text


def test_the_least_possible(tmp_path: Path, simulated: list[Simulated]) -> None:
    """A line for each initial state in the figure, and a column in the tables."""
    runs = [
        ({**one.row, "bound_m3": {"low-low": 200.0, "high-low": 100.0}[one.row["initial"]]},
         one.trajectory)
        for one in simulated
    ]
    # Two of the rows do not know it.
    runs[0][0]["bound_m3"] = runs[7][0]["bound_m3"] = ""
    path = write_study(tmp_path / "study", runs)
    report = report_of(path)
    figure = drawn(report, "total-deviation-1")
    assert {row["initial"]: row["v"] for row in figure.data["bound-1"]} == {
        "low-low": 200, "high-low": 100
    }
    for panel in figure.panels:
        rules = [
            layer for layer in panel.specification()["layer"] if layer["mark"]["type"] == "rule"
        ]
        assert [rule["data"]["name"] for rule in rules] == ["bound-1"]
    assert "bound-1" not in drawn(report, "energy-1").data
    text = page_of(path)
    assert text.count("over the least possible (1)</button>") == 2
    assert f">{simulated[1].metrics['total_deviation_m3'] / 200:.4f}<" in text
    assert ">unknown<" in text
    assert "<strong>Least possible</strong>" in text


# --- many seeds --------------------------------------------------------------------------------

ERRORS = ["forecast", "forecast_skill", "forecast_seed", "forecast_members"]
SEEDED = [*HEADER[:6], *ERRORS, *HEADER[6:]]


def seeded_rows(row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return 2 windows x 2 initial states x 3 settings x 2 skills x 25 seeds of made-up totals.

    The totals of seed n = 1..25 are the base + n m3, times 1 with better forecasts and
    2 with real ones.
    """
    rows = []
    for start, hours in (("2021-07-07T02:00:00-05:00", "12.0"), ("2021-07-20T02:00-05:00", "24")):
        for initial, bound in (("low-low", 500), ("high-low", 400)):
            for name, key, value, base in (
                ("mpc", "weight", "0.01", 900), ("onoff", "fraction", "0.5", 1000),
                ("onoff", "fraction", "2", 2000),
            ):
                for skill, times in (("real", 2), ("better", 1)):
                    rows += [
                        {**row, "start": start, "hours": hours, "initial": initial,
                         "controller": name, "parameter:weight": "", "parameter:fraction": "",
                         f"parameter:{key}": value,
                         "forecast": "ensemble", "forecast_skill": skill, "forecast_seed": seed,
                         "forecast_members": 10, "fallbacks": seed, "bound_m3": bound,
                         "total_deviation_m3": (base + seed) * times}
                        for seed in range(1, 26)
                    ]
    return rows


@pytest.fixture(scope="module")
def seeds(simulated: list[Simulated], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of forecast errors: a table without a single trajectory."""
    return write_study(
        tmp_path_factory.mktemp("seeds") / "study",
        [(row, None) for row in seeded_rows(simulated[0].row)], SEEDED,
    )


def test_seeds_belong_together(seeds: Path) -> None:
    """Mean of 25 seeds, mean of the worst two, worst: by hand; the worst tenth is rounded down."""
    report = report_of(seeds)
    assert report.results == [] and len(report.seeded) == 600
    found = spreads(report)
    assert len(found) == 2 * 2 * 3 * 2
    one = next(one for one in found if one.setting == "fraction 2" and one.skill == "real")
    assert one.place.start == "2021-07-07 02:00-05:00"
    assert len(one.totals) == 25
    assert (one.mean, one.worst_tenth, one.worst) == (2 * 2013, 2 * 2024.5, 2 * 2025)
    assert one.bound_m3 == 500
    assert [(one.controller, one.setting, one.skill) for one in found[:6]] == [
        (name, setting, skill)
        for name, setting in (
            ("mpc", "weight 0.01"), ("onoff", "fraction 0.5"), ("onoff", "fraction 2")
        )
        for skill in ("better", "real")
    ]


def test_seeds_figure(seeds: Path, tmp_path: Path) -> None:
    """One for the study, a panel for each window and initial state; none for each seed."""
    report = report_of(seeds)
    figures = [make() for make in make_figures(report, None)]
    assert [figure.name for figure in figures] == [
        "forecast-errors", "pump-curve-1", "pump-smoothing-1"
    ]
    figure = figures[0]
    assert figure.title == "Deviation under forecast errors"
    assert [panel.title for panel in figure.panels] == [
        [f"{window}", f"from {initial}"]
        for window in ("2021-07-07 02:00-05:00, 12 h", "2021-07-20 02:00-05:00, 24 h")
        for initial in ("low-low", "high-low")
    ]
    rows = figure.data["forecast-errors-2"]
    assert {
        row["amount"]: row["v"] for row in rows
        if row["series"] == "on/off fraction 0.5" and row["skill"] == "better"
    } == {"mean": 1013, "mean of the worst tenth": 1024.5}
    colour = figure.panels[0].specification()["layer"][-1]["encoding"]["color"]["scale"]
    # Colour is the controller's, whatever its setting.
    assert colour["domain"] == ["MPC weight 0.01", "on/off fraction 0.5", "on/off fraction 2"]
    assert colour["range"][0] != colour["range"][1] == colour["range"][2]
    figure.save(tmp_path)
    assert (tmp_path / "forecast-errors.png").stat().st_size > 10_000


def test_seeds_page(seeds: Path, tmp_path: Path) -> None:
    """Quick, without a trajectory: the table, and what the page leaves out."""
    done = command(str(seeds), "--output", "report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "their forecasts' errors: 600" in done.stdout
    text = page_of(seeds)
    table = text.partition("over their seeds</h3>")[2].partition("</table>")[0]
    assert table.count("<tr>") == 1 + 24
    row = next(row for row in table.split("<tr>") if "onoff 000002" in row)
    cells = [cell.partition("<")[0] for cell in row.split('">')[1:]]
    assert cells == [
        "on/off", "fraction 0.5", "25", "better", "2021-07-07 02:00-05:00", "12 h", "low-low",
        "1013.00", "1024.50", "1025.00", "2.0260", "2.0490", "2.0500",
    ]
    assert "Results of each run" not in text
    assert "judged together, by results.csv" in text
    # 25 different numbers of ticks are one note.
    assert text.count("found no answer in") == 1
    page = (tmp_path / "report" / "report.html").read_text()
    assert "report on 600 runs" in page
    assert (
        "toronto_2021-07.csv, 2021-07-20 02:00-05:00, 24 h, evapotranspiration published, forecast "
        "ensemble members 10 skill real, 25 seeds"
    ) in page


def test_seeds_beside_other_runs(tmp_path: Path, simulated: list[Simulated]) -> None:
    """A perfect forecast and a single seed stay as they were, and their tables leave none out."""
    one = simulated[0]
    errors = {"forecast": "errors", "forecast_skill": "real", "forecast_members": ""}
    path = write_study(
        tmp_path / "study",
        [
            (one.row, one.trajectory),
            (
                {**one.row, **errors, "forecast_skill": "worse", "forecast_seed": "7"},
                one.trajectory,
            ),
            *(({**one.row, **errors, "forecast_seed": seed}, None) for seed in ("1", "2")),
        ],
        SEEDED,
    )
    report = report_of(path)
    assert [window.forecast for window in report.windows] == ["", "errors skill worse seed 7"]
    assert [entry.name for entry in report.seeded] == ["003", "004"]
    assert [len(one.totals) for one in spreads(report)] == [2]
    names = [make().name for make in make_figures(report, None)]
    assert names.count("forecast-errors") == 1 and "trajectories-2-1" in names
    assert "trajectories-3-1" not in names
    text = page_of(path)
    assert "Results of each run" in text
    assert "over the least" not in text


def test_sensor_and_pump_errors_are_named(tmp_path: Path, simulated: list[Simulated]) -> None:
    """Runs with sensor or pump errors are not compared with those without, and are named."""
    one = simulated[0]
    noisy = {"roof_noise": "0.0005", "roof_offset": "0.0", "noise_seed": "3"}
    path = write_study(
        tmp_path / "study",
        [
            (one.row, one.trajectory),
            ({**one.row, **noisy, "minimum_on": "0.0"}, one.trajectory),
            ({**one.row, "noise_seed": "3", "minimum_on": "60.0"}, one.trajectory),
        ],
        [*HEADER[:6], "roof_noise", "roof_offset", "noise_seed", "minimum_on", *HEADER[6:]],
    )
    named = ["", "roof noise 0.0005 m, seed 3", "minimum on 60 s"]
    assert [window.sensor_pump_errors for window in report_of(path).windows] == named
    text = page_of(path)
    assert "evapotranspiration published, roof noise 0.0005 m, seed 3" in text
    assert "sensor and pump errors" in text


# --- the command -------------------------------------------------------------------------------


def payload(page: Path) -> dict[str, Any]:
    """Return the data that a page holds."""
    text = page.read_text().partition('id="payload">')[2].partition("</script>")[0]
    return json.loads(text)


def test_study(study: Path, tmp_path: Path) -> None:
    """A page, each figure twice, the failed run with its error, and where the page is."""
    done = command(str(study), "--output", "report", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page = tmp_path / "report" / "report.html"
    assert str(page) in done.stdout
    assert "fraction 2" in done.stdout
    text = page.read_text()
    assert "solver: &lt;gave up&gt;" in text
    assert "2 runs failed" in text
    assert "<td>not run</td>" in text
    assert "The command was above 1" in text
    assert "no real pump can follow it." in text and "better than" not in text
    assert text.count("pumped <br>(m³)</button>") == 3
    assert "over the least" not in text
    names = {path.stem for path in (tmp_path / "report" / "figures").iterdir()}
    assert {"pump-curve-1", "weather-1", "total-deviation-1", "trajectories-1-2"} <= names
    for name in names:
        svg = (tmp_path / "report" / "figures" / f"{name}.svg").read_text()
        png = (tmp_path / "report" / "figures" / f"{name}.png").read_bytes()
        assert svg.startswith("<svg") and "<text" in svg
        assert png.startswith(b"\x89PNG")
        width, height = struct.unpack(">II", png[16:24])
        assert width > 800 and height > 400
    assert {panel["figure"] for panel in payload(page)["panels"]} == names


def test_both_methods_stand_side_by_side(tmp_path: Path, simulated: list[Simulated]) -> None:
    """With their difference in %, by hand: 3 % more."""
    roof = simulated[0].trajectory.roof
    target = PAPER_SITE.x2_star
    further = dataclasses.replace(simulated[0].trajectory, roof=target + 1.03 * (roof - target))
    path = write_study(
        tmp_path / "study",
        [
            (simulated[0].row, simulated[0].trajectory),
            ({**simulated[0].row, "evapotranspiration": "fao56"}, further),
        ],
    )
    report = report_of(path)
    assert [window.method for window in report.windows] == ["published", "fao56"]
    text = render(
        report, [make() for make in make_figures(report, None)], find_runs([path], None),
        Assumptions(),
    )
    table = text.partition("both kinds of evapotranspiration</h3>")[2].partition("</table>")[0]
    assert f">{simulated[0].metrics['total_deviation_m3']:.2f}<" in table
    assert f">{1.03 * simulated[0].metrics['total_deviation_m3']:.2f}<" in table
    assert ">+3.00<" in table
    assert {
        row["method"] for row in drawn(report, "weather-1").data["evapotranspiration-1"]
    } == {"published", "fao56"}


# --- bags --------------------------------------------------------------------------------------

TOPICS = {
    "/cistern/level": "cistern", "/roof/level": "roof", "/pump/command": "command",
    "/pump/flow": "pump_flow", "/weather/precipitation": "precipitation",
    "/weather/evapotranspiration": "evapotranspiration", "/cistern/outflow": "outflow",
    "/roof/drainage": "drainage", "/weather/frost": "frost",
}


def write_bag(
    directory: Path,
    messages: dict[str, tuple[Sequence[int], Sequence[float]]],
    storage: StoragePlugin = StoragePlugin.MCAP,
    msgtype: str = "std_msgs/msg/Float64",
) -> Path:
    """Write a bag as somebody else would: stamps (ns since the start) and values of each topic."""
    Message = TYPES.types[msgtype]
    queue = []
    with Writer(directory, version=9, storage_plugin=storage) as writer:
        for topic, (stamps, values) in messages.items():
            connection = writer.add_connection(topic, msgtype, typestore=TYPES)
            queue += [
                (stamp, connection, value) for stamp, value in zip(stamps, values, strict=True)
            ]
        for stamp, connection, value in sorted(queue, key=lambda item: item[0]):
            writer.write(
                connection, START_NS + int(stamp),
                bytes(TYPES.serialize_cdr(Message(value), msgtype)),
            )
    return directory


def messages_of(trajectory: Trajectory) -> dict[str, tuple[Sequence[int], Sequence[float]]]:
    """Return the messages of a run, all of a tick at one time."""
    area = {"cistern": 25.0, "roof": 68.8}
    stamps = [round(time * 1e9) for time in trajectory.time]
    return {
        topic: (stamps, (getattr(trajectory, name) / area.get(name, 1.0)).tolist())
        for topic, name in TOPICS.items()
    }


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_gives_the_runs_numbers(
    tmp_path: Path, simulated: list[Simulated], storage: StoragePlugin
) -> None:
    """Read from the bag alone, with the paper's site, which the report says."""
    one = simulated[0]
    write_bag(tmp_path / "bag", messages_of(one.trajectory), storage)
    entry = find_runs([tmp_path / "bag"], None).runs[0]
    trajectory, notes = entry.load()
    for name in NAMES:
        np.testing.assert_allclose(
            getattr(trajectory, name), getattr(one.trajectory, name), rtol=1e-15, err_msg=name
        )
    assert trajectory.start == START
    judged = assess(entry.site, trajectory, Assumptions())
    for name in ("total_deviation_m3", "pumped_m3"):
        assert judged.metrics[name] == pytest.approx(one.metrics[name], rel=1e-12)
    assert (entry.name, entry.controller) == ("bag", "unknown")
    assert notes == ()
    assert any("the paper's, config/site.yaml" in str(note) for note in entry.notes)


def test_a_bag_of_a_namespace(tmp_path: Path, simulated: list[Simulated]) -> None:
    """The same run under /site1; two roofs in one bag are refused."""
    plain = messages_of(simulated[0].trajectory)
    spaced = {f"/site1{topic}": messages for topic, messages in plain.items()}
    write_bag(tmp_path / "plain", plain)
    write_bag(tmp_path / "spaced", spaced)
    write_bag(tmp_path / "both", {**plain, **spaced})
    runs = find_runs([tmp_path / "plain", tmp_path / "spaced", tmp_path / "both"], None).runs
    first, second = (run.load().trajectory for run in runs[:2])
    for name in NAMES:
        assert (getattr(first, name) == getattr(second, name)).all()
    with pytest.raises(ConfigurationError, match=r"of one graph, but holds .* /, /site1"):
        runs[2].load()


def test_a_real_sites_bag(tmp_path: Path) -> None:
    """Nothing is aligned: each stamp is a sample, all else is the last value before, by hand."""
    second = 10**9
    write_bag(
        tmp_path / "bag",
        {
            "/roof/level": ([0, 10 * second, 21 * second, 30 * second], [0.01, 0.02, 0.03, 0.04]),
            "/cistern/level": ([4 * second, 21 * second], [2.0, 1.5]),
            "/pump/command": ([5 * second, 29 * second], [0.0, 0.5]),
            "/pump/flow": ([6 * second, 29 * second], [0.0, 0.004]),
            "/weather/precipitation": ([20 * second], [1e-6]),
        },
    )
    entry = find_runs([tmp_path / "bag"], None).runs[0]
    trajectory, notes = entry.load()
    # At 0, 4 and 5 s there is no flow yet.
    assert trajectory.start.timestamp() == START_NS / 1e9 + 6
    assert (trajectory.time + 6).tolist() == [6, 10, 20, 21, 29, 30]
    assert trajectory.roof.tolist() == [
        68.8 * level for level in (0.01, 0.02, 0.02, 0.03, 0.03, 0.04)
    ]
    assert trajectory.cistern.tolist() == [50, 50, 50, 37.5, 37.5, 37.5]
    assert trajectory.command.tolist() == [0, 0, 0, 0, 0.5, 0.5]
    assert trajectory.pump_flow.tolist() == [0, 0, 0, 0, 0.004, 0.004]
    assert trajectory.precipitation.tolist() == [0, 0, 1e-6, 1e-6, 1e-6, 1e-6]
    assert trajectory.outflow.tolist() == [0] * 6
    assert {note.split()[0] for note in notes} == {
        "/weather/evapotranspiration", "/cistern/outflow", "/roof/drainage", "/weather/frost"
    }


MINUTE = 60 * 10**9


def site_bag(directory: Path, **changes: tuple[Sequence[int], Sequence[float]]) -> Path:
    """An hour of a real site: levels each minute, a flow of 1 L/s in seconds 70 to 89."""
    seconds, minutes = range(3600), [minute * MINUTE for minute in range(60)]
    flow = [0.001 * (70 <= second < 90) for second in seconds]
    return write_bag(directory, {
        "/roof/level": (minutes, [0.03] * 60), "/cistern/level": (minutes, [2.0] * 60),
        "/pump/command": ([second * 10**9 for second in seconds], [0.1 * (q > 0) for q in flow]),
        "/pump/flow": ([second * 10**9 for second in seconds], flow),
        **{f"/{key.replace('_', '/')}": value for key, value in changes.items()},
    })


def test_pulses_between_the_levels_count(tmp_path: Path) -> None:
    """20 s of 1 L/s lie between two levels; the deviation is an integral over time all the same."""
    trajectory, _ = find_runs([site_bag(tmp_path / "bag")], None).runs[0].load()
    judged = assess(PAPER_SITE, trajectory, Assumptions())
    assert judged.metrics["pumped_m3"] == pytest.approx(0.02, rel=1e-9)
    assert judged.metrics["pump_starts"] == 1
    assert judged.metrics["pump_hours"] == pytest.approx(20 / 3600)
    deviation = 3600 * 68.8 * (0.0457 - 0.03)
    assert judged.metrics["total_deviation_m3"] == pytest.approx(deviation, rel=1e-9)


@pytest.mark.parametrize(("starts", "warned"), [(20, False), (21, True)])
def test_pumps_that_start_too_often(starts: int, warned: bool, tmp_path: Path) -> None:
    """The paper's site allows 20 starts in an hour: the page warns of 21."""
    seconds = [minute * MINUTE for minute in range(60)]
    site_bag(tmp_path / "bag", pump_flow=(
        seconds, [0.001 * (minute % 2 and minute < 2 * starts) for minute in range(60)]
    ))
    text = page_of(tmp_path / "bag")
    assert ("The pumps started more than 20 times in an hour" in text) is warned


def test_a_gap_is_not_filled_with_flow(tmp_path: Path) -> None:
    """The recorder stood still for two hours while the pump ran; 9 minutes are no gap."""
    stamps = [0, MINUTE, 2 * MINUTE, 11 * MINUTE, 12 * MINUTE, 132 * MINUTE, 133 * MINUTE]
    count = len(stamps)
    write_bag(tmp_path / "bag", {
        "/roof/level": (stamps, [0.03] * count), "/cistern/level": (stamps, [2.0] * count),
        "/pump/command": (stamps, [0.1] * count), "/pump/flow": (stamps, [0.001] * count),
        "/weather/precipitation": (stamps, [1e-6] * count),
    })
    trajectory, notes = find_runs([tmp_path / "bag"], None).runs[0].load()
    assert trajectory.pump_flow.tolist() == [0.001] * 4 + [0] + [0.001] * 2
    assert trajectory.command.tolist() == [0.1] * 4 + [0] + [0.1] * 2
    assert trajectory.precipitation.tolist() == [1e-6] * 4 + [0] + [1e-6] * 2
    judged = assess(PAPER_SITE, trajectory, Assumptions())
    assert judged.metrics["pumped_m3"] == pytest.approx(0.001 * 13 * 60)
    assert judged.metrics["total_deviation_m3"] == pytest.approx((133 * 60 + 1) * 68.8 * 0.0157)
    [note] = [note for note in notes if "no message came" in note]
    assert "2021-07-07T07:12:00+00:00 to 2021-07-07T09:12:00+00:00 (2 h)" in note


def test_regular_samples_have_no_gaps(tmp_path: Path) -> None:
    """A value each quarter of an hour is how the site measures, not a gap."""
    stamps = [15 * MINUTE * number for number in range(8)]
    values = {"/roof/level": 0.03, "/cistern/level": 2.0, "/pump/command": 0.1,
              "/pump/flow": 0.001}
    write_bag(tmp_path / "bag", {key: (stamps, [value] * 8) for key, value in values.items()})
    trajectory, notes = find_runs([tmp_path / "bag"], None).runs[0].load()
    assert trajectory.pump_flow.tolist() == [0.001] * 8
    assert not any("no message came" in note for note in notes)


def test_outliers_are_left_out(tmp_path: Path) -> None:
    """A NaN and a spike among 3600 values: the value before holds on, and a note counts them."""
    stamps = [second * 10**9 for second in range(3600)]
    levels = [0.03] * 3600
    levels[100], levels[200] = float("nan"), 35.0
    site_bag(tmp_path / "bag", roof_level=(stamps, levels))
    trajectory, notes = find_runs([tmp_path / "bag"], None).runs[0].load()
    assert set(trajectory.roof.tolist()) == {68.8 * 0.03}
    assert any("2 of 3600 values of /roof/level are not finite" in note for note in notes)


@pytest.mark.parametrize("known", [0, 2, 3])
def test_frost_may_be_unknown(known: int, tmp_path: Path) -> None:
    """As at the start of a live site, before there is a forecast: a NaN, by the interface."""
    frost = [float("nan")] * (3 - known) + [0.0] * known
    small_bag(tmp_path / "bag", weather_frost=frost)
    trajectory, _ = find_runs([tmp_path / "bag"], None).runs[0].load()
    assert len(trajectory.roof) == 3


def test_a_wrong_unit_is_no_outlier(tmp_path: Path) -> None:
    """A pump in L/s that runs for 20 s of an hour, less than a hundredth of it, is refused."""
    stamps = [second * 10**9 for second in range(3600)]
    flow = [1.0 * (70 <= second < 90) for second in range(3600)]
    site_bag(tmp_path / "bag", pump_flow=(stamps, flow))
    with pytest.raises(ConfigurationError, match=r"/pump/flow: .*is a unit wrong"):
        find_runs([tmp_path / "bag"], None).runs[0].load()


def test_limits_are_those_of_the_site(tmp_path: Path) -> None:
    """Three times what the pumps give at the outlet's level, by hand, and all else just below."""
    full = np.roots([
        (3.56 * 18.4 / 0.2 + 0.6) / (2 * 9.81 * (0.01 * np.pi) ** 2) + 5.78e5, 0, 16 - 3 - 55.2
    ]).max()
    highest = {
        "roof_level": 1.0, "cistern_level": 9.0, "pump_flow": 3 * full,
        "weather_precipitation": 0.5 / 3600, "weather_evapotranspiration": 0.05 / 86400 * 68.8,
    }
    for name, value in highest.items():
        fine = small_bag(tmp_path / name, **{name: [value * (1 - 1e-6)] * 3})
        find_runs([fine], None).runs[0].load()
        wrong = small_bag(tmp_path / f"{name}-wrong", **{name: [value * (1 + 1e-6)] * 3})
        with pytest.raises(ConfigurationError, match="is a unit wrong"):
            find_runs([wrong], None).runs[0].load()


def own_run(directory: Path, one: Simulated) -> Path:
    """Write what bringup leaves of a run that was simulated."""
    write_bag(directory / "bag", messages_of(one.trajectory))
    (directory / "configuration" / "weather").mkdir(parents=True)
    shutil.copy(CONFIG / "site.yaml", directory / "configuration")
    shutil.copy(
        CONFIG / "weather" / "toronto_2021-07.csv", directory / "configuration" / "weather"
    )
    (directory / "summary.json").write_text(json.dumps({
        "controller": one.row["controller"], "parameters": {"fraction": 2.0},
        "initial": {"name": "low-low", "cistern_m3": 57.69, "roof_m3": 2.42},
        "start": START.isoformat(), "evapotranspiration_method": "published",
        "solver": {"fallbacks": 3}, "limited_steps": 4,
        "forecast_repeats_last_record_from": "2021-07-31T23:00-05:00",
        "filled": {"dew point": ["2021-07-20T13:00-05:00"]},
        "weather_notes": ["rain was moved an hour back"],
        "suspicious": ["79.2 mm at 2015-12-29T02:00-05:00"],
    }))
    return directory


def test_sites_of_run_directories(tmp_path: Path, simulated: list[Simulated]) -> None:
    """Runs of equal sites are compared, whatever their directories; other sites are in titles."""
    paths = [own_run(tmp_path / name, one) for name, one in zip("abc", simulated[:3], strict=True)]
    report = Report([result(run, Assumptions()) for run in find_runs(paths, None).runs])
    assert [run.site_name for run in report.entries] == ["site.yaml"] * 3
    assert len(report.windows) == 1
    assert "site" not in report.heading(report.windows[0])
    file = paths[1] / "configuration" / "site.yaml"
    file.write_text(file.read_text().replace("a1: 25.0", "a1: 30.0"))
    report = Report([result(run, Assumptions()) for run in find_runs(paths, None).runs])
    assert [run.site_name for run in report.entries] == [
        "site.yaml (a)", "site.yaml (b)", "site.yaml (a)"
    ]
    headings = list(map(report.heading, report.windows))
    assert len(set(headings)) == len(headings) == 2
    assert headings[1].startswith("site.yaml (b), ")
    header = {table.name: table.header for table in make_tables(report, Assumptions())}
    assert "site" in header["Results of each run"]


def ended_run(directory: Path, status: str, **known: Any) -> Path:
    """Write what bringup leaves of 720 ticks of MPC; without metrics, if it is not done."""
    one = simulate("mpc", "0.001", "low-low")
    ticks = known.get("last_tick") or 720
    columns = {name: getattr(one.trajectory, name)[: ticks + 1] for name in NAMES}
    write_bag(directory / "bag", messages_of(Trajectory(start=START, **columns)))
    (directory / "configuration").mkdir()
    shutil.copy(CONFIG / "site.yaml", directory / "configuration")
    (directory / "summary.json").write_text(json.dumps({
        "status": status, "reason": None, "last_tick": None, "controller": "mpc",
        "parameters": {"weight": 0.001, "max_command": None}, "weather": "toronto_2021-07.csv",
        "initial": {"name": "low-low", "cistern_m3": 57.69, "roof_m3": 2.42},
        "start": START.isoformat(), "steps": 720, "tau_s": 1.0,
        "evapotranspiration_method": "published", "parameter_changes": [], "refused": {},
        **known,
    }))
    return directory


def test_no_bound_from_a_sensor_that_errs(
    tmp_path: Path, simulated: list[Simulated]
) -> None:
    """Its first reading is not what was on the roof, and its sum no deviation of it."""
    path = own_run(tmp_path / "run", simulated[3])
    file = path / "summary.json"
    summary = json.loads(file.read_text())
    for sensor_pump_errors, known in (({"roof_offset": 0.005}, False), ({"minimum_on": 60}, True)):
        file.write_text(json.dumps({**summary, "sensor_pump_errors": sensor_pump_errors}))
        assert (report_of(path).results[0].bound_m3 is not None) == known


def test_a_study_without_trajectories(tmp_path: Path) -> None:
    """Its single runs cannot be drawn: said with what to do."""
    path = write_study(tmp_path / "study", [(simulate("onoff", "0.5", "low-low", "0.1").row, None)])
    with pytest.raises(ConfigurationError, match=r"parquet.*made with --no-trajectories"):
        report_of(path)


def test_a_run_directorys_notes_and_bound(tmp_path: Path, simulated: list[Simulated]) -> None:
    """As a study's: fallbacks, repeated forecasts, filled hours; and the least possible."""
    one = simulated[3]
    report = report_of(own_run(tmp_path / "run", one))
    for note in (
        "the controller's solver found no answer in 3 ticks",
        "a forecast ends at 2021-07-31T23:00-05:00, and what follows is assumed",
        "a tank ran empty in 4 ticks, and what left it was limited",
        "rain was moved an hour back",
        "dew point was missing and filled in",
        "suspicious, and taken as it is: 79.2 mm at 2015-12-29T02:00-05:00",
    ):
        assert note in map(str, report.results[0].notes)
    assert "2021-07-20T13:00-05:00" in [note.listed for note in report.results[0].notes]
    expected = clairvoyant_bound(paper_run("--initial", "low-low", "--hours", "0.2")).bound_m3
    assert report.results[0].bound_m3 == pytest.approx(expected, rel=1e-9)
    assert report.results[0].ratio_to_bound == pytest.approx(
        one.metrics["total_deviation_m3"] / expected, rel=1e-9
    )


def test_no_bound_for_other_weather(tmp_path: Path, simulated: list[Simulated]) -> None:
    """Where the rain in the bag is not that of the file, what was possible is unknown."""
    wet = dataclasses.replace(
        simulated[3].trajectory, precipitation=simulated[3].trajectory.precipitation + 1e-7
    )
    report = report_of(own_run(tmp_path / "run", simulated[3]._replace(trajectory=wet)))
    assert report.results[0].bound_m3 is None
    assert "over the least possible" not in page_of(tmp_path / "run")


def test_own_runs_may_be_beyond_a_sites(tmp_path: Path, simulated: list[Simulated]) -> None:
    """On/off of fraction 5 pumps five times the full flow, from a cistern that holds 15 m."""
    one = simulated[3].trajectory
    pumped = dataclasses.replace(
        one, command=np.full(len(one.time), 5.0), pump_flow=np.full(len(one.time), 0.04),
        cistern=one.cistern + 325,
    )
    report = report_of(own_run(tmp_path / "run", simulated[3]._replace(trajectory=pumped)))
    assert report.results[0].assessment.metrics["max_command"] == 5


FOREIGN = {
    "cut": "{", "a-list": "[1]", "empty": "", "another-tools": '{"name": "x"}',
    "a-number": '{"controller": 5}', "bytes": "\x00", "deep": "[" * 100_000,
    "initial-a-word": '{"controller": "mpc", "initial": "low"}',
    "initial-of-words": '{"controller": "mpc", "initial": {"cistern_m3": "a", "roof_m3": "b"}}',
    "parameters-a-list": '{"controller": "mpc", "parameters": [1]}',
    "filled-a-number": '{"controller": "mpc", "filled": {"rain": 3}}',
    "start-a-number": '{"controller": "mpc", "start": 5}',
    "forecast-a-word": '{"controller": "mpc", "forecast": "perfect"}',
    "solver-a-word": '{"controller": "mpc", "solver": "osqp"}',
    "limited-a-word": '{"controller": "mpc", "limited_steps": "many"}',
}


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("file", ["summary.json", "configuration/parameters.yaml"])
def test_foreign_labels_leave_the_numbers(tmp_path: Path, name: str, file: str) -> None:
    """What lies beside a good bag is no reason to refuse it: the directory's name is its label."""
    small_bag(tmp_path / "run" / "bag")
    (tmp_path / "run" / "configuration").mkdir()
    (tmp_path / "run" / file).write_text(FOREIGN[name])
    report = report_of(tmp_path / "run")
    one = report.results[0]
    assert (one.entry.name, one.entry.controller, one.entry.initial) == (
        "run", "unknown", "as recorded"
    )
    assert any(str(note).startswith(f"{file} beside the bag is damaged or foreign")
               for note in one.notes)
    assert one.assessment.metrics["pumped_m3"] == pytest.approx(0.002)


def test_a_damaged_summary_leaves_the_parameters(tmp_path: Path) -> None:
    """Of the nodes, as after a crash while it was written."""
    small_bag(tmp_path / "run" / "bag")
    (tmp_path / "run" / "configuration").mkdir()
    (tmp_path / "run" / "summary.json").write_text('{"controller": "mp')
    (tmp_path / "run" / "configuration" / "parameters.yaml").write_text(
        "/**/recorder: {ros__parameters: {controller: onoff}}\n"
        "/**/onoff: {ros__parameters: {fraction: 0.5, site_file: x}}\n"
        "/**/plant: {ros__parameters: {start: '2021-07-07T02:00-05:00', "
        "initial_cistern_volume: 50, initial_roof_volume: 2}}\n"
    )
    entry = find_runs([tmp_path / "run"], None).runs[0]
    assert (entry.controller, entry.parameters) == ("onoff", {"fraction": 0.5})
    assert entry.initial == "50 / 2 m3"
    assert any(str(note).startswith("summary.json beside the bag") for note in entry.notes)


def test_names_distinguish_paths(tmp_path: Path, study: Path) -> None:
    """By as much of the end of each path as it takes, and no more."""
    paths = [tmp_path / place for place in ("mon/bag", "tue/bag", "x/a/deep", "y/a/deep", "one")]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        small_bag(path)
    names = [run.name for run in find_runs(paths, None).runs]
    assert names == ["mon/bag", "tue/bag", "x/a/deep", "y/a/deep", "one"]
    twice = tmp_path / "again" / study.name
    shutil.copytree(study, twice)
    names = [run.name for run in find_runs([study, twice], None).runs]
    assert names[0] == f"{study.parent.name}/study/001"
    assert names[-1] == "again/study/008"
    with pytest.raises(ConfigurationError, match="two runs are named"):
        find_runs([paths[0], paths[1], tmp_path / "mon" / ".." / "mon" / "bag"], None)


def test_a_run_of_the_graph(domain: int, tmp_path: Path) -> None:
    """The bag of bringup gives the numbers of the summary, and its labels the run's."""
    pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    summary = bring_up(domain, tmp_path, "--hours", "0.1", "--controller", "onoff")
    entry = find_runs([tmp_path / "run"], None).runs[0]
    trajectory, notes = entry.load()
    judged = assess(entry.site, trajectory, Assumptions())
    for name, value in judged.metrics.items():
        assert value == pytest.approx(summary[name], rel=1e-12), name
    assert judged.roof_residual_m3 == pytest.approx(0, abs=1e-12)
    assert (entry.controller, entry.initial) == ("onoff", "low-low")
    assert entry.site_name == "site.yaml"
    assert trajectory.start.isoformat() == summary["start"]
    assert notes == () and entry.notes == ()
    assert entry.bound(trajectory) == pytest.approx(
        clairvoyant_bound(paper_run("--hours", "0.1")).bound_m3, rel=1e-9
    )
    (tmp_path / "run" / "summary.json").unlink()  # as after a crash
    crashed = find_runs([tmp_path / "run"], None).runs[0]
    assert (crashed.controller, crashed.parameters) == (entry.controller, entry.parameters)
    done = command("run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "report" / "report.html").is_file()


# A pump that gives 1 L/s, and in every tenth tick, the first among them, what cannot be.
BAD_DRIVER = """
import math, rclpy
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64

BAD, ticks = [math.nan, 5.0, -0.001, math.inf], 0

def on_command(message):
    global ticks
    publisher.publish(Float64(data=0.001 if ticks % 10 else BAD[ticks // 10 % 4]))
    ticks += 1

def on_liveliness(event):
    if event.alive_count == 0:
        raise SystemExit

rclpy.init()
node = rclpy.create_node("pump")
qos = QoSProfile(depth=64, durability=DurabilityPolicy.TRANSIENT_LOCAL)
qos.liveliness_lease_duration = Duration(seconds=1)
publisher = node.create_publisher(Float64, "pump/flow", qos)
events = SubscriptionEventCallbacks(liveliness=on_liveliness)
node.create_subscription(Float64, "pump/command", on_command, qos, event_callbacks=events)
rclpy.spin(node)
"""


def test_refused_flows_act_as_zero(domain: int, tmp_path: Path) -> None:
    """Summary and report agree, and with the sum by hand: 9 of 10 ticks of 1 L/s, 12 starts."""
    pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    driver = subprocess.Popen(
        [sys.executable, "-c", BAD_DRIVER], cwd=tmp_path, env=environment(domain)
    )
    try:
        summary = bring_up(
            domain, tmp_path, "--hours", str(120 / 3600), "--controller", "onoff",
            "--pump", "external",
        )
        assert driver.wait(300) == 0
    finally:
        driver.kill()
        driver.wait()
    assert summary["refused"] == {"/pump/flow": 13}  # of ticks 0 to 120
    assert summary["pumped_m3"] == pytest.approx(108 * 0.001, rel=1e-12)
    assert summary["pump_starts"] == 12
    (one,) = report_of(tmp_path / "run").results
    for name, value in one.assessment.metrics.items():
        assert value == pytest.approx(summary[name], rel=1e-12, abs=1e-15), name
    assert one.assessment.metrics["pump_starts"] == 12
    assert any("13 of 121 values of /pump/flow were refused" in str(note) for note in one.notes)


def test_what_the_plant_refuses_acts_as_zero(tmp_path: Path) -> None:
    """Command, rain and evapotranspiration of a run of this package; its own flow is as it was."""
    path = ended_run(tmp_path / "run", "done")
    shutil.rmtree(path / "bag")
    small_bag(
        path / "bag", pump_command=[math.nan, 2000.0, 0.5], pump_flow=[0.0, 8.0, 0.0],
        weather_precipitation=[2e-3, 1e-6, 0.0], weather_evapotranspiration=[-1.0, 1e-6, math.inf],
    )
    trajectory, notes = find_runs([path], None).runs[0].load()
    assert trajectory.command.tolist() == [0, 2000, 0.5]
    assert trajectory.pump_flow.tolist() == [0, 8, 0]
    assert trajectory.precipitation.tolist() == [0, 1e-6, 0]
    assert trajectory.evapotranspiration.tolist() == [0, 1e-6, 0]
    refused = {note.split()[5]: note.split()[0] for note in notes if "refused" in note}
    assert refused == {
        "/pump/command": "1", "/weather/precipitation": "1", "/weather/evapotranspiration": "2"
    }


def test_a_changed_parameter(tmp_path: Path) -> None:
    """It is in the setting, wherever that stands, and a warning; no axis has it as a number."""
    changes = [
        {"tick": 300, "parameter": "weight", "before": 0.001, "value": 0.00001},
        {"tick": 3660, "parameter": "weight", "before": 0.00001, "value": 0.1},
    ]
    path = ended_run(tmp_path / "run", "done", parameter_changes=changes)
    other = ended_run(tmp_path / "other", "done")
    report = report_of(path)
    became = "0.001 -> 0.00001 at 00:05 -> 0.1 at 01:01"
    assert report.settings["mpc"].labels == [became]
    rows = drawn(report, "trajectories-1-1").data["command-1-1-mpc"]
    assert {row["setting"] for row in rows} == {became}
    text = page_of(path).replace("&gt;", ">")
    assert f"weight was changed in the run: {became} (tick 300, 3660)." in text
    assert f">weight {became}<" in text
    both = Report([result(entry, Assumptions()) for entry in find_runs([path, other], None).runs])
    assert both.settings["mpc"].labels == ["0.001", became]
    assert both.settings["mpc"].axis == ""
    for make in make_figures(both, None):
        make()
    limit = {"tick": 60, "parameter": "max_command", "before": None, "value": 1.0}
    path = ended_run(tmp_path / "limited", "done", parameter_changes=[limit])
    assert report_of(path).settings["mpc"].full_label(find_runs([path], None).runs[0]) == (
        "max_command none -> 1 at 00:01"
    )


ENDINGS = {
    "failed": (
        {"last_tick": 72, "reason": "node weather ended (SIGKILL); its last lines:\n  none"},
        "failed at tick 72 of 720 (00:01:12): node weather ended (SIGKILL); its last lines: none",
    ),
    "interrupted": ({"last_tick": 610}, "was interrupted at tick 610 of 720 (00:10:10)"),
    "running": ({}, "has not ended, or bringup was killed"),
}


@pytest.mark.parametrize("status", ENDINGS)
def test_a_run_that_is_not_done_says_it_first(tmp_path: Path, status: str) -> None:
    """Alone before all else; beside others by name, and in its rows."""
    known, sentence = ENDINGS[status]
    path = ended_run(tmp_path / "broken", status, **known)
    text = page_of(path)
    said = f"<strong>Mind:</strong> this run {sentence}: what follows is of what was recorded"
    assert said in text
    assert text.index(said) < text.index('<section id="results">')
    if status == "failed":
        done = command("broken", cwd=tmp_path)
        assert f"broken {sentence}; what follows is of the part" in " ".join(done.stdout.split())
    whole = ended_run(tmp_path / "whole", "done")
    sources = find_runs([whole, path], None)
    html = render(
        Report([result(entry, Assumptions()) for entry in sources.runs]), [], sources,
        Assumptions(),
    )
    box = html.partition('class="cautions"')[2].partition("</p>")[0]
    assert "1 of 2 runs are not done" in box and 'href="#warnings"' in box
    warned = html.partition(f"{sentence[0].upper()}{sentence[1:]}; what follows")[2]
    assert "</summary>broken</details>" in warned.partition("</li>")[0]
    short = {"failed": "failed at tick 72", "interrupted": "interrupted at tick 610",
             "running": "not ended"}[status]
    assert html.count(f'class="text warning">{short}</td>') >= 2
    assert html.count(">done</td>") >= 2


LOSS = {
    "number": 1, "node": "pump", "part": "drive", "cause": "no connection to the drive",
    "began": "2026-11-21T02:25:12.500+00:00", "began_tick": 120,
    "ended": "2026-11-21T02:25:20.300+00:00", "ended_tick": 588,
}
STILL_LOST = {
    **LOSS, "number": 2, "node": "mpc", "part": "process", "cause": "ended (SIGKILL)",
    "began_tick": 600, "ended": None, "ended_tick": None,
}


def incidents_of(path: Path) -> list[list[str]]:
    """Return the cells of the table of incidents."""
    table = page_of(path).partition("<h3>Incidents</h3>")[2].partition("</table>")[0]
    return [
        re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", row)
        for row in table.partition("<tbody>")[2].split("<tr>")[1:]
    ]


def test_incidents_of_a_run(tmp_path: Path) -> None:
    """Said on the console and above all results, warned of, and listed."""
    path = ended_run(tmp_path / "run", "done", incidents=[LOSS, STILL_LOST])
    done = command("run", cwd=tmp_path)
    assert "run: done, with 2 incidents; the report lists them" in done.stdout
    text = (path / "report" / "report.html").read_text()
    lead = text.partition("</header>")[0]
    assert "from low-low: done, with 2 incidents." in lead
    assert "2 incidents: something was lost" in lead and 'href="#warnings"' in lead
    assert "Done, with 2 incidents: something was lost while the run went on" in text
    assert "damaged or foreign" not in text
    assert incidents_of(path) == [
        ["1", "pump: drive", "00:02:00 (tick 120)", "00:09:48 (tick 588)", "7.8",
         "no connection to the drive"],
        ["2", "mpc", "00:10:00 (tick 600)", "not over", "unknown", "ended (SIGKILL)"],
    ]
    whole = ended_run(tmp_path / "whole", "done")
    sources = find_runs([whole, path], None)
    html = render(
        Report([result(entry, Assumptions()) for entry in sources.runs]), [], sources,
        Assumptions(),
    )
    assert "2 incidents in 1 of 2 runs" in html
    assert 'class="text warning">done, with 2 incidents</td>' in html


def test_incidents_of_a_run_whose_bringup_was_killed(tmp_path: Path) -> None:
    """They are in a file of their own, beside a summary that has none, or beside none."""
    path = ended_run(tmp_path / "run", "running", incidents=[])
    lines = [json.dumps({**LOSS, "ended": None, "ended_tick": None}), json.dumps(LOSS), ""]
    (path / "incidents.jsonl").write_text("\n".join(lines))
    (cells,) = incidents_of(path)
    assert cells[3] == "00:09:48 (tick 588)"
    text = page_of(path)
    assert "from low-low: not ended, with 1 incident." in text
    assert "this run has not ended, or bringup was killed" in text
    (path / "summary.json").unlink()
    assert incidents_of(path) == [cells]
    (path / "incidents.jsonl").write_text(f"{{}}\n{json.dumps(LOSS)}\n")
    assert "Incidents.jsonl beside the bag is damaged, and not used: line 1: is no" in page_of(path)


def test_incidents_of_a_live_site(tmp_path: Path) -> None:
    """From its summary, in local standard time; its site is the one it ran with."""
    path = tmp_path / "live"
    small_bag(path / "bag")
    (path / "configuration" / "site").mkdir(parents=True)
    shutil.copy(CONFIG / "site.yaml", path / "configuration" / "site" / "my_site.yaml")
    lost = {**LOSS, "number": 300, "began_tick": None, "ended_tick": None}
    (path / "summary.json").write_text(json.dumps({
        "status": "done", "reason": "interrupted by SIGTERM", "began": LOSS["began"],
        "ended": LOSS["ended"], "last_time": None, "incident_count": 300, "incidents": [lost],
        "controller": "onoff", "parameters": {"fraction": 1.0}, "site": "/etc/my_site.yaml",
        "sensors": "sensors.yaml", "forecast": "/var/forecast.csv", "drive": "drive.yaml",
        "drive_at": "/dev/ttyUSB0", "versions": {},
    }))
    text = page_of(path)
    assert "done, with 300 incidents." in text and "damaged or foreign" not in text
    assert "A run of on/off (fraction 1): my_site.yaml" in text
    assert incidents_of(path) == [[
        "300", "pump: drive", "2026-11-20 21:25:12-05:00", "2026-11-20 21:25:20-05:00", "7.8",
        "no connection to the drive",
    ]]


def test_a_run_that_left_nothing(tmp_path: Path) -> None:
    """Refused with why it failed; beside others it is in the list."""
    path = ended_run(tmp_path / "broken", "failed", reason="no start within 30 s")
    shutil.rmtree(path / "bag")
    silent = ended_run(tmp_path / "silent", "interrupted", last_tick=0)
    shutil.rmtree(silent / "bag")
    small_bag(silent / "bag", roof_level=[], cistern_level=[], pump_command=[], pump_flow=[])
    ended_run(tmp_path / "whole", "done")
    done = command("broken", cwd=tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "broken failed: no start within 30 s; no bag" in done.stderr
    done = command("silent", cwd=tmp_path)
    assert done.returncode == 2 and "silent was interrupted at tick 0 of 720" in done.stderr
    done = command("whole", "broken", "silent", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "whole" / "report" / "report.html").read_text()
    assert "2 runs failed or did not run" in page
    assert '<th scope="row">broken</th><td>mpc</td><td>failed: no start within 30 s' in page


def test_a_page_begins_with_what_came_out(
    tmp_path: Path, study: Path, seeds: Path
) -> None:
    """Three sentences and a figure before the results; then figures and warnings, last versions."""
    pages = {
        "A run of MPC (weight 0.001): ": page_of(ended_run(tmp_path / "run", "done")),
        "8 runs of MPC (2 settings) and on/off (2 settings), from low-low and high-low: ":
        page_of(study),
        "600 runs of MPC and on/off (2 settings), from low-low and high-low: 4 windows of weather.":
        page_of(seeds),
    }
    for first, text in pages.items():
        lead = text.partition('class="lead">')[2].partition("</p>")[0]
        assert lead.startswith(first)
        assert len(re.findall(r"\.(?= [A-Z]|$)", lead)) == 3
        header = text.partition("</header>")[0]
        assert header.count("<figure") == (1 if "<figure" in text else 0)
        order = ['<section id="results">', '<section id="figures">', '<section id="numbers">',
                 '<section id="configuration">', "Made with greenroof_ros"]
        places = list(map(text.index, order))
        assert places == sorted(places)
        warnings = text.find('<section id="warnings">')
        assert warnings == -1 or places[1] < warnings < places[2]


@pytest.mark.parametrize(("count", "said"), [(9, True), (10, False)])
def test_too_few_seeds_are_said(
    tmp_path: Path, simulated: list[Simulated], count: int, said: bool
) -> None:
    """Before there are ten, the worst tenth is one run."""
    rows = [row for row in seeded_rows(simulated[0].row) if int(row["forecast_seed"]) <= count]
    text = page_of(write_study(tmp_path / "study", [(row, None) for row in rows], SEEDED))
    words = f"only {count} seeds: with fewer than 10, the worst tenth is a single run"
    assert (words in text.partition("</header>")[0]) == said
    assert (words[1:] in text.partition('id="warnings"')[2]) == said


def test_one_run_alone(tmp_path: Path) -> None:
    """No figure of single marks, and a line for each quantity; two runs of one kind have them."""
    path = ended_run(tmp_path / "run", "done")
    names = [make().name for make in make_figures(report_of(path), None)]
    assert names == [
        "weather-1", "trajectories-1-1", "water-balance-1", "pump-curve-1", "pump-smoothing-1"
    ]
    text = page_of(path)
    assert "Least total deviation" not in text and "<thead>" not in text.partition("Site:")[0]
    assert re.search(r">total deviation \(m³\)</th> <td data-key=\S+ class=\"\">[\d.]+</td>", text)
    other = ended_run(tmp_path / "other", "done", parameters={"weight": 0.01})
    both = Report([result(entry, Assumptions()) for entry in find_runs([path, other], None).runs])
    assert "energy-1" in [make().name for make in make_figures(both, None)]
    assert len(both.windows) == 1  # their sites are equal, each with its own copy


def test_force_replaces_a_report_and_nothing_else(
    tmp_path: Path, simulated: list[Simulated]
) -> None:
    """Refused with how; then page and figures are new, and those of before gone."""
    rows = seeded_rows(simulated[0].row)[:50]  # three figures are drawn of them
    write_study(tmp_path / "run", [(row, None) for row in rows], SEEDED)
    report = tmp_path / "run" / "report"
    assert command("run", "--force", cwd=tmp_path).returncode == 0
    first = (report / "report.html").read_text()
    (report / "figures" / "weather-7.svg").write_text("of a report before")
    done = command("run", "--water-price", "5", cwd=tmp_path)
    assert done.returncode == 2
    assert "--force replaces it" in done.stderr
    assert (report / "report.html").read_text() == first
    before = {file.name for file in (report / "figures").iterdir()}
    done = command("run", "--water-price", "5", "--force", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "5 CAD/m³" in (report / "report.html").read_text()
    assert {file.name for file in (report / "figures").iterdir()} == before - {"weather-7.svg"}
    for name in ("notes.txt", "figures/mine.svg", "figures/more/energy-1.svg"):
        (report / name).parent.mkdir(exist_ok=True)
        (report / name).write_text("mine")
        done = command("run", "--force", cwd=tmp_path)
        assert done.returncode == 2, name
        assert name.removesuffix("/energy-1.svg") in done.stderr and "no report's" in done.stderr
        assert (report / name).read_text() == "mine"
        (report / name).unlink()
    assert "5 CAD/m³" in (report / "report.html").read_text()


# --- wrong inputs ------------------------------------------------------------------------------


def small_bag(directory: Path, **changes: Any) -> Path:
    """A bag of three samples, with the values of some topics changed; None leaves one away."""
    values: dict[str, Any] = {
        "/roof/level": [0.03] * 3, "/cistern/level": [2.0] * 3, "/pump/command": [0.1] * 3,
        "/pump/flow": [0.001] * 3, **{f"/{key.replace('_', '/')}": value
                                      for key, value in changes.items()},
    }
    stamps = [0, 10**9, 2 * 10**9]
    return write_bag(
        directory,
        {
            topic: (stamps[: len(column)], column)
            for topic, column in values.items() if column is not None
        },
    )


def cut(file: Path, keep: int) -> None:
    file.write_bytes(file.read_bytes()[:keep])


def broken_bag(at: Path, how: Callable[[Path], Any]) -> None:
    how(small_bag(at / "in"))


def bad_study(at: Path, change: Callable[[str], str]) -> None:
    one = simulate("onoff", "0.5", "low-low", "0.01")
    write_study(at / "in", [(one.row, one.trajectory)])
    file = at / "in" / "results.csv"
    text = file.read_text()
    assert change(text) != text
    file.write_text(change(text))


def bad_trajectory(at: Path, how: Callable[[Path], Any]) -> None:
    bad_study(at, lambda text: text + "\n")
    how(at / "in" / "runs" / "001" / "trajectory.parquet")


WRONG: dict[str, tuple[Callable[[Path], Any], str, tuple[str, ...]]] = {
    # name: what makes the input "in", further options, words of the message
    "nothing-there": (lambda at: None, "", ("in: does not exist",)),
    "a-file": (lambda at: (at / "in").write_text("x"), "", ("in: must be a directory",)),
    "an-empty-directory": (lambda at: (at / "in").mkdir(), "", ("results.csv", "metadata.yaml")),
    "no-metadata": (
        lambda at: broken_bag(at, lambda bag: (bag / "metadata.yaml").unlink()), "",
        ("no metadata.yaml", "greenroof recover in"),
    ),
    "metadata-empty": (
        lambda at: broken_bag(at, lambda bag: cut(bag / "metadata.yaml", 0)), "",
        ("cannot be read as a bag",),
    ),
    "metadata-binary": (
        lambda at: broken_bag(at, lambda bag: (bag / "metadata.yaml").write_bytes(b"\x80\xff")),
        "", ("cannot be read as a bag",),
    ),
    "mcap-cut": (
        lambda at: broken_bag(at, lambda bag: cut(bag / "in.mcap", 300)), "",
        ("cannot be read as a bag", "greenroof recover in"),
    ),
    "mcap-empty": (
        lambda at: broken_bag(at, lambda bag: cut(bag / "in.mcap", 0)), "",
        ("cannot be read as a bag", "recover"),
    ),
    "mcap-gone": (
        lambda at: broken_bag(at, lambda bag: (bag / "in.mcap").unlink()), "",
        ("cannot be read as a bag",),
    ),
    "foreign-topics": (
        lambda at: write_bag(at / "in", {"/scan/range": ([0, 1], [0.5, 0.6])}), "",
        ("/cistern/level", "/pump/flow", "its topics are: /scan/range"),
    ),
    "one-topic-missing": (
        lambda at: small_bag(at / "in", pump_flow=None), "", ("has no /pump/flow",)
    ),
    "a-silent-topic": (
        lambda at: small_bag(at / "in", pump_flow=[]), "", ("no message of /pump/flow",)
    ),
    "empty-bag": (
        lambda at: small_bag(at / "in", roof_level=[], cistern_level=[], pump_flow=[],
                             pump_command=[]),
        "", ("no message of",),
    ),
    "one-sample": (
        lambda at: small_bag(at / "in", roof_level=[0.03], cistern_level=[2.0],
                             pump_command=[0.1], pump_flow=[0.001]),
        "", ("two samples", "not 1"),
    ),
    "float32": (
        lambda at: write_bag(
            at / "in", {name: ([0, 1], [0.0, 0.0]) for name in list(TOPICS)[:4]},
            msgtype="std_msgs/msg/Float32",
        ),
        "", ("std_msgs/msg/Float64", "not std_msgs/msg/Float32"),
    ),
    "cistern-in-mm": (
        lambda at: small_bag(at / "in", cistern_level=[2000.0] * 3), "",
        ("/cistern/level", "2000", "0 to 9 m", "outlet", "unit"),
    ),
    "cistern-in-cm": (
        lambda at: small_bag(at / "in", cistern_level=[80.0] * 3), "",
        ("/cistern/level", "80 m", "unit"),
    ),
    "a-weak-flow-in-litres": (
        lambda at: small_bag(at / "in", pump_flow=[0.0, 0.5, 0.5]), "",
        ("/pump/flow", "0.5", "three times what the pumps can give", "unit"),
    ),
    "flow-in-mm-per-hour": (
        lambda at: small_bag(at / "in", pump_flow=[0.0, 0.05, 0.05]), "",
        ("/pump/flow", "0.05", "unit"),
    ),
    "evapotranspiration-in-mm-per-hour": (
        lambda at: small_bag(at / "in", weather_evapotranspiration=[0.1, 0.2, 0.3]), "",
        ("/weather/evapotranspiration", "50 mm/day", "unit"),
    ),
    "drizzle-in-mm-per-hour": (
        lambda at: small_bag(at / "in", weather_precipitation=[0.0, 0.0, 0.0002]), "",
        ("/weather/precipitation", "500 mm/h", "unit"),
    ),
    "roof-in-mm": (
        lambda at: small_bag(at / "in", roof_level=[35.0] * 3), "",
        ("/roof/level", "35 m", "0.5 m", "unit"),
    ),
    "flow-in-litres": (
        lambda at: small_bag(at / "in", pump_flow=[0.0, 8.3, 8.3]), "",
        ("/pump/flow", "8.3", "m3/s", "2021-07-07T07:00:01", "unit"),
    ),
    "rain-in-mm-per-hour": (
        lambda at: small_bag(at / "in", weather_precipitation=[0.0, 3.0, 0.2]), "",
        ("/weather/precipitation", "m/s", "unit"),
    ),
    "not-a-number": (
        lambda at: small_bag(at / "in", roof_level=[0.03, float("nan"), 0.03]), "",
        ("/roof/level", "nan"),
    ),
    "infinite": (
        lambda at: small_bag(at / "in", pump_command=[0.1, float("inf"), 0.1]), "",
        ("/pump/command", "inf"),
    ),
    "negative": (
        lambda at: small_bag(at / "in", pump_command=[0.1, -0.1, 0.1]), "", ("/pump/command",)
    ),
    "given-twice": (
        lambda at: small_bag(at / "in"), "in", ("two runs are named in",)
    ),
    "no-such-site": (
        lambda at: small_bag(at / "in"), "--site nowhere.yaml", ("nowhere.yaml", "No such file")
    ),
    "site-wrong": (
        lambda at: (small_bag(at / "in"), (at / "site.yaml").write_text("a1: -25\n")),
        "--site site.yaml", ("site.yaml", "a1"),
    ),
    "site-for-a-study": (
        lambda at: bad_study(at, lambda text: text + "\n"), f"--site {CONFIG / 'site.yaml'}",
        ("--site", "has its own sites"),
    ),
    "output-not-empty": (
        lambda at: (small_bag(at / "in"), (at / "report").mkdir(), (at / "report/x").touch()), "",
        ("--output", "not empty", "never written over"),
    ),
    "output-a-file": (
        lambda at: (small_bag(at / "in"), (at / "report").touch()), "", ("--output", "report")
    ),
    "study-without-results": (
        lambda at: (at / "in" / "runs" / "001").mkdir(parents=True), "",
        ("a study without results.csv",),
    ),
    "results-empty": (
        lambda at: bad_study(at, lambda text: ""), "", ("results.csv", "is empty")
    ),
    "results-header-only": (
        lambda at: bad_study(at, lambda text: text.splitlines()[0] + "\n"), "",
        ("results.csv", "no runs"),
    ),
    "results-of-something-else": (
        lambda at: bad_study(at, lambda text: "a,b\n1,2\n"), "",
        ("results.csv, line 1", "no column run, site"),
    ),
    "no-finished-run": (
        lambda at: bad_study(at, lambda text: text.replace(",done,", ",failed,")), "",
        ("no finished run; 1 failed or did not run",),
    ),
    "row-cut": (
        lambda at: bad_study(at, lambda text: text[: len(text) // 2 + 60]), "",
        ("results.csv, line 2", "cells"),
    ),
    "status-unknown": (
        lambda at: bad_study(at, lambda text: text.replace(",done,", ",lost,")), "",
        ("line 2", "status = 'lost'", "done, failed or not run"),
    ),
    "volume-a-word": (
        lambda at: bad_study(at, lambda text: text.replace(",57.69", ",much57.69")), "",
        ("line 2", "cistern_m3", "much57.69"),
    ),
    "run-outside": (
        lambda at: bad_study(at, lambda text: text.replace("\n001,", "\n../001,")), "",
        ("line 2", "run = '../001'"),
    ),
    "site-of-the-study-gone": (
        lambda at: bad_study(at, lambda text: text.replace(",site.yaml,", ",other.yaml,"))
        or None, "", ("other.yaml", "No such file"),
    ),
    "trajectory-gone": (
        lambda at: bad_trajectory(at, lambda file: file.unlink()), "",
        ("001/trajectory.parquet", "is not there"),
    ),
    "trajectory-cut": (
        lambda at: bad_trajectory(at, lambda file: cut(file, 1000)), "",
        ("001/trajectory.parquet", "cut short"),
    ),
    "no-pump-data": (
        lambda at: small_bag(at / "in"), "--pump-data nowhere.csv", ("nowhere.csv", "No such file")
    ),
    "pump-data-header": (
        lambda at: (small_bag(at / "in"), (at / "p.csv").write_text("q,h\n0,50\n")),
        "--pump-data p.csv", ("p.csv, line 1", "flow [m3/s],head [m]"),
    ),
    "pump-data-word": (
        lambda at: (
            small_bag(at / "in"), (at / "p.csv").write_text("flow [m3/s],head [m]\n0,50\n1,x\n")
        ),
        "--pump-data p.csv", ("p.csv, line 3", "1,x"),
    ),
    "pump-data-swapped": (
        lambda at: (
            small_bag(at / "in"), (at / "p.csv").write_text("flow [m3/s],head [m]\n0,1\n0.1,2\n")
        ),
        "--pump-data p.csv", ("p.csv", "must fall"),
    ),
    "price-negative": (lambda at: small_bag(at / "in"), "--water-price=-1", ("--water-price",)),
    "price-nan": (lambda at: small_bag(at / "in"), "--energy-price nan", ("--energy-price",)),
    "band-a-word": (lambda at: small_bag(at / "in"), "--band wide", ("--band", "wide")),
}


@pytest.mark.parametrize("name", WRONG)
def test_refused(tmp_path: Path, name: str) -> None:
    """Exit code 2, one line that says what is wrong and where, no traceback, nothing written."""
    prepare, options, words = WRONG[name]
    prepare(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    arguments = ("report", "in", *options.split(), "--output", "report")
    done = run_command(*arguments, cwd=tmp_path, env=environment(0))
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr and done.stdout == ""
    assert done.stderr.count("error:") == 1, done.stderr
    message = done.stderr.partition("error:")[2].strip()
    assert "\n" not in message
    for word in words:
        assert word in message
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("missing", ["altair", "vl_convert", "jinja2", "polars", "rosbags"])
def test_without_the_extra(tmp_path: Path, missing: str) -> None:
    """A plain installation says what to install."""
    if missing == "polars":
        bad_study(tmp_path, lambda text: text + "\n")
    else:
        small_bag(tmp_path / "in")
    code = (
        f"import sys, runpy; sys.modules[{missing!r}] = None; "
        "sys.argv = ['report', 'in', '--output', 'report']; "
        "runpy.run_module('greenroof_ros.report', run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, **environment(0)},
        capture_output=True, text=True, timeout=60, check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "pip install 'greenroof_ros[study]'" in done.stderr
    assert "Traceback" not in done.stderr
