"""Reads a sensor on Modbus."""

from __future__ import annotations

import math
import time

from greenroof_ros.drives.modbus_line import DeviceThread, DriveError, decode
from greenroof_ros.drives.readings import Reading, Readings
from greenroof_ros.drives.sensor_file import ModbusSensor


class ModbusReader(DeviceThread[Reading]):
    """Reads a sensor once per period. It connects if needed, and again after every failure.

    A refused value, a failure, or a suspend of the machine empties the filter: the next value then
    comes from new readings only. The rise of a total remains.
    """

    def __init__(
        self, sensor: ModbusSensor, unit: str, timeout_s: float = 0.5, spread_s: float = math.inf
    ) -> None:
        """Prepare the reader without connecting.

        Args:
            sensor: what to read.
            unit: of the quantity, for messages.
            timeout_s: longest wait for a connection, and for each answer (s).
            spread_s: longest time over which a rise of a total is spread (s).

        Raises:
            ConfigurationError: there is no Modbus library.
        """
        super().__init__(f"{sensor.address}: reading", Reading(problem="not yet read"))
        self._sensor, self._timeout_s = sensor, timeout_s
        self._line = sensor.line(timeout_s)
        self._readings = Readings(sensor, unit, spread_s)
        self._due = time.monotonic()

    @property
    def snapshot(self) -> Reading:
        """What is known now."""
        with self._lock:
            self._snapshot = self._readings.now(self._snapshot)
            return self._snapshot

    def close(self) -> None:
        """End the thread; wait up to four timeouts for it to close the connection."""
        self._end(4 * self._timeout_s)

    def read(self) -> float | None:
        """Read once more, and return the filtered quantity.

        Raises:
            DriveError: no answer, a wrong one, or a value out of range.
        """
        sensor, line = self._sensor, self._line
        try:
            if not line.connected:
                line.connect()
            registers = line.read(
                sensor.register, sensor.registers, inputs=sensor.kind == "input"
            )
        except DriveError:
            line.close()  # a late answer must not be read as the next
            raise
        bits = decode(registers, f"uint{16 * len(registers)}", sensor.word_order)
        if bits == sensor.missing:
            raise line.error("answer", f"says 0x{bits:X}, which means 'no reading'")
        raw = decode(registers, sensor.type, sensor.word_order)
        assert not isinstance(raw, str)
        try:
            return self._readings.add(raw)
        except ValueError as error:
            raise line.error("answer", str(error)) from error

    # --- in the thread ----------------------------------------------------------------------------

    def _step(self) -> None:
        self._pause_until(self._due)
        # After a pause, missed readings are not made up for.
        self._due = max(self._due + self._sensor.period, time.monotonic())
        if self._closing:
            self._done = True
            self._line.close()
        else:
            self._readings.forget_after_suspend()
            self._update(value=self.read(), read_at=time.monotonic(), problem="")

    def _lost(self, error: Exception, problem: str) -> None:
        self._readings.clear()
        self._update(value=None, read_at=time.monotonic(), problem=problem)
        if not isinstance(error, DriveError):  # `read` has closed it after a DriveError
            self._line.close()
