"""A connection to a device on Modbus TCP or RTU: its address, requests and responses.

Every response is checked, and every failure raises an error that names the device. The function
codes are 03 and 04 (read holding registers, input registers) and 06 (write single register) of the
Modbus Application Protocol V1.1b3. No request is repeated automatically, because the caller decides
how to handle a lost request. The module also encodes and decodes register values.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.mqtt import parse_host
from greenroof_ros.base.parameter import entry

if TYPE_CHECKING:
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient
    from pymodbus.pdu import ModbusPDU

# TCP port of a device, unless its address specifies one.
PORT = 502
# The number of registers that a value of each type takes.
WIDTHS = {
    "uint16": 1, "int16": 1, "uint32": 2, "int32": 2, "float32": 2, "uint64": 4, "int64": 4,
    "float64": 4,
}
WORD_ORDERS = ("", "high first", "low first")

# Its messages repeat ours, and without a handler they would go to the terminal.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

# The code of the function that writes a single register.
_WRITE = 6
# What to do about an exception of the device itself, rather than of its gateway (section 7).
_REMARKS = {2: ": the device answers, but has no such register; check its drive or sensor file"}


# --- addresses of devices -------------------------------------------------------------------------


@dataclass(frozen=True)
class Serial:
    """Settings of Modbus RTU with 8 data bits."""

    baud_rate: int = entry("baud rate (bits per second)", 1200, 1_000_000)
    parity: str = entry("parity of the line", choices=("even", "odd", "none"))
    stop_bits: int = entry("number of stop bits", 1, 2)
    device_id: int = entry("slave address of the device", 1, 247)

    def parity_letter(self, line: str) -> str:
        """Return the letter of the parity (E, O or N); a pseudo-terminal supports only N."""
        pseudo = os.path.realpath(line).startswith("/dev/pts/")
        return "N" if pseudo else self.parity[0].upper()

    def device_id_at(self, address: Address) -> int:
        """Return the unit identifier or slave address: that of the address, or this one."""
        return self.device_id if address.device_id is None else address.device_id


@dataclass(frozen=True)
class Address:
    """The address of a device.

    Attributes:
        host: host for Modbus TCP; empty for a serial line.
        port: port for Modbus TCP; None for 502.
        line: the serial line's device, such as ``/dev/ttyUSB0``; empty for TCP.
        gateway: whether the host and the port are those of a gateway to the device's serial port.
        device_id: unit identifier or slave address; None for the one in the device's file.
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
        """The interface of the device at this address.

        ``tcp`` is its own Ethernet port; ``serial`` is its serial port, reached directly or through
        a gateway. A drive has a communication timeout for each interface, and only the timeout of
        the interface in use protects the pump.
        """
        return "serial" if self.line or self.gateway else "tcp"

    @property
    def connection(self) -> str:
        """The serial line, by its real path, or the host and the port."""
        return os.path.realpath(self.line) if self.line else f"{self.host}:{self.port or PORT}"

    def canonical_name(self) -> str:
        """Return a name for the line, or the host and port, that is the same for all spellings.

        The call may block while the host name is resolved.

        Raises:
            OSError: if the host is unknown or no name server responds.
        """
        if self.line:
            return self.connection
        host = min(str(info[4][0]) for info in socket.getaddrinfo(self.host, None))
        return f"{host}-{self.port or PORT}"


