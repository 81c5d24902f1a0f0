"""The workers of a Dask cluster."""

from __future__ import annotations

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
from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.results.versions import versions

with require_extra("dask"):
    import dask

    # Otherwise its log would repeat every error message in a hundred lines.
    quiet = dict.fromkeys(("distributed", "distributed.client", "tornado.application"), 100)
    dask.config.set({"logging": quiet})
    from distributed import Client, WorkerPlugin, get_worker

_CONNECT_S = 10
# A worker that its nanny restarts is back sooner than this.
_NO_WORKER_S = 15.0
# Time between two requests for the scheduler's list of workers.
_POLL_S = 2.0
# Longest time to wait until the workers have deleted their files.
_DELETE_S = 5.0


class InputFiles(WorkerPlugin):
    """The input files on a worker, which Dask sends to every worker once."""

    def __init__(self, files: Mapping[str, bytes]) -> None:
        """Set the contents of the files, by name."""
        self._files = files

    def setup(self, worker: Any) -> None:
        """Write the files before the worker receives its first task."""
        self._directory = tempfile.TemporaryDirectory(dir=worker.local_directory)
        self.path = Path(self._directory.name)
        write_inputs(self._files, self.path)

    def teardown(self, worker: Any) -> None:
        """Delete the files."""
        self._directory.cleanup()


def _on_worker(plugin: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function on a worker, with the directory of the input files as first argument."""
    files = get_worker().plugins[plugin]
    assert isinstance(files, InputFiles)
    return function(files.path, *arguments)


@contextmanager
def cluster(address: str, files: Mapping[str, bytes]) -> Iterator[Workers]:
    """Provide the workers of a Dask scheduler.

    Args:
        address: address of the scheduler, such as ``tcp://10.0.0.1:8786``.
        files: contents of the input files, by name.

    Raises:
        ConfigurationError: if the scheduler does not answer or has no worker, or if the versions
            on a worker differ from those of this process.
        WorkersLostError: if the scheduler or all its workers were lost during the work.
    """
    lost = WorkersLostError(f"the connection to the Dask scheduler at {address} was lost")
    try:
        client = Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"does not answer: {error}", key="--scheduler", value=address
        ) from error
    plugin = f"greenroof_ros-{client.id}"

    def delete() -> None:
        # If the scheduler is gone, the files are too: a repeated command sends them again.
        with suppress(Exception):
            client.unregister_worker_plugin(plugin)

    with client:
        try:
            client.wait_for_workers(1, timeout=_CONNECT_S)
            _check_versions(client.run(versions))
            client.register_plugin(InputFiles(files), plugin)
        except TimeoutError as error:
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
                partial(executor.submit, task), lambda future: future.result(), check
            )
        except CancelledError as error:  # this process did not cancel: the scheduler is gone
            raise lost from error
        finally:
            # This cancels running tasks, because nobody waits for their results after an interrupt.
            executor.shutdown(wait=False)
            # This runs in a thread, because a worker or scheduler that hangs would never answer.
            deleting = Thread(target=delete, daemon=True)
            deleting.start()
            deleting.join(_DELETE_S)


def _check_versions(workers: Mapping[str, Mapping[str, str]]) -> None:
    """Reject workers with different package versions, whose results could differ.

    Args:
        workers: versions of the packages on each worker, by its address.

    Raises:
        ConfigurationError: if a version on a worker differs from this process's.
    """
    here = versions()
    for address, theirs in workers.items():
        for package in here.keys() | theirs.keys():
            if theirs.get(package) != here.get(package):
                raise ConfigurationError(
                    f"its worker {address} uses {package} {theirs.get(package, '(missing)')}, but "
                    f"this process uses {here.get(package, '(missing)')}; install the same version",
                    key="--scheduler",
                )
