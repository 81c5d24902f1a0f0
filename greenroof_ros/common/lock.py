"""A lock that one process has at a time; the kernel frees it, however that process ends."""

from __future__ import annotations

import contextlib
import fcntl
import os
from io import FileIO
from pathlib import Path

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
                made = os.open(path, _FLAGS | os.O_CREAT | os.O_EXCL, mode)
                os.fchmod(made, mode)
                return FileIO(made, "r+")
