"""Bags: a full disk leaves what was recorded, which an independent reader opens.

What a killed recorder leaves is in the sample of the campaign, test_faults.py.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from commands import run_command
from disks import small_disk
from graphs import Process, environment, summary_of
from rosbags.highlevel import AnyReader


def recover(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the recovery as a user would."""
    return run_command("recover", str(directory), *arguments, cwd=Path.cwd(), env=environment(0))


def test_full_disk(domain: int, tmp_path: Path) -> None:
    """A disk that fills up is an error that reports it, and the bag can be recovered."""
    disk = tmp_path / "disk"
    with small_disk(disk, "200k"):
        process = Process(
            domain, "bringup", "--controller", "onoff", "--output", str(disk / "run"), cwd=tmp_path
        )
        assert process.wait(120) == 1
        assert "No space left on device" in process.stderr()
        assert "Traceback" not in process.stderr()
        summary = summary_of(disk / "run")
        assert summary["status"] == "failed"
        reason = re.fullmatch(
            r".*/bag: No space left on device; "
            r"'greenroof recover .*/bag' restores the first (\d+) ticks of the bag",
            summary["reason"],
        )
        assert reason is not None, summary["reason"]
        assert summary["reason"] in process.stderr()
        recovered = recover(disk / "run")
        assert recovered.returncode == 2
        assert "bag-recovered: cannot be written: No space left on device" in recovered.stderr
        assert not (disk / "run" / "bag-recovered").exists()
        done = recover(disk / "run", "--output", str(tmp_path / "rescued"))
        assert done.returncode == 0, done.stderr
        with AnyReader([tmp_path / "rescued"]) as reader:
            (ticks,) = {connection.msgcount for connection in reader.connections}
        assert ticks == int(reason[1]) > 300
        assert ticks <= summary["last_tick"] <= ticks + 64
