"""A simulated drive on a port or a line of its own, with its workbench beside it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace

from pymodbus.constants import ExcCodes

from greenroof_ros.drives.address import Address
from greenroof_ros.drives.drive_file import DriveFile
from greenroof_ros.drives.modbus_line import SIMULATOR
from greenroof_ros.model.initial_state import default_state
from greenroof_ros.model.pump_speed import flow_at
from greenroof_ros.model.site import Site
from greenroof_ros.simulators import faults
from greenroof_ros.simulators.faults import DRIVE_FAULTS
from greenroof_ros.simulators.faulty_server import FaultyServer, Wire, make_device, make_workbench
from greenroof_ros.simulators.simulated_drive import DriveSettings, SimulatedDrive

_STEP_S = 0.01


class DriveBench:
    """Runs a simulated drive in real time.

    Attributes:
        drive: the drive.
        device_id: its unit identifier or slave address.
    """

    def __init__(
        self,
        file: DriveFile,
        settings: DriveSettings,
        address: Address,
        workbench_address: Address,
        site: Site,
        say: Callable[[str], None],
    ) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            file: the make.
            settings: of the drive.
            address: TCP port or serial line of the drive; port 0 takes a free one. A drive whose
                file tells of no timeout of an Ethernet port of its own is behind a gateway there.
            workbench_address: TCP port of the workbench, likewise.
            site: for the flow, of drives that report it; until the workbench is told of another
                level, the cistern's is the one that runs begin with.
            say: is told what happens, for people.

        Raises:
            ConfigurationError: the make cannot be simulated.
        """
        self._site = site
        _, (cistern, _) = default_state(site)
        self._level = site.cistern_level(cistern)
        self._say = say
        self._gateway = not address.line and file.timeout.tcp is None
        interface = replace(address, gateway=self._gateway).interface
        self.drive = SimulatedDrive(
            file, settings, time.monotonic(), lambda speed: flow_at(site, speed, self._level), say,
            interface,
        )
        self.device_id = file.device_id_at(replace(address, gateway=self._gateway))
        self._wire = Wire(
            deaf=lambda: not self._answers(), heard=lambda: self.drive.heard(time.monotonic())
        )
        self._server = FaultyServer(
            address, file.serial,
            [make_device(
                self.device_id, self.drive.addresses(),
                lambda: self.drive.registers(time.monotonic()), self._write,
            )],
            self._wire, SIMULATOR,
        )
        self._registers = [0, 0, faults.DEFAULT, 0, 0, round(self._level / faults.LEVEL_UNIT)]
        self._workbench = make_workbench(workbench_address, self._read_workbench, self._put)

    @property
    def address(self) -> Address:
        """Where the drive is; its port is known when it has started."""
        return replace(self._server.address, gateway=self._gateway)

    @property
    def workbench_address(self) -> Address:
        """Where the workbench is, likewise."""
        return self._workbench.address

    def inject(self, name: str, parameter: int) -> bool:
        """Let a fault stand instead of the present one.

        Args:
            name: of one of `faults.DRIVE_FAULTS`.
            parameter: of it; `faults.DEFAULT` for its default.

        Returns:
            Whether the parameter is one that the fault can have.
        """
        now = time.monotonic()
        if parameter == faults.DEFAULT:
            parameter = DRIVE_FAULTS[name].default
        if name in ("exception", "refused_writes") and parameter not in list(ExcCodes):
            return False
        self._wire.fault, self._wire.parameter = name, parameter
        self.drive.no_fault(now)
        match name:
            case "absurd_value":
                self.drive.show_speed(parameter)
            case "drive_fault":
                self.drive.trip(parameter, now)
            case "speed_stays":
                self.drive.hold_speed(now)
            case "stuck_running":
                self.drive.run_stuck(parameter * faults.SPEED_UNIT, now)
            case "runs_on":
                self.drive.run_on(now)
            case "power_cycle":
                self.drive.power_cycle(now)
            case "timeout_off":
                self.drive.disable_timeout(now)
        self._registers[faults.FAULT] = DRIVE_FAULTS[name].number
        self._registers[faults.PARAMETER] = parameter
        self._say(f"fault {name}: {DRIVE_FAULTS[name].meaning}")
        return True

    async def start(self) -> None:
        """Open both ports.

        Raises:
            ConfigurationError: one of them cannot be opened.
        """
        await self._workbench.open()
        await self._server.open()

    async def run(self, ended: asyncio.Event) -> None:
        """Let time pass until the end."""
        while not ended.is_set():
            self.drive.advance(time.monotonic())
            # The drive's port is open while it has power and does not refuse.
            await self._server.be_open(self._answers())
            await asyncio.sleep(_STEP_S)
        self._server.close()
        self._workbench.close()

    def _answers(self) -> bool:
        return self.drive.answers(time.monotonic()) and self._wire.fault != "refused"

    def _write(self, address: int, values: list[int]) -> ExcCodes | None:
        return self.drive.write(address, values, time.monotonic())

    def _read_workbench(self) -> list[int]:
        self.drive.advance(time.monotonic())
        self._registers[faults.SPEED] = round(self.drive.speed / faults.SPEED_UNIT)
        return self._registers

    def _put(self, register: int, value: int) -> bool:
        """Do what a register of the workbench stands for; tell whether it can."""
        if register == faults.FAULT:
            name = faults.name_of(value, DRIVE_FAULTS)
            return name != "" and self.inject(name, self._registers[faults.PARAMETER])
        if register == faults.PARAMETER:
            self._registers[register] = value
        elif register == faults.POWER_CYCLE and value:
            self.drive.power_cycle(time.monotonic())
        elif register == faults.LOCAL:
            self.drive.take_over(bool(value), time.monotonic())
            self._registers[register] = int(bool(value))
        elif register == faults.CISTERN_LEVEL:
            self._level = value * faults.LEVEL_UNIT
            self._registers[register] = value
        return True
