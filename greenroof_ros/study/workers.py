"""Who runs the cases: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Protocol

from greenroof_ros import summary
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
    # A worker that is stopped does not clear up after itself.
    with tempfile.TemporaryDirectory(prefix="greenroof_ros-") as scratch:
        pool = ProcessPool(
            max_workers=jobs, context=context, initializer=_use_scratch, initargs=(scratch,)
        )
        try:
            yield lambda case, engine: pool.schedule(run_case, args=(case, engine))
        finally:
            pool.stop()
            pool.join()


def _use_scratch(directory: str) -> None:
    """Have a worker make its temporary files where they are cleared away."""
    tempfile.tempdir = directory


@contextmanager
def cluster(address: str) -> Iterator[Submit]:
    """Run cases on the workers of a Dask scheduler.

    Args:
        address: such as ``tcp://10.0.0.1:8786``.

    Raises:
        ConfigurationError: distributed is not installed, nobody answers, or a worker has other
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
        _check_versions(client.run(summary.versions))
        executor = client.get_executor(pure=False, retries=0)
        pending: list[Future[Outcome]] = []

        def submit(case: Case, engine: str) -> Future[Outcome]:
            pending.append(executor.submit(run_case, case, engine))
            return pending[-1]

        try:
            yield submit
        finally:
            # Interrupted, nobody waits for what the workers are at.
            for future in pending:
                future.cancel()
            executor.shutdown(wait=False)


def _check_versions(workers: Mapping[str, Mapping[str, str]]) -> None:
    """Refuse workers whose numbers may be others."""
    here = summary.versions()
    for address, versions in workers.items():
        for package in here.keys() | versions.keys():
            if versions.get(package) != here.get(package):
                raise ConfigurationError(
                    f"its worker {address} has {package} {versions.get(package, 'not at all')}, "
                    f"this process {here.get(package, 'not at all')}; make them the same",
                    key="--scheduler",
                )
