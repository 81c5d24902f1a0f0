"""Start a graph of any kind, with its page in a browser if an option asks for it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from greenroof_ros.common.command_line import EXIT_INTERRUPTED
from greenroof_ros.common.processes import InterruptedRun, Signals


def bring_up(
    arguments: argparse.Namespace, site_file: Path, start: Callable[[Signals], int],
    stopped: int = EXIT_INTERRUPTED,
) -> int:
    """Start a graph, with its web page if ``--watch`` was given; return the exit code.

    Args:
        arguments: the command line.
        site_file: the site file, for the page.
        start: runs the graph and returns the exit code.
        stopped: the exit code if a signal comes before any node was started.
    """
    page: AbstractContextManager[None] = nullcontext()
    if arguments.watch:
        from greenroof_ros.watch.page_process import watcher

        page = watcher(arguments.namespace, site_file)
    try:
        with page:
            return start(Signals())
    except InterruptedRun as error:  # before any node was started
        print(error, file=sys.stderr)
        return stopped
