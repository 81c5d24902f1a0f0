"""One driver for a drive at a time, of all programs of this machine."""

from __future__ import annotations

import contextlib
import re
import stat
from io import FileIO
from pathlib import Path

from greenroof_ros.common.processes import LockedError, take_lock
from greenroof_ros.drives.modbus_line import DriveError
from greenroof_ros.drives.placed import Placed

# Where the locks are.
_DIRECTORIES = (Path("/run/lock"), Path("/tmp"))


class DriveInUseError(DriveError):
    """Another process has the lock.

    Attributes:
        holder: its number; None where it could not write it, on a full disk.
    """

    def __init__(self, message: str, holder: int | None) -> None:
        super().__init__("drive", message)
        self.holder = holder


class DriveLock:
    """One driver for a drive: one process of all users of this machine has it at a time.

    A serial line is one driver's, whatever devices are connected to it. A driver on another
    computer, or in a container with a file system of its own, is not kept off by it.
    """

    def __init__(self, drive: Placed) -> None:
        """Take nothing yet."""
        self._drive = drive
        self._lock: tuple[FileIO, Path] | None = None

    @property
    def locked(self) -> bool:
        """Whether this has it."""
        return self._lock is not None

    def take(self) -> None:
        """Take it; may wait for the name of a host to be looked up.

        Raises:
            DriveInUseError: another process has it.
            DriveError: its file cannot be opened, or the host is not known.
        """
        path = self._path()
        try:
            self._lock = take_lock(path, 0o666), path
        except LockedError as error:
            raise DriveInUseError(
                f"{self._drive}: process {error.holder or 'unknown'} of this machine runs this "
                f"drive already (lock {path}); end that process, and this one goes on by itself",
                error.holder,
            ) from None
        except OSError as error:
            raise DriveError(
                "drive",
                f"{self._drive}: the lock {path} cannot be opened ({error.strerror}), without "
                "which two programs could run one drive; make it writable, or remove it",
            ) from error

    def release(self) -> None:
        """Give it back, if it was taken."""
        if self._lock is not None:
            lock, path = self._lock
            with contextlib.suppress(OSError):  # another user's file stays
                path.unlink()
            lock.close()
            self._lock = None

    def _path(self) -> Path:
        """Return the file, by the same name for each way to write the address.

        Raises:
            DriveError: the host is not known.
        """
        try:
            name = self._drive.place_of_lock()
        except OSError as error:
            raise DriveError(
                "connection",
                f"{self._drive}: cannot connect: the host is not found ({error.strerror})",
            ) from error
        # Where not everybody may write, two users would each take another directory.
        shared = [directory for directory in _DIRECTORIES
                  if directory.is_dir() and directory.stat().st_mode & stat.S_IWOTH]
        return (shared or [_DIRECTORIES[-1]])[0] / (
            f"greenroof_ros-{re.sub('[^A-Za-z0-9.]+', '-', name)}.lock"
        )
