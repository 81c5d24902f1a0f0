"""Markdown tables, as the campaigns print them for the documentation."""

from __future__ import annotations

from collections.abc import Sequence


def row(cells: Sequence[str]) -> str:
    """Return a table row."""
    return f"| {' | '.join(cells)} |"


def head(cells: Sequence[str]) -> str:
    """Return the two header lines of a table."""
    return f"{row(cells)}\n|{'---|' * len(cells)}"
