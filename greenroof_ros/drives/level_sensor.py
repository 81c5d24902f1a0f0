"""Reads one level over Modbus."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from dataclasses import dataclass

from greenroof_ros.common.times import suspended_time
from greenroof_ros.drives.modbus_line import DeviceThread, DriveError, Known, decode
from greenroof_ros.drives.sensor_file import Sensor


@dataclass(frozen=True)
class Reading(Known):
    """What is known of a level.

    Attributes:
        level: m; None if the last attempt gave none, and `problem` says why.
    """

    level: float | None = None


class LevelSensor(DeviceThread[Reading]):
    """Reads a sensor once a period. It connects when it must, and again after every failure.

    A value that is refused, a failure, or a suspend of the machine empties the filter: the next
    level comes from new readings alone.
    """

    def __init__(self, sensor: Sensor, timeout_s: float = 0.5) -> None:
        """Connect to nothing yet.

        Args:
            sensor: what to read.
            timeout_s: longest wait for a connection, and for an answer (s).

        Raises:
            ConfigurationError: there is no Modbus library.
        """
        super().__init__(f"{sensor.address}: reading", Reading(problem="not yet read"))
        self._sensor, self._timeout_s = sensor, timeout_s
        self._line = sensor.line(timeout_s)
        self._readings: deque[float] = deque(maxlen=sensor.median)
        self._due, self._suspended = time.monotonic(), suspended_time()

    def close(self) -> None:
        """End; at most a timeout or two later the connection is closed."""
        self._end(4 * self._timeout_s)

    def read(self) -> float:
        """Return the level of one reading (m).

        Raises:
            DriveError: there is no answer, a wrong one, or a level out of range.
        """
        sensor, line = self._sensor, self._line
        try:
            if not line.connected:
                line.connect()
            registers = line.read(
                sensor.register, sensor.registers, inputs=sensor.kind == "input"
            )
        except DriveError:
            line.close()  # a late answer must not meet the next question
            raise
        bits = decode(registers, "uint32" if len(registers) == 2 else "uint16", sensor.word_order)
        if bits == sensor.missing:
            raise line.error("answer", f"says 0x{bits:X}, which means that there is no reading")
        raw = decode(registers, sensor.type, sensor.word_order)
        assert not isinstance(raw, str)
        level = sensor.scale * raw + sensor.offset
        if not math.isfinite(level):
            raise line.error("answer", f"says {raw}, which is no number")
        if not sensor.low <= level <= sensor.high:
            raise line.error(
                "answer",
                f"says {level:.6g} m (raw {raw:g}), which is not from {sensor.low:g} to "
                f"{sensor.high:g} m",
            )
        return level

    # --- in the thread ----------------------------------------------------------------------------

    def _step(self) -> None:
        self._pause_until(self._due)
        # Not one reading after another to catch up with what a pause has cost.
        self._due = max(self._due + self._sensor.period, time.monotonic())
        if self._closing:
            self._done = True
            self._line.close()
        else:
            before, self._suspended = self._suspended, suspended_time()
            if self._suspended - before > self._sensor.period:
                self._readings.clear()
            self._readings.append(self.read())
            level = statistics.median_low(self._readings)
            self._update(level=level, read_at=time.monotonic(), problem="")

    def _lost(self, error: Exception, problem: str) -> None:
        self._readings.clear()
        self._update(level=None, read_at=time.monotonic(), problem=problem)
        if not isinstance(error, DriveError):  # after those it has closed what it must
            self._line.close()
