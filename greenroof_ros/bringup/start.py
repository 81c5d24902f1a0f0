"""Start a graph of any kind, with a watcher if an option asks for it.

The watcher is a process of its own; a run neither waits for it nor fails with it.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_INTERRUPTED
from greenroof_ros.common.processes import InterruptedRun, Signals, child_environment
from greenroof_ros.common.standard_error import print_line

# How long the watcher may take to end (s); then it is killed.
_ENDING_S = 3.0


def bring_up(
    arguments: argparse.Namespace, start: Callable[[Signals], int], stopped: int = EXIT_INTERRUPTED
) -> int:
    """Start a graph, with ``--watch`` its watcher; return the exit code.

    Args:
        arguments: the command line.
        start: runs the graph and returns the exit code.
        stopped: the exit code if a signal comes before any node was started, or after the run.
    """
    signals = Signals()
    try:
        with _watcher(arguments.namespace) if arguments.watch else nullcontext():
            code = start(signals)
    except InterruptedRun as error:  # before any node was started
        print(error, file=sys.stderr)
        return stopped
    finally:
        signals.ignore()
    return code or (stopped if signals.received else EXIT_DONE)


@contextmanager
def _watcher(namespace: str) -> Iterator[None]:
    """Run ``greenroof watch`` during a run; print its output, which begins with its address.

    The watcher ends with the run, however that ends. If it cannot start or ends early, a line
    states this, and the run goes on.

    Args:
        namespace: of the graph.
    """
    process = subprocess.Popen(
        [
            sys.executable, "-m", "greenroof_ros", "watch",
            *(["--namespace", namespace] if namespace else []),
        ],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        errors="replace",
        start_new_session=True,  # Ctrl-C is for the run, which ends the watcher
        env=child_environment(),
    )
    ending = threading.Event()
    printer = threading.Thread(target=_print_output, args=(process, ending), daemon=True)
    printer.start()
    try:
        yield
    finally:
        ending.set()
        process.terminate()
        try:
            process.wait(_ENDING_S)
        except subprocess.TimeoutExpired:
            process.kill()
        printer.join(_ENDING_S)


def _print_output(process: subprocess.Popen[str], ending: threading.Event) -> None:
    """Print the watcher's output, and a line if it ended without being asked to."""
    assert process.stdout is not None
    for line in process.stdout:
        if not ending.is_set():
            print_line(f"watch: {line.rstrip()}")
    code = process.wait()
    if not ending.is_set():
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        print_line(f"watch: the watcher has ended ({how}); the run goes on")