def parse_address(text: str, key: str = "address") -> Address:
    """Return the address that a user specified.

    Args:
        text: ``tcp://HOST``, ``tcp://HOST:PORT``, ``gateway://HOST:PORT`` or the path of a serial
            line's device; if the unit identifier or slave address differs from that in the drive
            file, it is appended after a comma.
        key: name of the option or parameter, for messages.

    Raises:
        ConfigurationError: if the text is none of these.
    """
    where, comma, device_id = text.partition(",")
    scheme, host, port = parse_host(where) or ("", "", None)
    if scheme in ("tcp", "gateway"):
        address = Address(host, port, gateway=scheme == "gateway")
    elif where.startswith("/") and not where.endswith("/"):
        address = Address(line=where)
    else:
        raise ConfigurationError(
            "must be tcp://HOST, tcp://HOST:PORT, gateway://HOST:PORT, or a serial line such as "
            "/dev/ttyUSB0",
            key=key, value=text,
        )
    if not comma:
        return address
    low, high = (0, 255) if address.interface == "tcp" else (1, 247)
    if not re.fullmatch(r"[0-9]{1,3}", device_id) or not low <= int(device_id) <= high:
        raise ConfigurationError(
            f"must have a device id, {low} to {high}, after the comma", key=key, value=text
        )
    return replace(address, device_id=int(device_id))


# --- requests and answers -------------------------------------------------------------------------


