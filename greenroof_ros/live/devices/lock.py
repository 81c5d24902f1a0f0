"""A lock: only one program on this machine may drive a drive at a time."""

from __future__ import annotations

import socket

from greenroof_ros.common.processes import LockedError, acquire_name_lock
from greenroof_ros.live.devices.endpoint import Endpoint
from greenroof_ros.live.devices.modbus_line import DriveError


class DriveInUseError(DriveError):
    """Another process has the lock.

    Attributes:
        holder: its process id; None if it is unknown.
    """

    def __init__(self, message: str, holder: int | None) -> None:
        super().__init__("drive", message)
        self.holder = holder


class DriveLock:
    """The lock of a drive: one process at a time holds it, among all users of this machine.

    A serial line is locked as a whole, with all devices on it. The lock does not keep off a driver
    on another computer, or in a container with its own network.
    """

    def __init__(self, drive: Endpoint) -> None:
        """Prepare the lock without acquiring it."""
        self._drive = drive
        self._lock: socket.socket | None = None

    @property
    def locked(self) -> bool:
        """Whether this object holds the lock."""
        return self._lock is not None

    def acquire(self) -> None:
        """Acquire the lock; may block while a host name is resolved.

        Raises:
            DriveInUseError: another process has it.
            DriveError: the system refuses the lock, or the host is unknown.
        """
        place = self._name()
        try:
            self._lock = acquire_name_lock(f"drive-{place}")
        except LockedError as error:
            raise DriveInUseError(
                f"{self._drive}: process {error.holder or 'unknown'} on this machine already runs "
                "this drive; end that process and this one continues automatically",
                error.holder,
            ) from None
        except OSError as error:
            raise DriveError(
                "drive",
                f"{self._drive}: its lock cannot be acquired ({error.strerror}); without it two "
                "programs could run the same drive",
            ) from error

    def release(self) -> None:
        """Release the lock, if it was acquired."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _name(self) -> str:
        """Return the name of the lock, which does not depend on how the address is written.

        Raises:
            DriveError: the host is unknown.
        """
        try:
            return self._drive.lock_name()
        except OSError as error:
            raise DriveError(
                "connection",
                f"{self._drive}: cannot connect: the host is not found ({error.strerror})",
            ) from error
