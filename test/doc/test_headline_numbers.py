"""The headline numbers of the README are what the commands beside them print."""

from __future__ import annotations

import json
import re
import shlex
from functools import cache
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from places import CHECKOUT


def cells() -> list[tuple[str, str, str]]:
    """Return each cell of the table: its row's command, its column's options, itself."""
    text = (CHECKOUT / "README.md").read_text().split("## What it is worth\n")[1].split("\n## ")[0]
    head, _, *rows = (
        [cell.strip() for cell in line.strip("| ").split(" | ")]
        for line in text.splitlines() if line.startswith("|")
    )
    options = [" ".join(re.findall("`(.*?)`", cell)) for cell in head[1:]]
    commands = [" ".join(re.findall("`(.*?)`", row[0])) for row in rows]
    return [
        (command, option, shown)
        for command, row in zip(commands, rows, strict=True)
        for option, shown in zip(options, row[1:], strict=True)
    ]


def run(command: str, options: str, *others: str) -> dict[str, float]:
    """Run a command of the package and return what it prints as JSON."""
    module, *words = shlex.split(f"{command} {options} --json")
    done = run_command(module, *words, *others, cwd=CHECKOUT, env=environment(0))
    assert done.returncode == 0, done.stderr
    printed: dict[str, float] = json.loads(done.stdout)
    return printed


@cache
def least_possible(options: str) -> float:
    """Return the bound of a column, to which each of its cells is compared."""
    return run("bound", options)["bound_m3"]


@pytest.mark.parametrize(("command", "options", "shown"), cells())
def test_headline_numbers(command: str, options: str, shown: str, tmp_path: Path) -> None:
    """The deviation to the digit, and how many times the least possible it is.

    Each cell is run: a ratio that fits the number beside it says nothing of either.
    """
    number, _, ratio = shown.partition(" ")
    least = least_possible(options)
    if command == "bound":
        assert f"{least:.1f}" == number
        return
    summary = run(command, options, "--output", str(tmp_path / "run"))
    deviation = summary["total_deviation_m3"]
    assert f"{deviation:.1f}" == number
    digits = len(ratio.strip("()").partition(".")[2])
    assert f"({deviation / least:.{digits}f})" == ratio


def test_there_are_headline_numbers() -> None:
    assert len(cells()) == 3
