"""Modbus servers of the simulators."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.live.devices.modbus_line import Address, Serial


def make_device(
    device_id: int, read: Callable[[], Mapping[int, int]],
    write: Callable[[int, Sequence[int]], ExcCodes | None] | None = None,
) -> SimDevice:
    """Return a device for a server.

    Args:
        device_id: unit identifier or slave address.
        read: function that returns the values of all registers of the device, by address.
        write: function that receives the first address and the values of a write request, and
            returns an exception code, or None for success; by default, nothing can be written.
    """

    async def action(
        function: int, start: int, address: int, count: int, current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        if values is not None:
            return ExcCodes.ILLEGAL_ADDRESS if write is None else write(address, values)
        # The answer to a write repeats what was written, even if the register now differs.
        if function in (3, 4):
            present, addresses = read(), range(address, address + count)
            if any(register not in present for register in addresses):
                return ExcCodes.ILLEGAL_ADDRESS
            current[address:address + count] = [present[register] for register in addresses]
        return None

    everything = SimData(0, count=65536, datatype=DataType.REGISTERS)
    return SimDevice(device_id, [everything], action=action)


@dataclass
class Server:
    """Server for the devices on a TCP port or a serial line; it can be closed and opened again.

    Attributes:
        address: TCP port or serial line; port 0 is replaced by a free port when the server opens.
        devices: devices on whose behalf the server responds.
        line: settings of a serial line; without effect on TCP.
        connection: function that makes the handler of a client's connection; None for pymodbus's.
    """

    address: Address
    devices: list[SimDevice]
    line: Serial
    connection: Callable[[Any], Any] | None = None
    _server: ModbusTcpServer | ModbusSerialServer | None = field(default=None, init=False)

    async def open(self) -> None:
        """Open the port or line if it is not open.

        Raises:
            ConfigurationError: if the port is in use, or the serial device does not exist.
        """
        if self._server is not None:
            return
        server: Any
        if self.address.line:
            server = ModbusSerialServer(
                self.devices, framer=FramerType.RTU, port=self.address.line,
                baudrate=self.line.baud_rate, parity=self.line.parity_letter(self.address.line),
                stopbits=self.line.stop_bits, bytesize=8,
            )
        else:
            server = ModbusTcpServer(
                self.devices, address=(self.address.host, self.address.port or 0)
            )
        if (connection := self.connection) is not None:
            server.callback_new_connection = lambda: connection(server)
        if not await server.listen():
            raise ConfigurationError(
                "cannot be opened: another program uses the port, the address does not belong to "
                "this computer, the serial device does not exist, or you lack permission",
                key="address", value=str(self.address),
            )
        if not self.address.line:
            port = server.transport.sockets[0].getsockname()[1]
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
