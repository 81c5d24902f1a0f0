"""A command's output: a separate directory, and streams that can be full or closed."""

from __future__ import annotations

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest

from greenroof_ros.simulation.directory import make_run_directory


def run_in_shell(command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a shell line, in which $SIMULATE is a short run, and return its output."""
    return subprocess.run(
        command, shell=True, cwd=cwd, capture_output=True, text=True, timeout=300, check=False,
        env={"SIMULATE": f"{sys.executable} -m greenroof_ros simulate --hours 0.01 --output run",
             "PYTHONPATH": ":".join(filter(None, sys.path)), "LC_ALL": "C.UTF-8"},
    )


def test_a_summary_that_cannot_be_printed(tmp_path: Path) -> None:
    """The run is done, its summary is in its file, and one line states the reason."""
    done = run_in_shell("$SIMULATE --json >/dev/full", tmp_path)
    assert (done.returncode, done.stderr) == (1, "error: No space left on device\n")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["status"] == "done"


def test_file_that_has_no_room(tmp_path: Path) -> None:
    """A limit on the size of files stands for a full disk: the message names the file."""
    command = "$SIMULATE --hours 1 --controller onoff --trajectory"
    done = run_in_shell(f"ulimit -f 100; {command}", tmp_path)
    file = tmp_path / "run" / "trajectory.csv"
    assert (done.returncode, done.stderr) == (1, f"error: {file}: File too large\n")


def test_output_that_no_one_reads(tmp_path: Path) -> None:
    """As with '| head': no message, and the run's directory is complete."""
    done = run_in_shell("{ $SIMULATE --json; echo $? >code; } | :", tmp_path)
    assert (tmp_path / "code").read_text() == "1\n"
    assert "error" not in done.stderr.lower()
    assert (tmp_path / "run" / "summary.json").exists()


def test_runs_of_one_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Started at the same time, without --output: each has a separate directory."""
    monkeypatch.chdir(tmp_path)
    count = 16
    together = Barrier(count)

    def make(_: int) -> Path:
        together.wait()
        return make_run_directory(None, "mpc")

    with ThreadPoolExecutor(count) as threads:
        directories = list(threads.map(make, range(count)))
    assert sorted(directories) == sorted((tmp_path / "runs").iterdir())
    assert len(set(directories)) == count
    assert all((directory / "configuration").is_dir() for directory in directories)
