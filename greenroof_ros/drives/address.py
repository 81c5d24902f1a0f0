"""Where a device on Modbus is: a TCP port, a gateway, or a serial line."""

from __future__ import annotations

import contextlib
import re
import socket
from dataclasses import dataclass, replace
from ipaddress import ip_address
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.records import entry

_TCP = re.compile(
    r"(?P<scheme>tcp|gateway)://(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:]+\])(:(?P<port>\d{1,5}))?/?"
)


def _is_pseudo(line: str) -> bool:
    return Path(line).resolve().is_relative_to("/dev/pts")


@dataclass(frozen=True)
class Serial:
    """Modbus RTU, 8 data bits."""

    baud_rate: int = entry("bits per second", 1200, 1_000_000)
    parity: str = entry("parity bit", choices=("even", "odd", "none"))
    stop_bits: int = entry("stop bits", 1, 2)
    device_id: int = entry("slave address", 1, 247)

    def parity_letter(self, line: str) -> str:
        """Return E, O or N for a line; a pseudo-terminal knows no parity and refuses it."""
        return "N" if _is_pseudo(line) else self.parity[0].upper()


@dataclass(frozen=True)
class Address:
    """Where a device is reached.

    Attributes:
        host: of Modbus TCP; empty for a serial line.
        port: of Modbus TCP; None for the one that the device's file names.
        line: the serial line's device, such as ``/dev/ttyUSB0``; empty for TCP.
        gateway: host and port are those of a gateway to the device's serial port.
        device_id: unit identifier or slave address; None for the one that the device's file names.
    """

    host: str = ""
    port: int | None = None
    line: str = ""
    gateway: bool = False
    device_id: int | None = None

    def __str__(self) -> str:
        device = "" if self.device_id is None else f",{self.device_id}"
        if self.line:
            return self.line + device
        scheme = "gateway" if self.gateway else "tcp"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{scheme}://{host}" + (f":{self.port}" if self.port is not None else "") + device

    @property
    def interface(self) -> str:
        """Return which interface of the device is reached.

        ``tcp`` is its own Ethernet port, ``serial`` its serial port, be it through a gateway. A
        drive has a communication timeout for each, and only that of the one in use guards.
        """
        return "serial" if self.line or self.gateway else "tcp"

    @property
    def is_here(self) -> bool:
        """Whether it is at loopback or a pseudo-terminal; may wait for a host to be looked up."""
        if self.line:
            return _is_pseudo(self.line)
        with contextlib.suppress(OSError):
            return all(ip_address(host).is_loopback for host in self._hosts())
        return False

    def shares_line(self, other: Address) -> bool:
        """Whether both are on one serial line, by whatever name; one program alone can open it."""
        return bool(self.line and other.line) and (
            Path(self.line).resolve() == Path(other.line).resolve()
        )

    def place(self, port: int) -> str:
        """Return where it leads, by the same name for each way to write it, but for the device.

        May wait for the name of a host to be looked up.

        Args:
            port: the TCP port, unless the address has one.

        Raises:
            OSError: there is no such host, or nobody who knows it answers.
        """
        if self.line:
            return str(Path(self.line).resolve())
        return f"{min(self._hosts())}-{self.port or port}"

    def _hosts(self) -> set[str]:
        """Return the addresses of the host."""
        try:
            return {str(each[4][0]) for each in socket.getaddrinfo(self.host, None)}
        except UnicodeError as error:  # no name that a host can have
            raise OSError(None, str(error)) from error


def parse_address(text: str, key: str = "address") -> Address:
    """Return the address that a user wrote.

    Args:
        text: ``tcp://HOST``, ``tcp://HOST:PORT``, ``gateway://HOST:PORT`` or the path of a serial
            line's device.
        key: the option or parameter, for messages.

    Raises:
        ConfigurationError: it is none of these.
    """
    found = _TCP.fullmatch(text)
    if found is not None:
        port = int(found["port"]) if found["port"] else None
        if port is None or 0 < port < 65536:
            return Address(found["host"].strip("[]"), port, gateway=found["scheme"] == "gateway")
    elif text.startswith("/") and not text.endswith("/"):
        return Address(line=text)
    raise ConfigurationError(
        "must be tcp://HOST, tcp://HOST:PORT, gateway://HOST:PORT, or a serial line such as "
        "/dev/ttyUSB0",
        key=key, value=text,
    )


def parse_drive_address(text: str, key: str) -> Address:
    """Return the address of a drive that a user wrote: as any, and perhaps its device id.

    Args:
        text: see `parse_address`; after a comma the unit identifier or slave address, where that is
            not the one of the drive's file.
        key: the option or parameter, for messages.

    Raises:
        ConfigurationError: it is none of these.
    """
    place, comma, device_id = text.rpartition(",")
    if not comma:
        return parse_address(text, key)
    address = parse_address(place, key)
    low, high = (0, 255) if address.interface == "tcp" else (1, 247)
    if not re.fullmatch(r"[0-9]{1,3}", device_id) or not low <= int(device_id) <= high:
        raise ConfigurationError(
            f"after the comma must be the drive's device id, {low} to {high}", key=key, value=text
        )
    return replace(address, device_id=int(device_id))
