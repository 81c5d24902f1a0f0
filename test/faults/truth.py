"""What really happens: the speed of the simulated drive, twenty times a second, and its faults."""

from __future__ import annotations

import asyncio
import itertools
import threading
import time
from collections import deque
from collections.abc import Coroutine, Iterator
from typing import Any

from greenroof_ros.drives.address import Address
from greenroof_ros.drives.faults import DEFAULT, DRIVE_FAULTS, SITE_FAULTS
from greenroof_ros.drives.modbus_line import DriveError
from greenroof_ros.drives.workbench import Workbench

_PERIOD_S = 0.05
# Six minutes, longer than the longest case.
_KEPT = 7200
# How far back a pump without a break is looked for (s).
_LOOK_BACK_S = 15.0
# Below it the motor stands (share of rated speed).
STANDS = 0.005
# Above it it runs.
TURNS = 0.1


class Truth:
    """Looks at the workbenches of drive and site; speaks to them from a thread of its own."""

    def __init__(self, drive: Address, site: Address | None = None) -> None:
        self.greatest = 0.0
        self.samples: deque[tuple[float, float]] = deque(maxlen=_KEPT)  # time (s), speed
        self._drive_at, self._site_at = drive, site
        self._loop = asyncio.new_event_loop()
        self._ended = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ended = True
        self._thread.join(5)

    def _work(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.set_exception_handler(lambda loop, context: None)
        self._drive = Workbench(self._drive_at)
        self._site = None if self._site_at is None else Workbench(self._site_at, SITE_FAULTS)
        self._loop.run_until_complete(self._sample())
        self._loop.close()

    async def _sample(self) -> None:
        while not self._ended:
            try:
                before = time.monotonic()
                speed = await self._drive.speed()
                self.samples.append(((before + time.monotonic()) / 2, speed))
                self.greatest = max(self.greatest, speed)
            except DriveError:
                pass  # the simulator was killed or stopped: nothing is known for a while
            await asyncio.sleep(_PERIOD_S)
        self._drive.close()
        if self._site is not None:
            self._site.close()

    def _do(self, action: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(action, self._loop).result(5)

    def inject_drive(self, fault: str, parameter: int = DEFAULT) -> None:
        assert fault in DRIVE_FAULTS
        self._do(self._drive.inject(fault, parameter))

    def inject_site(self, fault: str, parameter: int = DEFAULT) -> None:
        assert self._site is not None
        self._do(self._site.inject(fault, parameter))

    def take_over(self, local: bool) -> None:
        self._do(self._drive.take_over(local))

    @property
    def speed(self) -> float:
        return self.samples[-1][1] if self.samples else 0.0

    def runs(self) -> bool:
        """Whether the pump turns, and has for the last half second."""
        recent = self._from(time.monotonic() - 0.5)
        return len(recent) >= 3 and min(speed for _, speed in recent) > TURNS

    def steady_for(self) -> float:
        """Return for how long the pump has turned without a break (s), as far as is known."""
        now = since = time.monotonic()
        for at, speed in self._newest_first():
            if speed <= TURNS or since - at > 2.0 or now - at > _LOOK_BACK_S:
                break
            since = at
        return now - since

    def stood_at(self, since: float) -> float | None:
        """Return when the pump first stood after a time; None if it has not."""
        return next((at for at, speed in self._from(since) if speed <= STANDS), None)

    def turned(self, since: float, until: float) -> float:
        """Return the greatest speed between two times."""
        return max((v for at, v in self._from(since) if at <= until), default=0.0)

    def least(self, since: float, until: float) -> float:
        """Return the least speed between two times."""
        return min((v for at, v in self._from(since) if at <= until), default=0.0)

    def _newest_first(self) -> Iterator[tuple[float, float]]:
        """Yield the samples while others are being added, which an iterator does not bear."""
        for number in range(1, len(self.samples)):
            yield self.samples[-number]

    def _from(self, since: float) -> list[tuple[float, float]]:
        """Return the samples after a time, in order."""
        found = list(itertools.takewhile(lambda one: one[0] >= since, self._newest_first()))
        return found[::-1]
