"""Sensors on Modbus and MQTT: their readings are scaled, checked and filtered to the quantity.

A Modbus sensor is read by a thread of its own, which takes turns with the others on its line. An
MQTT sensor's messages arrive in the thread of a client. What follows from a reading is the same. A
running total, from a tipping bucket or a water meter, becomes a rate.
"""

from __future__ import annotations

import json
import logging
import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from greenroof_ros.base.mqtt import make_client, value_at
from greenroof_ros.base.times import boot_time
from greenroof_ros.live.devices.modbus_line import (
    WIDTHS,
    DriveError,
    ModbusLine,
    check_installed,
    decode,
)
from greenroof_ros.live.devices.sensor_file import QUANTITIES, ModbusSensor, MqttSensor, Sensor

# A rise may exceed the maximum rate by as much as that rate adds in this time (s).
_BURST_S = 60.0
# Longest time over which a rise of a flow meter's total is spread (s): a flow that is shown for
# 12 s while the pump is stopped is a fault.
_FLOW_SPREAD_S = 5.0
# Shortest time over which a rise is spread (s), which covers several calls by the node.
_MIN_SPREAD_S = 0.5
# Longest wait for a connection, and for each answer (s).
_TIMEOUT_S = 0.5
# Maximum number of timeouts that a reading takes: one to connect, two for an answer that arrives in
# pieces.
_TIMEOUTS = 3
# Messages are ignored for this long from the first one after a silence (s), since they may have
# been waiting or retained by another broker.
_IGNORING_S = 1.0


class Total:
    """The rate of a running total; each rise is spread over the time that it took.

    The integral of `rate` over time, with each value held until the next call, is the rise in the
    total, also after a lost connection or a suspension of the machine. What a total falls or jumps
    by is not counted.
    """

    def __init__(self, sensor: Sensor, unit: str, spread_s: float) -> None:
        """Initialize the rate without a total.

        Args:
            sensor: the sensor's section of the sensor file, with scale and maximum rate.
            unit: unit of the rate, for messages.
            spread_s: maximum time over which a rise is spread (s).
        """
        self._sensor, self._unit, self._spread_s = sensor, unit, spread_s
        self._last: float | None = None  # the last raw total
        self._received_at = 0.0  # when it was received (s, `boot_time`)
        self._growing = False  # whether the newest total continues an earlier one
        self._due = self._rate = 0.0  # what is still to be published (m or m3), and the rate of it
        self._updated_at = time.monotonic()

    def sensor_lost(self) -> None:
        """Record that the sensor was lost, so that only the rest of the last rise is known."""
        self._growing = False

    def rate(self) -> float | None:
        """Return the current rate; None if the growth is unknown, after one last 0."""
        before = self._rate
        self._update()
        return self._rate if before or self._growing else None

    def add(self, raw: float) -> None:
        """Add a total.

        Args:
            raw: total as the sensor reports it.

        Raises:
            DriveError: if the total rose faster than the maximum rate allows.
        """
        now, last, high = boot_time(), self._last, self._sensor.high
        gap = now - self._received_at
        self._last, self._received_at = raw, now
        rise = 0.0 if last is None else self._sensor.scale * (raw - last)
        self._growing = last is not None and 0 <= rise <= high * (
            min(_BURST_S, self._spread_s) + min(gap, self._spread_s)
        )
        if self._growing and rise:
            self._update()
            rest_s = self._due / self._rate if self._rate else 0.0
            self._due += rise
            spread_s = min(max(gap, min(rest_s, _BURST_S), _MIN_SPREAD_S), self._spread_s)
            self._rate = min(max(0.0, self._due / spread_s), high)
        elif rise > 0:
            raise DriveError(
                "answer", f"reports {raw:g}, a total that rose by {rise:.6g} "
                f"{self._unit.removesuffix('/s')} in {gap:.1f} s, which is faster than {high:g} "
                f"{self._unit}"
            )

    def _update(self) -> None:
        """Subtract what has been published since the last call."""
        now = time.monotonic()
        self._due -= self._rate * (now - self._updated_at)
        self._updated_at = now
        if self._due <= 0:
            self._rate = 0.0


@dataclass(frozen=True)
class Reading:
    """A snapshot of a measured quantity.

    Attributes:
        read_at: time of the last reading, good or bad (s, `boot_time`).
        problem: description of the last problem if it persists; otherwise empty.
        value: value in the unit of the quantity's topic; None after a failure, or before the second
            total. The rest of the last rise in a total is published even after a failure.
        code: condition code of the problem.
    """

    read_at: float
    problem: str = ""
    value: float | None = None
    code: str = "sensor_lost"


