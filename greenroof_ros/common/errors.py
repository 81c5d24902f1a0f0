"""The errors that a user can repair by editing a file or an option."""

from __future__ import annotations

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
