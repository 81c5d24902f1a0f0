"""Trajectories of long runs: every tick, or one sample per interval."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from paper import paper_run
from studies import edit_grid

import greenroof_ros as gr
from greenroof_ros.analysis.study.case import collect_contents
from greenroof_ros.analysis.study.case_run import run_case
from greenroof_ros.analysis.study.grid import read_grid
from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.recording.trajectory import read_trajectory
from greenroof_ros.simulation.loop import Simulation, record


def test_csv(tmp_path: Path) -> None:
    """Its rows are at full minutes, and at the end."""
    done = run_command(
        "simulate", "--controller", "onoff", "--hours", "0.055", "--trajectory-every", "60",
        "--output", "out", cwd=tmp_path, env=environment(0),
    )
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "out" / "trajectory.csv").open()))
    assert [float(row["time_s"]) for row in rows] == [0, 60, 120, 180, 198]
    run = paper_run("--controller", "onoff", "--hours", "0.055")
    roof = record(run, Simulation(run).ticks()).roof
    assert [float(row["roof_m3"]) for row in rows] == roof[[0, 60, 120, 180, 198]].tolist()


STARTED = ("simulate", "--controller", "onoff", "--hours", "2", "--speed", "20", "--trajectory",
           "--output", "out")


def test_an_existing_trajectory_is_refused_before_the_run(tmp_path: Path) -> None:
    """It stays as it is."""
    file = tmp_path / "out" / "trajectory.csv"
    file.parent.mkdir()
    file.write_text("of a week")
    done = run_command(*STARTED, cwd=tmp_path, env=environment(0))
    assert (done.returncode, file.read_text()) == (2, "of a week")
    assert "exists and is not empty" in done.stderr and [*file.parent.iterdir()] == [file]


@pytest.mark.parametrize(("number", "status", "code"), [
    (signal.SIGINT, "interrupted", 130), (signal.SIGKILL, "running", -signal.SIGKILL),
])
def test_an_interrupted_run_says_so(
    tmp_path: Path, number: signal.Signals, status: str, code: int
) -> None:
    """Its summary has no results; its trajectory is read as far as it goes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros", *STARTED], cwd=tmp_path, env=environment(0),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    file = tmp_path / "out" / "trajectory.csv"
    while not (file.exists() and file.stat().st_size):  # the first rows have left the buffer
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(300) == code
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == status and "total_deviation_m3" not in summary
    if number == signal.SIGINT:
        rows = gr.read_bag(tmp_path / "out")
        assert summary["last_tick"] == rows["time_s"][-1] == len(rows) - 1
        assert summary["reason"] == "interrupted by SIGINT"


def test_a_run_whose_controller_fails_says_so(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from greenroof_ros.controllers.onoff import OnOff\n\n\n"
        "class Tired(OnOff):\n"
        "    def command(self, *given):\n"
        "        return -1.0\n"
    )
    done = run_command(*STARTED[:1], "--controller", "mine:Tired", *STARTED[3:], cwd=tmp_path,
                       env=environment(0))
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert done.returncode == 2
    assert summary["status"] == "failed" and "Tired" in summary["reason"]


def test_results_do_not_depend_on_it(tmp_path: Path) -> None:
    """A study's run without a trajectory, with each tick, and with one every 100 s."""
    (tmp_path / "grid.yaml").write_text(edit_grid("0.25", "0.1"))
    case = read_grid(tmp_path / "grid.yaml")[-1]
    write_inputs(collect_contents([case]), tmp_path)
    outcomes = [run_case(tmp_path, case, every) for every in (None, 0.0, 100.0)]
    assert outcomes[0].files.keys() == {"events.csv"}
    assert len({outcome.files["events.csv"] for outcome in outcomes}) == 1
    assert outcomes[1].results == outcomes[0].results == outcomes[2].results
    for outcome, samples in zip(outcomes[1:], (361, 5), strict=True):
        (tmp_path / "file").write_bytes(outcome.files["trajectory.parquet"])
        assert len(read_trajectory(tmp_path / "file").time) == samples
