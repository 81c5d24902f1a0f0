"""What simulations need of a system: the commands without ROS on Linux, macOS and Windows.

On each system ``.github/workflows/ci.yml`` runs this file with ``--noconftest``, since the fixtures
of ``conftest.py`` need Linux.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from places import CHECKOUT

# Two of the paper's 30 runs.
GRID = """
site: site.yaml
weather: {file: weather/toronto_2021-07.csv, start: 2021-07-07T02:00, hours: 12,
          evapotranspiration: published}
initial: low-low
controllers:
  mpc: {weight: 1.0e-3}
  onoff: {fraction: 1.0}
"""

# Takes away what Windows lacks, and runs a command.
LIKE_WINDOWS = """
import multiprocessing.util, os, runpy, signal, socket, subprocess, sys, tempfile
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
for module, names in (
    (os, "register_at_fork sched_getaffinity pipe2 getuid pidfd_open O_DIRECTORY O_NOFOLLOW"),
    (signal, "SIGHUP SIGALRM ITIMER_REAL setitimer alarm"),
):
    for name in names.split():
        vars(module).pop(name, None)
runpy.run_module("greenroof_ros", run_name="__main__", alter_sys=True)
"""


def greenroof(cwd: Path, *arguments: str, code: str = "") -> None:
    """Run a command, and check that it succeeds."""
    start = ["-c", code] if code else ["-m", "greenroof_ros"]
    done = subprocess.run(
        [sys.executable, *start, *arguments], cwd=cwd, capture_output=True, encoding="utf-8",
        check=False, env={**os.environ, "PYTHONUTF8": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_study_has_the_totals_of_the_paper(tmp_path: Path) -> None:
    """In worker processes, with a report; the totals are those of the authors' code."""
    (tmp_path / "grid.yaml").write_text(GRID, encoding="utf-8")
    greenroof(tmp_path, "study", "grid.yaml", "--jobs", "2", "--output", "out")
    greenroof(tmp_path, "report", "out")
    assert (tmp_path / "out" / "report" / "report.html").stat().st_size > 100_000
    with (CHECKOUT / "config" / "paper" / "totals.csv").open(encoding="utf-8") as stream:
        theirs = {
            (row["controller"], float(row["parameter"])): float(row["total_deviation_m3"])
            for row in csv.DictReader(stream) if row["initial"] == "low-low"
        }
    with (tmp_path / "out" / "results.csv").open(newline="", encoding="utf-8") as stream:
        ours = {
            row["controller"]: float(row["total_deviation_m3"]) for row in csv.DictReader(stream)
        }
    assert ours == {
        "mpc": pytest.approx(theirs["mpc", 1e-3], rel=4e-5),
        "onoff": pytest.approx(theirs["onoff", 1.0], rel=4e-5),
    }


def test_a_new_site_is_simulated(tmp_path: Path) -> None:
    greenroof(
        tmp_path, "new-site", "--roof", "40", "--catchment", "120", "--cistern", "7",
        "--place", "43.66,-79.40", "--time-zone", "America/Toronto",
    )
    greenroof(
        tmp_path, "simulate", "--site", "my_site.yaml", "--controller", "lookahead",
        "--start", "2021-07-08T03:00", "--hours", "12", "--output", "run",
    )
    summary = json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    assert summary["status"] == "done" and summary["rain_m3"] > 1.0


def test_a_cistern_is_sized(tmp_path: Path) -> None:
    weather = CHECKOUT / "config" / "weather" / "toronto_2021.csv"
    greenroof(
        tmp_path, "size", "--site", str(CHECKOUT / "config" / "site_valve.yaml"), "--weather",
        str(weather), "--gaps", "fill", "--volumes", "5", "10", "--targets", "39",
        "--outlets", "none", "--jobs", "2", "--output", "sizes",
    )
    assert (tmp_path / "sizes" / "sizes.csv").is_file()


def test_the_numbers_are_those_of_a_system_without_posix(tmp_path: Path) -> None:
    """A run where everything is missing that Windows does not have."""
    options = ("simulate", "--controller", "onoff", "--hours", "0.5", "--output")
    greenroof(tmp_path, *options, "here")
    greenroof(tmp_path, *options, "there", code=LIKE_WINDOWS)
    here, there = (
        json.loads((tmp_path / name / "summary.json").read_text(encoding="utf-8"))
        for name in ("here", "there")
    )
    assert here["pumped_m3"] == there["pumped_m3"] > 0.0
