"""Functions for processes: end with the parent, locks, temporary files, signals, time limits."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import faulthandler
import hashlib
import os
import shutil
import signal
import socket
import struct
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from greenroof_ros.base.errors import HangError
from greenroof_ros.base.interrupts import SIGNALS

_PR_SET_PDEATHSIG = 1
# The environment variable of a child that must end with its parent: the parent's number.
_PARENT = "GREENROOF_ROS_PARENT"


def child_environment() -> dict[str, str]:
    """Return the environment for a child command of this package that ends with this process.

    The child itself ensures that it ends with its parent, because Python code between fork and exec
    (``preexec_fn``) can deadlock if the parent has threads.
    """
    return {**os.environ, _PARENT: str(os.getpid())}


def end_with_parent() -> None:
    """If requested, make the kernel stop this process when its parent dies, even by kill -9.

    The kernel sends SIGTERM, since background processes of a shell may ignore SIGINT. If the parent
    died before this call, the process stops immediately.
    """
    parent = os.environ.pop(_PARENT, None)  # children of this process have another parent
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if str(os.getppid()) != parent:
        os.kill(os.getpid(), signal.SIGTERM)


# What the kernel reports about the listener of a Unix socket: process, user and group.
_CREDENTIALS = struct.Struct("3i")


class LockedError(Exception):
    """Raised if another process holds the lock.

    Attributes:
        holder: process ID of the holder of the lock; None if it is unknown.
    """

    def __init__(self, lock: Path | str, holder: int | None) -> None:
        super().__init__(f"process {holder or 'unknown'} holds the lock {lock}")
        self.holder = holder


def acquire_name_lock(name: str) -> socket.socket:
    """Acquire a machine-wide lock on a name, and return the lock, which is held until closed.

    The lock is a socket in Linux's abstract namespace. Unlike a file, the lock cannot be removed by
    a cleanup of ``/tmp`` or at the end of a login session while the lock is held, and it is
    released when its process exits. Like a network port, the lock applies to the processes of one
    network namespace.

    Args:
        name: the name to lock, of any length.

    Raises:
        LockedError: if another process holds the lock.
        OSError: if the system does not support abstract sockets.
    """
    address = f"\0greenroof_ros-{hashlib.sha256(name.encode()).hexdigest()}"
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        lock.bind(address)
        lock.listen()  # so that others can ask the kernel who holds it
    except OSError as error:
        lock.close()
        if error.errno != errno.EADDRINUSE:
            raise
        raise LockedError(name, _find_listener(address)) from None
    return lock


def _find_listener(address: str) -> int | None:
    """Return the ID of the process that listens on an address; None if it is unknown."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as visitor:
        visitor.setblocking(False)
        try:
            visitor.connect(address)
            credentials = visitor.getsockopt(
                socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size
            )
        except OSError:  # it has just ended, or no one can connect any longer
            return None
    return int(_CREDENTIALS.unpack(credentials)[0]) or None  # 0: in another process namespace


@contextlib.contextmanager
def lock_file(path: Path) -> Iterator[None]:
    """Hold the lock of a lock file, which is created if necessary, for the time of a block.

    Raises:
        LockedError: if another process holds the lock.
        OSError: if the file cannot be opened.
    """
    import filelock  # takes long, and a node needs none

    try:
        with filelock.FileLock(path, timeout=0):
            yield
    except filelock.Timeout:
        raise LockedError(path, None) from None


