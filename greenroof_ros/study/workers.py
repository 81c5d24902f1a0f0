"""Where runs are made: in processes of this machine, or on a Dask cluster."""

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

from greenroof_ros.common.errors import ConfigurationError, in_extra
from greenroof_ros.common.processes import end_with
from greenroof_ros.common.versions import versions

# What each worker would otherwise import.
_PRELOADED = [
    "greenroof_ros.study.case_run", "greenroof_ros.controllers.mpc",
    "greenroof_ros.controllers.lookahead", "osqp", "polars", "scipy.optimize",
]
# How long a worker may take to be ready.
_START_S = 60
_CONNECT_S = 10
# A worker that its nanny starts again is back sooner.
_NO_WORKER_S = 15.0
# How often a scheduler is asked for its workers.
_ASK_S = 2.0


class WorkersGoneError(Exception):
    """Nothing is left that could make the runs; the message says what is gone."""


class Workers(NamedTuple):
    """Those who make the runs."""

    submit: Callable[..., Future[Any]]
    """hands a function and its arguments over, and returns the result to come"""
    check: Callable[[], None]
    """raises :class:`WorkersGoneError` where there is no worker any more"""


@contextmanager
def processes(jobs: int) -> Iterator[Workers]:
    """Work in parallel processes; one that is killed fails its own task alone.

    Args:
        jobs: how many at a time.

    Raises:
        ConfigurationError: pebble is not installed.
    """
    with in_extra("study"):
        from pebble import ProcessPool
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    # A terminal's Ctrl-C goes to the fork server, too, which would say where in its imports it was.
    # It, and with it the workers, ignores it from the start and leaves it to this process.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        forkserver.ensure_running()
    finally:
        signal.signal(signal.SIGINT, before)
    # A worker that is stopped does not clear up after itself.
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
            # In a thread, as that is not interrupted: a worker that is ended before it is ready
            # fails with a traceback, or is unknown to the pool, which cannot end it.
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
    """Have a worker make its temporary files where they are cleared away, and be quiet.

    What a single run warns of would tear the bar of hundreds. It ends with the study: the fork
    server, its parent, stays for as long as one of its children does.

    Args:
        scratch: directory of its temporary files.
        study: the process that hands out the runs.
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
        ConfigurationError: distributed is not installed, there is no answer, no worker, or a
            worker has other versions than this process.
        WorkersGoneError: the scheduler or all its workers went while there was work.
    """
    try:
        import dask

        # It would say in a hundred lines what a sentence here says.
        quiet = dict.fromkeys(("distributed", "distributed.client", "tornado.application"), 100)
        dask.config.set({"logging": quiet})
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            "needs distributed: pip install 'greenroof_ros[dask]'", key="--scheduler"
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
        except asyncio.TimeoutError as error:  # of Python 3.10, another than the built-in one
            raise ConfigurationError(
                "has no worker", key="--scheduler", value=address
            ) from error
        except (OSError, CancelledError) as error:
            raise gone from error
        executor = client.get_executor(pure=False, retries=0)
        pending: set[Future[Any]] = set()
        asked = seen = time.monotonic()

        def submit(function: Callable[..., Any], *arguments: Any) -> Future[Any]:
            future: Future[Any] = executor.submit(function, *arguments)
            pending.add(future)
            # One that were kept would keep its result on its worker, to be made again when that is
            # killed.
            future.add_done_callback(pending.discard)
            return future

        def check() -> None:
            nonlocal asked, seen
            now = time.monotonic()
            if now - asked < _ASK_S:
                return
            asked = now
            try:
                there = client.nthreads()
            except (OSError, RuntimeError) as error:  # its connection, or the client itself
                raise gone from error
            if there:
                seen = now
            elif now - seen > _NO_WORKER_S:
                raise WorkersGoneError(
                    f"the Dask scheduler at {address} has had no worker for {_NO_WORKER_S:g} s"
                )

        try:
            yield Workers(submit, check)
        except CancelledError as error:  # nobody here cancels what is waited for
            raise gone from error
        finally:
            # Interrupted, no one waits for the results of what is under way.
            for future in list(pending):
                future.cancel()
            executor.shutdown(wait=False)


def _check_versions(workers: Mapping[str, Mapping[str, str]]) -> None:
    """Refuse workers whose numbers may be others."""
    here = versions()
    for address, theirs in workers.items():
        for package in here.keys() | theirs.keys():
            if theirs.get(package) != here.get(package):
                raise ConfigurationError(
                    f"its worker {address} has {package} {theirs.get(package, 'not at all')}, "
                    f"this process {here.get(package, 'not at all')}; make them the same",
                    key="--scheduler",
                )
