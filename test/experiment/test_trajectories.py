"""Trajectories of long runs: every tick, or one sample per interval."""

from __future__ import annotations

import csv
from pathlib import Path

from commands import run_command
from graphs import environment
from paper import paper_run
from studies import edit_grid

from greenroof_ros.analysis.study.case import collect_contents
from greenroof_ros.analysis.study.case_run import run_case, write_inputs
from greenroof_ros.analysis.study.grid import read_grid
from greenroof_ros.experiment.closed_loop import Simulation, record
from greenroof_ros.recording.trajectory import read_trajectory


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


def test_results_do_not_depend_on_it(tmp_path: Path) -> None:
    """A study's run without a trajectory, with each tick, and with one every 100 s."""
    (tmp_path / "grid.yaml").write_text(edit_grid("0.25", "0.1"))
    case = read_grid(tmp_path / "grid.yaml")[-1]
    write_inputs(collect_contents([case]), tmp_path)
    outcomes = [run_case(tmp_path, case, every) for every in (None, 0.0, 100.0)]
    assert outcomes[0].files == {}
    assert outcomes[1].results == outcomes[0].results == outcomes[2].results
    for outcome, samples in zip(outcomes[1:], (361, 5), strict=True):
        (tmp_path / "file").write_bytes(outcome.files["trajectory.parquet"])
        assert len(read_trajectory(tmp_path / "file").time) == samples
