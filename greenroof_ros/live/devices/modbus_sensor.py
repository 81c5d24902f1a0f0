"""Sensors on Modbus: one thread per serial line or TCP port reads its sensors in turn."""

from __future__ import annotations

import math
import time

from greenroof_ros.live.devices.modbus_line import (
    DeviceSnapshot,
    DeviceThread,
    DriveError,
    ModbusLine,
    decode,
)
from greenroof_ros.live.devices.readings import Reading, SensorReader
from greenroof_ros.live.devices.sensor_file import ModbusSensor

# Longest wait for a connection, and for each answer (s).
_TIMEOUT_S = 0.5
# Maximum number of timeouts that a reading takes: one to connect, two for an answer that arrives in
# pieces. A failed reading takes this long if another sensor follows, so that an answer still on its
# way is dropped.
_TIMEOUTS = 3


class SensorLine(DeviceThread[DeviceSnapshot]):
    """A thread that reads the sensors on one line once per period, the most overdue sensor first.

    The thread connects if needed, and again after every failure. If there is more than one sensor
    on the line, the thread then waits until three timeouts have passed since the beginning of the
    failed reading. Otherwise, a gateway might label a late response with the transaction number of
    the next request, and the response would be mistaken for the value of the next register. A
    sensor that is absent, hangs or sends invalid responses delays the others by three timeouts per
    reading. The timeout is 0.5 s, or shorter if needed so that reading all n sensors of the line
    takes at most half of the maximum age A of a value: 3 n timeouts <= A / 2. A period is at most A
    / 2. The interval between the readings of a working sensor therefore never exceeds A, whatever
    the other sensors do. At A = 5 s, each of two sensors has 0.42 s to respond.
    """

    def __init__(self, name: str) -> None:
        """Prepare a line without sensors; see :class:`ModbusReader`.

        Args:
            name: address of the line, for messages.
        """
        super().__init__(f"{name}: reading", DeviceSnapshot())
        self.readers: list[ModbusReader] = []
        self._quiet_until = -math.inf

    def start(self) -> None:
        """Start the thread, unless it has already been started.

        Raises:
            ConfigurationError: if the Modbus library is not installed.
        """
        if not self.started:
            age = min(reader.max_age for reader in self.readers)
            self._timeout_s = min(_TIMEOUT_S, age / 2 / (_TIMEOUTS * len(self.readers)))
            self._line = self.readers[0].sensor.line(self._timeout_s)
            super().start()

    @property
    def closed(self) -> bool:
        """Whether the thread has ended or is ending."""
        return self._closing

    def remove(self, reader: ModbusReader) -> None:
        """Stop reading a sensor.

        After the last one, end the thread, and wait up to four timeouts for it to close the
        connection.
        """
        rest = [other for other in self.readers if other is not reader]
        if rest:
            self.readers = rest  # the thread uses either the old list or the new one
        else:
            self._stop_thread(4 * _TIMEOUT_S)

    # --- in the thread ----------------------------------------------------------------------------

    def _step(self) -> None:
        self._reader = reader = min(self.readers, key=lambda reader: reader.due)
        self._pause_until(max(reader.due, self._quiet_until))
        if self._closing:
            self._done = True
            self._line.close()
            return
        if reader not in self.readers:
            return
        began = time.monotonic()
        try:
            reader.read(self._line.for_device(reader.sensor.device_id))
        finally:
            # Missed readings are not made up for: a sensor that takes longer than its period is
            # read again after the others that are waiting.
            if not self._line.connected and len(self.readers) > 1:
                self._quiet_until = began + _TIMEOUTS * self._timeout_s
            now, period = max(time.monotonic(), self._quiet_until), reader.sensor.period
            reader.due = reader.due + period if reader.due + period > now else now + period

    def _handle_failure(self, error: Exception, problem: str) -> None:
        self._reader.report_failure(problem)
        if not isinstance(error, DriveError):  # `read` has closed it after a DriveError
            self._line.close()


class ModbusReader(SensorReader):
    """A sensor on a line, with the latest snapshot of its quantity.

    Attributes:
        sensor: the sensor to read.
        max_age: maximum age of the quantity (s).
        due: time of the next reading (s, `time.monotonic`).
    """

    def __init__(
        self, sensor: ModbusSensor, unit: str, line: SensorLine, max_age: float = math.inf,
        spread_s: float = math.inf,
    ) -> None:
        """Add a sensor to a line.

        The line's timeout depends on the sensors that it has when it is started.

        Args:
            sensor: the sensor to read.
            unit: unit of the quantity, for messages.
            line: the line that reads the sensor.
            max_age: maximum age of the quantity (s).
            spread_s: maximum time over which a rise in a total is spread (s).
        """
        self.sensor, self.max_age, self.due = sensor, max_age, time.monotonic()
        super().__init__(sensor, unit, spread_s, Reading(problem="not yet read"))
        self._line = line
        line.readers = [*line.readers, self]

    def start(self) -> None:
        """Start the sensor's line; see :meth:`SensorLine.start`."""
        self._line.start()

    def close(self) -> None:
        """Stop reading the sensor; see :meth:`SensorLine.remove`."""
        self._line.remove(self)

    # --- in the line's thread ---------------------------------------------------------------------

    def read(self, line: ModbusLine) -> None:
        """Read the sensor once.

        Raises:
            DriveError: if no valid response arrives, or the value is out of range.
        """
        self._readings.clear_after_suspend()
        value = self._read_quantity(line)
        with self._lock:
            self._reading = Reading(time.monotonic(), "", value)

    def _read_quantity(self, line: ModbusLine) -> float | None:
        """Read the sensor, and return the filtered quantity."""
        sensor = self.sensor
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
            raise line.error("answer", f"reports 0x{bits:X}, which means 'no reading'")
        raw = decode(registers, sensor.type, sensor.word_order)
        assert not isinstance(raw, str)
        try:
            return self._readings.add(raw)
        except ValueError as error:
            raise line.error("answer", str(error)) from error
