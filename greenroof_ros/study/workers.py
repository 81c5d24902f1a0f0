"""Who runs the cases: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Protocol

from greenroof_ros.errors import ConfigurationError
from greenroof_ros.study.case_run import Outcome, run_case
from greenroof_ros.study.grid import Case

# What a worker would otherwise import anew.
_PRELOADED = ["greenroof_ros.study.case_run", "greenroof_ros.controllers.mpc", "polars"]
_CONNECT_S = 10


class Submit(Protocol):
    """Hands a case over, and returns its outcome to come."""

    def __call__(self, case: Case, engine: str) -> Future[Outcome]:
        """Return at once."""
        ...


@contextmanager
def processes(jobs: int) -> Iterator[Submit]:
    """Run cases in parallel processes; one that is killed fails its own case alone.

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
    pool = ProcessPool(max_workers=jobs, context=context)
    try:
        yield lambda case, engine: pool.schedule(run_case, args=(case, engine))
    finally:
        pool.stop()
        pool.join()


@contextmanager
def cluster(address: str) -> Iterator[Submit]:
    """Run cases on the workers of a Dask scheduler.

    Args:
        address: such as ``tcp://10.0.0.1:8786``.

    Raises:
        ConfigurationError: distributed is not installed, or nobody answers.
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
    with client, client.get_executor(pure=False, retries=0) as executor:
        yield lambda case, engine: executor.submit(run_case, case, engine)
