"""What a sensor says, as the quantity that it measures: scaled, checked, filtered."""

from __future__ import annotations

import math
import statistics
import time
from collections import deque
from dataclasses import dataclass

from greenroof_ros.common.times import suspended_time
from greenroof_ros.drives.modbus_line import Known
from greenroof_ros.drives.sensor_file import Sensor

# A suspend so long (s) makes old what came before.
_SUSPEND_S = 1.0


@dataclass(frozen=True)
class Reading(Known):
    """What is known of a quantity.

    Attributes:
        value: in the unit of its topic. None if the last attempt gave none, and `problem` says why;
            or if it gave the first of two totals.
        code: of the problem.
    """

    value: float | None = None
    code: str = "sensor_lost"


class Readings:
    """The last values of a sensor, whose median counts.

    A median, not a first-order filter: it leaves single wrong readings out, where the other spreads
    them over many; and it follows a level that moves steadily, later by half its readings, without
    rounding off where it begins to move. Levels of tanks are slow enough for that.
    """

    def __init__(self, sensor: Sensor, unit: str) -> None:
        """Begin with none.

        Args:
            sensor: how its values are scaled, checked and filtered.
            unit: of the quantity, for messages.
        """
        self._sensor, self._unit = sensor, unit
        self._values: deque[float] = deque(maxlen=sensor.median)
        self._total: tuple[float, float] | None = None  # the last one, and when it came
        self._suspended = suspended_time()

    def clear(self) -> None:
        """Forget all: the next value comes from new readings alone."""
        self._values.clear()
        self._total = None

    def forget_after_suspend(self) -> bool:
        """Forget all if the machine was suspended since the last call; tell whether it was."""
        before, self._suspended = self._suspended, suspended_time()
        if self._suspended - before <= _SUSPEND_S:
            return False
        self.clear()
        return True

    def add(self, raw: float) -> float | None:
        """Take in what the sensor says now, and return the quantity by it and those before.

        Returns:
            None where it is a total, and there is none before it or a greater one: the sensor
            has started again.

        Raises:
            ValueError: it is no number, or out of range.
        """
        sensor = self._sensor
        value = sensor.scale * raw + sensor.offset
        if not math.isfinite(value):
            raise ValueError(f"says {raw}, which is no number")
        if sensor.counts:
            rate = self._rate(value)
            if rate is None:
                return None
            value = rate
        if not sensor.low <= value <= sensor.high:
            raise ValueError(
                f"says {value:.6g} {self._unit} (raw {raw:g}), which is not from {sensor.low:g} to "
                f"{sensor.high:g} {self._unit}"
            )
        self._values.append(value)
        return statistics.median_low(self._values)

    def _rate(self, total: float) -> float | None:
        """Return by how much a total has grown in a second since the one before."""
        before, self._total = self._total, (total, time.monotonic())
        if before is None or total < before[0] or self._total[1] == before[1]:
            return None
        return (total - before[0]) / (self._total[1] - before[1])
