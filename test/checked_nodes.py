"""Nodes of users: the examples, with changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from graphs import environment


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
