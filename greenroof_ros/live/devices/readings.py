"""Conversion of a sensor's readings to the measured quantity: scaling, checks and filter."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import deque
from dataclasses import dataclass, replace

from greenroof_ros.interface.conditions import Diagnosis, read_conditions
from greenroof_ros.live.boot_clock import suspended_time
from greenroof_ros.live.devices.modbus_line import DeviceSnapshot
from greenroof_ros.live.devices.sensor_file import Sensor
from greenroof_ros.live.devices.total import Total

# After a suspension longer than this (s), earlier readings are too old.
_SUSPEND_S = 1.0
# A sensor is unreliable if at least this many of its readings in a minute (s), and more than this
# share of them, were rejected.
_WINDOW_S, _MIN_REFUSED, _MAX_SHARE = 60.0, 5, 0.1


@dataclass(frozen=True)
class Reading(DeviceSnapshot):
    """A snapshot of a measured quantity.

    Attributes:
        read_at: time at which the last attempt ended or the sensor was lost (s, `time.monotonic`).
        value: value in the unit of the quantity's topic. The value is None after a failure, or
            before the second total. After a failure, however, the last rise in a total is still
            published until it has been distributed completely.
        code: condition code of the problem.
    """

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


class Readings:
    """The latest readings from a sensor; their median is the measured quantity.

    A median removes isolated outliers, which a first-order filter would smear over many readings.
    The median follows a steady rise or fall of the level with a delay of half its window, and does
    not blur the beginning of a rise. Tank levels change slowly enough for this delay to be
    acceptable.

    Attributes:
        share: counter of the rejected readings.
    """

    def __init__(self, sensor: Sensor, unit: str, spread_s: float = math.inf) -> None:
        """Start without readings.

        Args:
            sensor: the sensor's section of the sensor file, with scale, range and filter.
            unit: unit of the quantity, for messages.
            spread_s: maximum time over which a rise in a total is spread (s).
        """
        self._sensor, self._unit = sensor, unit
        self._values: deque[float] = deque(maxlen=sensor.median)
        self._total = Total(sensor, unit, spread_s) if sensor.counts else None
        self._suspended = suspended_time()
        self.share = RefusedShare()

    def clear(self, why: str) -> None:
        """Discard all readings and record the reason; the next value is based on new readings only.

        A running total is not discarded, because its growth in the meantime is water that has
        really fallen or flowed.
        """
        self.share.count(why)
        self._values.clear()
        if self._total is not None:
            self._total.sensor_lost()

    def clear_after_suspend(self) -> bool:
        """Discard all readings if the computer has been suspended.

        Returns:
            Whether the computer was suspended since the last call.
        """
        before, self._suspended = self._suspended, suspended_time()
        if self._suspended - before <= _SUSPEND_S:
            return False
        self.clear("the machine was suspended")
        return True

    def add(self, raw: float) -> float | None:
        """Add a reading; return the quantity, filtered with the earlier readings.

        Returns:
            The quantity; None for the first total, or for a total below the last, which means that
            the sensor has restarted.

        Raises:
            ValueError: if the reading is not a number or is out of range.
        """
        sensor = self._sensor
        value = sensor.convert(raw)
        if not math.isfinite(value):
            raise ValueError(f"reports {raw}, which is not a number")
        if self._total is not None:
            self._total.add(raw)
            self.share.count()
            return self._total.rate()
        if not sensor.low <= value <= sensor.high:
            raise ValueError(
                f"reports {value:.6g} {self._unit} (raw {raw:g}), which is not from {sensor.low:g} "
                f"to {sensor.high:g} {self._unit}"
            )
        self._values.append(value)
        self.share.count()
        return statistics.median_low(self._values)

    def current(self, reading: Reading) -> Reading:
        """Return a reading with its current value; the rate of a total changes between readings."""
        if self._total is None or (rate := self._total.rate()) == reading.value:
            return reading
        return replace(reading, value=rate)


class SensorReader:
    """Base class for the reader of a sensor, which keeps the latest snapshot of the quantity.

    A rejected value, a failure or a suspension of the computer empties the filter, so the next
    value is based on new readings only. The rise in a total is not affected.
    """

    def __init__(self, sensor: Sensor, unit: str, spread_s: float, first: Reading) -> None:
        """Start without readings.

        Args:
            sensor: see :class:`Readings`.
            unit: see :class:`Readings`.
            spread_s: see :class:`Readings`.
            first: initial snapshot, valid until the first reading has arrived or failed.
        """
        self._readings, self._reading = Readings(sensor, unit, spread_s), first
        self._lock = threading.RLock()

    @property
    def snapshot(self) -> Reading:
        """The latest snapshot of the quantity."""
        with self._lock:
            self._reading = self._readings.current(self._reading)
            return self._reading

    @property
    def share(self) -> RefusedShare:
        """The counter of the sensor's rejected readings."""
        return self._readings.share

    def report_failure(self, problem: str, code: str = "sensor_lost") -> None:
        """Record a failed reading with its problem and condition code."""
        with self._lock:
            self._readings.clear(problem)
            self._reading = Reading(time.monotonic(), problem, code=code)
