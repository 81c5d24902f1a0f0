"""Sensors on Modbus and MQTT: their readings are scaled, checked and filtered to the quantity.

One thread per serial line or TCP port reads its Modbus sensors in turn; an MQTT sensor's messages
arrive in the thread of a client of its own. A running total, from a tipping bucket or a water
meter, becomes a rate.
"""

from __future__ import annotations

import json
import logging
import math
import re
import statistics
import threading
import time
from collections import defaultdict, deque
from dataclasses import dataclass, replace

from greenroof_ros.base.mqtt import make_client
from greenroof_ros.interface.conditions import Diagnosis, read_conditions
from greenroof_ros.live.boot_clock import boot_time, suspended_time
from greenroof_ros.live.devices.json_path import value_at
from greenroof_ros.live.devices.modbus_line import (
    DeviceThread,
    DriveError,
    ModbusLine,
    decode,
)
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor, Sensor

# After a suspension longer than this (s), earlier readings are too old.
_SUSPEND_S = 1.0
# A sensor is unreliable if at least this many of its readings in a minute (s), and more than this
# share of them, were rejected.
_WINDOW_S, _MIN_REFUSED, _MAX_SHARE = 60.0, 5, 0.1
# A message may be repeated or overtaken within this time (s).
_LATE_S = 2.0
# A rise may exceed the maximum rate by as much as that rate adds in this time (s).
_BURST_S = 60.0
# Shortest time over which a rise is spread (s), which covers several calls by the node.
_MIN_SPREAD_S = 0.5
# Widths of counters that roll over (bits).
_BITS = (16, 32, 64)
# Longest wait for a connection, and for each answer (s).
_TIMEOUT_S = 0.5
# Maximum number of timeouts that a reading takes: one to connect, two for an answer that arrives in
# pieces. A failed reading takes this long if another sensor follows, so that an answer still on its
# way is dropped.
_TIMEOUTS = 3
# Longest message of a sensor that is accepted (bytes).
_MAX_BYTES = 65_536
# Messages are rejected for this long from the first one after a silence (s), since they may have
# been waiting or retained by another broker.
_IGNORING_S = 1.0
# A number as text, which need not be JSON: "317.3988", 00317.3988, +5.0 or .5.
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*", re.ASCII | re.IGNORECASE)
_WHOLE = re.compile(r"\s*[+-]?\d+\s*", re.ASCII)