class DriveError(Exception):
    """A failure of a drive or another device; the message names the device and the problem.

    Attributes:
        kind: ``connection`` (no connection, or no response), ``answer`` (an invalid response or a
            rejection) or ``drive`` (communication works, but the drive does not run).
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def check_installed() -> None:
    """Check that the Modbus library is installed.

    Raises:
        ConfigurationError: if the library is not installed.
    """
    with require_extra("pump"):
        import pymodbus.client  # noqa: F401 - only to see if it is there


class ModbusLine:
    """A connection to a device.

    Attributes:
        device_id: unit identifier or slave address of the device, to be changed for another one on
            the same line.
    """

    def __init__(self, address: Address, serial: Serial, timeout_s: float) -> None:
        """Prepare the connection without opening it.

        Args:
            address: address of the device.
            serial: settings of a serial line, and the device id if the address has none.
            timeout_s: maximum time to wait for a connection and for each response (s).

        Raises:
            ConfigurationError: if the Modbus library is not installed.
        """
        check_installed()
        from pymodbus.client import ModbusTcpClient

        self._address, self._timeout_s = address, timeout_s
        self.device_id = serial.device_id_at(address)
        # The bytes of the last request (True), and of what was received after it (False).
        self._frames = {True: b"", False: b""}
        self._client: ModbusTcpClient | ModbusSerialClient
        if address.line:
            self._client = _serial_client(address.line, serial, timeout_s, self._trace)
        else:
            self._client = ModbusTcpClient(
                address.host, port=address.port or PORT, timeout=timeout_s, retries=0,
                trace_packet=self._trace,
            )

    @property
    def where(self) -> str:
        """Address and device, for messages."""
        return f"{self._address}, device {self.device_id}"

    @property
    def connected(self) -> bool:
        """Whether the connection is open at this end."""
        return self._client.connected

    def connect(self) -> None:
        """Open the connection.

        Raises:
            DriveError: if the connection cannot be opened.
        """
        if not self._client.connect():
            raise self.error("connection", "cannot connect")
        if isinstance(plug := self._client.socket, socket.socket):
            plug.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    def close(self) -> None:
        """Close the connection.

        The connection is reset instead of being closed normally. A device with only one or two
        sockets can then accept a new connection immediately, and no late request can arrive.
        """
        self._client.close()  # type: ignore[no-untyped-call]

    def read(self, address: int, count: int, kind: str = "holding") -> list[int]:
        """Read registers of a kind: ``holding`` or ``input``.

        Raises:
            DriveError: if no valid response arrives.
        """
        read = getattr(self._client, f"read_{kind}_registers")
        function = 4 if kind == "input" else 3
        return self._request(f"reading register {address}", function, read, address, count=count)

    def write(self, address: int, word: int) -> None:
        """Write one holding register.

        Raises:
            DriveError: if no response arrives, or the response does not confirm the write.
        """
        action = f"writing 0x{word:04X} to register {address}"
        self._request(action, _WRITE, self._client.write_register, address, word)

    def _request(
        self, action: str, function: int, request: Callable[..., ModbusPDU], *values: int,
        **options: int,
    ) -> list[int]:
        """Send a request, and return the registers in the response, which must fit the request.

        The response to a write is the same as the request. Any other response with the bytes of the
        request is an echo.
        """
        from pymodbus.exceptions import ModbusException

        if not self.connected:
            raise self.error("connection", f"{action}: the connection was closed")
        self._frames[False] = b""
        try:
            answer = request(*values, device_id=self.device_id, **options)
        except (ModbusException, OSError) as error:
            if isinstance(error, ConnectionError):
                self.close()
            problem = "the connection was closed" if not self.connected else (
                f"no valid response within {self._timeout_s:.3g} s"
            )
            raise self.error("connection", f"{action}: {problem}") from error
        if answer.isError():
            code = answer.exception_code
            why = f"rejected with exception {code}{_REMARKS.get(code, '')}"
            raise self.error("answer", f"{action}: {why}")
        registers = list(answer.registers)
        fits = (answer.address, *registers) == values if function == _WRITE else (
            len(registers) == options["count"] and self._frames[True] not in self._frames[False]
        )
        if answer.function_code != function or not fits:
            raise self.error("answer", f"{action}: the response does not fit: {answer}")
        return registers

    def _trace(self, sending: bool, data: bytes) -> bytes:
        self._frames[sending] = data
        return data

    def error(self, kind: str, problem: str) -> DriveError:
        """Return an error that names the device and the problem."""
        return DriveError(kind, f"{self.where}: {problem}")


def _serial_client(
    line: str, settings: Serial, timeout_s: float, trace: Callable[[bool, bytes], bytes]
) -> ModbusSerialClient:
    """Return a client for a serial line that is not yet open."""
    from pymodbus.client import ModbusSerialClient
    from pymodbus.exceptions import ConnectionException

    class Client(ModbusSerialClient):
        def recv(self, size: int | None) -> bytes:
            """Return the bytes that arrive; pyserial limits the wait.

            Pymodbus measures the wait with the wall clock, so it would wait an hour longer if the
            clock were set back by an hour.
            """
            assert self.socket is not None
            try:
                first = self.socket.read(1)
                return bytes(first + self.socket.read(self.socket.in_waiting))
            except OSError as error:
                self.close()  # type: ignore[no-untyped-call]
                raise ConnectionException(str(error)) from error

    return Client(
        line, baudrate=settings.baud_rate, timeout=timeout_s, retries=0,
        parity=settings.parity_letter(line), stopbits=settings.stop_bits, trace_packet=trace,
    )


# --- values of registers --------------------------------------------------------------------------


def coding_mistakes(kind: str, word_order: str) -> Iterator[tuple[str, str]]:
    """Yield a mistake in ``word_order``, which only values of more than one word require."""
    if (WIDTHS.get(kind, 1) > 1) is not bool(word_order):
        yield "word_order", (
            "must be 'high first' or 'low first' for a number of 32 or 64 bits, and must be left "
            "out for any other value"
        )


def limits(kind: str) -> tuple[float, float]:
    """Return the minimum and the maximum value of an integer type."""
    bits = 16 * WIDTHS[kind]
    return (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


def decode(registers: Sequence[int], kind: str, word_order: str = "") -> int | float:
    """Return the number that registers encode."""
    from pymodbus.client.mixin import ModbusClientMixin

    value = ModbusClientMixin.convert_from_registers(
        registers, ModbusClientMixin.DATATYPE[kind.upper()],
        "little" if word_order == "low first" else "big",
    )
    assert isinstance(value, int | float)
    return value


def encode(value: float, kind: str, word_order: str = "") -> list[int]:
    """Return the registers that encode a number.

    For integer types, the number is rounded and limited to the range of the type.
    """
    from pymodbus.client.mixin import ModbusClientMixin

    if not kind.startswith("float"):
        low, high = limits(kind)
        value = int(min(max(round(value), low), high))
    return ModbusClientMixin.convert_to_registers(
        value, ModbusClientMixin.DATATYPE[kind.upper()],
        "little" if word_order == "low first" else "big",
    )
