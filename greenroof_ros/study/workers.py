"""Where runs are made: in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.processes import end_with
from greenroof_ros.common.versions import versions

# What each worker would otherwise import.
_PRELOADED = [
    "greenroof_ros.study.case_run", "greenroof_ros.controllers.mpc",
    "greenroof_ros.controllers.planning_mpc", "polars",
]
_CONNECT_S = 10


# Hands a function and its arguments over, and returns the result to come.
Submit = Callable[..., Future[Any]]


@contextmanager
def processes(jobs: int) -> Iterator[Submit]:
    """Work in parallel processes; one that is killed fails its own task alone.

    Args:
        jobs: how many at a time.

    Raises:
        ConfigurationError: pebble is not installed.
    """
    try:
        from pebble import ProcessPool
    except ImportError as error:
        raise ConfigurationError("needs pebble: pip install 'greenroof_ros[study]'") from error
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    # A worker that is stopped does not clear up after itself.
    with tempfile.TemporaryDirectory(prefix="greenroof_ros-") as scratch:
        pool = ProcessPool(
            max_workers=jobs, context=context, initializer=_prepare,
            initargs=(scratch, os.getpid()),
        )
        try:
            yield lambda function, *arguments: pool.schedule(function, args=arguments)
        finally:
            pool.stop()
            pool.join()


def _prepare(scratch: str, study: int) -> None:
    """Have a worker make its temporary files where they are cleared away, and be quiet.

    What a single run warns of would tear the bar of hundreds. It ends with the study: the fork
    server, its parent, stays for as long as one of its children does.

    Args:
        scratch: directory of its temporary files.
        study: the process that hands out the runs.
    """
    end_with(study)
    tempfile.tempdir = scratch
    logging.getLogger("greenroof_ros").setLevel(logging.ERROR)


@contextmanager
def cluster(address: str) -> Iterator[Submit]:
    """Work on the workers of a Dask scheduler.

    Args:
        address: such as ``tcp://10.0.0.1:8786``.

    Raises:
        ConfigurationError: distributed is not installed, there is no answer, or a worker has other
            versions than this process.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            "needs distributed: pip install 'greenroof_ros[dask]'", key="--scheduler"
        ) from error
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"does not answer: {error}", key="--scheduler", value=address
        ) from error
    with client:
        _check_versions(client.run(versions))
        executor = client.get_executor(pure=False, retries=0)
        pending: list[Future[Any]] = []

        def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
            pending.append(executor.submit(function, *arguments))
            return pending[-1]

        try:
            yield submit
        finally:
            # Interrupted, no one waits for the results of what is under way.
            for future in pending:
                future.cancel()
            executor.shutdown(wait=False)


def _check_versions(workers: Mapping[str, Mapping[str, str]]) -> None:
    """Refuse workers whose numbers may be others."""
    here = versions()
    for address, found in workers.items():
        for package in here.keys() | found.keys():
            if found.get(package) != here.get(package):
                raise ConfigurationError(
                    f"its worker {address} has {package} {found.get(package, 'not at all')}, "
                    f"this process {here.get(package, 'not at all')}; make them the same",
                    key="--scheduler",
                )
