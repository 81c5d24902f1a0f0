"""Whether a drive is this package's drive simulator: what it says of itself by function 43/14."""

from __future__ import annotations

from greenroof_ros.drives.address import Address
from greenroof_ros.drives.drive_file import DriveFile
from greenroof_ros.drives.modbus_line import DriveError, ModbusLine

VENDOR, PRODUCT = "greenroof_ros", "drive simulator"


def why_no_simulator(file: DriveFile, address: Address, timeout_s: float = 0.5) -> str:
    """Return why a drive is not, for certain, the drive simulator; empty where it is.

    Nothing is written to it, and nothing at all is sent to one that is not at loopback or a
    pseudo-terminal.

    Raises:
        DriveError: nobody answers there, of the kind ``connection``.
    """
    if not address.is_here:
        return f"{address} is neither at loopback nor a pseudo-terminal"
    line = ModbusLine(
        address, port=file.tcp.port, device_id=file.device_id_at(address), serial=file.serial,
        timeout_s=timeout_s,
    )
    try:
        line.connect()
        named = line.identification()
    except DriveError as error:
        if error.kind == "connection":
            raise
        return f"what is there does not identify itself as that ({error})"
    finally:
        line.close()
    if named == (VENDOR, PRODUCT):
        return ""
    return f"what is at {address} identifies itself as {named[0]!r}, {named[1]!r}"
