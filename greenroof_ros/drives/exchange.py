"""A drive kept up with in a thread of its own, which stops it when nobody asks for it any more."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from dataclasses import dataclass, replace
from typing import Any

from greenroof_ros.drives.address import Address
from greenroof_ros.drives.drive import Drive, DriveStatus
from greenroof_ros.drives.drive_file import DriveFile
from greenroof_ros.drives.modbus_line import DriveError, check_installed

# Waits between two attempts to connect (s): the first, and the longest.
FIRST_WAIT_S, LONGEST_WAIT_S = 0.25, 5.0
# How long a drive is given to ramp down before the connection is given up (s).
RAMP_S = 3.0
# After a drive did not come to run, how long it is left off before the next attempt (s).
PAUSE_S = 2.0
# So many cycles without a valid answer, one after the other, are a lost connection.
LOST_AFTER = 2

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Snapshot:
    """What is known of a drive at one moment.

    Attributes:
        status: what it said last; None while there is no connection (after `close`: what it said
            when it was left).
        read_at: when (s, `time.monotonic`).
        connected: there is a connection, over which answers come.
        identity: its nameplate; empty until read.
        timeout_s: its own communication timeout (s); None for off.
        timeout_known: the timeout could be read.
        timeout_note: why it counts as off, or could not be read.
        problem: what went wrong last and is not over; empty for nothing.
        errors: how often anything went wrong.
    """

    status: DriveStatus | None = None
    read_at: float = -math.inf
    connected: bool = False
    identity: str = ""
    timeout_s: float | None = None
    timeout_known: bool = False
    timeout_note: str = ""
    problem: str = "not yet connected"
    errors: int = 0


class DriveExchange:
    """Keeps a drive at the speed that was asked for last, or off.

    Control word and status go over the line in every period, so that the drive's own communication
    timeout is kept alive as long as, and only as long as, this thread lives. Nothing here raises
    into the caller.
    """

    def __init__(
        self,
        file: DriveFile,
        address: Address,
        period_s: float = 0.25,
        dead_man_s: float = 1.0,
        *,
        device_id: int | None = None,
        timeout_s: float = 0.5,
    ) -> None:
        """Prepare it.

        Args:
            file: what the drive is like.
            address: where it is.
            period_s: between two rounds of requests (s).
            dead_man_s: the drive is stopped when `demand` was not called for so long (s).
            device_id: unit identifier or slave address; None for that of the file.
            timeout_s: longest wait for each answer (s).

        Raises:
            ConfigurationError: there is no Modbus library.
        """
        check_installed()
        self._drive = (file, address, device_id, timeout_s)
        self._period_s, self._dead_man_s, self._timeout_s = period_s, dead_man_s, timeout_s
        self._snapshot, self._lock = Snapshot(), threading.Lock()
        # Written and read whole, so that no lock is needed.
        self._demand: tuple[float | None, float] = (None, -math.inf)
        self._reset_wanted = False
        self._closing = False
        self._paused_until = -math.inf
        self._loop: asyncio.AbstractEventLoop | None = None
        self._wake: asyncio.Event | None = None
        self._thread = threading.Thread(target=self._work, name="drive", daemon=True)

    @property
    def snapshot(self) -> Snapshot:
        """What is known now."""
        return self._snapshot

    @property
    def lost_after_s(self) -> float:
        """Within which time a connection on which nothing comes any more is noticed (s)."""
        return LOST_AFTER * (self._timeout_s + self._period_s)

    def start(self) -> None:
        """Start: connect, stop the drive, and keep it stopped until something is asked for."""
        self._thread.start()

    def close(self) -> None:
        """Stop the drive, read back that it stands, and let go; a few seconds at most."""
        self._demand = (None, -math.inf)
        self._closing = True
        self._rouse()
        if self._thread.is_alive():
            self._thread.join(RAMP_S + 2 * (LOST_AFTER + 1) * self._timeout_s + 1.0)

    def demand(self, speed: float | None) -> None:
        """Ask for a speed (share of rated speed), or for off (None); holds for `dead_man_s`.

        What is no number between 0 and 1 is refused, as a problem, and means off.
        """
        if speed is not None and not 0 <= speed <= 1:
            self._fail(f"refused: {speed} is no share of rated speed")
            speed = None
        before = self._demand[0]
        self._demand = (speed, time.monotonic())
        if (speed is None) != (before is None):
            self._rouse()

    def reset(self) -> None:
        """Have a fault acknowledged; the drive is stopped for it."""
        self._reset_wanted = True
        self._rouse()

    # --- in the thread ----------------------------------------------------------------------------

    def _rouse(self) -> None:
        loop, wake = self._loop, self._wake
        if loop is not None and wake is not None:
            try:
                loop.call_soon_threadsafe(wake.set)
            except RuntimeError:
                return  # it has just ended

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._snapshot = replace(self._snapshot, **changes)

    def _fail(self, problem: str) -> None:
        with self._lock:
            errors = self._snapshot.errors + 1
            self._snapshot = replace(self._snapshot, problem=problem, errors=errors)

    def _wanted(self) -> float | None:
        speed, at = self._demand
        fresh = time.monotonic() - at <= self._dead_man_s
        return speed if fresh and not self._closing else None

    def _work(self) -> None:
        asyncio.run(self._keep_up())

    async def _keep_up(self) -> None:
        self._loop, self._wake = asyncio.get_running_loop(), asyncio.Event()
        # A protocol that chokes on nonsense closes the connection, which is noticed here anyway.
        self._loop.set_exception_handler(lambda _loop, context: _log.debug("%s", context))
        wait = FIRST_WAIT_S
        left = False
        while not left:
            last_attempt = self._closing
            drive = Drive(*self._drive)
            try:
                await self._greet(drive)
                wait = FIRST_WAIT_S
                while not self._closing:
                    await self._cycle(drive)
                self._update(status=await _stand(drive), read_at=time.monotonic())
                left = True
            except DriveError as error:
                self._fail(str(error))
            except Exception as error:  # whatever it is, the next attempt starts with a stop
                _log.exception("talking to the drive failed")
                self._fail(f"talking to the drive failed: {error!r}")
            finally:
                await drive.close()
                self._update(connected=False, **({} if left else {"status": None}))
            if last_attempt:
                break
            if not left and not self._closing:
                await self._pause(wait)
                wait = min(2 * wait, LONGEST_WAIT_S)

    async def _pause(self, seconds: float) -> None:
        assert self._wake is not None
        try:
            await asyncio.wait_for(self._wake.wait(), seconds)
        except asyncio.TimeoutError:
            return
        finally:
            self._wake.clear()

    async def _greet(self, drive: Drive) -> None:
        """Stop a drive first, then see what it is and whether it would stop by itself."""
        await drive.connect()
        await drive.stop()
        status = await self._read(drive)
        seconds, known = None, False
        try:
            identity = await drive.identify()
            seconds = await drive.timeout()
            known, note = True, drive.timeout_note
        except DriveError as error:
            if error.kind == "connection":
                raise
            identity = self._snapshot.identity or "unknown"
            note = str(error)
        self._update(
            status=status, read_at=time.monotonic(), connected=True, problem="",
            identity=identity, timeout_s=seconds, timeout_known=known, timeout_note=note,
        )

    async def _cycle(self, drive: Drive) -> None:
        started = time.monotonic()
        silent = 0
        while True:
            try:
                problem = await self._exchange(drive)
                status = await self._read(drive)
                break
            except DriveError as error:
                silent += 1
                if silent >= LOST_AFTER or not drive.connected:
                    raise
                self._fail(str(error))
                # What is still to come of the late answer must not be taken for the next.
                await asyncio.sleep(self._period_s)
        self._update(
            status=status, read_at=time.monotonic(), problem=problem or self._lasting()
        )
        if not self._closing:
            await self._pause(max(0.0, self._period_s - (time.monotonic() - started)))

    async def _read(self, drive: Drive) -> DriveStatus:
        """Return what the drive says, after acknowledging that its communication timeout passed.

        That trip is what a lost connection comes to, and is over when the connection is back.
        """
        status = await drive.read()
        if status.timed_out:
            self._fail(f"the drive had stopped by itself: {status.fault}")
            try:
                await drive.reset()
            except DriveError as error:
                if error.kind != "drive":
                    raise
            status = await drive.read()
        return status

    def _lasting(self) -> str:
        """Return the problem that a good cycle does not end: the drive did not come to run."""
        return self._snapshot.problem if time.monotonic() < self._paused_until else ""

    async def _exchange(self, drive: Drive) -> str:
        """Do what is asked for; return what the drive itself has against it."""
        try:
            if self._reset_wanted:
                self._reset_wanted = False
                self._paused_until = -math.inf
                await drive.reset()
            speed = self._wanted()
            if speed is None or time.monotonic() < self._paused_until:
                await drive.stop()
            else:
                await drive.run(speed, lambda: self._wanted() is not None)
        except DriveError as error:
            if error.kind != "drive":
                raise
            await drive.stop()
            self._fail(str(error))
            self._paused_until = time.monotonic() + PAUSE_S
            return str(error)
        return ""


async def _stand(drive: Drive) -> DriveStatus:
    """Stop a drive; return what it says when it stands, or `RAMP_S` later."""
    deadline = time.monotonic() + RAMP_S
    while True:
        await drive.stop()
        status = await drive.read()
        if status.stands or time.monotonic() > deadline:
            return status
        await asyncio.sleep(0.1)


def stop_drive(
    file: DriveFile, address: Address, *, device_id: int | None = None, timeout_s: float = 0.5
) -> DriveStatus:
    """Stop a drive whose driver has died; blocks for a few seconds at most.

    Returns:
        What the drive said when it was stopped, which may be that it does not stand.

    Raises:
        DriveError: it could not be told to in three attempts; the message says why.
    """
    return asyncio.run(_stop(file, address, device_id, timeout_s))


async def _stop(
    file: DriveFile, address: Address, device_id: int | None, timeout_s: float
) -> DriveStatus:
    asyncio.get_running_loop().set_exception_handler(lambda _loop, _context: None)
    attempts = 3
    while True:
        drive = Drive(file, address, device_id, timeout_s)
        try:
            await drive.connect()
            return await _stand(drive)
        except DriveError:
            attempts -= 1
            if not attempts:
                raise
            await asyncio.sleep(FIRST_WAIT_S)
        finally:
            await drive.close()
