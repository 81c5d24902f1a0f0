"""Modbus servers for the simulators, which can be as bad as those of the real world."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import CommType

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.drives.address import Address, Serial
from greenroof_ros.simulators import faults

Read = Callable[[], dict[int, int]]
Write = Callable[[int, list[int]], ExcCodes | None]
_WRITES = (5, 6, 15, 16, 22, 23)


@dataclass
class Wire:
    """What is wrong with a connection; changed at run time.

    Attributes:
        fault: name of one of `faults.DRIVE_FAULTS`, as far as it concerns the wire.
        parameter: of the fault.
        deaf: tells whether it hears nothing at all, as where a device has no power.
        heard: is called for each request, also one that is refused.
        ignores: tells whether a device does not answer to a request for a register.
    """

    fault: str = "none"
    parameter: int = 0
    deaf: Callable[[], bool] = lambda: False
    heard: Callable[[], None] = lambda: None
    ignores: Callable[[int, int], bool] = lambda device, register: False
    random: random.Random = field(default_factory=lambda: random.Random(0))  # noqa: S311


def make_device(device_id: int, addresses: dict[int, bool], read: Read, write: Write) -> SimDevice:
    """Return a device whose registers are asked for and handed over at every request.

    Args:
        device_id: its unit identifier.
        addresses: of its registers, and whether each can be written.
        read: returns what all of them hold.
        write: takes the first address and the values of a write.
    """

    async def action(
        function: int, start: int, address: int, count: int, current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        if values is not None:
            refused = write(address, [int(value) for value in values])
            if refused is not None:
                return refused
        # The answer to a write repeats what was written, whatever the register then holds.
        if function not in _WRITES:
            held = read()
            for number in range(address, address + count):
                current[number - start] = held[number]
        return None

    return SimDevice(
        device_id,
        [
            SimData(address, datatype=DataType.REGISTERS, readonly=not addresses[address])
            for address in sorted(addresses)
        ],
        action=action,
    )


class _Handler(ServerRequestHandler):
    """One connection."""

    def __init__(self, server: Any, wire: Wire, device_ids: set[int]) -> None:
        super().__init__(server, None, None, None)  # type: ignore[no-untyped-call]
        self._wire, self._device_ids = wire, device_ids

    @property
    def _serial(self) -> bool:
        return self.comm_params.comm_type == CommType.SERIAL

    def data_received(self, data: bytes) -> None:
        """Take in bytes, or do not."""
        if self._wire.fault == "dropped":
            if not self._serial:
                self.transport.abort()  # type: ignore[attr-defined]
        elif not self._wire.deaf() and self._wire.fault != "half_open":
            super().data_received(data)

    async def handle_request(self) -> None:
        """Hand a request to the device that it names."""
        request = self.last_pdu
        if request is None:
            return
        if request.dev_id not in self._device_ids:
            if not self._serial:  # as a gateway; on a line another device may be meant
                self._refuse(request, ExcCodes.GATEWAY_NO_RESPONSE)
            return
        if self._wire.ignores(request.dev_id, request.address):
            return
        self._wire.heard()
        refuses_writes = self._wire.fault == "refused_writes" and request.function_code in _WRITES
        if refuses_writes or self._wire.fault == "exception":
            self._refuse(request, self._wire.parameter)
            return
        await super().handle_request()  # type: ignore[no-untyped-call]

    def _refuse(self, request: ModbusPDU, code: int) -> None:
        response = ExceptionResponse(
            request.function_code, code, device_id=request.dev_id,
            transaction=request.transaction_id,
        )
        self.pdu_send(response)

    def pdu_send(self, pdu: ModbusPDU, addr: Any = None) -> None:
        """Send an answer, or what the fault makes of it."""
        fault, parameter = self._wire.fault, self._wire.parameter
        device_id = pdu.dev_id
        content = bytes([pdu.function_code]) + pdu.encode()
        if fault == "silence":
            return
        if fault == "wrong_unit":
            device_id = device_id % 247 + 1
        elif fault == "wrong_function":
            content = bytes([content[0] + 1]) + content[1:]
        elif fault == "wrong_length":
            content = content[:-1]
        frame = self.framer.encode(content, device_id, pdu.transaction_id)
        if fault == "garbage":
            frame = self._wire.random.randbytes(parameter)
        if fault in ("slow", "late"):
            self.loop.call_later(parameter / 1000, self._put, frame)
        elif fault == "split":
            for number in range(len(frame)):
                self.loop.call_later(
                    number * parameter / 1000, self._put, frame[number:number + 1]
                )
        else:
            self._put(frame)

    def _put(self, data: bytes) -> None:
        if self.transport is not None:
            self.transport.write(data)  # type: ignore[attr-defined]


def make_workbench(
    address: Address, read: Callable[[], list[int]], put: Callable[[int, int], bool]
) -> FaultyServer:
    """Return the server of a workbench.

    Args:
        address: TCP port; port 0 takes a free one.
        read: returns what all registers hold.
        put: takes a register and what is written to it, but to that of the speed; tells whether it
            can be so.
    """

    def write(address: int, values: list[int]) -> ExcCodes | None:
        good = all(put(register, value) for register, value in enumerate(values, start=address))
        return None if good else ExcCodes.ILLEGAL_VALUE

    writable = {register: register != faults.SPEED for register in range(len(read()))}
    return FaultyServer(
        address, Serial(19200, "even", 1, faults.DEVICE_ID),
        [make_device(faults.DEVICE_ID, writable, lambda: dict(enumerate(read())), write)],
    )


class FaultyServer:
    """A server of devices on a TCP port or a serial line, which can be closed and opened again.

    Attributes:
        address: where it is; its port is known when it was opened.
        wire: what is wrong with it.
    """

    def __init__(
        self, address: Address, line: Serial, devices: list[SimDevice], wire: Wire | None = None,
        identity: tuple[str, str] | None = None,
    ) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            address: TCP port or serial line; port 0 takes a free one.
            line: settings of the serial line.
            devices: that are there.
            wire: what is wrong with it; nothing if None.
            identity: maker and product that function 43/14 names; one for all servers of a process.
        """
        self.address, self._line, self._devices = address, line, devices
        self.wire = wire or Wire()
        self._identity = None
        if identity is not None:
            self._identity = ModbusDeviceIdentification(  # type: ignore[no-untyped-call]
                dict(enumerate(identity))
            )
        self._server: ModbusTcpServer | ModbusSerialServer | None = None

    async def open(self) -> None:
        """Accept connections.

        Raises:
            ConfigurationError: the port is taken, or there is no such device.
        """
        wire, device_ids = self.wire, {device.id for device in self._devices}

        class Tcp(ModbusTcpServer):
            def callback_new_connection(self) -> _Handler:
                return _Handler(self, wire, device_ids)

        class Rtu(ModbusSerialServer):
            def callback_new_connection(self) -> _Handler:
                return _Handler(self, wire, device_ids)

        if self.address.line:
            server: ModbusTcpServer | ModbusSerialServer = Rtu(
                self._devices, framer=FramerType.RTU, port=self.address.line,
                baudrate=self._line.baud_rate, parity=self._line.parity_letter(self.address.line),
                stopbits=self._line.stop_bits, bytesize=8, identity=self._identity,
            )
        else:
            server = Tcp(
                self._devices, identity=self._identity,
                address=(self.address.host, self.address.port or 0),
            )
        if not await server.listen():
            raise ConfigurationError(
                "cannot be opened: the port is taken, not of this machine, or not allowed; or "
                "there is no such serial device",
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

    async def be_open(self, wanted: bool) -> None:
        """Open or close it, if it is not so already; a serial line stays open."""
        if self.address.line:
            return
        if wanted and self._server is None:
            await self.open()
        elif not wanted:
            self.close()
