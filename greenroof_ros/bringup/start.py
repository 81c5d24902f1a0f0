"""Start a graph of any kind, with its watchers if options ask for them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from greenroof_ros.common.command_line import EXIT_INTERRUPTED
from greenroof_ros.common.processes import InterruptedRun, Signals


def bring_up(
    arguments: argparse.Namespace, site_file: Path, start: Callable[[Signals], int],
    stopped: int = EXIT_INTERRUPTED,
) -> int:
    """Start a graph, with ``--watch`` and ``--foxglove`` its watchers; return the exit code.

    Args:
        arguments: the command line.
        site_file: the site file, for the page.
        start: runs the graph and returns the exit code.
        stopped: the exit code if a signal comes before any node was started.

    Raises:
        ConfigurationError: Foxglove cannot be served at the port.
    """
    watchers = {"watch": ("--site", str(site_file))} if arguments.watch else {}
    if arguments.foxglove is not None:
        from greenroof_ros.watch.foxglove_server import refuse_unusable

        refuse_unusable(arguments.foxglove)
        watchers["foxglove"] = "--foxglove", str(arguments.foxglove)
    try:
        with ExitStack() as stack:
            if watchers:
                from greenroof_ros.watch.page_process import watcher

                for name, options in watchers.items():
                    stack.enter_context(watcher(name, arguments.namespace, *options))
            return start(Signals())
    except InterruptedRun as error:  # before any node was started
        print(error, file=sys.stderr)
        return stopped
