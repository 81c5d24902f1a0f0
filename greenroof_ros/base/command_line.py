"""Code shared by all commands: exit codes, error reports, and the option parser."""

from __future__ import annotations

import argparse
import functools
import inspect
import io
import math
import os
import re
import sys
import textwrap
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from greenroof_ros.base.errors import (
    ConfigurationError,
    FailedError,
    HangError,
    LockstepError,
    OccupiedError,
    describe_choices,
    find_similar,
)
from greenroof_ros.base.interrupts import INTERRUPTED
from greenroof_ros.base.processes import InterruptedRun, end_with_parent
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.text import escape

if TYPE_CHECKING:  # it reads YAML, which a command's help does not need
    from greenroof_ros.base.parameter import Parameter

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_OCCUPIED = 3
EXIT_INTERRUPTED = INTERRUPTED


def exit_code(error: Exception) -> int:
    """Return the exit code for a configuration error: 3 if another graph is running, or else 2."""
    return EXIT_OCCUPIED if isinstance(error, OccupiedError) else EXIT_USAGE


def describe_error(error: Exception) -> str:
    """Return an unexpected error as one line: its type, message and location in the code."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({place.filename}, line {place.lineno})"


def print_failure(error: Exception) -> tuple[str, int]:
    """Print why a node or a run failed, and return it as a sentence, with the exit code.

    A traceback comes first if the error was not expected.
    """
    failure, code = explain(error)
    if failure != str(error):
        traceback.print_exception(error)
    print(f"error: {failure}", file=sys.stderr)
    return failure, code


def explain(error: Exception) -> tuple[str, int]:
    """Return a sentence that states why a node or a run failed, and the exit code."""
    if isinstance(error, ConfigurationError):
        return str(error), exit_code(error)
    known = isinstance(error, (LockstepError, OSError, HangError))
    return str(error) if known else describe_error(error), EXIT_FAILED


def _discard_what_cannot_be_printed() -> None:
    """Discard buffered output that cannot be printed, so that Python does not retry at exit."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def print_error(text: str) -> None:
    """Print an error in one line on standard error."""
    print(f"error: {escape(text)}", file=sys.stderr)


def print_lines(kind: str, lines: Iterable[str]) -> None:
    """Print lines on standard error, each after what it is, such as ``note``."""
    for line in lines:
        print(escape(f"{kind}: {line}"), file=sys.stderr)


def command(main: Callable[[], int | None], *, failed: int | None = None) -> Callable[[], NoReturn]:
    """Turn a function into a command that exits with the function's return value, or with 0.

    A :class:`ConfigurationError` is reported in one line on standard error, with exit code 2, or 3
    if another graph is running. A :class:`FailedError`, or a file or an output that cannot be
    written, is reported in one line with exit code 1. A signal that asks the command to stop, such
    as Ctrl-C, results in exit code 130. No traceback is printed in any of these cases. If the
    reader of the output has closed it, as after ``| head``, nothing is printed and the exit code
    is 1.

    Args:
        main: the function to turn into a command.
        failed: exit code to use instead of 1, 2 and 3, for a command whose own results use these
            codes; None for other commands.
    """

    def run() -> str | int | None:
        code: str | int | None
        try:
            try:
                code = main()
            except SystemExit as end:  # from argparse: after --help or wrong usage
                code = end.code and (failed or end.code)
            print(end="", flush=True)
        except (ConfigurationError, argparse.ArgumentError) as error:
            print_error(str(error))
            code = failed or exit_code(error)
        except FailedError as error:
            print_error(str(error))
            code = failed or EXIT_FAILED
        except (InterruptedRun, KeyboardInterrupt) as error:
            print(escape(str(error)) or "interrupted", file=sys.stderr)
            code = EXIT_INTERRUPTED
        except OSError as error:
            if not isinstance(error, BrokenPipeError):
                # When copying, it is the second file that has no room.
                parts = (error.filename2 or error.filename, error.strerror or str(error))
                print_error(": ".join(filter(None, parts)))
            code = failed or EXIT_FAILED
            _discard_what_cannot_be_printed()
        return code

    @functools.wraps(main)
    def wrapper() -> NoReturn:
        end_with_parent()
        if isinstance(sys.stdout, io.TextIOWrapper):  # not if a Python caller replaced it
            sys.stdout.reconfigure(line_buffering=True)
        sys.exit(run() or EXIT_DONE)

    return wrapper


