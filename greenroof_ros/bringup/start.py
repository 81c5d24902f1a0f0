"""Starting a graph of any kind, with the watchers requested by options.

A watcher is a separate process; a run neither waits for a watcher nor fails because of one.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

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
    watchers: dict[str, tuple[str, ...]] = {"watch": ()} if arguments.watch else {}
    if arguments.foxglove is not None:
        from greenroof_ros.watch.foxglove_server import refuse_unusable

        refuse_unusable(arguments.foxglove)
        watchers["foxglove"] = "--foxglove", str(arguments.foxglove)
    signals = Signals()
    try:
        with ExitStack() as stack:
            for name, options in watchers.items():
                stack.enter_context(_watcher(name, arguments.namespace, *options))
            code = start(signals)
    except InterruptedRun as error:  # before any node was started
        print(error, file=sys.stderr)
        return stopped
    finally:
        signals.ignore()
    return code or (stopped if signals.received else EXIT_DONE)


@contextmanager
def _watcher(name: str, namespace: str, *options: str) -> Iterator[None]:
    """Run ``greenroof watch`` during a run, and print its output, which includes its address.

    The watcher stops at the end of the run, regardless of how the run ends. If the watcher exits
    early, it is started again, at most ten times, and a line says so; the run continues.

    Args:
        name: name of the watcher, printed at the beginning of its lines.
        namespace: namespace of the graph.
        options: options of ``greenroof watch``.
    """
    words = [
        sys.executable, "-m", "greenroof_ros", "watch", *options,
        *(["--namespace", namespace] if namespace else []),
    ]
    ending = threading.Event()
    process = _start(words)

    def keep() -> None:
        nonlocal process
        for restarts in range(_MAX_RESTARTS + 1):
            how = _print_output(name, process, ending)
            again = restarts < _MAX_RESTARTS
            if not ending.is_set():
                then = f"starts again in {_WAIT_S:g} s" if again else "is given up"
                print_line(f"{name}: the watcher has exited ({how}), and {then}; the run continues")
            if not again or ending.wait(_WAIT_S):
                return
            process = _start(words)

    keeper = threading.Thread(target=keep, daemon=True)
    keeper.start()
    try:
        yield
    finally:
        ending.set()
        process.terminate()
        try:
            process.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            process.kill()
        keeper.join(_ENDING_S)


def _start(words: Sequence[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, errors="replace",
        start_new_session=True,  # Ctrl-C is for the run, which ends the watcher
        env=child_environment(),
    )


def _print_output(
    name: str, process: subprocess.Popen[str], ending: threading.Event
) -> str:
    """Print a watcher's output until the run ends, and return how the watcher exited."""
    assert process.stdout is not None
    for line in process.stdout:
        if not ending.is_set():
            print_line(f"{name}: {line.rstrip()}")
    code = process.wait()
    return f"exit code {code}" if code >= 0 else signal.Signals(-code).name
