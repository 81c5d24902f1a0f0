"""A command's output: directories, streams that can be full or closed, and runs that stop."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from commands import run_command
from graphs import environment

import greenroof_ros as gr
from greenroof_ros.base.versions import versions
from greenroof_ros.simulation.output import make_run_directory, write_summary


def run_in_shell(command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a shell line, in which $SIMULATE is a short run, and return its output."""
    return subprocess.run(
        command, shell=True, cwd=cwd, capture_output=True, text=True, timeout=300, check=False,
        env={"SIMULATE": f"{sys.executable} -m greenroof_ros simulate --hours 0.01 --output run",
             "PYTHONPATH": ":".join(filter(None, sys.path)), "LC_ALL": "C.UTF-8"},
    )


def test_an_output_that_is_full_or_that_no_one_reads(tmp_path: Path) -> None:
    """The run is done and its summary in its file; one line states the reason, or none.

    A limit on the size of files stands for a full disk: the message names the file.
    """
    done = run_in_shell("$SIMULATE --json >/dev/full", tmp_path)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, "error: No space left on device")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["status"] == "done"
    done = run_in_shell("{ $SIMULATE --json --output piped; echo $? >code; } | :", tmp_path)
    assert (tmp_path / "code").read_text() == "1\n"
    assert "error" not in done.stderr.lower()
    assert (tmp_path / "piped" / "summary.json").exists()
    command = "$SIMULATE --hours 1 --controller mpc --trajectory --output large"
    done = run_in_shell(f"ulimit -f 100; {command}", tmp_path)
    file = tmp_path / "large" / "trajectory.csv"
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, f"error: {file}: File too large")
    with pytest.raises(OSError, match=r"No such file or directory: '.*gone/summary.json'"):
        write_summary({"status": "done"}, tmp_path / "gone")


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


def test_a_killed_run_says_so(tmp_path: Path) -> None:
    """Its summary has no results; test_interrupted.py has those of other signals."""
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros", "simulate", "--hours", "60", "--controller", "mpc",
         "--output", "out"], cwd=tmp_path, env=environment(0), stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not (tmp_path / "out" / "summary.json").exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait(300)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "running" and "total_deviation_m3" not in summary


def test_a_run_whose_controller_fails_says_so(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from greenroof_ros.controllers.onoff import OnOff\n\n\n"
        "class Tired(OnOff):\n"
        "    def command(self, *given):\n"
        "        return -1.0\n"
    )
    done = run_command(
        "simulate", "--controller", "mine:Tired", "--output", "out", cwd=tmp_path,
        env=environment(0),
    )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert done.returncode == 2
    assert summary["status"] == "failed" and "Tired" in summary["reason"]


def test_the_source_is_a_hash_and_the_version_reports_it() -> None:
    """A hash of the names and contents of all Python files, in order; not a commit."""
    package = Path(gr.__file__).resolve().parent
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    by_name = versions()
    assert by_name["source"] == digest.hexdigest()[:12]
