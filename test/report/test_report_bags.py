"""Reports of bags and run directories: their numbers, files beside them, and how they ended."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import bring_up, environment
from inputs import (
    MINUTE,
    NAMES,
    START,
    START_NS,
    Simulated,
    command,
    ended_run,
    figures_of,
    messages_of,
    page_of,
    report_of,
    simulate,
    small_bag,
    write_bag,
    write_study,
)
from paper import paper_run
from places import CHECKOUT, CONFIG
from rosbags.rosbag2 import StoragePlugin

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.experiment.clairvoyant import clairvoyant_bound
from greenroof_ros.recording.trajectory import Trajectory, read_parquet
from greenroof_ros.report.__main__ import _show
from greenroof_ros.report.runs import find_runs

TOTAL = "total_deviation_m3"


# --- trajectories --------------------------------------------------------------------------------


def test_parquet_keeps_every_bit(tmp_path: Path) -> None:
    """For random bit patterns, including NaN and the sign of 0."""
    random = np.random.default_rng(1)
    columns = random.integers(-(2**63), 2**63, size=(len(NAMES), 500)).view(np.float64)
    columns[:, :3] = [-0.0, np.nan, np.inf]
    written = Trajectory(start=START, **dict(zip(NAMES, columns, strict=True)))
    (tmp_path / "file").write_bytes(written.to_parquet())
    again = read_parquet(tmp_path / "file")
    assert again.start.isoformat() == START.isoformat()
    for name in NAMES:
        bits = (getattr(whole, name).view(np.int64) for whole in (again, written))
        np.testing.assert_array_equal(*bits)


def test_parquet_of_something_else(tmp_path: Path) -> None:
    """Empty, cut anywhere, another table, without a start or samples."""
    import polars

    whole = Trajectory(start=START, **dict.fromkeys(NAMES, np.arange(100.0))).to_parquet()
    contents = [whole[:keep] for keep in (0, 100, -1)]
    tables = (polars.DataFrame({"time_s": [1.0], "frost": [1]}), polars.read_parquet(whole))
    for table in tables:
        table.write_parquet(tmp_path / "other")
        contents.append((tmp_path / "other").read_bytes())
    contents.append(Trajectory(start=START, **dict.fromkeys(NAMES, np.array([]))).to_parquet())
    for content in contents:
        (tmp_path / "file").write_bytes(content)
        with pytest.raises(ConfigurationError, match="is empty, truncated or not a trajectory"):
            read_parquet(tmp_path / "file")


# --- foreign bags --------------------------------------------------------------------------------


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_gives_the_runs_numbers(tmp_path: Path, storage: StoragePlugin) -> None:
    """Read from the bag only, with or without namespace, with the paper's site; two are refused."""
    example = simulate("mpc", "0.00001", "low-low")
    plain = messages_of(example.trajectory)
    spaced = {f"/site1{topic}": messages for topic, messages in plain.items()}
    for name, messages in (
        ("plain", plain), ("spaced", spaced), ("both", {**plain, **spaced}),
    ):
        write_bag(tmp_path / name, messages, storage)
    report = report_of(tmp_path / "plain", tmp_path / "spaced")
    for row in report.single:
        run = report.runs[row["run"]]
        trajectory, notes = loaded(tmp_path / run.name)
        for name in NAMES:
            np.testing.assert_allclose(
                getattr(trajectory, name), getattr(example.trajectory, name), rtol=1e-15,
                err_msg=name,
            )
        assert trajectory.start == START and notes == ()
        for name in (TOTAL, "pumped_m3"):
            assert row[name] == pytest.approx(example.row[name], rel=1e-12)
        assert (row["controller"], row["from"]) == ("unknown", "as recorded")
        assert any("the paper's, config/site.yaml" in note.text for note in run.notes)
    with pytest.raises(ConfigurationError, match=r"of one graph, but holds .* /, /site1"):
        report_of(tmp_path / "both")