class Total:
    """The rate of a total; each rise is spread over its duration, within the maximum rate.

    The integral of `rate` over time, with each value held until the next call, is the rise in the
    total. Each call subtracts the volume that the previous value has contributed. The remaining
    volume is not affected by a lost connection or a suspension of the machine. A repeated or
    delayed message therefore changes nothing.
    """

    def __init__(self, sensor: Sensor, unit: str, spread_s: float) -> None:
        """Initialize the rate without a total.

        Args:
            sensor: the sensor's section of the sensor file, with scale and maximum rate.
            unit: unit of the rate, for messages.
            spread_s: maximum time over which a rise is spread (s).
        """
        self._sensor, self._unit, self._spread_s = sensor, unit, spread_s
        self._burst_s = min(_BURST_S, spread_s)
        self._lock = threading.Lock()
        self._last: float | None = None  # the last raw total
        self._received_at = 0.0  # when it was received (s, `boot_time`)
        self._former: float | None = None  # the total before a fall, until the next rise
        self._odd: tuple[float, float] | None = None  # a rejected total, and when it was received
        self._rises: deque[tuple[float, float]] = deque()  # recent: when, and the total before
        self._growing = False  # whether the newest total continues an earlier one
        self._rates: defaultdict[float, float] = defaultdict(float)  # by their end (s)
        self._due = self._rate = 0.0
        self._updated_at = time.monotonic()

    def sensor_lost(self) -> None:
        """Record that the sensor was lost, so that only the remainder of the last rise is known."""
        with self._lock:
            self._growing = False

    def rate(self) -> float | None:
        """Return the current rate; None if no rise remains to be spread and growth is unknown."""
        with self._lock:
            now = time.monotonic()
            self._due -= self._rate * (now - self._updated_at)
            self._updated_at = now
            for end in [end for end in self._rates if end <= now]:
                del self._rates[end]
            if self._due <= 0:
                self._rate = 0.0
            else:
                rate = sum(self._rates.values()) or self._rate
                # The remainder that the maximum rate or a late call has left.
                behind = self._due - sum(
                    part * (end - now) for end, part in self._rates.items()
                )
                high = self._sensor.high
                self._rate = high if behind > _BURST_S * rate else min(rate, high)
            return self._rate if self._rate or self._growing else None

    def add(self, raw: float) -> None:
        """Add a total.

        Args:
            raw: total as the sensor reports it; differences of whole numbers are exact.

        Raises:
            ValueError: if the total rose faster than the maximum rate allows; the total is then
                ignored.
        """
        with self._lock:
            now = boot_time()
            if self._last is None:
                self._start(raw, now)
                return
            while self._rises and now - self._rises[0][0] > _LATE_S:
                self._rises.popleft()
            gap = now - self._received_at
            if self._former is not None and self._is_growth(self._former, raw, gap):
                self._last = self._former  # the fall was a single wrong or late total
            if self._is_growth(self._last, raw, gap):
                self._rise(raw, self._sensor.scale * (raw - self._last), now)
            elif self._sensor.scale * (raw - self._last) > 0:
                self._refuse(raw, now)
            elif self._rises and self._sensor.scale * (raw - self._rises[0][1]) >= 0:
                pass  # a late message: its water has been counted
            elif (wrapped := self._roll_over(raw, gap)) is not None:
                self._rise(raw, wrapped, now)
            else:  # the sensor has restarted
                former = self._former or self._last
                self._start(raw, now)
                self._former = former

    def _allowed(self, gap: float) -> float:
        """Return the maximum rise in a given time (s)."""
        return self._sensor.high * (self._burst_s + min(gap, self._spread_s))

    def _is_growth(self, before: float, raw: float, gap: float) -> bool:
        return 0 <= self._sensor.scale * (raw - before) <= self._allowed(gap)

    def _roll_over(self, raw: float, gap: float) -> float | None:
        """Return the rise of a counter that may have rolled over; None if it has not."""
        if not (isinstance(raw, int) and isinstance(self._last, int)):
            return None
        rises = (self._sensor.scale * ((raw - self._last) % 2**bits) for bits in _BITS)
        return next((rise for rise in rises if 0 < rise <= self._allowed(gap)), None)

    def _start(self, raw: float, now: float) -> None:
        self._last, self._received_at, self._growing = raw, now, False
        self._former = self._odd = None
        self._rises.clear()

    def _rise(self, raw: float, rise: float, now: float) -> None:
        gap, before = now - self._received_at, self._last
        assert before is not None
        self._last, self._received_at, self._growing, self._odd = raw, now, True, None
        if not rise:
            return
        self._former = None
        self._rises.append((now, before))
        started_at = time.monotonic()
        end = started_at + min(max(gap, _MIN_SPREAD_S), self._spread_s)
        # Simultaneous tips share the time of the first.
        end = min(
            (other for other in self._rates if end < other <= started_at + self._burst_s),
            default=end,
        )
        self._rates[end] += rise / (end - started_at)
        self._due += rise

    def _refuse(self, raw: float, now: float) -> None:
        """Reject a rise, unless a later total confirms it, in which case the sensor has restarted.

        Raises:
            ValueError: if the rise is rejected.
        """
        odd = self._odd
        confirms = odd is not None and self._is_growth(odd[0], raw, now - odd[1])
        if odd is not None and confirms and now - odd[1] > _LATE_S:
            self._start(raw, now)
            return
        if not confirms:
            self._odd = raw, now
        assert self._last is not None
        rise, amount = self._sensor.scale * (raw - self._last), self._unit.removesuffix("/s")
        raise ValueError(
            f"reports {raw:g}, a total that rose by {rise:.6g} {amount} in "
            f"{now - self._received_at:.1f} s, which is faster than {self._sensor.high:g} "
            f"{self._unit}"
        )


@dataclass(frozen=True)
class Reading:
    """A snapshot of a measured quantity.

    Attributes:
        read_at: time at which the last attempt ended or the sensor was lost (s, `time.monotonic`).
        problem: description of the last problem if it persists; otherwise empty.
        value: value in the unit of the quantity's topic. The value is None after a failure, or
            before the second total. After a failure, however, the last rise in a total is still
            published until it has been distributed completely.
        code: condition code of the problem.
    """

    read_at: float = -math.inf
    problem: str = ""
    value: float | None = None
    code: str = "sensor_lost"


