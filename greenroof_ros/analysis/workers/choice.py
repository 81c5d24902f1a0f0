"""The options that select the workers of a command, and the workers that they request."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from greenroof_ros.analysis.workers.processes import Workers, processes
from greenroof_ros.base.command_line import EXIT_FAILED, EXIT_INTERRUPTED, make_number_type, refuse
from greenroof_ros.base.processes import Signals, count_cores


def add_worker_arguments(parser: argparse.ArgumentParser, what: str, jobs: str) -> None:
    """Add the options that select the workers.

    Args:
        parser: the command's parser.
        what: name of the work that is handed to the workers, such as ``runs``.
        jobs: clause that describes the option ``--jobs``.
    """
    parser.add_argument(
        "--jobs", type=make_number_type(1, 1024, int), metavar="N",
        help=f"{jobs} (default: one per core)",
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS",
        help=f"run the {what} on a Dask cluster, such as tcp://10.0.0.1:8786, instead of on this "
            "machine; its workers need greenroof_ros[dask,study]",
    )


def check_workers(arguments: argparse.Namespace) -> None:
    """Check the options of a command that hands work to workers.

    Raises:
        ConfigurationError: if both a cluster and a number of processes are requested, or the
            weather is not a directory.
    """
    refuse((
        arguments.scheduler is not None and arguments.jobs is not None, "--jobs", arguments.jobs,
        "cannot be combined with --scheduler: the cluster sets the number of processes",
    ))
    weather: Path | None = arguments.weather
    refuse((
        weather is not None and not weather.is_dir(), "--weather", str(weather),
        "must be a directory with weather files",
    ))


def describe_end(error: Exception, signals: Signals | None) -> tuple[str, int]:
    """Return the reason why the work ended early, and the exit code.

    A signal that a batch system sends to all processes also stops the workers.

    Args:
        error: error that ended the work.
        signals: signals that the command has received; None before the command handles signals.
    """
    received = None if signals is None else signals.received
    if received is None:
        return f"error: {error}", EXIT_FAILED
    return f"interrupted by {received.name}", EXIT_INTERRUPTED


def open_workers(
    arguments: argparse.Namespace, files: Mapping[str, bytes], preload: Sequence[str]
) -> AbstractContextManager[Workers]:
    """Return the workers that a command line requests.

    Args:
        arguments: arguments with the options from :func:`add_worker_arguments`.
        files: contents of the input files, by name.
        preload: modules that are imported once for all processes on this machine.

    Raises:
        ConfigurationError: if the scheduler does not answer, has no worker, or has workers with
            other versions; raised when the context is entered.
    """
    if arguments.scheduler is None:
        return processes(arguments.jobs or count_cores(), files, preload)
    from greenroof_ros.analysis.workers.cluster import cluster  # needs an extra

    return cluster(arguments.scheduler, files)
