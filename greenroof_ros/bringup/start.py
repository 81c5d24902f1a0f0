"""Starting a graph of any kind, with the watcher that an option requests.

A watcher is a separate process; a run neither waits for a watcher nor fails because of one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import threading
from collections.abc import Callable

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_INTERRUPTED
from greenroof_ros.base.processes import InterruptedRun, Signals, child_environment
from greenroof_ros.base.standard_error import print_line

# How long the watcher may take to end (s) before it is killed.
_ENDING_S = 3.0
# How often a watcher that has exited is started again, after which time, and how often it is
# checked (s).
_MAX_RESTARTS, _WAIT_S, _CHECK_S = 10, 2.0, 0.25


def bring_up(
    arguments: argparse.Namespace, start: Callable[[Signals], int], stopped: int = EXIT_INTERRUPTED
) -> int:
    """Start a graph, with the watcher for ``--watch``; return the exit code.

    Args:
        arguments: the parsed command line.
        start: function that runs the graph and returns the exit code.
        stopped: exit code to return if a signal arrives before the first node is started, or after
            the run.
    """
    signals, ending = Signals(), threading.Event()
    keeper = threading.Thread(target=_keep_watcher, args=(arguments.namespace, ending))
    if arguments.watch:
        keeper.start()
    try:
        code = start(signals)
    except InterruptedRun as error:  # before any node was started
        print(error, file=sys.stderr)
        return stopped
    finally:
        signals.ignore()
        ending.set()
        if keeper.is_alive():
            keeper.join()
    return code or (stopped if signals.received else EXIT_DONE)


def _keep_watcher(namespace: str, ending: threading.Event) -> None:
    """Run ``greenroof watch`` until the run ends; it prints its address.

    If the watcher exits early, it is started again, at most ten times, and a line says so; the run
    continues.
    """
    for left in reversed(range(_MAX_RESTARTS + 1)):
        process = subprocess.Popen(
            [sys.executable, "-m", "greenroof_ros", "watch", f"--namespace={namespace}"],
            stdin=subprocess.DEVNULL, stdout=sys.stderr,  # a run's output may be JSON
            start_new_session=True,  # Ctrl-C is for the run, which ends the watcher
            env=child_environment(),
        )
        while process.poll() is None and not ending.wait(_CHECK_S):
            pass
        if ending.is_set():
            process.terminate()
            try:
                process.wait(_ENDING_S)
            except subprocess.TimeoutExpired:
                process.kill()
            return
        then = f"starts again in {_WAIT_S:g} s" if left else "is given up"
        print_line(f"watch: the watcher has exited, and {then}; the run continues")
        if ending.wait(_WAIT_S):
            return
