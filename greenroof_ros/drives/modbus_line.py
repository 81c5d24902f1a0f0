"""Requests to one device on Modbus TCP or RTU, every answer checked, every failure with a name.

Function codes 03 and 04 (read holding registers, input registers), 06 (write single register) and
43/14 (read device identification) of the Modbus Application Protocol V1.1b3. No request is sent
twice: who calls decides what a lost one means.
"""

from __future__ import annotations

import logging
import socket
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.drives.address import Address, Serial

if TYPE_CHECKING:
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient
    from pymodbus.pdu import ModbusPDU

# Its messages are ours in other words; without a handler they would go to the terminal.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

# A connection over which nothing gets through for so long is lost (s).
_LOST_S = 5
_OPTIONS = (
    (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, _LOST_S),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1),
    (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * _LOST_S),
)

# Section 7 of the specification.
_EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address: it has no such register",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledged, not yet done",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway: path unavailable",
    11: "gateway: the device behind it does not answer",
}


class DriveError(Exception):
    """What went wrong with a drive, or another device on Modbus; the message says what and where.

    Attributes:
        kind: ``connection`` (there is none, or no answer came), ``answer`` (one came that cannot
            be right, or says no) or ``drive`` (it works as it should, but the drive does not run).
    """

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


def check_installed() -> None:
    """See that there is a Modbus library.

    Raises:
        ConfigurationError: there is none.
    """
    try:
        import pymodbus.client  # noqa: F401 - only whether it is there
    except ModuleNotFoundError as error:
        raise ConfigurationError("needs pymodbus: pip install 'greenroof_ros[pump]'") from error


class ModbusLine:
    """One device on Modbus."""

    def __init__(
        self, address: Address, *, port: int, device_id: int, serial: Serial, timeout_s: float
    ) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            address: where it is.
            port: the TCP port, unless the address has one.
            device_id: unit identifier or slave address.
            serial: settings of a serial line.
            timeout_s: longest wait for a connection, and for each answer (s).

        Raises:
            ConfigurationError: there is no Modbus library.
        """
        check_installed()
        from pymodbus.client import ModbusTcpClient
        from pymodbus.exceptions import ModbusException

        self._errors = (ModbusException, OSError)
        self.where = f"{address}, device {device_id}"
        self._device_id = device_id
        self._timeout_s = timeout_s
        self._client: ModbusTcpClient | ModbusSerialClient
        if address.line:
            self._client = _serial_client(address.line, serial, timeout_s)
        else:
            self._client = ModbusTcpClient(
                address.host, port=address.port or port, timeout=timeout_s, retries=0
            )

    @property
    def connected(self) -> bool:
        """Whether the connection stands, as far as this end knows."""
        return self._client.connected

    def connect(self) -> None:
        """Open the connection.

        Raises:
            DriveError: it cannot be opened.
        """
        if not self._client.connect():
            raise DriveError("connection", f"{self.where}: cannot connect")
        try:
            self._set(*_OPTIONS)
        except OSError as error:  # it was closed meanwhile
            raise DriveError("connection", f"{self.where}: cannot connect: {error}") from error

    def close(self) -> None:
        """Close the connection.

        One over which a request was not answered is reset, instead of closed in good order: so a
        device with one socket or two has a free one at once, and no request that is still on its
        way arrives later.
        """
        self._client.close()  # type: ignore[no-untyped-call]

    def _set(self, *options: tuple[int, int, int | bytes]) -> None:
        """Set options of the socket, if there is one."""
        plug = self._client.socket
        if isinstance(plug, socket.socket):
            for level, option, value in options:
                plug.setsockopt(level, option, value)

    def read(self, address: int, count: int, *, inputs: bool = False) -> list[int]:
        """Read holding registers, or input registers.

        Raises:
            DriveError: no answer, or a wrong one.
        """
        what = f"reading register {address}" + (f" and {count - 1} more" if count > 1 else "")
        client = self._client
        read = client.read_input_registers if inputs else client.read_holding_registers
        answer = self._ask(what, 4 if inputs else 3, read, address, count=count)
        if len(answer.registers) != count:
            raise DriveError(
                "answer",
                f"{self.where}: {what}: {len(answer.registers)} registers came, not {count}",
            )
        return list(answer.registers)

    def write(self, address: int, word: int) -> None:
        """Write one holding register.

        Raises:
            DriveError: no answer, or one that does not say that it was written.
        """
        what = f"writing 0x{word:04X} to register {address}"
        answer = self._ask(what, 6, self._client.write_register, address, word)
        if answer.address != address or list(answer.registers) != [word]:
            raise DriveError(
                "answer",
                f"{self.where}: {what}: the answer speaks of {answer.registers} in register "
                f"{answer.address}",
            )

    def identification(self) -> tuple[str, str]:
        """Return the maker and the product that the device names, by function 43/14.

        Raises:
            DriveError: no answer, or a wrong one.
        """
        answer = self._ask(
            "reading its identification", 43, self._client.read_device_information
        )
        said = getattr(answer, "information", {})
        maker, product = (bytes(said.get(each, b"")).decode("latin-1") for each in (0, 1))
        return maker, product

    def _ask(
        self, what: str, function: int, request: Callable[..., ModbusPDU], *values: int,
        **options: int,
    ) -> ModbusPDU:
        """Return the answer to a request, if it is one to that function and no exception."""
        if not self.connected:
            raise DriveError("connection", f"{self.where}: {what}: the connection was closed")
        try:
            answer = request(*values, device_id=self._device_id, **options)
        except self._errors as error:
            raise self._silence(what, error) from error
        if answer.isError():
            code = answer.exception_code
            raise DriveError(
                "answer",
                f"{self.where}: {what}: refused with exception {code}, "
                f"{_EXCEPTIONS.get(code, 'unknown')}",
            )
        if answer.function_code != function:
            raise DriveError(
                "answer",
                f"{self.where}: {what}: the answer has function {answer.function_code}, not "
                f"{function}",
            )
        return answer

    def _silence(self, what: str, error: Exception) -> DriveError:
        if isinstance(error, ConnectionError):
            self.close()
        if not self.connected:
            return DriveError("connection", f"{self.where}: {what}: the connection was closed")
        self._set((socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)))
        return DriveError(
            "connection", f"{self.where}: {what}: no valid answer within {self._timeout_s:g} s"
        )


def _serial_client(line: str, settings: Serial, timeout_s: float) -> ModbusSerialClient:
    """Return a client of a serial line, which is not opened yet."""
    from pymodbus.client import ModbusSerialClient
    from pymodbus.exceptions import ConnectionException

    class Client(ModbusSerialClient):
        def recv(self, size: int | None) -> bytes:
            """Return what comes; the wait is pyserial's.

            Pymodbus waits by a clock that can be set, and so for an hour where it is set back by
            one.
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
        parity=settings.parity_letter(line), stopbits=settings.stop_bits,
    )
