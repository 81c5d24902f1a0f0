"""A lock that allows only one program at a time on this computer to control a drive."""

from __future__ import annotations

import socket

from greenroof_ros.base.processes import LockedError, acquire_name_lock
from greenroof_ros.live.devices.endpoint import Endpoint
from greenroof_ros.live.devices.modbus_line import DriveError


class DriveInUseError(DriveError):
    """Error for a drive that another process controls.

    Attributes:
        holder: id of the process that holds the lock; None if it is unknown.
    """

    def __init__(self, message: str, holder: int | None) -> None:
        super().__init__("drive", message)
        self.holder = holder


def acquire_drive_lock(drive: Endpoint) -> socket.socket:
    """Acquire the lock of a drive, and return it; closing the socket releases the lock.

    Only one process on this machine, regardless of its user, can hold the lock at a time. A serial
    line is locked as a whole, with all devices on it. The lock does not exclude a driver on another
    computer, or in a container with its own network.

    Raises:
        DriveInUseError: if another process holds the lock.
        DriveError: if the system denies the lock or the host is unknown.
    """
    try:
        name = drive.lock_name()
    except OSError as error:
        raise DriveError(
            "connection", f"{drive}: cannot connect: the host was not found ({error.strerror})"
        ) from error
    try:
        return acquire_name_lock(f"drive-{name}")
    except LockedError as error:
        raise DriveInUseError(
            f"{drive}: process {error.holder or 'unknown'} on this computer is already running "
            "this drive; once that process ends, this one continues automatically", error.holder,
        ) from None
    except OSError as error:
        raise DriveError(
            "drive",
            f"{drive}: its lock cannot be acquired ({error.strerror}); without the lock, two "
            "programs could run the same drive",
        ) from error