class RefusedShare:
    """Per-minute counter of readings whose rejection is too brief to raise an alarm.

    Readings are not counted if their rejection lasts long enough to raise an alarm.
    """

    def __init__(self) -> None:
        """Start counting the first minute."""
        self._all = self._refused = 0
        self._why = ""  # the reason for the last rejection
        self._began, self._refused_since = time.monotonic(), math.inf
        self._lasts = read_conditions()["sensor_lost"].lasts
        self._diagnosis: Diagnosis | None = None

    def count(self, why: str = "") -> None:
        """Count a reading, with the reason for its rejection; empty for a valid reading."""
        now = time.monotonic()
        if why:
            self._refused_since, self._why = min(self._refused_since, now), why
        else:
            if now - self._refused_since > self._lasts:
                self._all = self._refused = 0
            self._refused_since = math.inf
        self._all += 1
        self._refused += bool(why)
        ends = now - self._began >= _WINDOW_S
        if ends or self._diagnosis is None:  # so its numbers change, and are logged, once a minute
            self._diagnosis = self._judge()
        if ends:
            self._began, self._all, self._refused = now, 0, 0

    def _judge(self) -> Diagnosis | None:
        if not max(_MIN_REFUSED, _MAX_SHARE * self._all) <= self._refused < self._all:
            return None
        return Diagnosis.of(
            "readings_refused", refused=self._refused, readings=self._all, why=self._why
        )

    @property
    def diagnosis(self) -> Diagnosis | None:
        """A diagnosis if too many readings were rejected between valid readings; otherwise None."""
        lost = time.monotonic() - self._refused_since > self._lasts
        return None if lost else self._diagnosis


class SensorReader:
    """Base class for the reader of a sensor, which keeps the latest snapshot of the quantity.

    The quantity is the median of the latest readings. A median removes isolated outliers, which a
    first-order filter would smear over many readings. It follows a steady rise or fall of the level
    with a delay of half its window, and does not blur the beginning of a rise. Tank levels change
    slowly enough for this delay to be acceptable. A rejected value, a failure or a suspension of
    the computer empties the filter, so the next value is based on new readings only.

    Attributes:
        sensor: the sensor's section of the sensor file.
        share: counter of the rejected readings.
    """

    def __init__(self, sensor: Sensor, unit: str, spread_s: float, first: Reading) -> None:
        """Start without readings.

        Args:
            sensor: the sensor's section of the sensor file.
            unit: unit of the quantity, for messages.
            spread_s: maximum time over which a rise in a total is spread (s).
            first: initial snapshot, valid until the first reading has arrived or failed.
        """
        self.sensor, self._unit, self._reading = sensor, unit, first
        self._values: deque[float] = deque(maxlen=sensor.median)
        self._total = Total(sensor, unit, spread_s) if sensor.counts else None
        self._suspended = suspended_time()
        self._lock = threading.RLock()
        self.share = RefusedShare()

    @property
    def snapshot(self) -> Reading:
        """The latest snapshot of the quantity; the rate of a total changes between readings."""
        with self._lock:
            if self._total is not None and (rate := self._total.rate()) != self._reading.value:
                self._reading = replace(self._reading, value=rate)
            return self._reading

    def report_failure(self, problem: str, code: str = "sensor_lost") -> None:
        """Record a failed reading with its problem and condition code."""
        with self._lock:
            self._clear(problem)
            self._reading = Reading(time.monotonic(), problem, code=code)

    def _clear(self, why: str) -> None:
        """Discard all readings and record the reason.

        A running total is not discarded, because its growth in the meantime is water that has
        really fallen or flowed.
        """
        self.share.count(why)
        self._values.clear()
        if self._total is not None:
            self._total.sensor_lost()

    def _clear_after_suspend(self) -> bool:
        """Discard all readings if the computer was suspended since the last call, and say so."""
        before, self._suspended = self._suspended, suspended_time()
        if self._suspended - before <= _SUSPEND_S:
            return False
        self._clear("the machine was suspended")
        return True

    def _add(self, raw: float) -> None:
        """Add a reading, and update the quantity.

        The quantity is None for the first total, and for a total below the last, which means that
        the sensor has restarted.

        Raises:
            ValueError: if the reading is not a number or is out of range.
        """
        sensor = self.sensor
        value = sensor.convert(raw)
        if not math.isfinite(value):
            raise ValueError(f"reports {raw}, which is not a number")
        if self._total is not None:
            self._total.add(raw)
        elif sensor.low <= value <= sensor.high:
            self._values.append(value)
        else:
            raise ValueError(
                f"reports {value:.6g} {self._unit} (raw {raw:g}), which is not from {sensor.low:g} "
                f"to {sensor.high:g} {self._unit}"
            )
        self.share.count()
        filtered = statistics.median_low(self._values) if self._total is None else None
        with self._lock:
            self._reading = Reading(time.monotonic(), "", filtered)


