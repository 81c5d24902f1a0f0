"""The errors that a user can repair by editing a file or an option."""

from __future__ import annotations

from collections.abc import Collection
from difflib import get_close_matches
from pathlib import Path


class ConfigurationError(Exception):
    """A file or an option is wrong; the message says where, what is there, and what would be right.

    Commands end with exit code 2 on it, without a traceback.

    Attributes:
        wrong: the message without file and line.
    """

    def __init__(
        self,
        expected: str,
        *,
        file: Path | str | None = None,
        line: int | None = None,
        key: str | None = None,
        value: object = None,
    ) -> None:
        where = str(file) if file is not None else ""
        if line is not None:
            where += f", line {line}"
        what = key or ""
        if value is not None:
            what += f" = {value!r}" if key else repr(value)
        self.wrong = ": ".join(part for part in (what, expected) if part)
        super().__init__(f"{where}: {self.wrong}" if where else self.wrong)


class OccupiedError(ConfigurationError):
    """Another graph is where this one was to run; commands end with exit code 3."""


def did_you_mean(name: str, known: Collection[str]) -> str:
    """Return what a mistyped name may stand for, or all that there are: a clause of a message."""
    close = get_close_matches(name, known, 1) or [
        one for one in known if one.casefold() == name.casefold()
    ]
    if close:
        return f"did you mean {close[0]}?"
    return f"they are {', '.join(known)}"
