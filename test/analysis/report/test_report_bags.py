"""Reports of bags and run directories: their numbers, files next to them, and how they ended."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import polars
import pytest
from inputs import (
    MINUTE,
    NAMES,
    START,
    START_NS,
    TOPICS,
    ended_run,
    messages_of,
    report_of,
    simulate,
    small_bag,
    trajectory_of,
    write_bag,
)
from places import CONFIG, refusal
from rosbags.rosbag2 import StoragePlugin

import greenroof_ros as gr
from greenroof_ros.analysis.report.page import make_notes, render
from greenroof_ros.analysis.report.runs import TOTAL, find_runs, read_run
from greenroof_ros.commands.recover import recover
from greenroof_ros.results.trajectory import Trajectory, read_trajectory


def test_parquet(tmp_path: Path) -> None:
    """It keeps every bit, also of NaN and the sign of 0; anything else in its place is refused."""
    random, file = np.random.default_rng(1), tmp_path / "file"
    columns = random.integers(-(2**63), 2**63, size=(len(NAMES), 500)).view(np.float64)
    columns[:, :3] = [-0.0, np.nan, np.inf]
    columns[NAMES.index("time")] = np.arange(500.0)  # a table has times of the calendar, too
    written = Trajectory(start=START, **dict(zip(NAMES, columns, strict=True)))
    whole = written.to_parquet()
    file.write_bytes(whole)
    again = read_trajectory(file)
    assert again.start.isoformat() == START.isoformat()
    for name in NAMES:
        bits = (getattr(some, name).view(np.int64) for some in (again, written))
        np.testing.assert_array_equal(*bits)
    # Empty, cut anywhere, without samples, another table, without a start.
    contents = [b"", whole[:100], whole[:-1], trajectory_of([]).to_parquet()]
    for table in (polars.DataFrame({"time_s": [1.0], "frost": [1]}), polars.read_parquet(whole)):
        table.write_parquet(file)
        contents.append(file.read_bytes())
    for content in contents:
        file.write_bytes(content)
        refusal(read_trajectory, file, match="is empty, truncated or not a trajectory")


def test_a_bag_gives_the_runs_numbers(tmp_path: Path) -> None:
    """From the bag only, of either storage, with or without namespace; two are refused."""
    example = simulate("mpc", "0.00001", "low-low")
    plain = messages_of(example.trajectory)
    spaced = {f"/site1{topic}": messages for topic, messages in plain.items()}
    write_bag(tmp_path / "plain", plain, StoragePlugin.SQLITE3)
    write_bag(tmp_path / "spaced", spaced)
    report = report_of(tmp_path / "plain", tmp_path / "spaced")
    for row in (run.row for run in report.sources.runs):
        trajectory, notes = loaded(tmp_path / row["case"])
        assert trajectory.start == START and notes == []
        for name in (TOTAL, "pumped_m3", "rain_m3", "drainage_m3", "final_cistern_m3"):
            assert row[name] == pytest.approx(example.row[name], rel=1e-12), name
    assert "there is no site file beside the bag: the paper" in render(report, [])
    both = write_bag(tmp_path / "both", {**plain, **spaced})
    refusal(report_of, both, match=r"from a single graph, but contains .* /, /site1")


def loaded(path: Path) -> tuple[Trajectory, list[str]]:
    """Return the trajectory of the bag under a path, and the notes on it."""
    run = read_run(path)
    trajectory = run.trajectory()
    assert trajectory is not None
    return trajectory, [note for note in run.notes if "no site file" not in note]


def test_a_real_sites_bag(tmp_path: Path) -> None:
    """Nothing is aligned: each stamp is a sample, other values are held, by hand.

    The recorder stood still for two hours while the pump ran: in such a gap there is no flow. Nine
    minutes are no gap, nor is a quarter of an hour if the site measures in this interval.
    """
    second = 10**9
    write_bag(tmp_path / "bag", {
        "/roof/level": (
            [time * second for time in (0, 10, 21, 30, 7230, 7770)],
            [0.01, 0.02, 0.03, 0.04, 0.05, 0.06],
        ),
        "/cistern/level": ([4 * second, 21 * second], [2.0, 1.5]),
        "/pump/command": ([5 * second, 29 * second], [0.0, 0.5]),
        "/pump/flow": ([6 * second, 29 * second], [0.0, 0.004]),
        "/weather/precipitation": ([20 * second], [1e-6]),
    })
    trajectory, notes = loaded(tmp_path / "bag")
    # At 0, 4 and 5 s there is no flow yet.
    assert trajectory.start.timestamp() == START_NS / 1e9 + 6
    assert (trajectory.time + 6).tolist() == [6, 10, 20, 21, 29, 30, 7230, 7770]
    assert trajectory.roof.tolist() == [
        68.8 * level for level in (0.01, 0.02, 0.02, 0.03, 0.03, 0.04, 0.05, 0.06)
    ]
    assert trajectory.cistern.tolist() == [50, 50, 50, 37.5, 37.5, 37.5, 37.5, 37.5]
    assert trajectory.command.tolist() == [0, 0, 0, 0, 0.5, 0, 0.5, 0.5]
    assert trajectory.pump_flow.tolist() == [0, 0, 0, 0, 0.004, 0, 0.004, 0.004]
    assert trajectory.precipitation.tolist() == [0, 0, 1e-6, 1e-6, 1e-6, 0, 1e-6, 1e-6]
    assert trajectory.outflow.tolist() == [0] * 8
    *missing, gap = notes
    assert {note.split()[0] for note in missing} == {
        "/weather/evapotranspiration", "/cistern/outflow", "/roof/drainage", "/weather/frost"
    }
    assert "2021-07-07T07:00:30+00:00 to 2021-07-07T09:00:30+00:00 (2 h)" in gap
    assert read_run(tmp_path / "bag").row["pumped_m3"] == pytest.approx(0.004 * (1 + 540))
    stamps = [15 * number * MINUTE for number in range(8)]
    write_bag(tmp_path / "regular", dict.fromkeys(TOPICS, (stamps, [1e-6] * 8)))
    trajectory, notes = loaded(tmp_path / "regular")
    assert trajectory.pump_flow.tolist() == [1e-6] * 8 and notes == []


def test_a_bag_of_a_simulation_needs_simulated_times(tmp_path: Path) -> None:
    """A hundred times real time: 20 s in 0.2 s. The last one as its .mcap file alone.

    With ``--use-sim-time`` a message has the time of the last clock message before it.
    """
    simulated = [tick * 10**9 for tick in range(21)]
    times = {"arrived": [10**15 + 10**7 * tick for tick in range(21)], "late": [0, *simulated[:-1]]}
    topics = {
        "/site1/clock": range(21), "/site1/roof/level": [1e-3] * 21,
        "/site1/cistern/level": [2.0] * 21, "/site1/pump/command": [0.0] * 21,
        "/site1/pump/flow": [0.004] * 21,
    }
    bags = {
        name: write_bag(tmp_path / name, {topic: (stamps, of) for topic, of in topics.items()})
        for name, stamps in times.items()
    }
    refusal(loaded, bags["arrived"], match="record with 'ros2 bag record --use-sim-time'")
    (file,) = bags["late"].glob("*.mcap")
    assert loaded(file)[0].time.tolist() == list(range(20))


def test_messages_of_a_clock_that_was_not_set(tmp_path: Path) -> None:
    """In 1970: their times count as they stand, the note on gaps tells, and of the gap remains 7 h.

    The pump's 10 L/s hold for a second, and not in the gap.
    """
    stamps = [-START_NS, 0, 10**9, 2 * 10**9]
    bag = write_bag(tmp_path / "bag", dict.fromkeys(list(TOPICS)[:4], (stamps, [0.01] * 4)))
    trajectory, notes = loaded(bag)
    assert trajectory.time.tolist() == [0, 1625641200, 1625641201, 1625641202]
    (note,) = (note for note in notes if "gap" in note)
    assert "1970-01-01T00:00:00+00:00 to 2021-07-07T07:00" in note
    assert note.endswith("was a clock not set?") and note in render(report_of(bag), [])
    assert read_run(bag).row["pumped_m3"] == pytest.approx(0.02)


def test_values_out_of_their_range_are_left_out_and_noted(tmp_path: Path) -> None:
    """Any number of them: a NaN and a spike, and a pump in L/s for 20 s of ten minutes, or always.

    A NaN of frost means unknown, as at a live site before there is a forecast.
    """
    levels = [0.03] * 600
    levels[100], levels[200] = math.nan, 35.0
    trajectory, notes = loaded(small_bag(tmp_path / "spike", roof_level=levels))
    assert set(trajectory.roof.tolist()) == {68.8 * 0.03}
    assert any(note.startswith("2 of 600 values of /roof/level are left out") for note in notes)
    flow = [1.0 * (70 <= second < 90) for second in range(600)]
    trajectory, notes = loaded(small_bag(tmp_path / "litres", pump_flow=flow))
    assert set(trajectory.pump_flow.tolist()) == {0.0}
    assert any(note.startswith("20 of 600 values of /pump/flow") for note in notes)
    always = small_bag(tmp_path / "always", pump_flow=[2.0] * 3)
    refusal(loaded, always, match=r"no usable messages \(\S*Float64\) on /pump/flow; 3 of 3 values")
    for known in (0, 2):
        frost = [math.nan] * (3 - known) + [0.0] * known
        bag = small_bag(tmp_path / f"frost-{known}", weather_frost=frost)
        assert len(loaded(bag)[0].roof) == 3


def test_the_limits_are_the_sites(tmp_path: Path) -> None:
    """Three times the pumps' flow at the outlet's level, by hand; just below is accepted."""
    full = np.roots([
        (3.56 * 18.4 / 0.2 + 0.6) / (2 * 9.81 * (0.01 * np.pi) ** 2) + 5.78e5, 0, 16 - 3 - 55.2
    ]).max()
    highest = {
        "roof_level": 1.0, "cistern_level": 9.0, "pump_flow": 3 * full,
        "weather_precipitation": 2.0 / 3600, "weather_evapotranspiration": 0.05 / 86400 * 68.8,
    }
    bag = small_bag(tmp_path / "bag", **{
        name: [value * (1 - 1e-6)] * 2 + [value * (1 + 1e-6)] for name, value in highest.items()
    })
    left_out = [note.split()[5] for note in loaded(bag)[1] if note.startswith("1 of 3 values of ")]
    assert left_out == [f"/{name.replace('_', '/')}" for name in highest]


def test_discharge_that_nobody_recorded(tmp_path: Path) -> None:
    """A live site has no flow meter in its outlet: then nothing is known, not that nothing came.

    The outflow alone tells the overflow, which has two results.
    """
    for recorded, known in (
        ((), 0), (("cistern_outflow",), 2), (("roof_drainage",), 0),
        (("cistern_outflow", "roof_drainage"), 10),
    ):
        name = "-".join(recorded) or "none"
        run = read_run(small_bag(tmp_path / name, **{each: [1e-3] * 3 for each in recorded}))
        assert len([key for key in run.row if "discharge" in key or "overflow" in key]) == known
    assert run.row["discharge_m3"] == pytest.approx(4e-3)


def test_results_of_a_run_that_is_done_are_its_own(tmp_path: Path) -> None:
    """From its summary, with its notes: the bag's roof can be the reading of a sensor with errors.

    Changed parameters are noted.
    """
    example = simulate("onoff", "2", "low-low", "0.05")
    results = {name: example.row[name] for name in (TOTAL, "pumped_m3", "final_roof_m3")}
    off = dataclasses.replace(example.trajectory, roof=example.trajectory.roof + 0.5)
    report = report_of(ended_run(
        tmp_path / "noisy", example=example._replace(trajectory=off), **results, limited_steps=4,
        parameter_change_count=2, solver={"fallbacks": 3}, weather_notes=["rain was moved"],
    ))
    (run,) = report.sources.runs
    assert {name: run.row[name] for name in results} == results
    notes = "\n".join(make_notes(report))
    for words in ("less water than was demanded", "no solution", "rain was moved", "2 changes"):
        assert words in notes
    assert (run.row["site"], run.row["initial"]) == ("site.yaml", "low-low")
    assert "fraction 2.0" in report.sources.read[0]


def test_names_state_what_differs(tmp_path: Path) -> None:
    """Runs with summaries are named by controller and settings, whatever their directories."""
    runs = [
        gr.simulate(name, site=CONFIG / "site_valve.yaml", hours=0.1, **given)
        for name, given in (("onoff", {"outlet": "drain"}), ("onoff", {"outlet": "plan"}),
                            ("mpc", {}))
    ]
    paths = [run.save(tmp_path / f"{number}") for number, run in enumerate(runs)]
    assert [run.row["case"] for run in find_runs(paths).runs] == [
        "onoff, outlet drain", "onoff, outlet plan", "mpc",
    ]
    assert find_runs(paths[:1]).runs[0].row["case"] == "0"  # nothing differs
    (again,) = (run.save(tmp_path / "again") for run in runs[:1])
    names = [run.row["case"] for run in find_runs([paths[0], again]).runs]
    assert names == ["0", "again"]


def test_what_the_plant_refuses_acts_as_zero(tmp_path: Path) -> None:
    """In this package's runs: command, rain and evapotranspiration; the plant's flow is kept.

    The flow of an external pump, which the summary tells, is none of the plant's.
    """
    for name, refused, flow in (("own", {}, 8.0), ("external", {"/pump/flow": 1}, 0.0)):
        path = ended_run(tmp_path / name, refused=refused)
        shutil.rmtree(path / "bag")
        small_bag(
            path / "bag", pump_command=[math.nan, 2000.0, 0.5], pump_flow=[0.0, 8.0, 0.0],
            weather_precipitation=[2e-3, 1e-6, 0.0], weather_evapotranspiration=[-1.0, 1e-6, 0.0],
        )
        trajectory, notes = loaded(path)
        assert trajectory.command.tolist() == [0, 2000, 0.5]
        assert trajectory.pump_flow.tolist() == [0, flow, 0]
        assert trajectory.precipitation.tolist() == [0, 1e-6, 0]
        assert trajectory.evapotranspiration.tolist() == [0, 1e-6, 0]
        rejected = [note.split()[5] for note in notes if "rejected" in note]
        topics = {"/pump/command", "/weather/precipitation", "/weather/evapotranspiration"}
        assert {*rejected} == topics | refused.keys()


def test_how_runs_ended(tmp_path: Path) -> None:
    """It stands above all results: of runs without data, and of others, for the recorded part."""
    reason = "node weather ended (SIGKILL); its last lines:\n  none"
    broken = ended_run(tmp_path / "broken", "failed", last_tick=72, reason=reason)
    done = ended_run(tmp_path / "done")
    nothing = ended_run(tmp_path / "nothing", "failed", reason="the run did not start within 30 s")
    shutil.rmtree(nothing / "bag")
    silent = ended_run(tmp_path / "silent", "interrupted", last_tick=0)
    shutil.rmtree(silent / "bag")
    small_bag(silent / "bag", roof_level=[], cistern_level=[], pump_command=[], pump_flow=[])
    refusal(report_of, nothing, match="no run has .*: failed, the run did not start within 30 s; ")
    report = report_of(done, broken, nothing, silent)
    assert len(report.sources.runs) == 2
    failed = dict(report.sources.failed)
    assert failed.keys() == {"broken", "nothing", "silent"}
    assert failed["broken"].startswith("failed, node weather ended (SIGKILL)")
    assert "its last lines: none" in render(report, []).partition("<h2>Results")[0]


def test_a_live_site(tmp_path: Path) -> None:
    """An impossible sensor value is left out; it did not act as 0 as in a simulation."""
    path = tmp_path / "live"
    small_bag(path / "bag", pump_command=[0.1] * 100 + [math.nan] + [0.1] * 99)
    (path / "configuration").mkdir(parents=True)
    shutil.copy(CONFIG / "site.yaml", path / "configuration" / "site.yaml")
    (path / "summary.json").write_text(json.dumps({
        "status": "done", "controller": "onoff", "parameters": {"fraction": 1.0},
        "forecast": "/var/forecast.csv", "drive_at": "/dev/ttyUSB0",
    }))
    assert set(loaded(path)[0].command.tolist()) == {0.1}
    run = read_run(path)
    # In the site's zone, as its configuration has no start.
    assert (run.row["site"], run.row["start"]) == ("site.yaml", START.isoformat())


def test_what_recover_makes_of_a_damaged_bag(tmp_path: Path, recorded: Path) -> None:
    """The report advises to recover it; the new bag has the site and the summary of the run."""
    run = shutil.copytree(recorded, tmp_path / "run")
    (summary := run / "summary.json").write_text("{")
    refusal(find_runs, [run], match="summary.json: is not the summary of a run")
    shutil.copy(recorded / "summary.json", summary)
    file = run / "bag" / "bag_0.mcap"
    os.truncate(file, file.stat().st_size // 2)
    (run / "bag" / "metadata.yaml").write_bytes(b"\xff{[")
    refusal(report_of, run, match=f"run/bag: cannot be read as a bag.*greenroof recover {run}")
    recover(run)
    assert 16 <= len(loaded(run / "bag-recovered")[0].time) < 361
    assert read_run(run / "bag-recovered").row["site"] == "site.yaml"
