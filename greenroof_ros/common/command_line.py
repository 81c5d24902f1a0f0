"""What all commands share: exit codes, error reports, and the option parser."""

from __future__ import annotations

import argparse
import functools
import io
import itertools
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from greenroof_ros import INTERRUPTED, SIGNALS, end_interrupted
from greenroof_ros.common.errors import (
    ConfigurationError,
    OccupiedError,
    describe_choices,
    find_similar,
)
from greenroof_ros.common.processes import end_with_parent, find_signal, store_signals
from greenroof_ros.common.ranges import Range

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_OCCUPIED = 3
EXIT_INTERRUPTED = INTERRUPTED
_HAS_TIMER = hasattr(signal, "setitimer")  # Windows has none


def exit_code(error: Exception) -> int:
    """Return the exit code for a wrong set-up: 3 if another graph is in the way, otherwise 2."""
    return EXIT_OCCUPIED if isinstance(error, OccupiedError) else EXIT_USAGE


class Interrupted(KeyboardInterrupt):
    """A signal asks the command to end; the message names the signal.

    After a plain KeyboardInterrupt, Python may end itself by the signal, with any exit code.
    """


class _Interrupts:
    """The handler of signals: raises, and raises again every second until the command has ended.

    Compiled code can discard an exception or turn it into another one. A module that is being
    imported can do so, too, or go on without what it tried to import; so the exception is raised
    after the import, or during it if that takes long.
    """

    _IMPORT_S, _MAX_IMPORTS, _REPEAT_S = 0.05, 40, 1.0

    def __init__(self) -> None:
        self.received = 0
        self._numbers = [
            number for number in SIGNALS if signal.getsignal(number) is end_interrupted
        ]
        for number in self._numbers:
            signal.signal(number, self)
        if self._numbers:
            store_signals()

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.received += 1
        is_importing = False
        while frame is not None and self.received <= self._MAX_IMPORTS:
            is_importing |= frame.f_code.co_filename.startswith("<frozen importlib")
            frame = frame.f_back
        if _HAS_TIMER:
            # As the signal again, for whatever handler is installed by then.
            signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(number))
            signal.setitimer(signal.ITIMER_REAL, self._IMPORT_S if is_importing else self._REPEAT_S)
        if not (is_importing and _HAS_TIMER):
            raise Interrupted(signal.Signals(number).name)

    def end(self) -> None:
        """From now on, end the process immediately if a signal arrives."""
        for number in self._numbers:
            signal.signal(number, end_interrupted)
        if self.received:
            end_repeats()


def end_repeats() -> None:
    """Stop raising :class:`Interrupted`: the command has begun to end, and is writing how."""
    if _HAS_TIMER:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def check_interrupts() -> None:
    """Raise :class:`Interrupted` if a signal was received, even if other code swallowed it.

    A user's class can handle signals itself, or discard a KeyboardInterrupt.
    """
    if (received := find_signal()) is not None:
        raise Interrupted(received.name)


def _discard_what_cannot_be_printed() -> None:
    """Keep the interpreter from trying to print it again at its end, which would be an error."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def command(
    main: Callable[[], int | None], *, failed: int | None = None
) -> Callable[[], NoReturn]:
    """Turn a function into a command that exits with the code the function returns, or with 0.

    A :class:`ConfigurationError` becomes one line on standard error and exit code 2, or 3 if
    another graph is in the way. A file or an output that cannot be written becomes one line and
    exit code 1; a signal that asks the command to end, such as Ctrl-C, becomes exit code 130. None
    of them leaves a traceback. If no one reads the output any more, as after ``| head``, nothing is
    printed and the exit code is 1.

    Args:
        main: the function.
        failed: the exit code used instead of 1, 2 and 3 above, for a command whose own results use
            these codes; None if it has no such results.
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
            print(f"error: {error}", file=sys.stderr)
            code = failed or exit_code(error)
        except OSError as error:
            if not isinstance(error, BrokenPipeError):
                # When copying, it is the second file that has no room.
                parts = (error.filename2 or error.filename, error.strerror or str(error))
                print("error:", ": ".join(filter(None, parts)), file=sys.stderr)
            code = failed or EXIT_FAILED
            _discard_what_cannot_be_printed()
        return code

    @functools.wraps(main)
    def wrapper() -> NoReturn:
        end_with_parent()
        if isinstance(sys.stdout, io.TextIOWrapper):  # not if a Python caller replaced it
            sys.stdout.reconfigure(line_buffering=True)
        interrupts = _Interrupts()
        try:
            code = run()
            interrupts.end()
            if interrupts.received:
                raise Interrupted
        except BaseException as error:
            interrupts.end()
            # Compiled code can turn it into any other error.
            if not isinstance(error, KeyboardInterrupt) and not interrupts.received:
                raise
            print("interrupted", file=sys.stderr)
            code = EXIT_INTERRUPTED
        sys.exit(code)

    return wrapper


