"""The ``greenroof`` command: its help, its commands under both names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_command
from places import CHECKOUT

import greenroof_ros
from greenroof_ros.__main__ import COMMANDS

# Runs each of its arguments as a command, and prints which top-level packages are imported.
IMPORTED = """
import sys
from greenroof_ros.__main__ import main
for line in sys.argv[1:]:
    sys.argv = ["greenroof", *line.split()]
    try:
        main()
    except SystemExit as end:
        print(chr(12), end.code, flush=True)
print(*{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


def greenroof(directory: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return run_command("__main__", *words, cwd=directory, env=dict(os.environ))


def imported_by(directory: Path, *lines: str) -> tuple[set[str], str]:
    """Return the packages that commands have imported when they end, and their output."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED, *lines], cwd=directory, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, check=True, timeout=120,
    )
    return set(done.stderr.splitlines()[-1].split()), done.stdout


def test_each_command_has_its_help_and_imports_little_for_it(tmp_path: Path) -> None:
    names = [name for name in COMMANDS if name != "live"]  # live needs ROS
    packages, printed = imported_by(tmp_path, *(f"{name} --help" for name in names))
    *texts, after_last = printed.split("\f 0\n")
    assert after_last == ""
    for name, text in zip(names, texts, strict=True):
        assert text.startswith(f"usage: greenroof {name} "), name
    assert not packages & {"rclpy", "pymodbus", "osqp", "aiohttp", "polars", "altair"}


def test_what_is_no_command_is_refused(tmp_path: Path) -> None:
    done = greenroof(tmp_path, "simulators", "siet")
    assert (done.returncode, done.stdout) == (2, "")
    assert "did you mean simulators site?" in done.stderr


def test_version_is_printed(tmp_path: Path) -> None:
    """As pip and the bags name it."""
    done = greenroof(tmp_path, "--version")
    assert (done.returncode, done.stdout) == (0, f"greenroof_ros {greenroof_ros.__version__}\n")


@pytest.mark.parametrize(("words", "meant"), [
    ("run --hour 0.01", "--hours"),
    ("live --controller=lookahead --waiting-b 3", "--waiting-budget"),
])
def test_an_unknown_option_is_refused_with_what_it_means(
    tmp_path: Path, words: str, meant: str
) -> None:
    done = greenroof(tmp_path, *words.split())
    assert (done.returncode, done.stdout) == (2, "")
    assert f"did you mean {meant}?" in done.stderr


def test_a_command_imports_what_it_needs(tmp_path: Path) -> None:
    helped, _ = imported_by(tmp_path, "--help")
    assert not helped & {"numpy", "rich", "yaml", "rclpy"}
    simulated, _ = imported_by(tmp_path, "simulate --hours 0.01 --controller mpc")
    assert "osqp" in simulated
    assert not simulated & {"rclpy", "pymodbus", "mcap", "aiohttp", "polars"}
