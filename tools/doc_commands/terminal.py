"""A terminal with a shell, as a reader of the documentation uses."""

from __future__ import annotations

import codecs
import fcntl
import os
import pty
import re
import select
import signal
import subprocess
import termios
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

# The shell prints this around exit codes; nothing else prints it.
_MARK = "\x1e"
_PROMPT = re.compile(f"{_MARK}prompt{_MARK}")
_FAILED = re.compile(f"{_MARK}failed (\\d+) (.*?){_MARK}", re.DOTALL)
_JOB_FAILED = re.compile(r"\[\d+\][+-]?\s+(Exit \d+.*)")
_COLOURS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_SET_UP = (
    r"stty -echo; unset HISTFILE; PS2=; PS1=$'\036prompt\036'; set -E; "
    r"""trap 'printf "\036failed %s %s\036\n" "$?" "$BASH_COMMAND"' ERR"""
)
# Exit codes after Ctrl-C: the program's own, or 128 + SIGINT.
_INTERRUPTED = {0, 130}
_CTRL_C_LIMIT_S = 30.0
_READY_LIMIT_S = 120.0
_LIMIT_S = 4 * 3600.0


@dataclass(frozen=True)
class Outcome:
    """The outcome of a block.

    Attributes:
        output: what was printed.
        failures: a sentence for each; empty if all went as documented.
    """

    output: str
    failures: list[str]


def _acquire_terminal() -> None:
    """Make standard input the terminal of this session, and let Ctrl-C work."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


class Terminal:
    """A terminal in a directory, with one shell for everything that is typed."""

    def __init__(self, directory: Path, environment: Mapping[str, str]) -> None:
        """Open the terminal."""
        self._directory = directory
        self._master, slave = pty.openpty()
        self.shell = subprocess.Popen(
            ["bash", "--norc", "--noprofile", "--noediting", "-i"],
            stdin=slave, stdout=slave, stderr=slave, cwd=directory, env=dict(environment),
            start_new_session=True,
            preexec_fn=_acquire_terminal,  # noqa: PLW1509
        )
        os.close(slave)
        self._decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
        self._unread = ""
        self._type(_SET_UP)
        self._until([_PROMPT], 30)

    def run(
        self, commands: str, ready: Sequence[str] = (), then_s: float = 0.0,
        limit_s: float = _LIMIT_S,
    ) -> Outcome:
        """Run a block of commands to its end.

        Args:
            commands: as in the documentation.
            ready: for each command that never ends, what it prints when it is ready for Ctrl-C.
            then_s: time that each then runs before Ctrl-C (s).
            limit_s: longest time that the block may take (s).
        """
        script = self._directory / ".block.sh"
        script.write_text(commands, encoding="utf-8")
        self._type("source ./.block.sh")
        output, failures = "", []
        for pattern in ready:
            text, matched = self._until([re.compile(pattern), _PROMPT], _READY_LIMIT_S)
            if matched == 0 and then_s:
                more, ended = self._until([_PROMPT], then_s)
                text += more
                if ended == 0:
                    matched = 1
            output += text
            if matched != 0:
                failures.append(
                    f"did not print {pattern!r} within {_READY_LIMIT_S:g} s" if matched is None
                    else f"ended before its Ctrl-C, which was due after {pattern!r}"
                )
                break
            os.write(self._master, b"\x03")
        if not failures:
            limit_s = _CTRL_C_LIMIT_S if ready else limit_s
            text, matched = self._until([_PROMPT], limit_s)
            output += text
            if matched is None:
                failures.append(f"did not end within {limit_s:g} s")
        if matched is None:
            os.killpg(os.tcgetpgrp(self._master), signal.SIGKILL)
            output += self._until([_PROMPT], _CTRL_C_LIMIT_S)[0]
        expected = _INTERRUPTED if ready else {0}
        for code, command in _FAILED.findall(output):
            if int(code) not in expected and not command.startswith("source ./.block.sh"):
                failures.append(f"exit code {code}: {command}")
        failures += _JOB_FAILED.findall(output)
        if "Traceback (most recent call last)" in output:
            failures.append("a traceback")
        return Outcome(_FAILED.sub("", output), failures)

    def close(self) -> list[str]:
        """End background processes by Ctrl-C and close; return what did not end."""
        outcome = self.run(
            "jobs=$(jobs -p); for job in $jobs; do kill -INT -- -$job; done; wait; :", limit_s=60
        )
        self._type("exit")
        try:
            self.shell.wait(10)
        except subprocess.TimeoutExpired:
            self.shell.kill()
            self.shell.wait()
        os.close(self._master)
        return [failure for failure in outcome.failures if not failure.startswith("Exit 130")]

    def _type(self, line: str) -> None:
        os.write(self._master, line.encode() + b"\n")

    def _until(self, patterns: list[re.Pattern[str]], limit_s: float) -> tuple[str, int | None]:
        """Read until a pattern is printed; return the text, and the number of the pattern."""
        until = time.monotonic() + limit_s
        while True:
            self._unread = _COLOURS.sub("", self._unread).replace("\r", "\n")
            for number, pattern in enumerate(patterns):
                if match := pattern.search(self._unread):
                    text = self._unread[:match.end()]
                    self._unread = self._unread[match.end():]
                    return _PROMPT.sub("", text), number
            remaining = until - time.monotonic()
            if remaining <= 0 or not select.select([self._master], [], [], remaining)[0]:
                break
            try:
                self._unread += self._decoder.decode(os.read(self._master, 65536))
            except OSError:  # the shell has gone
                break
        text, self._unread = self._unread, ""
        return text, None