class _HelpFormatter(argparse.HelpFormatter):
    """Formatter that wraps paragraphs at the terminal's width, except for indented lines."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        text = re.sub(r"^(\S.*)\n(?=\S)", r"\1 ", text.strip(), flags=re.MULTILINE)
        return "\n".join(
            line if line.startswith(" ") else textwrap.fill(line, width, break_on_hyphens=False)
            for line in text.splitlines()
        )


class Parser(argparse.ArgumentParser):
    """The parser of a command's options.

    Options must be written in full, because an abbreviation that is unambiguous now would become
    ambiguous if a later version added an option that begins with the same letters. In a description
    or an epilog, indented lines, such as examples, stay unchanged; all other lines are wrapped.

    Attributes:
        hint: text added to the message about an unknown option; empty for none.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_HelpFormatter, **settings)
        self.hint = ""

    @classmethod
    def of(cls, name: str, text: str | None, usage: str = "[options]") -> Parser:
        """Return the parser of a command whose help is a docstring.

        Args:
            name: name of the command.
            text: the docstring, which from its examples or exit codes on is printed after the
                options.
            usage: the command's arguments in its usage line.
        """
        about, *more = re.split(
            r"\n\n(?=Examples?:|Exit codes)", inspect.cleandoc(text or ""), maxsplit=1
        )
        return cls(
            prog=f"greenroof {name}", usage=f"%(prog)s {usage}", description=about,
            epilog="".join(more),
        )

    def parse_args(self, args: Iterable[str] | None = None, namespace: Any = None) -> Any:
        """Parse a command line; for an unknown option, suggest the likely options."""
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            option = next((word for word in unknown if word.startswith("--")), "")
            similar = find_similar(option.partition("=")[0], self._option_string_actions)
            meant = f"; did you mean {' or '.join(similar)}?" if similar else ""
            hint = f" ({self.hint})" if self.hint else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{meant}{hint}")
        return parsed

    def error(self, message: str) -> NoReturn:
        """Print the usage and an error, and exit with code 2."""
        super().error(escape(message))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Reject a value that is not one of the option's choices, and suggest likely choices."""
        if action.choices is not None and value not in action.choices:
            wrong = f"{value!r} {describe_choices([*action.choices], str(value))}"
            raise argparse.ArgumentError(action, wrong)


def make_number_type(
    low: float, high: float, kind: type[float] = float, *, word: str = ""
) -> Callable[[str], float]:
    """Return a parser for an option whose value is a number in a range (an integer for ``int``).

    Args:
        low: the minimum value.
        high: the maximum value.
        kind: ``float`` or ``int``.
        word: a word that the option also accepts as 0; empty for none.
    """
    allowed = Range(low, high, whole=kind is int, words=(word,) if word else ())

    def parse(text: str) -> float:
        try:
            return 0.0 if text in allowed.words else allowed.parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{error}, not {text}") from None

    # The documentation shows this as the value that the option accepts.
    parse.__name__ = str(allowed).removeprefix("a ")
    return parse


def refuse(*rules: tuple[object, str, object, str]) -> None:
    """Reject a command line that breaks a rule, and report the first broken rule.

    Args:
        rules: one tuple for each rule: a value that is true if the rule is broken, the option, the
            option's value, and the description of the expected value.

    Raises:
        ConfigurationError: if a rule is broken.
    """
    for broken, option, value, expected in rules:
        if broken:
            raise ConfigurationError(expected, key=option, value=value)


def refuse_unwritable(file: Path, *endings: str) -> None:
    """Reject a file for ``--output`` that has the wrong extension, exists, or cannot be written.

    Args:
        file: the file to write.
        endings: the allowed file extensions, such as ``.html``.

    Raises:
        ConfigurationError: if the file has the wrong extension, already exists, or cannot be
            written.
    """
    writable = file.parent.is_dir() and os.access(file.parent, os.W_OK)
    wrong = {
        f"must be a file name that ends in {' or '.join(endings)}": file.suffix not in endings,
        "must be in an existing, writable directory": not writable,
        "exists; choose another file name": file.exists(),
    }
    refuse(*((broken, "--output", str(file), text) for text, broken in wrong.items()))


def add_site(parser: argparse._ActionsContainer, about: str = "site file") -> None:
    """Add the option for the site file."""
    from greenroof_ros.base.files import default_site_file  # reads YAML: not for every --help

    parser.add_argument(
        "--site", type=Path, default=default_site_file(), metavar="FILE",
        help=f"{about} (default: the paper's, config/site.yaml)",
    )


def add_option(group: argparse._ArgumentGroup, parameter: Parameter, **settings: Any) -> None:
    """Add the option for an input; the value of an omitted option is None."""
    default, about = parameter.default, [] if parameter.unit in ("", "1") else [parameter.unit]
    if isinstance(default, (int, float)) or math.isfinite(parameter.low):
        kind = int if parameter.whole else float
        settings |= {"metavar": "X", "type": make_number_type(parameter.low, parameter.high, kind)}
    elif parameter.among:
        settings["choices"] = parameter.among
    if isinstance(default, float):
        default = None if math.isnan(default) else f"{default:g}"
    if parameter.usual is not None:
        about.append("usually {:g} to {:g}".format(*parameter.usual))
    if default is not None:
        about.append(f"default: {default}")
    end = f" ({', '.join(about)})" if about else ""
    group.add_argument(option_of(parameter.name), help=f"{parameter.meaning}{end}", **settings)


def option_of(name: str) -> str:
    """Return the name of the option for an input."""
    return f"--{name.replace('_', '-')}"


CHECKED_NODE = "check the running node of this name, with its namespace if it has one: /site1/pump"
"""help of the option for the node that a command checks"""


def print_results(title: str, results: Iterable[tuple[str, str]]) -> int:
    """Print results as they come, and return exit code 0 if every check passed, otherwise 1.

    Args:
        title: the first line.
        results: for each check what it requires, and the problem; empty if it passed.
    """
    print(title)
    problems = []
    for check, problem in results:
        problems.append(problem)
        print(f"  failed: {check}: {problem}" if problem else f"  passed: {check}")
    print(f"{problems.count('')} of {len(problems)} checks passed")
    return EXIT_FAILED if any(problems) else EXIT_DONE
