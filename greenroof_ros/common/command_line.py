"""What every command has in common: its exit codes and how it reports a mistake."""

from __future__ import annotations

import argparse
import functools
import os
import sys
from collections.abc import Callable
from typing import NoReturn

from greenroof_ros.common.errors import ConfigurationError, OccupiedError

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_OCCUPIED = 3
EXIT_INTERRUPTED = 130


def exit_code(error: Exception) -> int:
    """Return the exit code of a wrong set-up: 3 where another graph is in the way, otherwise 2."""
    return EXIT_OCCUPIED if isinstance(error, OccupiedError) else EXIT_USAGE


def command(main: Callable[[], int]) -> Callable[[], NoReturn]:
    """Make a function a command: it exits with the code that the function returns.

    A :class:`ConfigurationError` becomes one line on standard error and exit code 2, or 3 where
    another graph is in the way; a file that cannot be written likewise 1, and Ctrl-C exit code 130;
    none leaves a traceback. Where the output has no reader any more, as behind ``| head``, nothing
    is said: exit code 1.
    """

    @functools.wraps(main)
    def wrapper() -> NoReturn:
        try:
            code = main()
            sys.stdout.flush()
        except BrokenPipeError:
            # What is still to be written would fail once more at the interpreter's end.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            code = EXIT_FAILED
        except (ConfigurationError, argparse.ArgumentError) as error:
            print(f"error: {error}", file=sys.stderr)
            code = exit_code(error)
        except OSError as error:
            print(f"error: {error.filename or ''}: {error.strerror}", file=sys.stderr)
            code = EXIT_FAILED
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            code = EXIT_INTERRUPTED
        sys.exit(code)

    return wrapper


def within(
    low: float, high: float, kind: Callable[[str], float] = float
) -> Callable[[str], float]:
    """Return what parses an option that must be a number, with ``int`` a whole one, in a range."""

    def parse(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:
            raise ValueError
        return value

    # argparse puts it into its message
    parse.__name__ = (
        f"whole number from {low} to {high}" if kind is int
        else f"number from {low:g} to {high:g}"
    )
    return parse
