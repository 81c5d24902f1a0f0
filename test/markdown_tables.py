"""Tables in Markdown, as campaigns print them for the documentation."""

from __future__ import annotations

from collections.abc import Sequence


def row(cells: Sequence[str]) -> str:
    """Return a row."""
    return f"| {' | '.join(cells)} |"


def head(cells: Sequence[str]) -> str:
    """Return the two lines that a table begins with."""
    return f"{row(cells)}\n|{'---|' * len(cells)}"