class Reader:
    """A sensor's readings, of which the latest snapshot of the quantity is kept.

    The quantity is the median of the latest readings. A median removes isolated outliers, which a
    first-order filter would smear over many readings. It follows a steady rise or fall of the level
    with a delay of half its window, and does not blur the beginning of a rise. A rejected value, a
    failure or a silence empties the filter, so the next value is based on new readings only.

    Attributes:
        sensor: the sensor's section of the sensor file.
    """

    sensor: Sensor

    def __init__(self, section: str, sensor: Sensor, max_age: float) -> None:
        """Start without readings.

        Args:
            section: section of the sensor file.
            sensor: the content of the section.
            max_age: longest silence after which the sensor is lost (s).
        """
        self.sensor, self.max_age, self._unit = sensor, max_age, QUANTITIES[section].unit
        self._reading, self._starting = Reading(boot_time()), True  # until a reading or failure
        self._values: deque[float] = deque(maxlen=sensor.median)
        spread_s = _FLOW_SPREAD_S if section == "flow_meter" else math.inf
        self._total = Total(sensor, self._unit, spread_s) if sensor.counts else None
        self._lock = threading.RLock()

    @property
    def snapshot(self) -> Reading:
        """The latest snapshot of the quantity; the rate of a total changes between readings."""
        with self._lock:
            if not self._reading.problem and boot_time() - self._reading.read_at > self.max_age:
                self.fail(f"has sent nothing for {self.max_age:g} s")
            if self._total is not None:
                return replace(self._reading, value=self._total.rate())
            return self._reading

    def fail(self, why: str, code: str = "sensor_lost") -> None:
        """Record a failed reading with its reason and condition code."""
        with self._lock:
            self._starting = False
            self._values.clear()
            if self._total is not None:
                self._total.sensor_lost()
            why = why.removeprefix(f"{self.sensor}: ")
            self._reading = Reading(boot_time(), f"{self.sensor}: {why}", code=code)

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Record any failure in a block as a failed reading, since the next one follows."""
        try:
            yield
        except DriveError as error:
            self.fail(str(error))
        except Exception as error:
            logging.getLogger(__name__).exception("%s failed", self.sensor)
            self.fail(f"reading failed: {error!r}")

    def add(self, raw: float) -> None:
        """Add a reading, and update the quantity.

        Raises:
            DriveError: if the reading is not a number or is out of range.
        """
        sensor, value = self.sensor, self.sensor.scale * raw + self.sensor.offset
        with self._lock:
            if boot_time() - self._reading.read_at > self.max_age:
                self._values.clear()
            if not math.isfinite(value):
                raise DriveError("answer", f"reports {raw}, which is not a number")
            if self._total is not None:
                self._total.add(raw)
                self._reading = Reading(boot_time())
            elif sensor.low <= value <= sensor.high:
                self._values.append(value)
                self._reading = Reading(boot_time(), "", statistics.median_low(self._values))
            else:
                raise DriveError(
                    "answer", f"reports {value:.6g} {self._unit} (raw {raw:g}), which is not from "
                    f"{sensor.low:g} to {sensor.high:g} {self._unit}"
                )


class SensorLine:
    """A serial line or TCP port, whose sensors are read in turn.

    The line connects if needed, and again after every failure. If there is more than one sensor on
    the line, a failed reading takes three timeouts. Otherwise, a gateway might label a late
    response with the transaction number of the next request, and the response would be mistaken for
    the value of the next register. The timeout is 0.5 s, or shorter if needed so that reading all n
    sensors of the line takes at most half of the maximum age A of a value: 3 n timeouts <= A / 2. A
    period is at most A / 2. The interval between the readings of a working sensor therefore never
    exceeds A, whatever the other sensors do. At A = 5 s, each of two sensors has 0.42 s to respond.

    Attributes:
        max_ages: maximum age of the value of each sensor on the line (s).
    """

    def __init__(self) -> None:
        """Prepare a line without sensors."""
        self.max_ages: dict[ModbusSensor, float] = {}
        self._turn = threading.Lock()
        self._line: ModbusLine | None = None

    def read(self, sensor: ModbusSensor) -> list[int]:
        """Return the registers of a sensor once it is its turn.

        Raises:
            DriveError: if no valid response arrives.
        """
        with self._turn:
            began, count = time.monotonic(), len(self.max_ages)
            timeout_s = min(_TIMEOUT_S, min(self.max_ages.values()) / 2 / (_TIMEOUTS * count))
            if self._line is None:
                self._line = ModbusLine(sensor.place, sensor.serial, timeout_s)
            line, line.device_id = self._line, sensor.device_id
            try:
                if not line.connected:
                    line.connect()
                return line.read(sensor.register, WIDTHS[sensor.type], sensor.kind)
            except Exception:
                line.close()  # a late answer must not be read as the next
                if count > 1:
                    time.sleep(max(0.0, began + _TIMEOUTS * timeout_s - time.monotonic()))
                raise


class ModbusReader(Reader):
    """A thread that reads a sensor on a line once per period."""

    sensor: ModbusSensor

    def __init__(
        self, section: str, sensor: ModbusSensor, line: SensorLine, max_age: float
    ) -> None:
        """Add a sensor to a line.

        Args:
            section: section of the sensor file.
            sensor: the sensor to read.
            line: the line that the sensor shares with others.
            max_age: maximum age of the quantity (s).

        Raises:
            ConfigurationError: if the Modbus library is not installed.
        """
        check_installed()
        super().__init__(section, sensor, max_age)
        self._line, self._closed = line, threading.Event()
        line.max_ages[sensor] = max_age

    def start(self) -> None:
        """Start the thread."""
        threading.Thread(target=self._read_on, name=str(self.sensor), daemon=True).start()

    def close(self) -> None:
        """Let the thread end after the reading that it is waiting for, if any."""
        self._closed.set()

    def read(self) -> None:
        """Read the sensor once, when it is its turn on the line."""
        sensor = self.sensor
        with self.reading():
            registers = self._line.read(sensor)
            bits = decode(registers, f"uint{16 * len(registers)}", sensor.word_order)
            if bits == sensor.missing:
                raise DriveError("answer", f"reports 0x{bits:X}, which means 'no reading'")
            self.add(decode(registers, sensor.type, sensor.word_order))

    def _read_on(self) -> None:
        due = time.monotonic()
        while not self._closed.wait(max(0.0, due - time.monotonic())):
            self.read()
            due += self.sensor.period
            if due <= time.monotonic():  # not made up for, so that it is the others' turn
                due = time.monotonic() + self.sensor.period


class MqttReader(Reader):
    """A receiver of a sensor's messages, which reconnects automatically after every failure.

    A message counts as a reading at the time of its arrival. Retained messages, and the first
    messages after a silence or a lost connection, do not count as readings, since they may be of
    any age.

    Attributes:
        start: function that connects, and starts the client's thread.
        close: function that disconnects.
    """

    sensor: MqttSensor

    def __init__(self, section: str, sensor: MqttSensor) -> None:
        """Prepare the reader without connecting.

        Args:
            section: section of the sensor file.
            sensor: the sensor whose messages are received.

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        super().__init__(section, sensor, sensor.max_age)
        broker, self._topic = sensor.place
        # When the last message arrived, and until when messages are ignored (s, `boot_time`).
        self._received_at = self._ignoring_until = -math.inf
        self._client = make_client(
            broker, f"greenroof_{section}", self._on_connect, self.receive, self._on_disconnect,
        )
        self.start, self.close = self._client.loop_start, self._client.disconnect

    # --- in the client's thread -------------------------------------------------------------------

    def _on_connect(self) -> None:
        self._received_at = -math.inf
        self._expect("has sent nothing yet")
        self._client.subscribe(self._topic)

    def _on_disconnect(self, why: str) -> None:
        self.fail(f"no connection to the broker: {why}", "broker_lost")

    def receive(self, topic: str, payload: bytes, retained: bool) -> None:
        """Take a message, if it is the sensor's and not an old one, as a reading."""
        if topic != self._topic:
            return
        now = boot_time()
        if retained:
            self._expect("has not yet sent a new message; the retained message may be old")
            return
        before, self._received_at = self._received_at, now
        if now - before > self.max_age:
            self._ignoring_until = now + _IGNORING_S
            self._expect("is sending again, but its first messages may be old")
        elif now >= self._ignoring_until:
            self._starting = False
            with self.reading():
                self.add(read_number(payload, self.sensor.value))

    def _expect(self, why: str) -> None:
        """Record why there is no reading yet; at the start, only a long silence is a failure."""
        with self._lock:
            if self._starting:
                self._reading = Reading(boot_time())
            else:
                self.fail(why)


def read_number(payload: bytes, path: str) -> float:
    """Return the number at a path in a JSON message; without a path, the message is the number.

    Raises:
        DriveError: if there is no number.
    """
    try:
        value = value_at(json.loads(payload), path)
        if type(value) in (int, float):
            return float(value)
    except (ValueError, LookupError, TypeError, OverflowError, RecursionError):
        pass
    place = f" at {path}" if path else ""
    raise DriveError("answer", f"reports {payload[:80]!r}, which has no number{place}")
