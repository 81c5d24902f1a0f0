"""A level sensor's line that can go bad: before it stands a server of the simulators'."""

from __future__ import annotations

import asyncio
import threading

from greenroof_ros.drives.modbus_line import Address, DriveError, ModbusLine
from greenroof_ros.simulators import faults
from greenroof_ros.simulators.server import Device, Server, StandingFault


class Line:
    """Listens at a port, and asks the sensor at another, in a thread of its own."""

    def __init__(self, port: int, behind: int) -> None:
        self._behind = ModbusLine(
            Address("127.0.0.1", behind), port=0, device_id=1, timeout_s=0.2
        )
        self._fault = StandingFault()
        self._level: dict[int, int] = {}
        device = Device(lambda: self._level, hears=self._ask)
        self._server = Server(Address("127.0.0.1", port), {1: device}, fault=self._fault)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        self._thread.start()

    def inject(self, fault: str) -> None:
        """Let a fault stand, with its default; connections that there are meet it, too."""
        self._fault.parameter = faults.DRIVE_FAULTS[fault].default
        self._fault.name = fault

    def close(self) -> None:
        self._ended.set()
        self._thread.join(3)

    async def _serve(self) -> None:
        while not self._ended.is_set():
            await self._server.be_open(self._fault.name != "refused")
            await asyncio.sleep(0.02)
        self._server.close()
        self._behind.close()

    def _ask(self, register: int) -> bool:
        """Read the level; where there is no answer, none is given."""
        try:
            if not self._behind.connected:
                self._behind.connect()
            self._level = {register: self._behind.read(register, 1, inputs=True)[0]}
        except DriveError:
            self._behind.close()
            return False
        return True
