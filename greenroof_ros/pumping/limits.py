"""When a pump may start, must stay on, and must not run: times, starts, a day's use, water, frost.

All of it heals by itself.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

from greenroof_ros.model.site import Site
from greenroof_ros.pumping.ledger import Ledger
from greenroof_ros.pumping.settings import DAY_S, PumpSettings

_HOUR_S = 3600.0


class SwitchLimits:
    """Least times on and off, and starts in any hour.

    How long the pump had been off before the first step is unknown, so it waits for the least time
    off first.
    """

    def __init__(self, settings: PumpSettings, started_ago: Iterable[float] = ()) -> None:
        """Prepare for the first step.

        Args:
            settings: the limits.
            started_ago: how long before the first step the pump was started (s), oldest first.
        """
        self._settings = settings
        self._switched_at: float | None = None
        self._starts = deque(-ago for ago in started_ago)

    def begin(self, now: float) -> None:
        """Take the first step's time (s) for that of the last stop."""
        if self._switched_at is None:
            self._switched_at = now
            self._starts = deque(now + start for start in self._starts)

    def started(self, now: float) -> None:
        """Count a start."""
        self._switched_at = now
        self._starts.append(now)

    def stopped(self, now: float) -> None:
        """Count a stop."""
        self._switched_at = now

    def since_start(self, now: float) -> float:
        """Return the time since the last start (s)."""
        return now - self._starts[-1] if self._starts else math.inf

    def must_stay_on(self, now: float) -> bool:
        """Whether a pump that is on has not been for the least time."""
        return self._elapsed(now) < self._settings.least_on

    def wait(self, now: float) -> tuple[float, str]:
        """Return how long a pump that is off must wait before it starts (s), and why."""
        while self._starts and now - self._starts[0] >= _HOUR_S:
            self._starts.popleft()
        waits = [
            (self._settings.least_off - self._elapsed(now),
             f"it stays off for at least {self._settings.least_off:g} s"),
        ]
        allowed = int(self._settings.starts_per_hour)
        if len(self._starts) >= allowed:
            again = self._starts[0] + _HOUR_S - now
            waits.append((again, f"it starts at most {allowed} times in an hour"))
        longest, why = max(waits)
        return (longest, why) if longest > 0 else (0.0, "")

    def _elapsed(self, now: float) -> float:
        return math.inf if self._switched_at is None else now - self._switched_at


class SiteLimits:
    """What must be so at the site: water above the suction level, no frost, not too much of all."""

    def __init__(self, site: Site, settings: PumpSettings, ledger: Ledger) -> None:
        self._site = site
        self._settings = settings
        self._ledger = ledger
        self._dry = False
        self._on_for = 0.0
        self._rests_for = 0.0

    def account(self, dt: float, on: bool) -> None:
        """Count time (s) in which the pump was on, or was not."""
        if on:
            self._on_for += dt
            if self._on_for >= self._settings.greatest_run:
                self._rests_for = self._settings.greatest_run
        else:
            self._on_for = 0.0
            self._rests_for = max(0.0, self._rests_for - dt)

    def reasons(
        self,
        command: float | None,
        cistern_level: float | None,
        roof_level: float | None,
        frost: bool | None,
    ) -> dict[str, str]:
        """Return what speaks against running now, by interlock; to be asked at every step.

        Args:
            command: share of the maximum flow; 0 ends the rest after too long a run, None (no
                good command) does not.
            cistern_level: m; None is unknown.
            roof_level: m; None is unknown.
            frost: whether there is; None is unknown.
        """
        reasons = self._water(cistern_level) | self._day()
        if roof_level is None:
            reasons["roof_level_unknown"] = "the level of the roof is unknown"
        if frost is None:
            reasons["frost_unknown"] = "it is unknown whether there is frost"
        elif frost:
            reasons["frost"] = "there is frost"
        if command == 0:
            self._rests_for = 0.0
        if self._rests_for > 0:
            reasons["longest_run"] = (
                f"it ran for {_minutes(self._settings.greatest_run)} without a break; it rests "
                f"until the command is 0, or for {_minutes(self._rests_for)}"
            )
        return reasons

    def _water(self, level: float | None) -> dict[str, str]:
        if level is None:
            return {"cistern_level_unknown": "the level of the cistern is unknown"}
        least = self._site.suction_level + self._settings.level_offset
        if self._dry:
            least += self._settings.suction_hysteresis
        self._dry = level <= least
        if self._dry:
            return {"cistern_low": f"the cistern is at {level:.3f} m, not above {least:g} m"}
        return {}

    def _day(self) -> dict[str, str]:
        record, settings = self._ledger.record, self._settings
        reasons: dict[str, str] = {}
        again = f"goes on in {_minutes(DAY_S - record.day_elapsed)}"
        if record.day_volume >= settings.greatest_volume_per_day:
            reasons["daily_volume"] = (
                f"{record.day_volume:.2f} m3 were pumped in this day, the most is "
                f"{settings.greatest_volume_per_day:g} m3; {again}"
            )
        if record.day_run >= settings.greatest_run_per_day:
            reasons["daily_run"] = (
                f"it ran for {_minutes(record.day_run)} in this day, the most is "
                f"{_minutes(settings.greatest_run_per_day)}; {again}"
            )
        return reasons


def _minutes(seconds: float) -> str:
    """Return a time as people say it."""
    if seconds < 120:
        return f"{math.ceil(seconds)} s"
    return f"{math.ceil(seconds / 60)} min"
