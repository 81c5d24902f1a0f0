"""Monitor that checks whether a drive obeys *stop*: its speed must fall."""

from __future__ import annotations

import math
from dataclasses import replace

from greenroof_ros.live.devices.drive import DriveStatus
from greenroof_ros.live.devices.modbus_line import DriveError

# The minimum decrease of the speed that counts (share of the rated speed).
SLOWER = 0.005
# A drive that acknowledges *stop* has a fault if its speed has not fallen for RUNS_ON_S (s), which
# is longer than a drive needs to begin its ramp. It is left in silence once the fault has been
# visible for VISIBLE_S (s), which is longer than the caller's step, even if a connection breaks
# meanwhile. Together they do not exceed the default time for which pump control waits for a speed
# to follow beyond the ramp (follow_time).
RUNS_ON_S, VISIBLE_S = 10.0, 2.0
# Minimum time from a silence that did not help to the next one (s): the fault may need a person.
RUNS_ON_AGAIN_S = 60.0


class RunsOnError(DriveError):
    """Error for a drive that runs on after *stop*; nothing must be sent to it for a while."""


class Deceleration:
    """The fall of a drive's speed after *stop*."""

    def __init__(self) -> None:
        self._lowest, self._fell_at = math.inf, -math.inf

    def update(self, status: DriveStatus, now: float) -> float:
        """Process a drive's status, and return the time since its speed last fell (s)."""
        if abs(status.speed) < self._lowest - SLOWER:
            self._lowest, self._fell_at = abs(status.speed), now
        return now - self._fell_at


class StopMonitor:
    """Monitor that checks whether a drive obeys *stop*, even across lost connections.

    A drive obeys if its speed falls, however slowly. A drive under local control is left to the
    person at its panel. All times are those of `time.monotonic` (s).
    """

    def __init__(self, where: str) -> None:
        """Initialize the monitor without any knowledge of the drive.

        Args:
            where: address of the drive, for messages.
        """
        self._where = where
        # The fall since *stop* became the last order; None if the drive runs or is stopped.
        self._fall: Deceleration | None = None
        # For how long reports have shown that the speed does not fall, and the time of the last
        # such report on this connection.
        self._visible_s, self._reported_at = 0.0, math.inf
        # Time since which *stop* has been written without any speed being read.
        self._unread_from = math.inf
        # The number of consecutive connections on which the last *stop* could not be written.
        self._refusals = 0
        # End of the last silence because the drive ran on or its speed could not be read; reset
        # when it comes to rest or runs.
        self._silent_until = -math.inf

    def stop_written(self, now: float) -> None:
        """Record that *stop* was written as the last command."""
        self._fall = self._fall or Deceleration()
        self._unread_from = min(self._unread_from, now)

    def order_changed(self) -> None:
        """Record that the last command was not *stop*, or may have come from another program."""
        self._fall = None

    def speed_read(self) -> None:
        """Record that the speed was read, or that a person at the panel controls the drive."""
        self._unread_from = math.inf

    def check(
        self, status: DriveStatus, now: float, disbelieved: bool = False
    ) -> DriveStatus:
        """Return a drive's status, with a fault added if the drive runs on after *stop*.

        Args:
            status: the status.
            now: the time.
            disbelieved: whether the pump is running although the drive reports standstill.

        Raises:
            RunsOnError: if the fault has been visible for long enough or is certain.
        """
        fall, reported_at, self._reported_at = self._fall, self._reported_at, math.inf
        if disbelieved and fall is not None and status.at_rest:
            raise RunsOnError(
                "drive", f"{self._where}: the drive reports standstill, but water is flowing"
            )
        if fall is None or status.at_rest or not status.remote:
            self._fall, self._silent_until = None, -math.inf
            return status
        steady_s = fall.update(status, now)
        if steady_s <= RUNS_ON_S:
            self._visible_s = 0.0
            return status
        self._reported_at, self._visible_s = now, self._visible_s + max(0.0, now - reported_at)
        problem = f"the drive acknowledges *stop*, but its speed has not fallen for {RUNS_ON_S:g} s"
        if self._visible_s > VISIBLE_S and now - self._silent_until > RUNS_ON_AGAIN_S:
            raise RunsOnError(
                "drive", f"{self._where}: {problem} (the speed is {status.speed:.1%})"
            )
        fault = "; ".join(filter(None, (status.fault, problem)))
        return replace(status, fault=fault, timed_out=False, runs_on=True)

    def connection_lost(self, stopped: bool | None, now: float) -> str | None:
        """Record that the connection was lost.

        Args:
            stopped: whether the last *stop* was written; None if no *stop* was attempted.
            now: the time.

        Returns: The reason why nothing may be sent to the drive for a while, worded to be appended
        to the problem; None if no silence is needed.
        """
        self._reported_at = math.inf
        if stopped is not None:
            self._refusals = 0 if stopped else self._refusals + 1
        unread = now - self._unread_from > RUNS_ON_S
        if stopped and unread and now - self._silent_until > RUNS_ON_AGAIN_S:
            return (
                f"; the speed cannot be read, and for {RUNS_ON_S:g} s it has been unknown "
                "whether the drive has stopped, although *stop* is written"
            )
        if self._refusals > 1:
            return "; *stop* could not be written on two successive connections"
        return None

    def silence_started(self, until: float) -> None:
        """Record the start of a silence, and the time of its end."""
        if not self._refusals:
            self._silent_until = until
