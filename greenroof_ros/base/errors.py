"""Errors that a user can fix by editing a file or an option, and errors that end a run."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path

from greenroof_ros.base.text import escape

# Maximum length of a value in a message, and of a message (characters).
_MAX_VALUE, _MAX_MESSAGE = 300, 4000


def describe_value(value: object) -> str:
    """Return Python's representation of a value for a message, truncated to 300 characters."""
    try:
        return _shorten(repr(value), _MAX_VALUE)
    except ValueError:  # from Python
        return "a number with thousands of digits"


def _shorten(text: str, max_length: int) -> str:
    """Return a text, with its middle removed if it is longer than the maximum."""
    half = max_length // 2
    return text if len(text) <= max_length else f"{text[:half]} ... {text[-half:]}"


class ConfigurationError(Exception):
    """Raised if a file or an option is invalid; the message gives the place and valid values.

    Control characters in the message are escaped. A command then exits with code 2 and prints no
    traceback.

    Attributes:
        wrong: the message without the file and the line.
        expected: the description of the expected value.
        file: the invalid file; None if the error is in another input.
        key: key with the invalid value; None if the message names no key.
        value: the invalid value; None if the message shows no value.
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
            subject += f" = {describe_value(value)}" if key else describe_value(value)
        self.expected, self.file, self.key, self.value = expected, file, key, value
        wrong = ": ".join(part for part in (subject, expected) if part)
        self.wrong = escape(_shorten(wrong, _MAX_MESSAGE))
        super().__init__(f"{escape(place)}: {self.wrong}" if place else self.wrong)


@contextmanager
def rename_keys(names: Mapping[str, str]) -> Iterator[None]:
    """Rename keys in errors to the user's names for inputs, such as ``--hours`` for ``hours``.

    Args:
        names: the user's names, keyed by the keys in errors; other keys and keys in files are
            unchanged.
    """
    try:
        yield
    except ConfigurationError as error:
        name = names.get(error.key or "")
        if error.file is not None or name is None:
            raise
        raise ConfigurationError(error.expected, key=name, value=error.value) from error


class FailedError(Exception):
    """Raised if what a command was asked for could not be done; the command exits with code 1."""


class LockstepError(Exception):
    """Raised if the graph cannot continue; the message names the topic and the node."""


class MalformedMessageError(Exception):
    """Raised if the bytes received do not form a message of the topic's type."""


class HangError(Exception):
    """Raised if a callback takes too long; the message states the time limit and the position."""


class OccupiedError(ConfigurationError):
    """Raised if another graph is already running in the namespace; a command exits with code 3."""


def describe_extra(extra: str) -> str:
    """Return the clause of a message that tells the user to install an extra.

    The clause names no command, since the package may be installed from an index, a wheel or a
    checkout.
    """
    return f"install greenroof_ros with its extra [{extra}]"


@contextmanager
def require_extra(extra: str) -> Iterator[None]:
    """Turn an import error in the block into a message about the extra that has to be installed.

    Args:
        extra: the extra of this package that installs the imported package, such as ``study``.

    Raises:
        ConfigurationError: if the imported package is missing; the message names the extra to
            install.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        raise ConfigurationError(f"needs {package}: {describe_extra(extra)}") from error


# The minimum similarity of two names, 0 to 1: in a name of three letters, one may be wrong.
_ALIKE, _SHORT_ALIKE = 0.6, 0.5


def find_similar(name: str, known: Collection[str]) -> list[str]:
    """Return the known names most similar to a shortened or mistyped name."""
    start, words = name.casefold(), {word.casefold(): word for word in known}
    longer = [word for folded, word in words.items() if start and folded.startswith(start)]
    alike = get_close_matches(start, words, 1, _SHORT_ALIKE if len(name) <= 3 else _ALIKE)
    return longer or [words[folded] for folded in alike]


def suggest_names(name: str, known: Collection[str]) -> str:
    """Return a clause, for a message, with the most similar names, or else all known names."""
    meant = find_similar(name, known)
    return f"did you mean {' or '.join(meant)}?" if meant else f"choose from {', '.join(known)}"


def describe_choices(known: Collection[str], name: str, otherwise: str = "") -> str:
    """Return a message about an unknown name, with the most similar names, or all names.

    Args:
        known: the valid names.
        name: the unknown name.
        otherwise: text about other allowed values, to append to the list, such as ``, or a
            FILE.yaml``.
    """
    if find_similar(name, known):
        return f"is unknown; {suggest_names(name, known)}"
    return f"must be one of {', '.join(known)}{otherwise}"
