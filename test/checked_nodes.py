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


def wrong_verdict(process: Process, expected: dict[str, str]) -> str:
    """Return the verdict of a check unless it is right; empty if it is.

    Args:
        process: the check.
        expected: a part of the title of each check that must fail, and a pattern for its problem.
            Checks that could not be tried do not count.
    """
    code, lines = process.wait(180), process.stdout().splitlines()
    failed = [line for line in lines if line.startswith("  failed: ")]
    tried = [line for line in failed if "not checked" not in line]
    right = code == bool(expected) and len(tried) == len(expected) and all(
        any(part in line and re.search(pattern, line) for line in tried)
        for part, pattern in expected.items()
    )
    return "" if right else f"exit code {code}, {failed}, {process.stderr()}"
