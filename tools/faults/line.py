"""The line of a level sensor on Modbus, and the cable to a broker; both can be made to fail."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from functools import partial

from pymodbus.pdu import ModbusPDU
from rig_simulators import FAULTS, ActiveFault, FaultyConnection

from greenroof_ros.live.devices.modbus_line import Address, DriveError, ModbusLine, Serial
from greenroof_ros.live.simulators.server import Server, make_device

_SERIAL = Serial(19200, "even", 1, 1)


class Line:
    """Listens at a port and asks the sensor at another, in a thread of its own.

    It puts one of the simulators' servers in front of the sensor.
    """

    def __init__(self, port: int, behind: int) -> None:
        self._behind = ModbusLine(
            Address("127.0.0.1", behind), _SERIAL, 0.2
        )
        self._fault = ActiveFault()
        self._level: dict[int, int] = {}
        self._server = Server(
            Address("127.0.0.1", port), [make_device(1, lambda: self._level)], _SERIAL,
            connection=partial(FaultyConnection, fault=self._fault, hear=self._hear),
        )
        self._ended = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        self._thread.start()

    def inject(self, fault: str) -> None:
        """Start a fault with its default parameter; it also affects existing connections."""
        self._fault.parameter = FAULTS[fault]
        self._fault.name = fault

    def close(self) -> None:
        self._ended.set()
        self._thread.join(3)

    async def _serve(self) -> None:
        while not self._ended.is_set():
            if self._fault.name == "refused":
                self._server.close()
            else:
                await self._server.open()
            await asyncio.sleep(0.02)
        self._server.close()
        self._behind.close()

    def _hear(self, request: ModbusPDU) -> bool:
        """Read the level; return False, for no answer, if the sensor gives none."""
        try:
            if not self._behind.connected:
                self._behind.connect()
            register = request.address
            self._level = {register: self._behind.read(register, 1, "input")[0]}
        except DriveError:
            self._behind.close()
            return False
        return True


class Cable:
    """Forwards each TCP connection to a port; while it is cut nothing passes in either direction.

    It acts like a lost network: connections stay open, and new ones get no answer. Data sent
    meanwhile arrive when it is whole again.

    Attributes:
        port: its own port, on loopback.
        cut: whether it is cut.
    """

    def __init__(self, behind: int) -> None:
        self.cut = self._ended = False
        self._behind = behind
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._ended = True
        self._server.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # the server was closed
            while True:
                near = self._server.accept()[0]
                try:
                    far = socket.create_connection(("127.0.0.1", self._behind), 1)
                except OSError:
                    near.close()
                    continue
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._forward, args=ends, daemon=True).start()

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError), source, target:
            source.settimeout(None)
            while data := source.recv(4096):
                self._wait_for_frame()
                target.sendall(data)
            self._wait_for_frame()

    def _wait_for_frame(self) -> None:
        while self.cut and not self._ended:
            time.sleep(0.02)
