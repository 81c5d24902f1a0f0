"""Where a device on Modbus is: a TCP port, a gateway, or a serial line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.records import Entry

_TCP = re.compile(
    r"(?P<scheme>tcp|gateway)://(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:]+\])(:(?P<port>\d{1,5}))?/?"
)


@dataclass(frozen=True)
class Serial:
    """Modbus RTU, 8 data bits."""

    baud_rate: Annotated[int, Entry("bits per second", low=1200, high=1_000_000)]
    parity: Annotated[str, Entry("parity bit", choices=("even", "odd", "none"))]
    stop_bits: Annotated[int, Entry("stop bits", low=1, high=2)]
    device_id: Annotated[int, Entry("slave address", low=1, high=247)]

    def parity_letter(self, line: str) -> str:
        """Return E, O or N for a line; a pseudo-terminal knows no parity and refuses it."""
        pseudo = Path(line).resolve().is_relative_to("/dev/pts")
        return "N" if pseudo else self.parity[0].upper()


@dataclass(frozen=True)
class Address:
    """Where a device is reached.

    Attributes:
        host: of Modbus TCP; empty for a serial line.
        port: of Modbus TCP; None for the one that the device's file names.
        line: the serial line's device, such as ``/dev/ttyUSB0``; empty for TCP.
        gateway: host and port are those of a gateway to the device's serial port.
    """

    host: str = ""
    port: int | None = None
    line: str = ""
    gateway: bool = False

    def __str__(self) -> str:
        if self.line:
            return self.line
        scheme = "gateway" if self.gateway else "tcp"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{scheme}://{host}" + (f":{self.port}" if self.port is not None else "")

    @property
    def interface(self) -> str:
        """Return which interface of the device is reached.

        ``tcp`` is its own Ethernet port, ``serial`` its serial port, be it through a gateway. A
        drive has a communication timeout for each, and only that of the one in use guards.
        """
        return "serial" if self.line or self.gateway else "tcp"


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
