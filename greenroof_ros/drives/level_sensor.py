"""Reads one level over Modbus."""

from __future__ import annotations

import asyncio
import logging
import math
import statistics
import threading
import time
from collections import deque
from dataclasses import dataclass

from greenroof_ros.drives.modbus_line import DriveError, ModbusLine
from greenroof_ros.drives.sensor_file import Sensor
from greenroof_ros.drives.values import decode, unsigned

_log = logging.getLogger(__name__)


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

    async def read(self) -> float:
        """Return the level (m): the median of this reading and those before it.

        Raises:
            DriveError: there is no answer, a wrong one, or a level out of range.
        """
        try:
            self._readings.append(await self._reading())
        except DriveError:
            self._readings.clear()
            raise
        return statistics.median_low(self._readings)

    def close(self) -> None:
        """Let go of the connection."""
        if self._line is not None:
            self._line.close()
            self._line = None

    async def _reading(self) -> float:
        sensor = self._sensor
        try:
            line = await self._connected()
            registers = await line.read(
                sensor.register, sensor.registers, inputs=sensor.kind == "input"
            )
        except DriveError:
            self.close()  # a late answer must not meet the next question
            raise
        if sensor.missing is not None and unsigned(registers, sensor.word_order) == sensor.missing:
            raise self._refused(f"0x{sensor.missing:X}, which means that there is no reading")
        raw = decode(registers, sensor.type, sensor.word_order)
        level = sensor.scale * raw + sensor.offset
        if not math.isfinite(level):
            raise self._refused(f"{raw}, which is no number")
        if not sensor.low <= level <= sensor.high:
            raise self._refused(
                f"{level:.6g} m (raw {raw:g}), which is not from {sensor.low:g} to "
                f"{sensor.high:g} m"
            )
        return level

    async def _connected(self) -> ModbusLine:
        if self._line is None:
            self._line = self._sensor.connection(self._timeout_s)
            await self._line.connect()
        return self._line

    def _refused(self, what: str) -> DriveError:
        sensor = self._sensor
        return DriveError("answer", f"{sensor.address}, device {sensor.device_id}: says {what}")


@dataclass(frozen=True)
class Reading:
    """What is known of a level.

    Attributes:
        level: m; None if the last attempt gave none.
        read_at: when that was (s, `time.monotonic`).
        problem: why there is none; empty if there is one.
    """

    level: float | None = None
    read_at: float = -math.inf
    problem: str = "not yet read"


class SensorExchange:
    """Reads a sensor once a period in a thread of its own; it raises nothing into its user."""

    def __init__(self, sensor: Sensor, timeout_s: float = 0.5) -> None:
        self._sensor = sensor
        self._timeout_s = timeout_s
        self._reading = Reading()
        self._end = threading.Event()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._run()), name="level sensor", daemon=True
        )

    @property
    def snapshot(self) -> Reading:
        """The newest reading."""
        return self._reading

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """End; at most a timeout or two later the connection is closed."""
        self._end.set()
        self._thread.join(4 * self._timeout_s)

    async def _run(self) -> None:
        # A protocol that chokes on nonsense closes its connection, which is noticed here anyway.
        asyncio.get_running_loop().set_exception_handler(
            lambda _loop, context: _log.debug("%s", context)
        )
        sensor = LevelSensor(self._sensor, self._timeout_s)
        due = time.monotonic()
        while not self._end.is_set():
            try:
                level = await sensor.read()
                self._reading = Reading(level, time.monotonic(), "")
            except DriveError as error:
                self._reading = Reading(None, time.monotonic(), str(error))
            # Whatever it is, the next reading starts anew.
            except (Exception, asyncio.CancelledError) as error:
                _log.exception("reading a level failed")
                self._reading = Reading(
                    None, time.monotonic(), f"{self._sensor.address}: reading failed: {error!r}"
                )
                sensor.close()
                sensor = LevelSensor(self._sensor, self._timeout_s)
            # Not one reading after another to catch up with what a pause has cost.
            due = max(due + self._sensor.period, time.monotonic())
            while not self._end.is_set() and (rest := due - time.monotonic()) > 0:
                await asyncio.sleep(min(rest, self._timeout_s))
        sensor.close()