class SensorLine(DeviceThread):
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
        super().__init__(f"{name}: reading")
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
        max_age: maximum age of the quantity (s).
        due: time of the next reading (s, `time.monotonic`).
    """

    sensor: ModbusSensor

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
        self.max_age, self.due = max_age, time.monotonic()
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
        self._clear_after_suspend()
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
            self._add(raw)
        except ValueError as error:
            raise line.error("answer", str(error)) from error


def read_number(payload: bytes, sensor: MqttSensor) -> float:
    """Return the number in a message; a whole number of any length remains an integer.

    Args:
        payload: content of the message, which is JSON or a plain number.
        sensor: the sensor's section of the sensor file, which contains the path of the number.

    Raises:
        ValueError: if the message contains no number at the path.
    """
    if len(payload) > _MAX_BYTES:
        raise ValueError(f"a message has {len(payload)} bytes, but the limit is {_MAX_BYTES}")
    value: object = payload.decode(errors="replace")
    if sensor.value or not _NUMBER.fullmatch(str(value)):
        try:
            value = json.loads(payload)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"reports {payload[:40]!r}, which is not JSON") from error
    try:
        value = value_at(value, sensor.value)
    except LookupError as error:
        raise ValueError(
            f"reports {payload[:80]!r}, which does not contain {sensor.value}"
        ) from error
    text = str(value)
    if isinstance(value, bool) or not (isinstance(value, float) or _NUMBER.fullmatch(text)):
        raise ValueError(f"reports {text[:40]!r}, which is not a number")
    number = float(text)
    if math.isinf(number) and not isinstance(value, float):
        raise ValueError("reports a number that is too large")
    return int(text) if _WHOLE.fullmatch(text) else number


class MqttReader(SensorReader):
    """A receiver of a sensor's messages, which reconnects automatically after every failure.

    A message counts as a reading at the time of its arrival. Retained messages, and the first
    messages after a silence or a lost connection, do not count as readings, since they may be of
    any age.
    """

    sensor: MqttSensor

    def __init__(
        self, name: str, sensor: MqttSensor, unit: str, spread_s: float = math.inf
    ) -> None:
        """Prepare the reader without connecting.

        Args:
            name: name of the quantity, for the client id.
            sensor: the sensor whose messages are received.
            unit: unit of the quantity, for messages.
            spread_s: maximum time over which a rise in a total is spread (s).

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        broker, self._topic = sensor.broker_and_topic()
        first = Reading(problem=f"{sensor.address}: not yet connected", code="broker_lost")
        super().__init__(sensor, unit, spread_s, first)
        # When the last message arrived, and until when messages are rejected (s).
        self._received_at, self._ignoring_until = -math.inf, -math.inf
        self._client = make_client(
            broker, f"greenroof_{name}", self._on_connect, self._on_message, self._on_disconnect,
        )

    @property
    def snapshot(self) -> Reading:
        """The latest snapshot of the quantity."""
        with self._lock:
            age = time.monotonic() - self._reading.read_at
            if not self._reading.problem and age > self.sensor.max_age:
                self._fail(f"has sent nothing for {self.sensor.max_age:g} s")
            return super().snapshot

    def start(self) -> None:
        """Connect, and start the client's thread."""
        self._client.loop_start()

    def close(self) -> None:
        """Disconnect."""
        self._client.disconnect()

    # --- in the client's thread -------------------------------------------------------------------

    def _on_connect(self) -> None:
        self._received_at = -math.inf
        self._fail("has sent nothing yet")
        self._client.subscribe(self._topic)

    def _on_disconnect(self, why: str) -> None:
        self._fail(f"no connection to the broker: {why}", "broker_lost")

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if topic != self._topic:
            return
        with self._lock:
            try:
                self._receive(payload, retained)
            except ValueError as error:
                self._fail(str(error))
            except Exception as error:  # whatever the error, the next message is read
                logging.getLogger(__name__).exception("%s failed", self.sensor.address)
                self._fail(f"reading failed: {error!r}")

    def _receive(self, payload: bytes, retained: bool) -> None:
        now = time.monotonic()
        if retained:
            raise ValueError("has not yet sent a new message; the retained message may be old")
        suspended = self._clear_after_suspend()
        before, self._received_at = self._received_at, now
        if suspended or now - before > self.sensor.max_age:
            self._ignoring_until = now + _IGNORING_S
            raise ValueError("is sending again, but its first messages may be old")
        if now < self._ignoring_until:
            return
        self._add(read_number(payload, self.sensor))

    def _fail(self, why: str, code: str = "sensor_lost") -> None:
        self.report_failure(f"{self.sensor.address}: {why}", code)
