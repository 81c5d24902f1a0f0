"""Modbus servers of the simulators."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import CommType

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.live.devices.modbus_line import Address, Serial

WRITES = (5, 6, 15, 16, 22, 23)


@dataclass(frozen=True)
class Device:
    """A device on the wire.

    Attributes:
        read: function that returns the values of all registers of the device, by address.
        write: function that receives the first address and the values of a write request, and
            returns an exception code, or None for success.
        on_request: callback for every request; it receives the address of the first register, and
            returns whether to respond to the request.
    """

    read: Callable[[], Mapping[int, int]]
    write: Callable[[int, list[int]], ExcCodes | None] = (
        lambda address, values: ExcCodes.ILLEGAL_ADDRESS
    )
    on_request: Callable[[int], bool] = lambda register: True

    def on_wire(self, device_id: int) -> SimDevice:
        """Return the device for pymodbus, with all registers, which are read on request."""

        async def action(
            function: int, start: int, address: int, count: int, current: list[int],
            values: list[int] | list[bool] | None,
        ) -> ExcCodes | None:
            if values is not None:
                return self.write(address, [int(value) for value in values])
            # The answer to a write repeats what was written, even if the register now differs.
            if function not in WRITES:
                present, addresses = self.read(), range(address, address + count)
                if any(register not in present for register in addresses):
                    return ExcCodes.ILLEGAL_ADDRESS
                current[address:address + count] = [present[register] for register in addresses]
            return None

        everything = SimData(0, count=65536, datatype=DataType.REGISTERS)
        return SimDevice(device_id, [everything], action=action)


class Connection(ServerRequestHandler):
    """The server side of a connection to a client."""

    def __init__(self, server: Any, devices: Mapping[int, Device]) -> None:
        super().__init__(server, None, None, None)  # type: ignore[no-untyped-call]
        self._devices = devices
        self._serial = self.comm_params.comm_type == CommType.SERIAL

    async def handle_request(self) -> None:
        """Pass a request to the device that it addresses."""
        request = self.last_pdu
        if request is None:
            return
        device = self._devices.get(request.dev_id)
        if device is None:
            if not self._serial:  # as a gateway does; a line may have other devices on it
                self.refuse(request, ExcCodes.GATEWAY_NO_RESPONSE)
        elif device.on_request(request.address):
            await super().handle_request()  # type: ignore[no-untyped-call]

    def refuse(self, request: ModbusPDU, code: int) -> None:
        """Respond to a request with an exception."""
        self.pdu_send(ExceptionResponse(
            request.function_code, code, device_id=request.dev_id,
            transaction=request.transaction_id,
        ))


@dataclass
class Server:
    """Server for the devices on a TCP port or a serial line; it can be closed and opened again.

    Attributes:
        address: TCP port or serial line; port 0 is replaced by a free port when the server opens.
        devices: devices on whose behalf the server responds, by unit identifier or slave address.
        line: settings of a serial line; not needed on TCP.
        connection: function that creates the handler for a client's connection.
    """

    address: Address
    devices: Mapping[int, Device]
    line: Serial | None = None
    connection: Callable[[Any, Mapping[int, Device]], Connection] = Connection
    _server: ModbusTcpServer | ModbusSerialServer | None = field(default=None, init=False)

    async def open(self) -> None:
        """Open the port or line if it is not open.

        Raises:
            ConfigurationError: if the port is in use, or the serial device does not exist.
        """
        if self._server is not None:
            return
        devices = [device.on_wire(number) for number, device in self.devices.items()]
        server: ModbusTcpServer | ModbusSerialServer
        if self.address.line:
            assert self.line is not None
            server = ModbusSerialServer(
                devices, framer=FramerType.RTU, port=self.address.line,
                baudrate=self.line.baud_rate, parity=self.line.parity_letter(self.address.line),
                stopbits=self.line.stop_bits, bytesize=8,
            )
        else:
            server = ModbusTcpServer(
                devices, address=(self.address.host, self.address.port or 0)
            )
        server.callback_new_connection = (  # type: ignore[method-assign]
            lambda: self.connection(server, self.devices)
        )
        if not await server.listen():
            raise ConfigurationError(
                "cannot be opened: another program uses the port, the address does not belong to "
                "this computer, the serial device does not exist, or you lack permission",
                key="address", value=str(self.address),
            )
        if not self.address.line:
            port = server.transport.sockets[0].getsockname()[1]  # type: ignore[attr-defined]
            self.address = Address(self.address.host, port)
        self._server = server

    def close(self) -> None:
        """Close the port and every connection."""
        if self._server is not None:
            for connection in list(self._server.active_connections.values()):
                if isinstance(connection.transport, asyncio.WriteTransport):
                    connection.transport.abort()
            self._server.close()
            self._server = None
