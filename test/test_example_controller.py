"""The example of a controller of one's own, through simulate, bringup, study and report."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from graphs import bring_up, environment
from places import CHECKOUT
from studies import GRID, rows_of

from greenroof_ros.recording.trajectory import read_parquet

EXAMPLE = "examples.proportional:Proportional"
FILE = str(CHECKOUT / "examples" / "proportional.yaml")
TICKS = 361


def run(directory: Path, module: str, *options: str) -> str:
    """Run a command to its good end and return what it prints."""
    result = subprocess.run(
        [sys.executable, "-m", f"greenroof_ros.{module}", *options],
        cwd=directory, env=environment(0), capture_output=True, text=True, timeout=120, check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_it_is_short() -> None:
    """At most 60 lines, with its documentation."""
    assert len((CHECKOUT / "examples" / "proportional.py").read_text().splitlines()) <= 60


def test_simulate_and_graph_agree(domain: int, tmp_path: Path) -> None:
    """Its parameter file is used by both, and the numbers are equal in every bit."""
    pytest.importorskip("rclpy", reason="the graph needs ROS 2")
    options = ("--controller", EXAMPLE, "--parameters", FILE, "--gain", "35", "--hours", "0.1")
    alone = json.loads(run(tmp_path, "simulate", "--json", "--output", "alone", *options))
    graph = bring_up(domain, tmp_path, *options)
    assert graph["controller"] == alone["controller"] == "proportional"
    assert graph["controller_reference"] == EXAMPLE
    assert graph["parameters"] == alone["parameters"] == {"gain": 35.0}
    differing = {key for key in alone if alone[key] != graph[key]}
    assert differing <= {"wall_s", "times_real_time", "messages", "weather", "site"}
    assert set(graph["messages"].values()) == {TICKS}
    # It solves nothing: no topic of a solver.
    assert not any(topic.startswith("/controller/") for topic in graph["messages"])


def test_study_and_report(tmp_path: Path) -> None:
    """It stands in grid, table and page beside a controller of this package, with its parameter."""
    section = f"  {EXAMPLE}:\n    gain: [10.0, 20.0]\n  onoff:\n"
    grid = GRID[: GRID.index("  mpc:\n")] + section
    grid = grid.replace("hours: 0.25", "hours: 0.1").replace("[published, fao56]", "published")
    (tmp_path / "grid.yaml").write_text(grid)
    run(tmp_path, "study", "grid.yaml", "--output", "study", "--jobs", "1")
    rows = [row for row in rows_of(tmp_path / "study" / "results.csv")
            if row["controller"] == "proportional"]
    assert {row["status"] for row in rows} == {"done"}
    assert len(rows) == 2 * 2  # initial states, gains
    own = run(
        tmp_path, "simulate", "--controller", EXAMPLE, "--gain", "10", "--hours", "0.1", "--json",
        "--evapotranspiration", "published",
    )
    mine = next(row for row in rows if row["initial"] == "low-low"
                and row["evapotranspiration"] == "published" and "10.0" in row.values())
    assert float(mine["total_deviation_m3"]) == json.loads(own)["total_deviation_m3"]
    trajectory = read_parquet(tmp_path / "study" / "runs" / mine["run"] / "trajectory.parquet")
    assert len(trajectory.time) == TICKS
    run(tmp_path, "report", "study", "--output", "report")
    page = (tmp_path / "report" / "report.html").read_text()
    assert "proportional" in page
    assert "gain" in page


def test_another_state_of_its_code_is_another_run(tmp_path: Path) -> None:
    """A study that was begun with other code of the controller is not gone on with."""
    (tmp_path / "mine.py").write_text((CHECKOUT / "examples" / "proportional.py").read_text())
    grid = GRID[: GRID.index("  mpc:\n")] + "  mine:Proportional:\n"
    (tmp_path / "grid.yaml").write_text(grid.replace("hours: 0.25", "hours: 0.01"))
    run(tmp_path, "study", "grid.yaml", "--output", "study", "--jobs", "1")
    with (tmp_path / "mine.py").open("a") as stream:
        stream.write("# changed\n")
    result = subprocess.run(
        [sys.executable, "-m", "greenroof_ros.study", "grid.yaml", "--output", "study"],
        cwd=tmp_path, env=environment(0), capture_output=True, text=True, timeout=60, check=False,
    )
    assert result.returncode == 2
    assert "holds a study begun with another grid, or other files" in result.stderr
