"""Nodes under test: examples, with changes that each break one rule, and the verdicts on them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from graphs import Process, environment


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, old
    return text.replace(old, new)


def start_node(
    domain: int, directory: Path, name: str, source: str, *arguments: str
) -> subprocess.Popen[bytes]:
    """Start a node from its source, as its user would."""
    file = directory / f"{name}.py"
    file.write_text(source)
    return subprocess.Popen(
        [sys.executable, str(file), *arguments], cwd=directory, env=environment(domain)
    )


def in_namespace(name: str) -> tuple[str, ...]:
    """Return the arguments that put a node into a namespace."""
    return "--ros-args", "-r", f"__ns:=/{name}"


def failures(output: str) -> dict[str, str]:
    """Return the failed checks of a table, each with what was wrong."""
    rows: list[list[str]] = []
    for line in output.splitlines():
        if line.startswith("│"):
            rows.append([cell.strip() for cell in line.strip("│").split("│")])
        elif line.startswith("├"):
            rows.append([])
    results = dict(filter(None, rows))
    return {check: result for check, result in results.items() if not result.startswith("passed")}


def wrong_verdict(process: Process, expected: dict[str, str]) -> str:
    """Return the verdict of a check unless it is right; empty if it is.

    Args:
        process: the check.
        expected: a part of the title of each check that must fail, and a pattern for its problem.
            Checks that could not be tried do not count.
    """
    code, failed = process.wait(180), failures(process.stdout())
    tried = {title: problem for title, problem in failed.items() if "not checked" not in problem}
    right = code == bool(expected) and len(tried) == len(expected) and all(
        any(part in title and re.search(pattern, problem) for title, problem in tried.items())
        for part, pattern in expected.items()
    )
    return "" if right else f"exit code {code}, {failed}, {process.stderr()}"
