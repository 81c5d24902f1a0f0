"""Modbus servers with the faults of real ones, and the base of the simulators that have them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import random
import signal
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
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
from greenroof_ros.live.devices.modbus_line import Address, Serial
from greenroof_ros.live.simulators import faults

_WRITES = (5, 6, 15, 16, 22, 23)


@dataclass
class ActiveFault:
    """The present fault; changed at run time.

    Attributes:
        name: of one of `faults.DRIVE_FAULTS` or `faults.SITE_FAULTS`; this module makes the faults
            of the wire.
        parameter: of the fault.
    """

    name: str = faults.NONE
    parameter: int = 0


@dataclass(frozen=True)
class Device:
    """A device on the wire.

    Attributes:
        read: returns all its registers, by address.
        write: takes the first address and the values of a write; returns an error code, or None.
        on_request: called for each request with its first register; returns whether to answer it.
    """

    read: Callable[[], Mapping[int, int]]
    write: Callable[[int, list[int]], ExcCodes | None] = (
        lambda address, values: ExcCodes.ILLEGAL_ADDRESS
    )
    on_request: Callable[[int], bool] = lambda register: True

    def on_wire(self, device_id: int) -> SimDevice:
        """Return it for pymodbus: every register exists, and is read when a client asks."""

        async def action(
            function: int, start: int, address: int, count: int, current: list[int],
            values: list[int] | list[bool] | None,
        ) -> ExcCodes | None:
            if values is not None:
                return self.write(address, [int(value) for value in values])
            # The answer to a write repeats what was written, even if the register now differs.
            if function not in _WRITES:
                present, addresses = self.read(), range(address, address + count)
                if any(register not in present for register in addresses):
                    return ExcCodes.ILLEGAL_ADDRESS
                current[address:address + count] = [present[register] for register in addresses]
            return None

        everything = SimData(0, count=65536, datatype=DataType.REGISTERS)
        return SimDevice(device_id, [everything], action=action)


class _Connection(ServerRequestHandler):
    """One connection of a client."""

    _random = random.Random(0)  # noqa: S311 - garbage, not a secret

    def __init__(self, server: Any, devices: Mapping[int, Device], fault: ActiveFault) -> None:
        super().__init__(server, None, None, None)  # type: ignore[no-untyped-call]
        self._devices, self._fault = devices, fault
        self._serial = self.comm_params.comm_type == CommType.SERIAL
        self._started_at = time.monotonic()

    async def handle_request(self) -> None:
        """Pass a request to the device that it addresses."""
        request, fault = self.last_pdu, self._fault
        if request is None or fault.name == "half_open":
            return
        if fault.name == "echo":
            self.pdu_send(request)
            return
        device = self._devices.get(request.dev_id)
        refused = fault.name == "exception" or (
            fault.name == "refused_writes" and request.function_code in _WRITES
        )
        lasts_s = fault.parameter if fault.name == "runs_on" else 0
        lasted = 0 < lasts_s < time.monotonic() - self._started_at
        # 'runs_on' never ends a connection at an order: *stop* must be known to have arrived.
        if fault.name == "dropped" or (lasted and request.function_code not in _WRITES):
            if not self._serial:
                self.transport.abort()  # type: ignore[attr-defined]
        elif device is None:
            if not self._serial:  # as a gateway does; a line may have other devices
                self._refuse(request, ExcCodes.GATEWAY_NO_RESPONSE)
        elif device.on_request(request.address):
            if refused:
                self._refuse(request, fault.parameter)
            else:
                await super().handle_request()  # type: ignore[no-untyped-call]

    def _refuse(self, request: ModbusPDU, code: int) -> None:
        self.pdu_send(ExceptionResponse(
            request.function_code, code, device_id=request.dev_id,
            transaction=request.transaction_id,
        ))

    def pdu_send(self, pdu: ModbusPDU, addr: Any = None) -> None:
        """Send an answer, altered by the present fault."""
        fault, device_id = self._fault, pdu.dev_id
        content = bytes([pdu.function_code]) + pdu.encode()
        match fault.name:
            case "wrong_unit":
                device_id = device_id % 247 + 1
            case "wrong_function":
                content = bytes([content[0] + 1]) + content[1:]
            case "wrong_length":
                content = content[:-1]
        frame = self.framer.encode(content, device_id, pdu.transaction_id)
        match fault.name:
            case "silence":
                return
            case "garbage":
                self._write_data(self._random.randbytes(fault.parameter))
            case "slow" | "late":
                self.loop.call_later(fault.parameter / 1000, self._write_data, frame)
            case "split":
                for number in range(len(frame)):
                    delay = number * fault.parameter / 1000
                    self.loop.call_later(delay, self._write_data, frame[number:number + 1])
            case _:
                self._write_data(frame)

    def _write_data(self, data: bytes) -> None:
        if self.transport is not None:
            self.transport.write(data)  # type: ignore[attr-defined]


@dataclass
class Server:
    """Devices on a TCP port or a serial line, which can be closed and opened again.

    Attributes:
        address: TCP port or serial line; port 0 takes a free one, known once it is open.
        devices: on it, by unit identifier or slave address.
        line: settings of a serial line; not needed on TCP.
        fault: of the wire.
        identity: maker and product for function 43/14; shared by all servers of a process.
    """

    address: Address
    devices: Mapping[int, Device]
    line: Serial | None = None
    fault: ActiveFault = field(default_factory=ActiveFault)
    identity: tuple[str, str] | None = None
    _server: ModbusTcpServer | ModbusSerialServer | None = field(default=None, init=False)

    async def set_open(self, wanted: bool) -> None:
        """Open or close the port, if needed; a serial line is opened and then stays open.

        Raises:
            ConfigurationError: the port is in use, or there is no such device.
        """
        if wanted and self._server is None:
            await self._open()
        elif not wanted and not self.address.line:
            self.close()

    async def _open(self) -> None:
        devices = [device.on_wire(number) for number, device in self.devices.items()]
        named = None
        if self.identity is not None:
            named = ModbusDeviceIdentification(  # type: ignore[no-untyped-call]
                dict(enumerate(self.identity))
            )
        server: ModbusTcpServer | ModbusSerialServer
        if self.address.line:
            assert self.line is not None
            server = ModbusSerialServer(
                devices, framer=FramerType.RTU, port=self.address.line, identity=named,
                baudrate=self.line.baud_rate, parity=self.line.parity_letter(self.address.line),
                stopbits=self.line.stop_bits, bytesize=8,
            )
        else:
            server = ModbusTcpServer(
                devices, address=(self.address.host, self.address.port or 0), identity=named
            )
        server.callback_new_connection = (  # type: ignore[method-assign]
            lambda: _Connection(server, self.devices, self.fault)
        )
        if not await server.listen():
            raise ConfigurationError(
                "cannot be opened: another program uses the port, the address is not one of this "
                "machine, or you may not use it; or there is no such serial device",
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


class PseudoLine:
    """A simulated serial line: two pseudo-terminals, joined.

    Attributes:
        ends: the paths of its two ends, each a device that can be opened as a serial line.
    """

    def __init__(self) -> None:
        """Open both ends."""
        pairs = [pty.openpty() for _ in range(2)]
        for _, device in pairs:
            tty.setraw(device)
        # The devices stay open here, so an end can be closed and opened again.
        self._masters, self._devices = zip(*pairs, strict=True)
        self.ends = tuple(os.ttyname(device) for device in self._devices)
        for master in self._masters:
            os.set_blocking(master, False)

    def join(self) -> None:
        """Forward, in the running event loop, what is sent at either end."""
        loop = asyncio.get_running_loop()
        for source, target in (self._masters, self._masters[::-1]):
            loop.add_reader(source, self._forward, source, target)

    @staticmethod
    def _forward(source: int, target: int) -> None:
        data = os.read(source, 4096)
        with contextlib.suppress(BlockingIOError):  # no one reads: lost, as on a real line
            os.write(target, data)


class Bench(ABC):
    """A simulator: its servers and their workbench, which run until someone ends them.

    Attributes:
        fault: the present fault.
        registers: of the workbench, by number.
        servers: of the simulator itself.
    """

    def __init__(self, injectable: Mapping[str, faults.Fault], workbench: Address) -> None:
        """Prepare the simulator without opening anything.

        Args:
            injectable: the faults that can be requested.
            workbench: TCP port of the workbench; port 0 takes a free one.
        """
        self.fault = ActiveFault()
        self.registers = {faults.SPEED: 0, faults.FAULT: 0, faults.PARAMETER: faults.DEFAULT}
        self.servers: list[Server] = []
        self._faults = injectable
        device = Device(self.read_registers, self._write)
        self._workbench = Server(workbench, {faults.DEVICE_ID: device})
        self._started_at = time.monotonic()

    @property
    @abstractmethod
    def addresses(self) -> str:
        """The addresses of its servers, for people and for programs that start it."""

    @abstractmethod
    async def run(self, ended: asyncio.Event) -> None:
        """Run the simulation until the end."""

    def read_registers(self) -> Mapping[int, int]:
        """Return the registers of the workbench."""
        return self.registers

    def write_register(self, register: int, value: int) -> None:
        """Write a register of the workbench, and do what that requests."""
        self.registers[register] = value

    def inject(self, name: str, parameter: int) -> bool:
        """Replace the present fault.

        Args:
            name: of the new fault.
            parameter: of it; `faults.DEFAULT` for its default.

        Returns:
            Whether the fault can have that parameter.
        """
        fault = self._faults[name]
        self.fault.name = name
        self.fault.parameter = fault.default if parameter == faults.DEFAULT else parameter
        self.registers |= {faults.FAULT: fault.number, faults.PARAMETER: parameter}
        self.log(f"fault {name}: {fault.meaning}")
        return True

    def log(self, text: str) -> None:
        """Log what happens, with the time."""
        print(f"{time.monotonic() - self._started_at:9.2f} s  {text}", flush=True)

    def serve(self, name: str, parameter: int) -> None:
        """Open all ports, print that they are ready, and run until Ctrl-C or SIGTERM.

        Args:
            name: of the fault at the start.
            parameter: of it.

        Raises:
            ConfigurationError: a port cannot be opened, or the fault cannot have that parameter.
        """
        asyncio.run(self._serve(name, parameter))

    async def _serve(self, name: str, parameter: int) -> None:
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        for server in (self._workbench, *self.servers):
            await server.set_open(True)
        print(
            f"ready: {self.addresses}; workbench {self._workbench.address}, "
            f"device {faults.DEVICE_ID}",
            flush=True,
        )
        if name != faults.NONE and not self.inject(name, parameter):
            raise ConfigurationError("is not an exception code", key="--fault", value=parameter)
        await self.run(ended)
        for server in (*self.servers, self._workbench):
            server.close()

    def _write(self, address: int, values: list[int]) -> ExcCodes | None:
        addresses = range(address, address + len(values))
        if any(
            register == faults.SPEED or register not in self.registers for register in addresses
        ):
            return ExcCodes.ILLEGAL_ADDRESS
        for register, value in zip(addresses, values, strict=True):
            if register != faults.FAULT:
                self.write_register(register, value)
                continue
            names = [name for name, fault in self._faults.items() if fault.number == value]
            if not names or not self.inject(names[0], self.registers[faults.PARAMETER]):
                return ExcCodes.ILLEGAL_VALUE
        return None
