"""Workers that make runs: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import forkserver
from multiprocessing.synchronize import Semaphore
from typing import Any, NamedTuple

from greenroof_ros.common.errors import ConfigurationError, in_extra, with_extra
from greenroof_ros.common.processes import end_with
from greenroof_ros.experiment.summary import versions

# Imported once by the fork server, not by each worker.
_PRELOADED = [
    "greenroof_ros.study.case_run", "greenroof_ros.controllers.mpc",
    "greenroof_ros.controllers.lookahead", "osqp", "polars", "scipy.optimize",
]
# Longest time for a worker to become ready.
_START_S = 60
_CONNECT_S = 10
# A worker that its nanny restarts is back sooner.
_NO_WORKER_S = 15.0
# Time between two requests to a scheduler for its workers.
_ASK_S = 2.0


class WorkersGoneError(Exception):
    """No worker is left; the message says what is gone."""


class Workers(NamedTuple):
    """The means to hand out runs."""

    submit: Callable[..., Future[Any]]
    """schedules a function with its arguments, and returns the future"""
    check: Callable[[], None]
    """raises :class:`WorkersGoneError` if no worker is left"""


@contextmanager
def processes(jobs: int) -> Iterator[Workers]:
    """Work in parallel processes; if one is killed, only its own task fails.

    Args:
        jobs: number of processes.

    Raises:
        ConfigurationError: pebble is not installed.
    """
    with in_extra("study"):
        from pebble import ProcessPool
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    # A terminal's Ctrl-C also reaches the fork server, which would print a traceback. So the server
    # and its workers ignore it from the start, and only this process handles it.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
    # A worker that is stopped does not delete its temporary files.
    with tempfile.TemporaryDirectory(prefix="greenroof_ros-") as scratch:
        started = context.Semaphore(0)
        pool = ProcessPool(
            max_workers=jobs, context=context, initializer=_prepare,
            initargs=(scratch, os.getpid(), started),
        )

        def start() -> None:
            pool.schedule(os.getpid)  # the first task starts all workers
            for _ in range(jobs):
                started.acquire(timeout=_START_S)

        try:
            # In a thread, which Ctrl-C does not interrupt: a worker that is ended before it is
            # ready prints a traceback, or the pool does not know it and cannot end it.
            with ThreadPoolExecutor(1) as starter:
                starter.submit(start).result()
            yield Workers(
                submit=lambda function, *arguments: pool.schedule(function, args=arguments),
                check=lambda: None,
            )
        finally:
            pool.stop()
            pool.join()


def _prepare(scratch: str, study: int, started: Semaphore) -> None:
    """Prepare a worker: its directory for temporary files, no warnings, and its end.

    Warnings of single runs would break the progress bar. The worker ends with the study itself,
    because its parent, the fork server, stays while any of its children runs.

    Args:
        scratch: directory for temporary files, which the study deletes.
        study: process number of the study.
        started: counts the workers that are ready.
    """
    end_with(study)
    tempfile.tempdir = scratch
    logging.getLogger("greenroof_ros").setLevel(logging.ERROR)
    started.release()


@contextmanager
def cluster(address: str) -> Iterator[Workers]:
    """Work on the workers of a Dask scheduler.

    Args:
        address: such as ``tcp://10.0.0.1:8786``.

    Raises:
        ConfigurationError: distributed is not installed, the scheduler does not answer or has no
            worker, or the versions on a worker differ from this process's.
        WorkersGoneError: the scheduler or all its workers disappeared during work.
    """
    try:
        import dask

        # Its log would repeat an error message in a hundred lines.
        quiet = dict.fromkeys(("distributed", "distributed.client", "tornado.application"), 100)
        dask.config.set({"logging": quiet})
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            f"needs distributed: {with_extra('dask')}", key="--scheduler"
        ) from error
    gone = WorkersGoneError(f"the Dask scheduler at {address} is gone")
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"does not answer: {error}", key="--scheduler", value=address
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
            _check_versions(client.run(versions))
        except asyncio.TimeoutError as error:  # in Python 3.10 not the built-in one
            raise ConfigurationError(
                "has no worker", key="--scheduler", value=address
            ) from error
        except (OSError, CancelledError) as error:
            raise gone from error
        executor = client.get_executor(pure=False, retries=0)
        asked = seen = time.monotonic()

        def check() -> None:
            nonlocal asked, seen
            now = time.monotonic()
            if now - asked < _ASK_S:
                return
            asked = now
            try:
                there = client.nthreads()
            except (OSError, RuntimeError) as error:  # the connection or the client failed
                raise gone from error
            if there:
                seen = now
            elif now - seen > _NO_WORKER_S:
                raise WorkersGoneError(
                    f"the Dask scheduler at {address} has had no worker for {_NO_WORKER_S:g} s"
                )

        try:
            yield Workers(executor.submit, check)
        except CancelledError as error:  # not by this process: the scheduler is gone
            raise gone from error
        finally:
            # Cancels running tasks: after an interrupt nobody waits for their results.
            executor.shutdown(wait=False)


def _check_versions(workers: Mapping[str, Mapping[str, str]]) -> None:
    """Refuse workers with other versions, which could compute other numbers."""
    here = versions()
    for address, theirs in workers.items():
        for package in here.keys() | theirs.keys():
            if theirs.get(package) != here.get(package):
                raise ConfigurationError(
                    f"its worker {address} has {package} {theirs.get(package, 'not at all')}, "
                    f"this process {here.get(package, 'not at all')}; make them the same",
                    key="--scheduler",
                )