def test_a_real_sites_bag(tmp_path: Path) -> None:
    """Nothing is aligned: each stamp is a sample, other values are held, by hand."""
    second = 10**9
    write_bag(tmp_path / "bag", {
        "/roof/level": ([0, 10 * second, 21 * second, 30 * second], [0.01, 0.02, 0.03, 0.04]),
        "/cistern/level": ([4 * second, 21 * second], [2.0, 1.5]),
        "/pump/command": ([5 * second, 29 * second], [0.0, 0.5]),
        "/pump/flow": ([6 * second, 29 * second], [0.0, 0.004]),
        "/weather/precipitation": ([20 * second], [1e-6]),
    })
    trajectory, notes = loaded(tmp_path / "bag")
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


def loaded(path: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """Return what happened in the run under a path."""
    load = find_runs([path], None).runs[0].load
    assert load is not None
    return load()


def test_a_gap_is_not_filled_with_flow(tmp_path: Path) -> None:
    """The recorder stood still for two hours while the pump ran; 9 minutes are not a gap.

    Nor is a quarter of an hour between all values: then the site measures in this interval.
    """
    for name, minutes in (
        ("gap", [0, 1, 2, 11, 12, 132, 133]), ("regular", [15 * number for number in range(8)]),
    ):
        stamps = [minute * MINUTE for minute in minutes]
        write_bag(tmp_path / name, {topic: (stamps, [value] * len(stamps)) for topic, value in {
            "/roof/level": 0.03, "/cistern/level": 2.0, "/pump/command": 0.1, "/pump/flow": 0.001,
            "/weather/precipitation": 1e-6,
        }.items()})
    trajectory, notes = loaded(tmp_path / "gap")
    for column, value in (("pump_flow", 0.001), ("command", 0.1), ("precipitation", 1e-6)):
        assert getattr(trajectory, column).tolist() == [value] * 4 + [0] + [value] * 2
    (row,) = report_of(tmp_path / "gap").single
    assert row["pumped_m3"] == pytest.approx(0.001 * 13 * 60)
    assert row[TOTAL] == pytest.approx((133 * 60 + 1) * 68.8 * 0.0157)
    [note] = [note for note in notes if "no message came" in note]
    assert "2021-07-07T07:12:00+00:00 to 2021-07-07T09:12:00+00:00 (2 h)" in note
    trajectory, notes = loaded(tmp_path / "regular")
    assert trajectory.pump_flow.tolist() == [0.001] * 8
    assert not any("no message came" in note for note in notes)


def test_outliers_are_left_out_and_wrong_units_are_not(tmp_path: Path) -> None:
    """A NaN and a spike among 600 values; a pump in L/s for 20 s of ten minutes.

    A NaN of frost means unknown, as at a live site before there is a forecast.
    """
    stamps = [second * 10**9 for second in range(600)]
    levels = [0.03] * 600
    levels[100], levels[200] = math.nan, 35.0
    flow = [0.001 * (70 <= second < 90) for second in range(600)]
    values = {
        "/roof/level": (stamps, levels), "/cistern/level": (stamps[:1], [2.0]),
        "/pump/command": (stamps[:1], [0.1]), "/pump/flow": (stamps, flow),
    }
    trajectory, notes = loaded(write_bag(tmp_path / "spike", values))
    assert set(trajectory.roof.tolist()) == {68.8 * 0.03}
    assert any("2 of 600 values of /roof/level are not finite" in note for note in notes)
    values |= {"/roof/level": (stamps[:1], [0.03]), "/pump/flow": (stamps, [1e3 * q for q in flow])}
    with pytest.raises(ConfigurationError, match=r"/pump/flow: .*is a unit wrong"):
        loaded(write_bag(tmp_path / "litres", values))
    for known in (0, 2):
        frost = [math.nan] * (3 - known) + [0.0] * known
        bag = small_bag(tmp_path / f"frost-{known}", weather_frost=frost)
        assert len(loaded(bag)[0].roof) == 3


def test_limits_are_those_of_the_site(tmp_path: Path) -> None:
    """Three times the pumps' flow at the outlet's level, by hand; just below is accepted."""
    full = np.roots([
        (3.56 * 18.4 / 0.2 + 0.6) / (2 * 9.81 * (0.01 * np.pi) ** 2) + 5.78e5, 0, 16 - 3 - 55.2
    ]).max()
    highest = {
        "roof_level": 1.0, "cistern_level": 9.0, "pump_flow": 3 * full,
        "weather_precipitation": 0.5 / 3600, "weather_evapotranspiration": 0.05 / 86400 * 68.8,
    }
    for name, value in highest.items():
        loaded(small_bag(tmp_path / name, **{name: [value * (1 - 1e-6)] * 3}))
        wrong = small_bag(tmp_path / f"{name}-wrong", **{name: [value * (1 + 1e-6)] * 3})
        topic = f"/{name.replace('_', '/')}"
        with pytest.raises(ConfigurationError, match=rf"{topic}.*2021-07-07T.*is a unit wrong"):
            loaded(wrong)


# --- run directories -----------------------------------------------------------------------------


def own_run(directory: Path, example: Simulated, **known: Any) -> Path:
    """Write a run directory of on/off as bringup leaves it, with its weather."""
    ended_run(directory, example=example, parameters={"fraction": 2.0}, **known)
    (directory / "configuration" / "weather").mkdir()
    shutil.copy(
        CONFIG / "weather" / "toronto_2021-07.csv", directory / "configuration" / "weather"
    )
    return directory


def test_results_of_a_run_that_is_done_are_its_own(tmp_path: Path) -> None:
    """From its summary: with sensor errors the bag's roof differs from the true one.

    It then has no bound, because its first reading was not the true volume.
    """
    example = simulate("onoff", "2", "low-low", "0.05")
    path = own_run(tmp_path / "run", example)
    (row,) = report_of(path).single
    assert row["bound_m3"] == pytest.approx(
        clairvoyant_bound(paper_run("--initial", "low-low", "--hours", "0.05")).bound_m3, rel=1e-9
    )
    assert row["ratio"] == pytest.approx(example.row[TOTAL] / row["bound_m3"], rel=1e-9)
    results = {name: example.row[name] for name in (TOTAL, "pumped_m3", "final_roof_m3")}
    off = dataclasses.replace(example.trajectory, roof=example.trajectory.roof + 0.5)
    path = own_run(
        tmp_path / "noisy", example._replace(trajectory=off), status="done", **results,
        sensor_pump_errors={"roof_offset": 0.005},
    )
    report = report_of(path)
    (row,) = report.single
    assert {name: row[name] for name in results} == results
    assert row["bound_m3"] is None
    sensor = "what a sensor reads (roof offset 0.005 m); the results are of the true one"
    assert sensor in page_of(report)
    # Nor if the rain in the bag is not that in the file.
    rain = example.trajectory.precipitation + 1e-7
    wet = dataclasses.replace(example.trajectory, precipitation=rain)
    report = report_of(own_run(tmp_path / "wet", example._replace(trajectory=wet)))
    assert report.single[0]["bound_m3"] is None
    assert "over the least possible" not in page_of(report)


def test_a_run_directorys_notes(tmp_path: Path) -> None:
    """Fallbacks, repeated forecasts, filled hours: by name, and on the page."""
    path = own_run(
        tmp_path / "run", simulate("onoff", "0.5", "low-low", "0.01"), limited_steps=4,
        solver={"fallbacks": 3}, filled={"dew point": ["2021-07-20T13:00-05:00"]}, filled_hours=1,
        forecast_repeats_last_record_from="2021-07-31T23:00-05:00",
        weather_notes=["rain was moved an hour back"],
        suspicious=["79.2 mm at 2015-12-29T02:00-05:00"],
    )
    report = report_of(path)
    assert {note.text for note in report.runs["run"].notes} == {
        "the controller's solver found no answer in 3 ticks",
        "a forecast ends at 2021-07-31T23:00-05:00, and what follows is assumed",
        "a tank ran empty in 4 ticks, and what left it was limited",
        "rain was moved an hour back",
        "1 hours of the weather from 2021-07-07 02:00-05:00 were missing and filled in",
        "suspicious, and not changed: 79.2 mm at 2015-12-29T02:00-05:00",
    }
    text = page_of(report)
    assert "Suspicious, and not changed: 79.2 mm at 2015-12-29T02:00-05:00." in text
    listed = "dew point: 2021-07-20T13:00-05:00"
    assert f"<details><summary>which</summary>{listed}</details>" in text


FOREIGN = (
    "{", "[1]", "", '{"name": "x"}', '{"controller": 5}', "[" * 100_000,
    '{"controller": "mpc", "initial": {"cistern_m3": "a", "roof_m3": "b"}}',
)


@pytest.mark.parametrize("file", ["summary.json", "configuration/parameters.yaml"])
def test_foreign_labels_leave_the_numbers(tmp_path: Path, file: str) -> None:
    """A bad file beside a good bag does not matter: the directory's name is the label."""
    small_bag(tmp_path / "run" / "bag")
    (tmp_path / "run" / "configuration").mkdir()
    for text in FOREIGN:
        (tmp_path / "run" / file).write_text(text)
        report = report_of(tmp_path / "run")
        (row,) = report.single
        assert (row["run"], row["controller"], row["from"]) == ("run", "unknown", "as recorded")
        assert any(note.text.startswith(f"{file} beside the bag is damaged or foreign")
                   for note in report.runs["run"].notes), text
        assert row["pumped_m3"] == pytest.approx(0.002)


def test_a_damaged_summary_leaves_the_parameters(tmp_path: Path) -> None:
    """The nodes' parameters, as after a crash while the summary was written."""
    small_bag(tmp_path / "run" / "bag")
    (tmp_path / "run" / "configuration").mkdir()
    (tmp_path / "run" / "summary.json").write_text('{"controller": "mp')
    (tmp_path / "run" / "configuration" / "parameters.yaml").write_text(
        "/**/recorder: {ros__parameters: {controller: onoff}}\n"
        "/**/onoff: {ros__parameters: {fraction: 0.5, site_file: x}}\n"
        "/**/plant: {ros__parameters: {start: '2021-07-07T02:00-05:00', "
        "initial_cistern_volume: 50, initial_roof_volume: 2}}\n"
    )
    (run,) = find_runs([tmp_path / "run"], None).runs
    assert (run.row["controller"], run.parameters) == ("onoff", {"fraction": 0.5})
    assert run.row["from"] == "50 / 2 m3"
    assert any(note.text.startswith("summary.json beside the bag") for note in run.notes)


def test_names_distinguish_paths(tmp_path: Path) -> None:
    """By the shortest part of each path's end that is unique."""
    paths = [tmp_path / place for place in ("mon/bag", "tue/bag", "x/a/deep", "y/a/deep", "one")]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        small_bag(path)
    names = [run.name for run in find_runs(paths, None).runs]
    assert names == ["mon/bag", "tue/bag", "x/a/deep", "y/a/deep", "one"]
    row = simulate("onoff", "0.5", "low-low").row
    studies = [write_study(tmp_path / place / "study", [(row, None)]) for place in ("a", "b")]
    assert [run.name for run in find_runs(studies, None).runs] == ["a/study/001", "b/study/001"]
    with pytest.raises(ConfigurationError, match="two runs are named"):
        find_runs([paths[0], paths[1], tmp_path / "mon" / ".." / "mon" / "bag"], None)


# --- graphs --------------------------------------------------------------------------------------


# The example's pump, but with 1 L/s, and an impossible flow in every tenth tick from the first on.
DRIVER = (CHECKOUT / "examples" / "pump_driver.py").read_text()
BAD_FLOWS = """
import itertools
BAD = [math.nan, 5.0, -0.001, math.inf]
flows = (0.001 if tick % 10 else BAD[tick // 10 % 4] for tick in itertools.count())
rclpy.init()
"""


def test_a_run_of_the_graph(domain: int, tmp_path: Path) -> None:
    """Bringup's bag gives the numbers of the summary, and the labels of the run.

    By hand: 9 of 10 ticks of 1 L/s, 12 starts, because refused flows act as 0.
    """
    pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    bad = DRIVER.replace("rclpy.init()\n", BAD_FLOWS)
    bad = bad.replace(".publish(flow)", ".publish(Float64(data=next(flows)))")
    assert bad.count("flows)") == 1
    driver = subprocess.Popen(
        [sys.executable, "-c", bad], cwd=tmp_path, env=environment(domain)
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
    assert summary["refused"] == {"/pump/flow": 13}  # in ticks 0 to 120
    assert summary["pumped_m3"] == pytest.approx(108 * 0.001, rel=1e-12)
    assert summary["pump_starts"] == 12
    report = report_of(tmp_path / "run")
    (row,), (run,) = report.single, report.runs.values()
    assert (row["controller"], row["from"], row["site"]) == ("onoff", "low-low", "site.yaml")
    assert report.drawn["run"].start.isoformat() == summary["start"]
    (note,) = run.notes
    assert note.text.startswith("13 of 121 values of /pump/flow were refused")
    assert row["bound_m3"] == pytest.approx(
        clairvoyant_bound(paper_run("--hours", str(120 / 3600))).bound_m3, rel=1e-9
    )
    (tmp_path / "run" / "summary.json").unlink()  # as after a crash
    crashed = report_of(tmp_path / "run")
    (worked_out,) = crashed.single
    assert crashed.runs["run"].parameters == run.parameters
    for name in row:
        if name in summary and isinstance(row[name], float) and worked_out[name] is not None:
            assert worked_out[name] == pytest.approx(summary[name], rel=1e-12, abs=1e-15), name
    assert worked_out["roof_residual_m3"] == pytest.approx(0, abs=1e-12)


def test_what_the_plant_refuses_acts_as_zero(tmp_path: Path) -> None:
    """In this package's runs: command, rain and evapotranspiration; the plant's flow is kept."""
    path = ended_run(tmp_path / "run")
    shutil.rmtree(path / "bag")
    small_bag(
        path / "bag", pump_command=[math.nan, 2000.0, 0.5], pump_flow=[0.0, 8.0, 0.0],
        weather_precipitation=[2e-3, 1e-6, 0.0], weather_evapotranspiration=[-1.0, 1e-6, math.inf],
    )
    trajectory, notes = loaded(path)
    assert trajectory.command.tolist() == [0, 2000, 0.5]
    assert trajectory.pump_flow.tolist() == [0, 8, 0]
    assert trajectory.precipitation.tolist() == [0, 1e-6, 0]
    assert trajectory.evapotranspiration.tolist() == [0, 1e-6, 0]
    refused = {note.split()[5]: note.split()[0] for note in notes if "refused" in note}
    assert refused == {
        "/pump/command": "1", "/weather/precipitation": "1", "/weather/evapotranspiration": "2"
    }


# --- how runs ended, and their incidents ---------------------------------------------------------


def test_a_changed_parameter(tmp_path: Path) -> None:
    """It is shown in the setting, wherever that appears, and as a warning; no axis has it."""
    changes = [
        {"tick": 300, "parameter": "weight", "before": 0.001, "value": 0.00001},
        {"tick": 3660, "parameter": "weight", "before": 0.00001, "value": 0.1},
    ]
    path = ended_run(tmp_path / "run", parameter_changes=changes)
    other = ended_run(tmp_path / "other")
    report = report_of(path)
    became = "0.001 -> 0.00001 at 00:05 -> 0.1 at 01:01"
    assert report.settings["mpc"].labels == [became]
    rows = figures_of(report)["trajectories-1-1"].data["command-1-1-mpc"]
    assert {row["setting"] for row in rows} == {became}
    text = page_of(report).replace("&gt;", ">")
    assert f"weight was changed in the run: {became} (tick 300, 3660)." in text
    assert f">weight {became}<" in text
    both = report_of(path, other)
    assert both.settings["mpc"].labels == ["0.001", became]
    assert both.settings["mpc"].axis == ""
    figures_of(both)
    limit = {"tick": 60, "parameter": "max_command", "before": None, "value": 1.0}
    path = ended_run(tmp_path / "limited", parameter_changes=[limit])
    assert report_of(path).single[0]["setting"] == "max_command none -> 1 at 00:01"


ENDINGS = {
    "failed": (
        {"last_tick": 72, "reason": "node weather ended (SIGKILL); its last lines:\n  none"},
        "failed at tick 72 of 720 (00:01:12): node weather ended (SIGKILL); its last lines: none",
        "failed at tick 72",
    ),
    "running": ({}, "has not ended, or bringup was killed", "not ended"),
}


@pytest.mark.parametrize("status", ENDINGS)
def test_a_run_that_is_not_done_says_it_first(tmp_path: Path, status: str) -> None:
    """If alone, before everything else; beside others by name, and in its rows."""
    known, sentence, short = ENDINGS[status]
    path = ended_run(tmp_path / "broken", status, **known)
    lead = page_of(path).partition('<section id="results">')[0]
    assert f"<strong>Mind:</strong> this run {sentence}: what follows is of what was rec" in lead
    html = page_of(ended_run(tmp_path / "whole"), path)
    box = html.partition('class="cautions"')[2].partition("</p>")[0]
    assert "1 of 2 runs are not done" in box and 'href="#warnings"' in box
    warned = html.partition(f"{sentence[0].upper()}{sentence[1:]}; what follows")[2]
    assert "</summary>broken</details>" in warned.partition("</li>")[0]
    for ended in (f'class="text warning">{short}</td>', ">done</td>"):
        assert html.count(ended) >= 2


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
    """Mentioned above all results, in the warnings, and listed."""
    path = ended_run(tmp_path / "run", incidents=[LOSS, STILL_LOST])
    text = page_of(path)
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
    html = page_of(ended_run(tmp_path / "whole"), path)
    assert "2 incidents in 1 of 2 runs" in html
    assert 'class="text warning">done, with 2 incidents</td>' in html


def test_incidents_of_a_run_whose_bringup_was_killed(tmp_path: Path) -> None:
    """They are in a separate file; the summary has none, or does not exist."""
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
    """From its summary, in local standard time; its site is the one it ran with.

    An impossible sensor value is left out; it did not act as 0 as in a simulation.
    """
    path = tmp_path / "live"
    small_bag(path / "bag", pump_command=[0.1] * 100 + [math.nan] + [0.1] * 99)
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
    assert set(loaded(path)[0].command.tolist()) == {0.1}
    text = page_of(path)
    assert "done, with 300 incidents." in text and "damaged or foreign" not in text
    assert "A run of on/off (fraction 1): my_site.yaml" in text
    assert incidents_of(path) == [[
        "300", "pump: drive", "2026-11-20 21:25:12-05:00", "2026-11-20 21:25:20-05:00", "7.8",
        "no connection to the drive",
    ]]


def test_what_the_terminal_says_of_how_runs_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run without data is refused with the reason it failed; beside others it is listed."""
    nothing = ended_run(tmp_path / "nothing", "failed", reason="no start within 30 s")
    shutil.rmtree(nothing / "bag")
    silent = ended_run(tmp_path / "silent", "interrupted", last_tick=0)
    shutil.rmtree(silent / "bag")
    small_bag(silent / "bag", roof_level=[], cistern_level=[], pump_command=[], pump_flow=[])
    done = command("nothing", cwd=tmp_path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "nothing failed: no start within 30 s; no bag" in done.stderr
    with pytest.raises(ConfigurationError, match="silent was interrupted at tick 0 of 720"):
        report_of(silent)
    lossy = ended_run(tmp_path / "lossy", incidents=[LOSS, STILL_LOST])
    known, sentence, _ = ENDINGS["failed"]
    broken = ended_run(tmp_path / "broken", "failed", **known)
    _show(report_of(lossy, broken, nothing, silent))
    said = " ".join(capsys.readouterr().out.split())
    assert "lossy: done, with 2 incidents; the report lists them" in said
    assert f"broken {sentence}; what follows is of the part" in said
    page = page_of(lossy, broken, nothing, silent)
    assert "2 runs failed or did not run" in page
    assert '<th scope="row">nothing</th><td>mpc</td><td>failed: no start within 30 s' in page


def test_one_run_alone(tmp_path: Path) -> None:
    """A line for each quantity; two similar runs are compared, each with its copy of a site."""
    path = ended_run(tmp_path / "run")
    text = page_of(path)
    assert "Least total deviation" not in text and "<thead>" not in text.partition("Site:")[0]
    assert re.search(r">total deviation \(m³\)</th> <td data-key=\S+ class=\"\">[\d.]+</td>", text)
    both = report_of(path, ended_run(tmp_path / "other", parameters={"weight": 0.01}))
    assert "energy-1" in figures_of(both)
    assert len(both.windows()) == 1
    assert both.single[0][TOTAL] == both.single[1][TOTAL]
