"""``greenroof``: its help, its commands and those of ``python -m``, completion in the shell."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_command
from places import CHECKOUT

from greenroof_ros.__main__ import COMMANDS, GROUPS

# The module of ``python -m greenroof_ros.MODULE``.
MODULES = {
    "run": "bringup",
    "live": "bringup.live",
    "simulate": "simulate",
    "bound": "bound",
    "study": "study",
    "report": "report",
    "watch": "watch",
    "calibrate": "calibrate",
    "verify": "verify",
    "check-controller": "check_controller",
    "check-pump": "check_pump",
    "simulators drive": "drive_simulator",
    "simulators site": "site_simulator", "simulators forecast": "forecast_simulator",
    "fetch-forecast": "fetch_forecast",
    "recover": "recover",
    "topics": "topics",
}
# Runs what follows it on the command line, and prints the top-level packages that are imported.
IMPORTED = """
import sys
from greenroof_ros.__main__ import main
try:
    main()
finally:
    print(*{name.partition(".")[0] for name in sys.modules}, file=sys.stderr)
"""


def greenroof(directory: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return run_command("__main__", *words, cwd=directory, env=dict(os.environ))


def imported_by(directory: Path, *words: str) -> set[str]:
    """Return the packages that a command has imported when it ends."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED, *words], cwd=directory, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, check=True, timeout=120,
    )
    return set(done.stderr.splitlines()[-1].split())


def test_these_are_the_commands() -> None:
    assert COMMANDS.keys() == MODULES.keys()


@pytest.mark.parametrize("words", [(), ("--help",), ("-h",), ("simulators",), ("simulators", "-h")])
def test_help_groups_the_commands(tmp_path: Path, words: tuple[str, ...]) -> None:
    """By what a user wants to do, each with a line that fits a terminal."""
    done = greenroof(tmp_path, *words)
    assert (done.returncode, done.stderr) == (0, "")
    sections = {
        lines[0].removesuffix(":"): lines[1:]
        for lines in (part.splitlines() for part in done.stdout.split("\n\n"))
    }
    for title, group in GROUPS.items():
        assert [line[2:22].strip() for line in sections[title]] == list(group)
        assert max(map(len, sections[title])) <= 80


@pytest.mark.parametrize("name", MODULES)
def test_help_is_that_of_the_module(tmp_path: Path, name: str) -> None:
    ours = greenroof(tmp_path, *name.split(), "--help")
    module = run_command(MODULES[name], "--help", cwd=tmp_path, env=dict(os.environ))
    assert (ours.returncode, ours.stdout, ours.stderr) == (0, module.stdout, "")
    assert ours.stdout.startswith("usage: greenroof ")


@pytest.mark.parametrize(("words", "meant"), [
    (["simulat"], "simulat; did you mean simulate?"),
    (["check_pump"], "check_pump; did you mean check-pump?"),
    (["simulators", "drvie"], "simulators drvie; did you mean simulators drive?"),
    (["bringup", "--help"], f"bringup; they are {', '.join(COMMANDS)}"),
])
def test_what_is_no_command_is_refused(tmp_path: Path, words: list[str], meant: str) -> None:
    done = greenroof(tmp_path, *words)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1] == f"greenroof: error: there is no command {meant}"


def test_a_command_does_what_its_module_does(tmp_path: Path) -> None:
    """Its output, its exit code and what it says of a wrong option."""
    assert greenroof(tmp_path, "topics").stdout.startswith("| topic |")
    wrong = greenroof(tmp_path, "simulate", "--hours", "-1")
    assert wrong.returncode == 2
    assert wrong.stderr.splitlines()[-1].startswith("greenroof simulate: error: argument --hours:")


def test_run_simulates_and_live_is_a_site(tmp_path: Path) -> None:
    """Neither has the other's options."""
    live = greenroof(tmp_path, "live")
    assert (live.returncode, live.stderr.partition(" is missing")[0]) == (
        2, "error: --sensors FILE:"
    )
    for name, option in (("run", "--sensors"), ("live", "--hours")):
        done = greenroof(tmp_path, name, option, "1")
        assert done.returncode == 2
        assert f"greenroof {name}: error: unrecognized arguments: {option} 1" in done.stderr


def test_a_command_imports_what_it_needs(tmp_path: Path) -> None:
    assert not imported_by(tmp_path, "--help") & {"numpy", "rich", "yaml", "rclpy"}
    simulated = imported_by(tmp_path, "simulate", "--hours", "0.01")
    assert "osqp" in simulated
    assert not simulated & {"rclpy", "pymodbus", "mcap", "aiohttp", "polars"}
    for name in set(MODULES) - {"live"}:
        packages = imported_by(tmp_path, *name.split(), "--help")
        assert not packages & {"rclpy", "pymodbus", "osqp", "aiohttp", "polars", "altair"}, name


@pytest.mark.parametrize(("typed", "completed"), [
    ("greenroof s", {"simulate", "simulators", "study"}),
    ("greenroof simulators ", {"drive", "site", "forecast", "-h", "--help"}),
    ("greenroof simulate --controller lookahead --hor", {"--horizon"}),
    ("greenroof simulate --initial high", {"high-low", "high-high"}),
    ("greenroof simulators drive --ram", {"--ramp"}),
])
def test_the_shell_completes_it(tmp_path: Path, typed: str, completed: set[str]) -> None:
    argcomplete = pytest.importorskip("argcomplete", reason="the extra [completion]")
    command = tmp_path / "greenroof"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m greenroof_ros "$@"\n')
    command.chmod(0o755)
    script = (
        f"{argcomplete.shellcode(['greenroof'])}\n"
        f"COMP_LINE='{typed}' COMP_POINT={len(typed)} COMP_TYPE=9\n"
        '_python_argcomplete greenroof; printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(
        ["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT), "PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )
    assert {each.strip() for each in done.stdout.split()} == completed, done.stderr
