"""A lock: only one program on this machine may drive a drive at a time."""

from __future__ import annotations

import contextlib
import re
import stat
from io import FileIO
from pathlib import Path

from greenroof_ros.common.processes import LockedError, take_lock
from greenroof_ros.drives.modbus_line import DriveError
from greenroof_ros.drives.placed import Placed

# Directories of the lock files.
_DIRECTORIES = (Path("/run/lock"), Path("/tmp"))


class DriveInUseError(DriveError):
    """Another process has the lock.

    Attributes:
        holder: its process id; None if it could not be written, because the disk is full.
    """

    def __init__(self, message: str, holder: int | None) -> None:
        super().__init__("drive", message)
        self.holder = holder


class DriveLock:
    """The lock of a drive: one process at a time holds it, among all users of this machine.

    A serial line is locked as a whole, with all devices on it. The lock does not keep off a driver
    on another computer, or in a container with its own file system.
    """

    def __init__(self, drive: Placed) -> None:
        """Prepare the lock without taking it."""
        self._drive = drive
        self._lock: tuple[FileIO, Path] | None = None

    @property
    def locked(self) -> bool:
        """Whether this object holds the lock."""
        return self._lock is not None

    def take(self) -> None:
        """Take the lock; may block while a host name is resolved.

        Raises:
            DriveInUseError: another process has it.
            DriveError: the lock file cannot be opened, or the host is unknown.
        """
        path = self._path()
        try:
            self._lock = take_lock(path, 0o666), path
        except LockedError as error:
            raise DriveInUseError(
                f"{self._drive}: process {error.holder or 'unknown'} on this machine already runs "
                f"this drive (lock {path}); end that process and this one continues by itself",
                error.holder,
            ) from None
        except OSError as error:
            raise DriveError(
                "drive",
                f"{self._drive}: the lock {path} cannot be opened ({error.strerror}); without it "
                "two programs could run the same drive; make it writable, or remove it",
            ) from error

    def release(self) -> None:
        """Release the lock, if it was taken."""
        if self._lock is not None:
            lock, path = self._lock
            with contextlib.suppress(OSError):  # another user's file cannot be removed
                path.unlink()
            lock.close()
            self._lock = None

    def _path(self) -> Path:
        """Return the lock file; its name does not depend on how the address is written.

        Raises:
            DriveError: the host is unknown.
        """
        try:
            name = self._drive.place_of_lock()
        except OSError as error:
            raise DriveError(
                "connection",
                f"{self._drive}: cannot connect: the host is not found ({error.strerror})",
            ) from error
        # Only directories writable for all users: otherwise two users could use different ones.
        shared = [directory for directory in _DIRECTORIES
                  if directory.is_dir() and directory.stat().st_mode & stat.S_IWOTH]
        return (shared or [_DIRECTORIES[-1]])[0] / (
            f"greenroof_ros-{re.sub('[^A-Za-z0-9.]+', '-', name)}.lock"
        )
