"""The headline numbers of README and results are what the commands beside them print."""

from __future__ import annotations

import csv
import json
import re
import shlex
import sys
from functools import cache
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from places import CHECKOUT

sys.path.append(str(CHECKOUT / "doc"))

import worth

# The page with a table of results, and its heading.
TABLE = ("doc/results.md", "## All controllers and the least possible deviation\n")


def cells_of(page: str, heading: str) -> list[tuple[str, str, str]]:
    """Return each cell of a table: its row's command, its column's options, itself."""
    text = (CHECKOUT / page).read_text().split(heading)[1].split("\n## ")[0]
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


def cells() -> list[tuple[str, str, str]]:
    """Return each cell of the table."""
    return cells_of(*TABLE)


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
    assert len(cells()) == 15


def test_readme_says_what_its_figure_shows() -> None:
    """The figure is drawn from the file that is kept, and so are the README's percentages."""
    assert (CHECKOUT / "doc" / "_static" / "worth.svg").read_text() == worth.drawing()
    with worth.FILE.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    readme = " ".join((CHECKOUT / "README.md").read_text().split())
    shares = [100 * float(row["share of on/off's"]) for row in rows]
    _, none, issued, dressed, perfect, plan, _, *paper = shares
    bound = 100 * float(rows[5]["its low end"])
    assert (
        f"Measured roof: lookahead without a forecast {none:.0f}, with issued forecasts "
        f"{issued:.0f}, dressed {dressed:.0f}, perfect {perfect:.0f}, least possible {bound:.0f} "
        f"to {plan:.0f}. The paper's roof: {', '.join(f'{share:.0f}' for share in paper)}."
    ) in readme
    assert (
        f"deviates {100 - issued:.0f} % less on the measured roof and {100 - paper[1]:.0f} % less "
        "on the paper's;"
    ) in readme
    assert f"{100 - dressed:.0f} and {100 - paper[2]:.0f} %." in readme
