"""The workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.analysis.workers.processes import Workers, WorkersLostError
from greenroof_ros.common.errors import ConfigurationError, require_extra
from greenroof_ros.experiment.summary import versions

with require_extra("dask"):
    import dask

    # Its log would repeat an error message in a hundred lines.
    quiet = dict.fromkeys(("distributed", "distributed.client", "tornado.application"), 100)
    dask.config.set({"logging": quiet})
    from distributed import Client, WorkerPlugin, get_worker

_CONNECT_S = 10
# A worker that its nanny restarts is back sooner.
_NO_WORKER_S = 15.0
# Time between two requests to a scheduler for its workers.
_POLL_S = 2.0
# The longest wait for the workers to delete their files.
_DELETE_S = 5.0


class InputFiles(WorkerPlugin):
    """Keeps the input files on a worker; Dask sends them to each worker once."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        """Set the contents by name."""
        self._files = files

    def setup(self, worker: Any) -> None:
        """Write the files, before the worker gets its first task."""
        self._directory = tempfile.TemporaryDirectory(dir=worker.local_directory)
        self.path = Path(self._directory.name)
        write_inputs(self._files, self.path)

    def teardown(self, worker: Any) -> None:
        """Delete the files."""
        self._directory.cleanup()


def _on_worker(plugin: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function on a worker with the directory of the input files."""
    files = get_worker().plugins[plugin]
    assert isinstance(files, InputFiles)
    return function(files.path, *arguments)


@contextmanager
def cluster(address: str, files: Mapping[str, bytes]) -> Iterator[Workers]:
    """Work on the workers of a Dask scheduler.

    Args:
        address: such as ``tcp://10.0.0.1:8786``.
        files: contents of the input files, by name.

    Raises:
        ConfigurationError: the scheduler does not answer or has no worker, or the versions on a
            worker differ from this process's.
        WorkersLostError: the scheduler or all its workers disappeared during work.
    """
    lost = WorkersLostError(f"the Dask scheduler at {address} is gone")
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"does not answer: {error}", key="--scheduler", value=address
        ) from error
    plugin = f"greenroof_ros-{client.id}"

    def delete() -> None:
        with suppress(Exception):  # the scheduler is gone, and a repeated command sends them again
            client.unregister_worker_plugin(plugin)

    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
            _check_versions(client.run(versions))
            client.register_plugin(InputFiles(files), plugin)
        except asyncio.TimeoutError as error:  # in Python 3.10 not the built-in one
            raise ConfigurationError(
                "has no worker", key="--scheduler", value=address
            ) from error
        except (OSError, CancelledError) as error:
            raise lost from error
        executor = client.get_executor(pure=False, retries=0)
        polled = last_worker = time.monotonic()

        def check() -> None:
            nonlocal polled, last_worker
            now = time.monotonic()
            if now - polled < _POLL_S:
                return
            polled = now
            try:
                there = client.nthreads()
            except (OSError, RuntimeError) as error:  # the connection or the client failed
                raise lost from error
            if there:
                last_worker = now
            elif now - last_worker > _NO_WORKER_S:
                raise WorkersLostError(
                    f"the Dask scheduler at {address} has had no worker for {_NO_WORKER_S:g} s"
                )

        try:
            task = partial(_on_worker, plugin)
            yield Workers(
                partial(executor.submit, task), lambda future: future.result(), check,
                sum(client.nthreads().values()),
            )
        except CancelledError as error:  # not by this process: the scheduler is gone
            raise lost from error
        finally:
            # Cancels running tasks: after an interrupt no one waits for their results.
            executor.shutdown(wait=False)
            # In a thread, because a worker or scheduler that hangs would never answer.
            deleting = Thread(target=delete, daemon=True)
            deleting.start()
            deleting.join(_DELETE_S)


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
