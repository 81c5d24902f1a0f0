"""Reads one level over Modbus."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from dataclasses import dataclass

from greenroof_ros.drives.device_thread import DeviceThread, Known
from greenroof_ros.drives.modbus_line import DriveError, ModbusLine
from greenroof_ros.drives.sensor_file import Sensor
from greenroof_ros.drives.values import decode


class LevelSensor:
    """A client of one sensor. It connects when it must, and starts anew after every failure.

    A value that is refused, or a failure, empties the filter: the level after it is of new readings
    alone.
    """

    def __init__(self, sensor: Sensor, timeout_s: float = 0.5) -> None:
        """Connect to nothing yet.

        Args:
            sensor: what to read.
            timeout_s: longest wait for a connection, and for an answer (s).
        """
        self._sensor = sensor
        self._timeout_s = timeout_s
        self._line: ModbusLine | None = None
        self._readings: deque[float] = deque(maxlen=sensor.median)

    def read(self) -> float:
        """Return the level (m): the median of this reading and those before it.

        Raises:
            DriveError: there is no answer, a wrong one, or a level out of range.
        """
        try:
            self._readings.append(self._reading())
        except Exception:
            self._readings.clear()
            raise
        return statistics.median_low(self._readings)

    def close(self) -> None:
        """Let go of the connection."""
        if self._line is not None:
            self._line.close()
            self._line = None

    def _reading(self) -> float:
        sensor = self._sensor
        try:
            line = self._connected()
            registers = line.read(
                sensor.register, sensor.registers, inputs=sensor.kind == "input"
            )
        except DriveError:
            self.close()  # a late answer must not meet the next question
            raise
        bits = decode(registers, "uint32" if len(registers) == 2 else "uint16", sensor.word_order)
        if bits == sensor.missing:
            raise self._refused(f"0x{bits:X}, which means that there is no reading")
        raw = decode(registers, sensor.type, sensor.word_order)
        assert not isinstance(raw, str)
        level = sensor.scale * raw + sensor.offset
        if not math.isfinite(level):
            raise self._refused(f"{raw}, which is no number")
        if not sensor.low <= level <= sensor.high:
            raise self._refused(
                f"{level:.6g} m (raw {raw:g}), which is not from {sensor.low:g} to "
                f"{sensor.high:g} m"
            )
        return level

    def _connected(self) -> ModbusLine:
        if self._line is None:
            self._line = self._sensor.connection(self._timeout_s)
            self._line.connect()
        return self._line

    def _refused(self, what: str) -> DriveError:
        sensor = self._sensor
        return DriveError("answer", f"{sensor.address}, device {sensor.device_id}: says {what}")


@dataclass(frozen=True)
class Reading(Known):
    """What is known of a level.

    Attributes:
        level: m; None if the last attempt gave none, and `problem` says why.
    """

    level: float | None = None


class SensorExchange(DeviceThread[Reading]):
    """Reads a sensor once a period; it connects when it must."""

    def __init__(self, sensor: Sensor, timeout_s: float = 0.5) -> None:
        """Prepare it; see `LevelSensor`."""
        super().__init__(f"{sensor.address}: reading", Reading(problem="not yet read"))
        self._sensor = LevelSensor(sensor, timeout_s)
        self._period, self._timeout_s = sensor.period, timeout_s
        self._due = time.monotonic()

    def close(self) -> None:
        """End; at most a timeout or two later the connection is closed."""
        self._end(4 * self._timeout_s)

    def _step(self) -> None:
        self._pause_until(self._due)
        # Not one reading after another to catch up with what a pause has cost.
        self._due = max(self._due + self._period, time.monotonic())
        if self._closing:
            self._done = True
            self._sensor.close()
        else:
            self._update(level=self._sensor.read(), read_at=time.monotonic(), problem="")

    def _lost(self, error: Exception, problem: str) -> None:
        self._update(level=None, read_at=time.monotonic(), problem=problem)
        if not isinstance(error, DriveError):  # after those it has closed what it must
            self._sensor.close()
