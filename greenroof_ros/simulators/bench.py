"""What both simulators are: servers with a workbench beside them, until somebody ends them."""

from __future__ import annotations

import asyncio
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping

from pymodbus.constants import ExcCodes

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.drives.address import Address, Serial
from greenroof_ros.simulators import faults
from greenroof_ros.simulators.faults import Fault
from greenroof_ros.simulators.server import Device, Server, StandingFault

NO_LINE = Serial(19200, "even", 1, faults.DEVICE_ID)
"""of workbenches, which are always on TCP"""


class Bench(ABC):
    """A simulator with its servers.

    Attributes:
        fault: the one that stands.
        registers: of the workbench, by number.
        servers: of the simulator itself.
    """

    def __init__(self, known: Mapping[str, Fault], workbench: Address) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            known: the faults that can be asked for.
            workbench: TCP port of the workbench; port 0 takes a free one.
        """
        self.fault = StandingFault()
        self.registers = {faults.SPEED: 0, faults.FAULT: 0, faults.PARAMETER: faults.DEFAULT}
        self.servers: list[Server] = []
        self._known = known
        self._workbench = Server(
            workbench, NO_LINE, {faults.DEVICE_ID: Device(self.look, self._write)}
        )
        self._began = time.monotonic()

    @property
    @abstractmethod
    def place(self) -> str:
        """Where its servers are, for people and for programs that start it."""

    @abstractmethod
    async def run(self, ended: asyncio.Event) -> None:
        """Let time pass until the end."""

    def look(self) -> Mapping[int, int]:
        """Return what the registers of the workbench hold."""
        return self.registers

    def adjust(self, register: int, value: int) -> None:
        """Do what a register of the workbench stands for."""
        self.registers[register] = value

    def inject(self, name: str, parameter: int) -> bool:
        """Let a fault stand instead of the present one.

        Args:
            name: of the fault.
            parameter: of it; `faults.DEFAULT` for its default.

        Returns:
            Whether the parameter is one that the fault can have.
        """
        fault = self._known[name]
        self.fault.name = name
        self.fault.parameter = fault.default if parameter == faults.DEFAULT else parameter
        self.registers |= {faults.FAULT: fault.number, faults.PARAMETER: parameter}
        self.say(f"fault {name}: {fault.meaning}")
        return True

    def say(self, text: str) -> None:
        """Tell people what happens."""
        print(f"{time.monotonic() - self._began:9.2f} s  {text}", flush=True)

    def serve(self, name: str, parameter: int) -> None:
        """Open all ports, say so, and go on until Ctrl-C or SIGTERM.

        Args:
            name: of a fault from the start on.
            parameter: of it.

        Raises:
            ConfigurationError: a port cannot be opened, or the fault has no such parameter.
        """
        asyncio.run(self._serve(name, parameter))

    async def _serve(self, name: str, parameter: int) -> None:
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, ended.set)
        for server in (self._workbench, *self.servers):
            await server.be_open(True)
        print(
            f"ready: {self.place}; workbench {self._workbench.address}, "
            f"device {faults.DEVICE_ID}",
            flush=True,
        )
        if name != faults.NONE and not self.inject(name, parameter):
            raise ConfigurationError("is no exception code", key="--fault", value=parameter)
        await self.run(ended)
        for server in (*self.servers, self._workbench):
            server.close()

    def _write(self, address: int, values: list[int]) -> ExcCodes | None:
        wanted = range(address, address + len(values))
        if any(each == faults.SPEED or each not in self.registers for each in wanted):
            return ExcCodes.ILLEGAL_ADDRESS
        for register, value in zip(wanted, values, strict=True):
            if register != faults.FAULT:
                self.adjust(register, value)
                continue
            names = [name for name, fault in self._known.items() if fault.number == value]
            if not names or not self.inject(names[0], self.registers[faults.PARAMETER]):
                return ExcCodes.ILLEGAL_VALUE
        return None
