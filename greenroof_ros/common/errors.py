"""The errors that a user can repair by editing a file or an option."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from difflib import SequenceMatcher
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
        place = str(file) if file is not None else ""
        if line is not None:
            place += f", line {line}"
        subject = key or ""
        if value is not None:
            subject += f" = {value!r}" if key else repr(value)
        self.wrong = ": ".join(part for part in (subject, expected) if part)
        super().__init__(f"{place}: {self.wrong}" if place else self.wrong)


class OccupiedError(ConfigurationError):
    """Another graph is where this one was to run; commands end with exit code 3."""


@contextmanager
def in_extra(extra: str) -> Iterator[None]:
    """Import what a plain installation does not have.

    Args:
        extra: of this package that installs it, such as ``study``.

    Raises:
        ConfigurationError: it is not there; it says what to install.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        raise ConfigurationError(
            f"needs {package}: pip install 'greenroof_ros[{extra}]'"
        ) from error


# How alike two names must be, from 0 to 1: of three letters one may be wrong.
_ALIKE, _SHORT_ALIKE = 0.6, 0.5


def did_you_mean(name: str, known: Collection[str]) -> str:
    """Return what a mistyped name may stand for, or all that there are: a clause of a message."""
    alike = {
        word: SequenceMatcher(None, name.casefold(), word.casefold()).ratio() for word in known
    }
    best = max(alike.values(), default=0.0)
    if best >= (_SHORT_ALIKE if len(name) <= 3 else _ALIKE):
        return f"did you mean {' or '.join(word for word in known if alike[word] == best)}?"
    return f"choose from {', '.join(known)}"
