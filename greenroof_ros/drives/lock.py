"""One driver for a drive: a lock that all programs and users of a machine share."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
from pathlib import Path

from greenroof_ros.drives.address import Address
from greenroof_ros.drives.drive_file import DriveFile
from greenroof_ros.drives.modbus_line import DriveError

_DIRECTORIES = (Path("/run/lock"), Path("/tmp"))
_FLAGS = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC


class HeldError(DriveError):
    """Another process has the lock.

    Attributes:
        holder: its number; None where it could not write it, on a full disk.
    """

    def __init__(self, message: str, holder: int | None) -> None:
        super().__init__("drive", message)
        self.holder = holder


class DriveLock:
    """Held by one process at a time; the kernel frees it, however that process ends.

    A serial line is one driver's, whatever devices are connected to it. A driver on another
    computer, or in a container with a file system of its own, is not kept off by it.
    """

    def __init__(self, file: DriveFile, address: Address) -> None:
        """Take nothing yet."""
        self._file, self._address = file, address
        self._open: tuple[int, Path] | None = None

    @property
    def taken(self) -> bool:
        """Whether this has it."""
        return self._open is not None

    def take(self) -> None:
        """Take it; may wait for the name of a host to be looked up.

        Raises:
            HeldError: another process has it.
            DriveError: its file cannot be opened, or the host is not known.
        """
        path = self._path()
        try:
            while True:
                lock = _open(path)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    text = os.read(lock, 32).decode("ascii", "replace").strip()
                    os.close(lock)
                    raise HeldError(
                        f"{self._address}: process {text or 'unknown'} of this machine runs this "
                        f"drive already (lock {path}); end that one, and this one goes on by "
                        "itself",
                        int(text) if text.isdecimal() else None,
                    ) from None
                # Who had it may have removed the file between our opening and locking it.
                if path.exists() and path.stat().st_ino == os.fstat(lock).st_ino:
                    break
                os.close(lock)
            self._open = lock, path
            with contextlib.suppress(OSError):  # a full disk: the lock holds, without a name
                os.ftruncate(lock, 0)
                os.write(lock, f"{os.getpid()}\n".encode())
        except OSError as error:
            raise DriveError(
                "drive",
                f"{self._address}: the lock {path} cannot be opened ({error.strerror}), without "
                "which two programs could run one drive; make it writable, or remove it",
            ) from error

    def release(self) -> None:
        """Give it back, if it was taken."""
        if self._open is not None:
            lock, path = self._open
            with contextlib.suppress(OSError):  # another user's file stays
                path.unlink()
            os.close(lock)
            self._open = None

    def _path(self) -> Path:
        """Return the file, by the same name for each way to write the address.

        Raises:
            DriveError: the host is not known.
        """
        address = self._address
        try:
            name = address.place(self._file.tcp.port)
        except OSError as error:
            raise DriveError(
                "connection", f"{address}: cannot connect: the host is not found ({error.strerror})"
            ) from error
        if not address.line:
            name += f"-{self._file.device_id_at(address)}"
        # Where not everybody may write, two users would each take another directory.
        shared = [each for each in _DIRECTORIES
                  if each.is_dir() and each.stat().st_mode & stat.S_IWOTH]
        return (shared or [_DIRECTORIES[-1]])[0] / (
            f"greenroof_ros-{re.sub('[^A-Za-z0-9.]+', '-', name.strip('/'))}.lock"
        )


def _open(path: Path) -> int:
    """Return a file that every user can open, made if need be.

    Where a file is there it is opened without O_CREAT: in a directory such as /tmp the kernel
    refuses that for another user's.
    """
    while True:
        try:
            return os.open(path, _FLAGS)
        except FileNotFoundError:
            with contextlib.suppress(FileExistsError):
                made = os.open(path, _FLAGS | os.O_CREAT | os.O_EXCL, 0o666)
                os.fchmod(made, 0o666)  # whatever the umask
                return made