IN_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""a place for files in memory; None if the system has none, as other systems than Linux"""
# Directories of temporary files, and the lock in each; nothing else may have such a name.
_SCRATCH, _LOCK = "greenroof_ros_temporary-", "lock"
# A lock file may be younger than this (s) without being locked.
_NEW_S = 1.0


@contextlib.contextmanager
def scratch_directory(place: str | None = None) -> Iterator[Path]:
    """Create a directory for temporary files, and remove the directories of killed processes.

    The process holds a lock in its directory. Unlike a process ID, a lock also works between
    containers that share ``/dev/shm``.

    Args:
        place: parent directory; None for the system's directory for temporary files.
    """
    for stale in Path(place or tempfile.gettempdir()).glob(f"{_SCRATCH}*/{_LOCK}"):
        # Others are another user's or in use, or are about to be locked.
        with contextlib.suppress(OSError, LockedError):
            if time.time() - stale.stat().st_mtime > _NEW_S:
                with lock_file(stale):
                    shutil.rmtree(stale.parent)
    with tempfile.TemporaryDirectory(
        prefix=_SCRATCH, dir=place, ignore_cleanup_errors=True
    ) as made, lock_file(Path(made, _LOCK)):
        yield Path(made)


def count_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class InterruptedRun(Exception):
    """Raised if Ctrl-C, SIGTERM or a closed terminal ends a run; the message names the signal."""


class Signals:
    """Handler that stores a received signal, so that the run can stop at a safe point.

    An exception from the handler could interrupt any code, even the shutdown of the nodes. A signal
    that the process already ignores stays ignored: under ``nohup`` a process ignores the closing of
    its terminal, and a shell makes background processes ignore Ctrl-C.

    Python also sends the number of every signal through a socket. So a signal is found even if
    other code, such as a controller of the user, handles the signal or discards the exception.
    """

    def __init__(self, *, interrupt: bool = False) -> None:
        """Handle the signals from now on.

        Args:
            interrupt: True to raise a KeyboardInterrupt at each signal, for code that might not
                reach a safe point for a long time.
        """
        self._received: signal.Signals | None = None
        self._interrupt = interrupt
        self._numbers, self._sender = socket.socketpair()  # on Windows, a pipe would not do
        for end in (self._numbers, self._sender):
            end.setblocking(False)
        signal.set_wakeup_fd(self._sender.fileno(), warn_on_full_buffer=False)
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: Any) -> None:
        self._received = signal.Signals(number)
        if self._interrupt:
            raise KeyboardInterrupt

    @property
    def received(self) -> signal.Signals | None:
        """The signal received so far, even if other code handled it; None if there was none."""
        with contextlib.suppress(BlockingIOError):
            for number in self._numbers.recv(4096):
                if number in SIGNALS:
                    self._received = signal.Signals(number)
        return self._received

    def ignore(self) -> None:
        """Ignore all later signals, which would interrupt the end of the run or the interpreter."""
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def check(self) -> None:
        """Raise :class:`InterruptedRun` if a signal was received."""
        if (received := self.received) is not None:
            raise InterruptedRun(f"interrupted by {received.name}")


# How often the error is raised until the code ends (s).
_AGAIN_S = 1.0
# How long after the limit Python code may still take to end (s). Whatever is not Python code, such
# as compiled code or a disk that hangs, cannot be ended.
_LAST_S = 5.0


class Watchdog:
    """Watchdog of the main thread, which must report before each limit has passed.

    The nodes of a process share its main thread. Code that does not return would therefore block
    all nodes, and Ctrl-C as well. After the limit, a :class:`HangError` is raised in the code,
    every second until the code ends.
    """

    def __init__(self, *, exits: bool = False) -> None:
        """Create the watchdog without starting it.

        Args:
            exits: whether the process exits if the error has no effect; otherwise, the place of the
                code is written to standard error.
        """
        self._exits, self._limit = exits, 0.0
        signal.signal(signal.SIGALRM, self._end_code)

    def report(self, limit: float) -> None:
        """Report that the code has returned; the next report must follow within the limit (s)."""
        self._limit = limit
        signal.setitimer(signal.ITIMER_REAL, limit, _AGAIN_S)
        faulthandler.dump_traceback_later(limit + _LAST_S, exit=self._exits)

    def stop(self) -> None:
        """Stop watching."""
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        faulthandler.cancel_dump_traceback_later()

    def _end_code(self, _: int, frame: FrameType | None) -> None:
        place = "" if frame is None else f"{frame.f_code.co_filename}, line {frame.f_lineno}"
        raise HangError(f"did not return within {self._limit:g} s; it was executing {place}")


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise an error in Python code of the main thread that takes too long.

    Raises:
        HangError: if the code takes longer than the given time (s).
    """
    watchdog = Watchdog()
    watchdog.report(seconds)
    try:
        yield
    finally:
        watchdog.stop()
