"""Processes: how they end, locks that exclude each other, and what is said to systemd."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import select
import signal
import socket
import threading
from io import FileIO
from pathlib import Path
from typing import Any

_PR_SET_PDEATHSIG = 1
# The environment variable by which a process asks a child to end with it: its own number.
_PARENT = "GREENROOF_ROS_PARENT"


def asked_to_end_with_this() -> dict[str, str]:
    """Return an environment in which a command of this package ends with the present process.

    The child itself sees to it, at its start: Python code between fork and exec (``preexec_fn``)
    can lock up where the parent has threads.
    """
    return {**os.environ, _PARENT: str(os.getpid())}


def end_with_parent() -> None:
    """Have the kernel end this process when its parent dies, even by kill -9, if that asked for it.

    By SIGTERM: what runs in the background of a shell may ignore SIGINT. A parent that died before
    this was called counts, too.
    """
    parent = os.environ.pop(_PARENT, None)  # what this process starts is not the other's child
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if str(os.getppid()) != parent:
        os.kill(os.getpid(), signal.SIGTERM)


def end_with(process: int) -> None:
    """End this process at once when another one, not its parent perhaps, has ended in any way."""

    def watch() -> None:
        try:
            select.select([os.pidfd_open(process)], [], [])
        finally:  # or it has ended before
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


_FLAGS = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC


class LockedError(Exception):
    """Another process has the lock.

    Attributes:
        holder: its number; None where it could not write it, on a full disk.
    """

    def __init__(self, path: Path, holder: int | None) -> None:
        super().__init__(f"process {holder or 'unknown'} has the lock {path}")
        self.holder = holder


def take_lock(path: Path, mode: int = 0o600) -> FileIO:
    """Return the open file of a lock; the lock is held until it is closed.

    Args:
        path: of its file, which is made if need be; no link is followed. Who has the lock may
            remove it.
        mode: of that file, whatever the umask.

    Raises:
        LockedError: another process has it.
        OSError: its file cannot be opened.
    """
    while True:
        lock = _open(path, mode)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            text = lock.read(32).decode("ascii", "replace").strip()
            lock.close()
            raise LockedError(path, int(text) if text.isdecimal() else None) from None
        # Who had it may have removed the file between our opening and locking it.
        if path.exists() and path.stat().st_ino == os.fstat(lock.fileno()).st_ino:
            break
        lock.close()
    with contextlib.suppress(OSError):  # a full disk: the lock holds, without a name
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n".encode())
    return lock


def _open(path: Path, mode: int) -> FileIO:
    """Return the file, made if need be.

    Where it is there it is opened without O_CREAT: in a directory such as /tmp the kernel refuses
    that for another user's.
    """
    while True:
        try:
            return FileIO(os.open(path, _FLAGS), "r+")
        except FileNotFoundError:
            with contextlib.suppress(FileExistsError):
                descriptor = os.open(path, _FLAGS | os.O_CREAT | os.O_EXCL, mode)
                os.fchmod(descriptor, mode)
                return FileIO(descriptor, "r+")


_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class InterruptedRun(Exception):
    """Ctrl-C, or SIGTERM, or the terminal was closed; the message says which."""


class Signals:
    """Notes that a signal came; the run looks at it where it can end cleanly.

    An exception out of the handler could fall into the middle of anything, the end of the nodes
    among it. A signal that is ignored stays so: ``nohup`` ignores the end of the terminal, and a
    shell Ctrl-C for what it starts in the background.
    """

    def __init__(self) -> None:
        self._came: signal.Signals | None = None
        for number in _NUMBERS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    def _on_signal(self, signum: int, frame: Any) -> None:
        self._came = signal.Signals(signum)

    def ignore(self) -> None:
        """Take no further signal: the end of the interpreter would be ended by it."""
        for number in _NUMBERS:
            signal.signal(number, signal.SIG_IGN)

    def check(self) -> None:
        """Raise :class:`InterruptedRun` if a signal came."""
        if self._came is not None:
            raise InterruptedRun(f"interrupted by {self._came.name}")


def notify(*lines: str) -> None:
    """Tell systemd, where it is what started this process; elsewhere nothing happens.

    Args:
        lines: such as ``READY=1`` and ``STATUS=all nodes are here``.
    """
    path = os.environ.get("NOTIFY_SOCKET")
    if not path:
        return
    address = f"\0{path[1:]}" if path.startswith("@") else path  # a socket without a file
    # A service manager that is restarted, or slow, must not stop what it watches.
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto("\n".join(lines).encode(), address)
