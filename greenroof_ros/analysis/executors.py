"""Tasks in threads, in processes, or in any executor, such as that of a Dask cluster: one loop."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context, resource_tracker
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

from greenroof_ros.base.processes import count_cores, scratch_directory

# Longest time between two reports of progress (s).
_REFRESH_S = 0.5
_LOST = (
    "a worker was killed, or the connection to it was lost; if memory ran out, reduce --jobs; a "
    "script must call this package below if __name__ == '__main__':, because workers import it"
)

class WorkersLostError(BrokenExecutor):
    """Raised when the workers cannot continue; the message states what was lost."""


class Task(NamedTuple):
    """A call of a function, with the directory of the input files as its first argument."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    in_threads: bool = False
    """whether the call may run in a thread of this process, because its code is compiled"""


def run_tasks(
    tasks: Iterable[Task], directory: Path, receive: Callable[[Task, Any, Exception | None], None],
    *, executor: Executor | None = None, jobs: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Run tasks, and hand over each result as soon as it is there.

    Args:
        tasks: the tasks, which begin in this order.
        directory: directory with the input files.
        receive: function that receives a task, its result, and the error that it raised, if any.
        executor: executor that runs all tasks, on this machine or on others that see the same
            directory; None for threads and processes of this machine.
        jobs: number of threads, and of processes; None for one per core.
        progress: function that receives the completed share of the tasks at least every half
            second; an error that it raises ends the work.

    Raises:
        WorkersLostError: if a process was killed, or if the executor was lost.
    """
    pending = dict[Future[Any], Task]()
    with ExitStack() as stack:
        threads: Any = executor
        processes, results = threads, None
        if executor is None:
            threads = stack.enter_context(futures.ThreadPoolExecutor(jobs or count_cores()))
            processes, results = stack.enter_context(_open_processes(jobs or count_cores()))
        try:
            with _hold_interrupts():
                for task in tasks:
                    pool, place = (threads, None) if task.in_threads else (processes, results)
                    pending[pool.submit(_call, directory, place, *task[:2])] = task
            count, lost = len(pending), None
            while pending:
                progress(1 - len(pending) / count)
                for future in futures.wait(pending, _REFRESH_S, futures.FIRST_COMPLETED).done:
                    task = pending.pop(future)
                    try:
                        result = future.result()
                    except (BrokenExecutor, CancelledError) as error:
                        lost = error  # raised once all results that came before are received
                    except Exception as error:  # raised by the task
                        receive(task, None, error)
                    else:
                        receive(task, _read(result) if isinstance(result, Path) else result, None)
                if lost is not None:
                    raise lost
            progress(1.0)
        # The last two are raised if a process is killed while it starts.
        except (BrokenExecutor, CancelledError, EOFError, ConnectionError) as error:
            raise WorkersLostError(_LOST) from error
        finally:
            # The pool of processes cancels its own: of others, its thread may report the end too.
            for future, task in pending.items():
                if executor is not None or task.in_threads:
                    future.cancel()


def _call(
    inputs: Path, results: Path | None, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> Any:
    """Call a function, and return its result or, from a process, the path of a file with it.

    A large result is not sent to the pool of processes itself, because it would wait forever for
    the rest if the process were killed while sending the result.
    """
    result = function(inputs, *arguments)
    if results is None:
        return result
    path = results / uuid4().hex
    path.write_bytes(pickle.dumps(result))
    return path


def _read(path: Path) -> Any:
    result = pickle.loads(path.read_bytes())  # noqa: S301 - written by our own process
    path.unlink()
    return result


@contextmanager
def _open_processes(jobs: int) -> Iterator[tuple[Executor, Path]]:
    """Provide processes, which start with their first task, and a directory for their results."""
    context = get_context("spawn")
    alive, end = context.Pipe(duplex=False)
    # A process that is killed does not delete its temporary files.
    with scratch_directory() as scratch:
        executor = futures.ProcessPoolExecutor(jobs, context, _prepare, (alive, str(scratch)))
        try:
            yield executor, scratch
        finally:
            end.close()
            executor.shutdown(cancel_futures=True)


def _prepare(alive: Any, scratch: str) -> None:
    """Prepare a process: set its directory, silence warnings, and tie its life to the work.

    Warnings from single runs would break the progress bar.

    Args:
        alive: connection that is closed when the work ends for any reason, even by kill -9; the
            process then ends at once.
        scratch: directory for temporary files, which the process of the work deletes.
    """
    def watch() -> None:
        alive.poll(None)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    tempfile.tempdir = scratch
    logging.getLogger("greenroof_ros").setLevel(logging.ERROR)


@contextmanager
def _hold_interrupts() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all processes, from those that start in the block."""
    mask = getattr(signal, "pthread_sigmask", lambda *_: None)  # Windows has none
    resource_tracker.ensure_running()  # first, because it unblocks the signal
    mask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        mask(signal.SIG_UNBLOCK, {signal.SIGINT})
