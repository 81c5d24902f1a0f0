"""Readable texts: printable versions of other programs' texts, and numbers with nouns."""

from __future__ import annotations


def clean_text(text: str, max_length: int = 500) -> str:
    """Return a printable version of a text, truncated to a maximum number of characters."""
    short = text[:max_length] + ("…" if len(text) > max_length else "")
    if short.isprintable():
        return short
    return "".join(
        sign if sign.isprintable() else " " if sign.isspace() else "\N{REPLACEMENT CHARACTER}"
        for sign in short
    )


def number_of(count: int, noun: str) -> str:
    """Return a number with its noun, such as ``1 season`` or ``1,000 buildings``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
