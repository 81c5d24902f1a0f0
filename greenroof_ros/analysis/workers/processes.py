"""Workers that are processes on this machine.

The workers of a Dask cluster are in :mod:`greenroof_ros.analysis.workers.cluster`.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing.context import BaseContext
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.processes import scratch_directory


class WorkersLostError(BrokenExecutor):
    """Raised when the workers cannot continue; the message states what was lost."""


class Workers(NamedTuple):
    """The functions that distribute work to the workers."""

    submit: Callable[..., Future[Any]]
    """schedules a function, which is called with the directory of the input files, followed by
    the arguments that were passed"""
    result: Callable[[Future[Any]], Any]
    """returns the result of the function of a future, or raises the error that it raised"""
    check: Callable[[], None]
    """raises :class:`WorkersLostError` if no worker is left"""


@contextmanager
def processes(
    jobs: int, files: Mapping[str, bytes], preload: Sequence[str]
) -> Iterator[Workers]:
    """Provide parallel processes on this machine as workers.

    Args:
        jobs: number of processes.
        files: contents of the input files, by name.
        preload: modules that the fork server imports once for all workers.

    Raises:
        WorkersLostError: if a process ended unexpectedly or was killed.
    """
    context = _start_fork_server(preload)
    # A worker that is killed does not delete its temporary files.
    with scratch_directory() as scratch:
        inputs = scratch / "inputs"
        inputs.mkdir()
        write_inputs(files, inputs)
        executor = ProcessPoolExecutor(jobs, context, _prepare, (str(scratch),))
        try:
            task = partial(_to_file, inputs)
            yield Workers(partial(executor.submit, task), _from_file, lambda: None)
        # The other errors occur if a worker is killed while it starts.
        except (BrokenProcessPool, EOFError, ConnectionError) as error:
            raise WorkersLostError(
                "a worker process was killed; if memory ran out, reduce --jobs"
            ) from error
        finally:
            for process in multiprocessing.active_children():
                process.kill()
            # This waits for the executor's thread; after a shutdown without waiting, nothing can
            # wait for it, and when Python ends it closes a pipe to which Python still writes.
            executor.shutdown(cancel_futures=True)


def _start_fork_server(preload: Sequence[str]) -> BaseContext:
    """Return the context in which workers start: a fork server or, on Windows, new processes."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver, resource_tracker

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([*preload])
    # Ctrl-C on a terminal also reaches the fork server, which would print a traceback. So the
    # signal is blocked in the server and its workers from the start; this process receives it a
    # moment later.
    resource_tracker.ensure_running()  # first, because it unblocks the signal
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    return context


def _to_file(directory: Path, function: Callable[..., Any], *arguments: Any) -> Path:
    """Call a function in a worker, and return the path of a file with its result.

    A large result is not sent to the executor itself, because the executor would wait forever for
    the rest if the worker were killed while sending the result.
    """
    result = function(directory, *arguments)
    path = Path(tempfile.gettempdir(), uuid4().hex)
    with add_path_to_errors(path):
        path.write_bytes(pickle.dumps(result))
    return path


def _from_file(future: Future[Path]) -> Any:
    path = future.result()
    result = pickle.loads(path.read_bytes())  # noqa: S301 - written by our own worker
    path.unlink()
    return result


def _prepare(scratch: str) -> None:
    """Prepare a worker: set its directory, silence warnings, and tie its lifetime to the command.

    Warnings from single runs would break the progress bar. The worker itself has to ensure that it
    ends with the command, because its parent, the fork server, continues to run while any of its
    children is running.

    Args:
        scratch: directory for temporary files, which the command deletes.
    """
    _end_with_command()
    tempfile.tempdir = scratch
    logging.getLogger("greenroof_ros").setLevel(logging.ERROR)


def _end_with_command() -> None:
    """Stop this worker immediately when the process that requested it stops for any reason.

    The requesting process is not always the parent, because workers are children of
    multiprocessing's fork server.
    """
    def watch() -> None:
        try:
            if (command := multiprocessing.parent_process()) is not None:
                command.join()
        finally:
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
