"""A simulated drive in real time, on a port or a line of its own, with its workbench beside it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace

from pymodbus.constants import ExcCodes

from greenroof_ros.drives.drive_file import DriveFile
from greenroof_ros.drives.modbus_line import SIMULATOR, Address
from greenroof_ros.model.initial_state import default_state
from greenroof_ros.model.pump_speed import flow_at
from greenroof_ros.model.site import Site
from greenroof_ros.simulators import faults
from greenroof_ros.simulators.control_profiles import profile_of
from greenroof_ros.simulators.server import Bench, Device, PseudoLine, Server
from greenroof_ros.simulators.simulated_drive import DriveSettings

_STEP_S = 0.01
_PTY = "pty"


class DriveBench(Bench):
    """Runs a simulated drive.

    Attributes:
        drive: the drive.
    """

    def __init__(
        self, file: DriveFile, settings: DriveSettings, address: Address, workbench: Address,
        site: Site,
    ) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            file: the make.
            settings: of the drive.
            address: TCP port or serial line of the drive; port 0 takes a free one, and the line
                ``pty`` is a pseudo-terminal. A drive whose file tells of no timeout of an Ethernet
                port of its own is behind a gateway there.
            workbench: TCP port of the workbench, likewise.
            site: for the flow, of drives that report it; until the workbench is told of another
                level, the cistern's is the one that runs begin with.

        Raises:
            ConfigurationError: the make cannot be simulated.
        """
        super().__init__(faults.DRIVE_FAULTS, workbench)
        self._line = PseudoLine() if address.line == _PTY else None
        own = address if self._line is None else Address(line=self._line.ends[0])
        self._reached = replace(own, gateway=not own.line and file.timeout.tcp is None)
        self._device_id = file.device_id_at(self._reached)
        self.drive = profile_of(file.make)(
            file, settings, interface=self._reached.interface,
        )
        self.drive.say = self.say
        self.drive.flow = lambda speed: flow_at(
            site, speed, self.registers[faults.CISTERN_LEVEL] * faults.LEVEL_UNIT
        )
        level = site.cistern_level(default_state(site)[1][0])
        self.registers |= {
            faults.POWER_CYCLE: 0, faults.LOCAL: 0,
            faults.CISTERN_LEVEL: round(level / faults.LEVEL_UNIT),
        }
        device = Device(self.drive.registers, self.drive.write, self._hears)
        self.servers.append(
            Server(own, file.serial, {self._device_id: device}, self.fault, SIMULATOR)
        )

    @property
    def place(self) -> str:
        """Where the drive is; behind a gateway if it has no Ethernet port of its own."""
        address = replace(self.servers[0].address, gateway=self._reached.gateway)
        end = self._line.ends[1] if self._line is not None else address
        return f"drive {end}, device {self._device_id}"

    def inject(self, name: str, parameter: int) -> bool:
        """Let a fault stand, of the wire or of the drive."""
        codes = [faults.DEFAULT, *ExcCodes]
        if name in ("exception", "refused_writes") and parameter not in codes:
            return False
        super().inject(name, parameter)
        self.drive.inject(name, self.fault.parameter)
        return True

    async def run(self, ended: asyncio.Event) -> None:
        """Let time pass until the end."""
        if self._line is not None:
            self._line.join()
        while not ended.is_set():
            self.drive.advance()
            # The drive's port is open while it has power and does not refuse.
            await self.servers[0].be_open(self._answers)
            await asyncio.sleep(_STEP_S)

    @property
    def _answers(self) -> bool:
        return self.drive.answers and self.fault.name != "refused"

    def _hears(self, register: int) -> bool:
        if self._answers:
            self.drive.heard()
        return self._answers

    def look(self) -> Mapping[int, int]:
        """Return what the registers of the workbench hold, the true speed among them."""
        self.drive.advance()
        return self.registers | {faults.SPEED: round(self.drive.speed / faults.SPEED_UNIT)}

    def adjust(self, register: int, value: int) -> None:
        """Cut the power, or take the drive over at its panel."""
        if register == faults.POWER_CYCLE and value:
            self.drive.power_cycle()
        elif register == faults.LOCAL:
            self.drive.take_over(bool(value))
        if register != faults.POWER_CYCLE:
            self.registers[register] = value
