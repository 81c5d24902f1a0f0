"""Starting a graph of any kind, with the watchers requested by options.

A watcher is a separate process; a run neither waits for a watcher nor fails because of one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_INTERRUPTED
from greenroof_ros.base.processes import InterruptedRun, Signals, child_environment
from greenroof_ros.base.standard_error import print_line

# How long the watcher may take to end (s) before it is killed.
_ENDING_S = 3.0
# How often a watcher that has exited is started again, and after which time (s).
_MAX_RESTARTS, _WAIT_S = 10, 2.0


def bring_up(
    arguments: argparse.Namespace, start: Callable[[Signals], int], stopped: int = EXIT_INTERRUPTED
) -> int:
    """Start a graph with the watchers for ``--watch`` and ``--foxglove``; return the exit code.

    Args:
        arguments: the parsed command line.
        start: function that runs the graph and returns the exit code.
        stopped: exit code to return if a signal arrives before the first node is started, or after
            the run.

    Raises:
        ConfigurationError: if the Foxglove server cannot use the port.
    """
    watchers: dict[str, list[str]] = {"watch": []} if arguments.watch else {}
    if arguments.foxglove is not None:
        from greenroof_ros.watch.foxglove_server import refuse_unusable

        refuse_unusable(arguments.foxglove)
        watchers["foxglove"] = ["--foxglove", str(arguments.foxglove)]
    signals = Signals()
    try:
        with ExitStack() as ends:
            for name, options in watchers.items():
                ends.callback(_Watcher(name, [*options, f"--namespace={arguments.namespace}"]).end)
            code = start(signals)
    except InterruptedRun as error:  # before any node was started
        print(error, file=sys.stderr)
        return stopped
    finally:
        signals.ignore()
    return code or (stopped if signals.received else EXIT_DONE)


class _Watcher:
    """``greenroof watch`` during a run, with its output, which includes its address.

    If the watcher exits early, it is started again, at most ten times, and a line says so; the run
    continues.
    """

    def __init__(self, name: str, options: list[str]) -> None:
        """Start the watcher; the name is printed at the beginning of its lines."""
        self._name, self._options = name, options
        self._ending = threading.Event()
        self._process = self._start()
        self._keeper = threading.Thread(target=self._keep, daemon=True)
        self._keeper.start()

    def end(self) -> None:
        """End the watcher."""
        self._ending.set()
        self._process.terminate()
        try:
            self._process.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._keeper.join(_ENDING_S)

    def _start(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "greenroof_ros", "watch", *self._options],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True, errors="replace",
            start_new_session=True,  # Ctrl-C is for the run, which ends the watcher
            env=child_environment(),
        )

    def _keep(self) -> None:
        for left in reversed(range(_MAX_RESTARTS + 1)):
            for line in self._process.stdout or ():
                print_line(f"{self._name}: {line.rstrip()}")
            self._process.wait()
            if self._ending.is_set():
                return
            then = f"starts again in {_WAIT_S:g} s" if left else "is given up"
            print_line(f"{self._name}: the watcher has exited, and {then}; the run continues")
            if not left or self._ending.wait(_WAIT_S):
                return
            self._process = self._start()
