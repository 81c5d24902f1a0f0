"""What every command has in common: exit codes, how it reports a mistake, where its output goes."""

from __future__ import annotations

import argparse
import errno
import functools
import io
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TextIO

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.common.processes import end_with_parent

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_OCCUPIED = 3
EXIT_INTERRUPTED = 130
# The least number of an option that must be greater than 0, as far as people are concerned.
_TINY = 1e-9


def exit_code(error: Exception) -> int:
    """Return the exit code of a wrong set-up: 3 where another graph is in the way, otherwise 2."""
    return EXIT_OCCUPIED if isinstance(error, OccupiedError) else EXIT_USAGE


class OutputError(Exception):
    """What a command has to say could not be printed.

    Attributes:
        quiet: whether nobody is there who reads it, as behind ``| head``.
    """

    def __init__(self, error: OSError, elsewhere: str) -> None:
        why = "it is closed" if error.errno == errno.EBADF else error.strerror
        super().__init__(f"standard output cannot be written: {why}{elsewhere}")
        self.quiet = isinstance(error, BrokenPipeError)


class _Stream(io.FileIO):
    """Standard output or standard error, which keeps its first error instead of raising it.

    A progress bar whose terminal is gone must not end a run, and a summary that cannot be printed
    is in its file.
    """

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Write, or keep why that was not possible."""
        try:
            return super().write(data)
        except OSError as error:
            self.error = self.error or error
            return len(data)


def _stream(number: int, replaced: TextIO | None) -> TextIO:
    """Return a stream to a file descriptor, in the encoding of the one that it replaces."""
    return io.TextIOWrapper(
        io.BufferedWriter(_Stream(number, "w", closefd=False)),
        encoding=getattr(replaced, "encoding", None),
        errors=getattr(replaced, "errors", None),
        line_buffering=True,
    )


def _set_up_streams() -> None:
    """Have standard output and error keep their errors, also where they are closed.

    The number of a closed one would go to the next file or pipe that is opened, and what is printed
    with it. Output is opened for reading instead, so that it answers "Bad file descriptor".
    """
    for number, mode in enumerate((os.O_RDONLY, os.O_RDONLY, os.O_RDWR)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, mode)  # takes the lowest number that is free, this one
    # Not those that a caller within Python has put there to read them.
    if sys.stdout is sys.__stdout__:
        sys.stdout = _stream(1, sys.stdout)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _stream(2, sys.stderr)


def flush_output(elsewhere: str = "") -> None:
    """Hand over all that was printed.

    Args:
        elsewhere: where else it is, for the message.

    Raises:
        OutputError: some of it could not be written.
    """
    sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    if isinstance(raw, _Stream) and raw.error is not None:
        raise OutputError(raw.error, elsewhere)


def command(main: Callable[[], int]) -> Callable[[], NoReturn]:
    """Make a function a command: it exits with the code that the function returns.

    A :class:`ConfigurationError` becomes one line on standard error and exit code 2, or 3 where
    another graph is in the way; a file or an output that cannot be written likewise 1, and Ctrl-C
    exit code 130; none leaves a traceback. Where the output has no reader any more, as behind
    ``| head``, nothing is said: exit code 1.
    """

    @functools.wraps(main)
    def wrapper() -> NoReturn:
        end_with_parent()
        _set_up_streams()
        try:
            try:
                code: str | int | None = main()
            except SystemExit as end:  # of argparse: --help is done, usage is wrong
                code = end.code
            flush_output()
        except OutputError as error:
            if not error.quiet:
                print(f"error: {error}", file=sys.stderr)
            code = EXIT_FAILED
        except (ConfigurationError, argparse.ArgumentError) as error:
            print(f"error: {error}", file=sys.stderr)
            code = exit_code(error)
        except OSError as error:
            parts = (error.filename, error.strerror or str(error))
            print("error:", ": ".join(filter(None, parts)), file=sys.stderr)
            code = EXIT_FAILED
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            code = EXIT_INTERRUPTED
        sys.exit(code)

    return wrapper


def within(
    low: float, high: float, kind: Callable[[str], float] = float, *, word: str = ""
) -> Callable[[str], float]:
    """Return what parses an option that must be a number, with ``int`` a whole one, in a range.

    Args:
        low: the least.
        high: the greatest.
        kind: ``float`` or ``int``.
        word: that the option takes as well; it stands for 0.
    """
    number = "a whole number" if kind is int else "a number"
    number = f"{word}, or {number}" if word else number
    limits = f"from {low} to {high}" if kind is int else f"from {low:g} to {high:g}"

    def parse(text: str) -> float:
        if word and text == word:
            return 0.0
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            expected = "greater than 0" if 0 < low <= _TINY and not value > 0 else limits
            raise argparse.ArgumentTypeError(f"must be {number} {expected}, not {text}")
        return value

    # What the option takes, where it is documented.
    parse.__name__ = f"{number.removeprefix('a ')} {limits}"
    return parse


def namespace(text: str) -> str:
    """Return a namespace as ROS writes it, ``/site1``; empty for none."""
    name = text.strip("/")
    if name and not re.fullmatch(r"([A-Za-z_]\w*/)*[A-Za-z_]\w*", name, re.ASCII):
        raise ValueError
    return f"/{name}" if name else ""


# argparse puts it into its message
namespace.__name__ = "namespace: letters, digits and _, no digit first, such as site1"


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        check: what the part must do.
        problem: what it does instead; empty where it is right.
        came: what it did, where that is right and worth a number.
    """

    check: str
    problem: str
    came: str = ""


def print_findings(title: str, findings: Sequence[Finding]) -> int:
    """Print findings as a table, and return the exit code: whether all is right."""
    from rich.console import Console  # most commands print none
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for name in ("check", "result"):
        table.add_column(name)
    for finding in findings:
        right = f"right: {finding.came}" if finding.came else "right"
        table.add_row(finding.check, finding.problem or right)
    Console().print(table)
    failed = [finding for finding in findings if finding.problem]
    print(f"{len(findings) - len(failed)} of {len(findings)} checks passed")
    return EXIT_FAILED if failed else EXIT_DONE


def refuse_unwritable(file: Path, endings: Sequence[str], key: str) -> None:
    """Refuse a file that has none of some endings, is there already, or cannot be written.

    Args:
        file: to be written.
        endings: such as ``.html``.
        key: the option that names it.

    Raises:
        ConfigurationError: it is so.
    """
    def error(expected: str) -> ConfigurationError:
        return ConfigurationError(expected, key=key, value=str(file))

    if file.suffix not in endings:
        raise error(f"must be the name of a file that ends in {' or '.join(endings)}")
    if not (file.parent.is_dir() and os.access(file.parent, os.W_OK)):
        raise error("must be in a directory that exists and can be written to")
    if file.exists():
        raise error("exists; name another file")
