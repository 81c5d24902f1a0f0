"""A client of a simulator's workbench."""

from __future__ import annotations

from collections.abc import Mapping

from greenroof_ros.drives.address import Address, Serial
from greenroof_ros.drives.modbus_line import DriveError, ModbusLine
from greenroof_ros.simulators import faults
from greenroof_ros.simulators.faults import DRIVE_FAULTS, Fault

_NO_LINE = Serial(19200, "even", 1, faults.DEVICE_ID)  # it is always TCP


class Workbench:
    """A client of a workbench. Each method connects if it must.

    Each raises `DriveError` where there is no answer.
    """

    def __init__(
        self,
        address: Address,
        known: Mapping[str, Fault] = DRIVE_FAULTS,
        timeout_s: float = 1.0,
    ) -> None:
        """Connect to nothing yet.

        Args:
            address: TCP port of the workbench.
            known: the faults that it knows.
            timeout_s: longest wait for a connection, and for an answer (s).
        """
        self._address, self._faults, self._timeout_s = address, known, timeout_s
        self._line: ModbusLine | None = None

    def speed(self) -> float:
        """Return the true speed of the motor (share of rated)."""
        line = self._connected()
        try:
            return faults.SPEED_UNIT * (line.read(faults.SPEED, 1))[0]
        except DriveError:
            self.close()
            raise

    def inject(self, fault: str, parameter: int = faults.DEFAULT) -> None:
        """Ask for a fault, of which there is one at a time; ``none`` ends it.

        Args:
            fault: its name.
            parameter: see there.
        """
        self._write(faults.PARAMETER, parameter)
        self._write(faults.FAULT, self._faults[fault].number)

    def power_cycle(self) -> None:
        """Take the drive's power away for a moment."""
        self._write(faults.POWER_CYCLE, 1)

    def take_over(self, local: bool) -> None:
        """Take the drive over at its panel, or hand it back to the bus."""
        self._write(faults.LOCAL, int(local))

    def set_cistern_level(self, level: float) -> None:
        """Say how deep the water is (m), for drives that report their flow."""
        raw = min(max(round(level / faults.LEVEL_UNIT), 0), 0xFFFF)
        self._write(faults.CISTERN_LEVEL, raw)

    def close(self) -> None:
        """Let go of the connection."""
        if self._line is not None:
            self._line.close()
            self._line = None

    def _write(self, register: int, value: int) -> None:
        line = self._connected()
        try:
            line.write(register, value)
        except DriveError:
            self.close()
            raise

    def _connected(self) -> ModbusLine:
        if self._line is not None and not self._line.connected:
            self.close()
        if self._line is None:
            line = ModbusLine(
                self._address, port=0, device_id=faults.DEVICE_ID, serial=_NO_LINE,
                timeout_s=self._timeout_s,
            )
            line.connect()
            self._line = line
        return self._line
