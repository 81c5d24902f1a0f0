"""Readable texts: without control characters, and numbers with nouns."""

from __future__ import annotations


def escape(text: str) -> str:
    r"""Return a text in one line, with control characters and direction marks escaped.

    On a terminal, these characters of other people's files and messages could hide or change what
    is printed. For example, ESC becomes ``\x1b``. Every command prints what a file or a service may
    contain through this function, or on a :class:`.PlainConsole`.
    """
    if text.isprintable():
        return text
    return "".join(
        sign if sign.isprintable()
        else " " if sign.isspace() and sign != "\r"
        else sign.encode("unicode_escape").decode()
        for sign in text
    )


def clean_text(text: str, max_length: int = 500) -> str:
    """Return another program's text, escaped and truncated to a maximum number of characters."""
    return escape(text[:max_length] + ("…" if len(text) > max_length else ""))


def number_of(count: int, noun: str) -> str:
    """Return a number with its noun, such as ``1 season`` or ``1,000 buildings``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"
