"""The true state: the simulated drive's speed, sampled twenty times a second, and its faults."""

from __future__ import annotations

import itertools
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress

from rig_simulators import DEFAULT, FAULTS
from simulators import Workbench

from greenroof_ros.live.devices.modbus_line import Address, DriveError

_PERIOD_S = 0.05
# Six minutes of samples, longer than the longest case.
_CAPACITY = 7200
# How far back to look for a break in running (s).
_HISTORY_S = 15.0
# Speed below which the motor is stopped (share of rated speed). It is below the drivers' limit,
# because a true speed has no noise.
AT_REST = 0.005
# Speed above which it runs.
TURNS = 0.1


class Truth:
    """Reads the workbenches of drive and site, in a thread of its own."""

    def __init__(self, drive: Address, site: Address | None = None) -> None:
        self._drive = Workbench(drive)
        self._site = None if site is None else Workbench(site)
        self.begin()

    def begin(self) -> None:
        """Begin to sample."""
        self.maximum = 0.0
        self.samples: deque[tuple[float, float]] = deque(maxlen=_CAPACITY)  # time (s), speed
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._thread.start()

    def read(self) -> float:
        """Return the present speed.

        Raises:
            DriveError: if nothing is known, since the simulator is killed or stopped.
        """
        return self._drive.speed()

    def close(self) -> None:
        self._ended.set()
        self._thread.join(5)
        self._drive.close()
        if self._site is not None:
            self._site.close()

    def _sample(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            with suppress(DriveError), self._lock:
                before = time.monotonic()
                speed = self.read()
                self.samples.append(((before + time.monotonic()) / 2, speed))
                self.maximum = max(self.maximum, speed)

    def inject_drive(self, fault: str, parameter: int = DEFAULT) -> None:
        assert fault in FAULTS
        self._request(lambda: self._drive.inject(fault, parameter))

    def inject_site(self, fault: str, parameter: int = DEFAULT) -> None:
        site = self._site
        assert site is not None
        self._request(lambda: site.inject(fault, parameter))

    def take_over(self, local: bool) -> None:
        self._request(lambda: self._drive.take_over(local))

    def _request(self, request: Callable[[], None]) -> None:
        with self._lock:
            try:
                request()
            except DriveError:  # the simulator was restarted since the last request
                request()

    @property
    def speed(self) -> float:
        return self.samples[-1][1] if self.samples else 0.0

    def runs(self) -> bool:
        """Return whether the pump turns, and has turned for the last half second."""
        recent = self._from(time.monotonic() - 0.5)
        return len(recent) >= 3 and min(speed for _, speed in recent) > TURNS

    def steady_for(self) -> float:
        """Return for how long the pump has turned without a break (s), as far back as is known."""
        now = since = time.monotonic()
        for at, speed in self._newest_first():
            if speed <= TURNS or since - at > 2.0 or now - at > _HISTORY_S:
                break
            since = at
        return now - since

    def stopped_at(self, since: float) -> float | None:
        """Return when the pump first stood after a time; None if it has not."""
        return next((at for at, speed in self._from(since) if speed <= AT_REST), None)

    def max_speed(self, since: float, until: float) -> float:
        """Return the maximum speed between two times."""
        return max((v for at, v in self._from(since) if at <= until), default=0.0)

    def minimum(self, since: float, until: float) -> float:
        """Return the minimum speed between two times."""
        return min((v for at, v in self._from(since) if at <= until), default=0.0)

    def _newest_first(self) -> Iterator[tuple[float, float]]:
        """Yield the samples, newest first; an iterator would fail while others are added."""
        for number in range(1, len(self.samples)):
            yield self.samples[-number]

    def _from(self, since: float) -> list[tuple[float, float]]:
        """Return the samples after a time, in order."""
        newest = itertools.takewhile(lambda sample: sample[0] >= since, self._newest_first())
        return list(newest)[::-1]
