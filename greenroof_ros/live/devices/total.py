"""Conversion of a running total, from a tipping bucket or a water meter, to a rate."""

from __future__ import annotations

import threading
import time
from collections import defaultdict, deque

from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.devices.sensor_file import Sensor

# A message may be repeated or overtaken within this time (s).
_LATE_S = 2.0
# A rise may exceed the maximum rate by as much as that rate adds in this time (s).
_BURST_S = 60.0
# Shortest time over which a rise is spread (s), which covers several calls by the node.
_MIN_SPREAD_S = 0.5
# Widths of counters that roll over (bits).
_BITS = (16, 32, 64)


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