class _HelpFormatter(argparse.HelpFormatter):
    """Fills the paragraphs of a description to the terminal's width; keeps indented lines as is."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        filled: list[str] = []
        for is_laid_out, lines in itertools.groupby(
            text.strip().splitlines(), lambda line: not line or line.startswith(" ")
        ):
            if is_laid_out:
                filled += lines
            else:
                filled += textwrap.wrap(" ".join(lines), width, break_on_hyphens=False)
        return "\n".join(filled)


class Parser(argparse.ArgumentParser):
    """The parser of a command's options.

    Options must be written in full: an abbreviation that is clear today would become ambiguous as
    soon as a later version adds an option that begins the same way. In a description or an epilog,
    indented lines, such as examples, stay as they are; the others are filled.

    Attributes:
        hint: text added to the message about an unknown option; empty for none.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_HelpFormatter, **settings)
        self.hint = ""

    def parse_args(self, args: Iterable[str] | None = None, namespace: Any = None) -> Any:
        """Parse a command line; for an unknown option, name the options that may be meant."""
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            option = next((word[2:] for word in unknown if word.startswith("--")), "")
            known = [known[2:] for known in self._option_string_actions if known.startswith("--")]
            similar = find_similar(option.partition("=")[0], known)
            meant = " or ".join(f"--{name}" for name in similar)
            self.error(
                f"unrecognized arguments: {' '.join(unknown)}"
                + (f"; did you mean {meant}?" if meant else "")
                + (f" ({self.hint})" if self.hint else "")
            )
        return parsed

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Reject a value that is not one of the option's choices; name what may be meant."""
        if action.choices is not None and value not in action.choices:
            wrong = f"{value!r} {describe_choices([*action.choices], str(value))}"
            raise argparse.ArgumentError(action, wrong)


def make_number_type(
    low: float, high: float, kind: type[float] = float, *, word: str = ""
) -> Callable[[str], float]:
    """Return a parser for an option whose value is a number in a range (whole for ``int``).

    Args:
        low: the minimum value.
        high: the maximum value.
        kind: ``float`` or ``int``.
        word: a word that the option also accepts; it stands for 0.
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
    """Reject a command line that breaks a rule; report the first rule that it breaks.

    Args:
        rules: each is (whether it is broken, the option, its value, what is expected).

    Raises:
        ConfigurationError: if a rule is broken.
    """
    for broken, option, value, expected in rules:
        if broken:
            raise ConfigurationError(expected, key=option, value=value)


def parse_namespace(text: str) -> str:
    """Return a namespace the way ROS writes it, ``/site1``; empty if there is none."""
    name = text.strip("/")
    if name and not re.fullmatch(r"([A-Za-z_]\w*/)*[A-Za-z_]\w*", name, re.ASCII):
        raise ValueError
    return f"/{name}" if name else ""


# argparse shows this in its error message
parse_namespace.__name__ = (
    "namespace of letters, digits and _ that does not begin with a digit, such as site1"
)


def add_namespace(parser: argparse.ArgumentParser, more: str = "") -> None:
    """Add the option that names the graph which a command joins, with more help on it."""
    parser.add_argument(
        "--namespace", type=parse_namespace, default="", metavar="NAME",
        help=f"namespace of the graph, as passed to greenroof run or live{more} (default: none)",
    )


def add_site(parser: argparse._ActionsContainer, about: str = "site file") -> None:
    """Add the option that names the site file."""
    from greenroof_ros.common.files import default_site_file  # reads YAML: not for every --help

    parser.add_argument(
        "--site", type=Path, default=default_site_file(), metavar="FILE",
        help=f"{about} (default: the paper's, config/site.yaml)",
    )


def add_foxglove(parser: argparse._ActionsContainer, about: str) -> None:
    """Add the option that serves a graph to Foxglove; viewers suggest the same default port."""
    parser.add_argument(
        "--foxglove", nargs="?", const=8765, type=make_number_type(0, 65535, int), metavar="PORT",
        help=f"{about} PORT is 8765 if omitted; 0 selects any free port. This needs the extra "
            "[foxglove]",
    )


@dataclass(frozen=True)
class CheckResult:
    """The result of one check.

    Attributes:
        check: what the part is required to do.
        problem: what it does instead; empty if the check passed.
        result: the result of the check, if it passed and the result is worth showing.
    """

    check: str
    problem: str
    result: str = ""


def print_check_results(title: str, results: Sequence[CheckResult]) -> int:
    """Print results as a table; return exit code 0 if every check passed, otherwise 1."""
    from rich.console import Console  # most commands print none
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for name in ("check", "result"):
        table.add_column(name)
    for result in results:
        passed = f"passed: {result.result}" if result.result else "passed"
        table.add_row(result.check, result.problem or passed)
    Console().print(table)
    failed = [result for result in results if result.problem]
    print(f"{len(results) - len(failed)} of {len(results)} checks passed")
    return EXIT_FAILED if failed else EXIT_DONE


def refuse_unwritable(file: Path, endings: Sequence[str], key: str) -> None:
    """Reject a file that has the wrong ending, already exists, or cannot be written.

    Args:
        file: the file to write.
        endings: the allowed endings, such as ``.html``.
        key: the option that names the file.

    Raises:
        ConfigurationError: if the file is rejected.
    """
    def error(expected: str) -> ConfigurationError:
        return ConfigurationError(expected, key=key, value=str(file))

    if file.suffix not in endings:
        raise error(f"must be a file name that ends in {' or '.join(endings)}")
    if not (file.parent.is_dir() and os.access(file.parent, os.W_OK)):
        raise error("must be in a directory that exists and can be written to")
    if file.exists():
        raise error("exists; name another file")
