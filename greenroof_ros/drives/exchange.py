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
from greenroof_ros.drives.drive_file import LONGEST_RAMP_S, DriveFile
from greenroof_ros.drives.lock import DriveLock, HeldError
from greenroof_ros.drives.modbus_line import DriveError, check_installed

# Waits between two attempts to connect (s): the first, and the longest.
FIRST_WAIT_S, LONGEST_WAIT_S = 0.25, 5.0
# How long the speed of a drive that was told to stop may stay as it is before it is taken for one
# that does not stop (s), and what counts as slower (share of rated speed).
STILL_S, SLOWER = 3.0, 0.005
# A drive that acknowledges *stop* and whose speed does not fall for so long (s) has a fault, and is
# left in silence when that fault could be seen for so long (s). Longer than a drive needs to begin
# its ramp, and than a tick of who asks for it, even where a connection breaks meanwhile; together
# less than the pump control waits for a speed to follow.
RUNS_ON_S, SEEN_S = 10.0, 2.0
# The same after a silence that did not help (s): it may be faults that only a person can end.
RUNS_ON_AGAIN_S = 60.0
# For how long orders may still go to a drive whose speed cannot be read (s), before the silence in
# which its own timeout can fall.
UNREAD_S = RUNS_ON_S + LONGEST_WAIT_S
# Above this share of rated speed a pump that is told to stop turns: more than noise at rest.
TURNS = 0.02
# How long a drive is given to come to rest, at most (s), by its driver and by the supervisor: its
# ramp, and what asking takes. It must fit into the 40 s that bringup gives the pump node to end,
# and twice, one after the other, into the 120 s that examples/greenroof.service has.
LEAVE_S = LONGEST_RAMP_S + 3.0
# After a drive did not come to run, how long it is left off before the next attempt (s).
PAUSE_S = 2.0
# The same after the last sign that somebody else writes to it: longer than a slow writer's period.
INTRUDER_PAUSE_S = 10.0
# How long the drive has to acknowledge its fault before the fault counts again (s).
RESET_S = 5.0
# How often the drive's settings on which safety rests are read again (s).
SETTINGS_S = 30.0
# By how much a silence is longer than the drive's own communication timeout (s).
SILENCE_MARGIN_S = 1.0
# Between two attempts to be the only driver of this machine (s).
LOCK_WAIT_S = 1.0
# So many cycles without a valid answer, one after the other, are a lost connection.
LOST_AFTER = 2

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Snapshot:
    """What is known of a drive at one moment.

    Attributes:
        status: what it said last; None while there is no connection. After `close`: what it said
            when it was left, which may be that it does not stand; None where it was not heard.
        read_at: when (s, `time.monotonic`).
        connected: there is a connection, over which answers come.
        identity: its nameplate; empty until read.
        timeout_s: its own communication timeout (s); None for off.
        timeout_known: the timeout could be read.
        timeout_note: why it counts as off, or could not be read.
        hold: why the drive is kept off although it is connected; empty where nothing does.
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
    hold: str = ""
    problem: str = "not yet connected"
    errors: int = 0


class DriveExchange:
    """Keeps a drive at the speed that was asked for last, or off.

    Control word and status go over the line in every period, so that the drive's own communication
    timeout is kept alive as long as, and only as long as, this thread lives. Where the drive does
    not take the order to stop, or acknowledges it and runs on, it is left in silence for longer
    than that timeout: it may count any order as a sign of life; so is one that takes the order and
    whose speed cannot be read. While this lives, it is the only one on this machine for its drive.
    Nothing here raises into the caller.
    """

    def __init__(
        self,
        file: DriveFile,
        address: Address,
        period_s: float = 0.25,
        dead_man_s: float = 1.0,
        *,
        timeout_s: float = 0.5,
        timeout_limit_s: float = 10.0,
    ) -> None:
        """Prepare it.

        Args:
            file: what the drive is like.
            address: where it is.
            period_s: between two rounds of requests (s).
            dead_man_s: the drive is stopped when `demand` was not called for so long (s).
            timeout_s: longest wait for each answer (s).
            timeout_limit_s: what the drive's own communication timeout is taken for while it is
                unknown, or off (s).

        Raises:
            ConfigurationError: there is no Modbus library.
        """
        check_installed()
        self._drive = (file, address, timeout_s)
        self._only = DriveLock(file, address)
        self._period_s, self._dead_man_s, self._timeout_s = period_s, dead_man_s, timeout_s
        self._timeout_limit_s = timeout_limit_s
        self._snapshot, self._lock = Snapshot(), threading.Lock()
        # Written and read whole, so that no lock is needed.
        self._demand: tuple[float | None, float] = (None, -math.inf)
        # Until then a fault is to be acknowledged.
        self._reset_until = -math.inf
        self._closing = False
        self._leave_by = math.inf
        self._paused_until = -math.inf
        self._settings_at = -math.inf
        # On so many connections, one after the other, *stop* could not be written at last.
        self._not_stopped = 0
        # How the speed falls since *stop* is the last word, over connections that break, too; None
        # where the drive is run, or stands.
        self._fall: _Fall | None = None
        # Since when connections begin with a *stop* that is taken, and no speed is read.
        self._unread_from: float | None = None
        # It runs on although it acknowledges *stop*, and must be left in silence now.
        self._runs_on = False
        # When it was left so last, or as its speed could not be read, since it last stood or ran.
        self._left_at = -math.inf
        own = file.timeout.over(address)
        self._unguarded_s = 0.0 if own is None else own.unguarded_after_power_up_s
        self._guarded_from = -math.inf
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
        """Stop the drive, read back that it stands, and let go; what came of it is in `snapshot`.

        It goes on for as long as the speed falls, `LEAVE_S` at most; a drive whose speed does not
        fall, or that does not answer, is left after a few seconds.
        """
        self._demand = (None, -math.inf)
        self._leave_by = time.monotonic() + LEAVE_S
        self._closing = True
        self._rouse()
        if self._thread.is_alive():
            self._thread.join(LEAVE_S + LONGEST_WAIT_S)
            if self._thread.is_alive():
                self._update(connected=False, status=None)
                self._fail("whether the drive stands was not read: its connection hangs")

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
        """Have a fault acknowledged; the drive is stopped for it.

        It is for the faults that can be seen now: without a connection, or when it could not be
        done for `RESET_S`, nothing comes of it.
        """
        self._reset_until = time.monotonic() + RESET_S
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
        return speed if fresh and not self._closing and not self._hold() else None

    def _hold(self) -> str:
        """Return why the drive must not run although it is connected.

        Since the connection before, it may have been without power, which looks like a cut cable.
        """
        if time.monotonic() >= self._guarded_from:
            return ""
        return (
            f"its own communication timeout does not guard for {self._unguarded_s:g} s after "
            "power-up, so it is not run for so long after it was connected"
        )

    def _work(self) -> None:
        try:
            asyncio.run(self._keep_up())
        except BaseException as error:
            _log.exception("the exchange with the drive has ended")
            self._update(connected=False, status=None)
            self._fail(
                f"the exchange with the drive has ended: {error!r}; nothing is sent to it any "
                "more, so that its own timeout stops it; restart this program"
            )
        finally:
            self._only.release()

    async def _keep_up(self) -> None:
        self._loop, self._wake = asyncio.get_running_loop(), asyncio.Event()
        # A protocol that chokes on nonsense closes the connection, which is noticed here anyway.
        self._loop.set_exception_handler(lambda _loop, context: _log.debug("%s", context))
        if not await self._alone():
            return
        wait = FIRST_WAIT_S
        left: DriveStatus | None = None
        while left is None:
            last_attempt = self._closing
            drive = Drive(*self._drive)
            try:
                try:
                    await self._greet(drive)
                    wait = FIRST_WAIT_S
                    while not self._closing:
                        await self._cycle(drive)
                    left = await _stand(drive, self._leave_by)
                    self._update(read_at=time.monotonic())
                finally:
                    self._update(connected=False, status=left)
                    await drive.close()
            except DriveError as error:
                self._fail(str(error))
            except Exception as error:  # whatever it is, the next attempt starts with a stop
                _log.exception("talking to the drive failed")
                self._fail(f"talking to the drive failed: {error!r}")
            if drive.stopped is not None:
                self._not_stopped = 0 if drive.stopped else self._not_stopped + 1
            if last_attempt:
                break
            if self._runs_on:
                await self._leave("")
            elif drive.stopped and self._is_unread():
                await self._leave(
                    "; its speed cannot be read, and whether it stands has not been known for "
                    f"{RUNS_ON_S:g} s, although *stop* is written"
                )
            elif self._not_stopped > 1:
                await self._be_silent(
                    "; *stop* could not be written on two connections one after the other"
                )
            elif left is None and not self._closing:
                await self._pause(wait)
                wait = min(2 * wait, LONGEST_WAIT_S)

    async def _alone(self) -> bool:
        """Wait until nobody else on this machine runs the drive; tell whether it came to that."""
        while not self._closing:
            try:
                self._only.take()
            except DriveError as error:
                if self._snapshot.problem != str(error):
                    self._fail(str(error))
            else:
                return True
            await self._pause(LOCK_WAIT_S)
        return False

    def _is_unread(self) -> bool:
        """Whether it must be left in silence because its speed cannot be read."""
        now = time.monotonic()
        return (
            self._unread_from is not None and now - self._unread_from > RUNS_ON_S
            and now - self._left_at > RUNS_ON_AGAIN_S
        )

    async def _leave(self, why: str) -> None:
        """Be silent once, and remember when: the next silence comes a while later."""
        self._runs_on = False
        await self._be_silent(why)
        self._left_at = time.monotonic()

    async def _be_silent(self, why: str) -> None:
        """Send nothing, for longer than the drive waits before it stops by itself.

        Args:
            why: what to say of that after the problem.
        """
        known = self._snapshot.timeout_s
        timeout_s = self._timeout_limit_s if known is None else known
        silence_s = timeout_s + SILENCE_MARGIN_S
        self._update(problem=(
            f"{self._snapshot.problem}{why}, so nothing is sent for {silence_s:g} s: the drive's "
            f"own communication timeout ({timeout_s:g} s"
            f"{'' if known is not None else ', if it is no longer'}) stops it then, which any "
            "message might put off"
        ))
        until = time.monotonic() + silence_s
        while not self._closing and time.monotonic() < until:
            await self._pause(until - time.monotonic())

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
        self._guarded_from = time.monotonic() + self._unguarded_s
        try:
            await self._stop(drive)
            if self._unread_from is None:
                self._unread_from = time.monotonic()
            # Another one's word, which takes a while to come, cannot stand there yet.
            await drive.intruder()
            status = self._judge(await self._read(drive))
        except DriveError as error:
            # How long a silence must be is worth another question.
            if error.kind != "connection" and not self._snapshot.timeout_known:
                await self._read_settings(drive)
            raise
        try:
            identity = await drive.identify()
        except DriveError as error:
            if error.kind == "connection":
                raise
            identity = self._snapshot.identity or "unknown"
        await self._read_settings(drive)
        self._reset_until = -math.inf
        self._update(
            status=status, read_at=time.monotonic(), connected=True, problem="",
            identity=identity, hold=self._hold(),
        )

    async def _read_settings(self, drive: Drive) -> None:
        """Read what somebody may change at the panel, and on which safety rests."""
        drive.forget_full_scales()
        seconds, known = None, False
        try:
            seconds = await drive.timeout()
            known, note = True, drive.timeout_note
        except DriveError as error:
            if error.kind == "connection":
                raise
            note = str(error)
        self._settings_at = time.monotonic()
        self._update(timeout_s=seconds, timeout_known=known, timeout_note=note)

    async def _cycle(self, drive: Drive) -> None:
        started = time.monotonic()
        silent = 0
        while True:
            try:
                problem = await self._exchange(drive)
                status = await self._read(drive)
                if time.monotonic() - self._settings_at > SETTINGS_S:
                    await self._read_settings(drive)
                break
            except DriveError as error:
                silent += 1
                if silent >= LOST_AFTER or not drive.connected:
                    raise
                self._fail(str(error))
                # What is still to come of the late answer must not be taken for the next.
                await asyncio.sleep(self._period_s)
        status = self._judge(status)
        self._update(
            status=status, read_at=time.monotonic(), problem=problem or self._lasting(),
            hold=self._hold(),
        )
        if not self._closing:
            await self._pause(max(0.0, self._period_s - (time.monotonic() - started)))

    def _judge(self, status: DriveStatus) -> DriveStatus:
        """Return what the drive said, with a fault where it was told to stop and runs on.

        One whose speed falls, however slowly, obeys. One in local control is a person's at its
        panel; it is that person's to stop.

        Raises:
            DriveError: it must be left in silence now.
        """
        fall, now, before = self._fall, time.monotonic(), self._snapshot
        if fall is None or abs(status.speed) <= TURNS or not status.remote:
            self._fall, self._left_at = None, -math.inf
            return status
        if fall.still_s(status) <= RUNS_ON_S:
            return status
        says = f"it acknowledges *stop*, but its speed has not fallen for {RUNS_ON_S:g} s"
        if before.status is not None and says in before.status.fault:
            fall.seen_s += now - before.read_at
        if fall.seen_s > SEEN_S and now - self._left_at > RUNS_ON_AGAIN_S:
            self._runs_on = True
            raise DriveError("drive", f"{self._drive[1]}: {says} (it is {status.speed:.1%})")
        fault = "; ".join(filter(None, (status.fault, says)))
        return replace(status, fault=fault, timed_out=False)

    async def _read(self, drive: Drive) -> DriveStatus:
        """Return what the drive says, after acknowledging that its communication timeout passed.

        That trip is what a lost connection comes to, and is over when the connection is back.
        """
        try:
            status = await drive.read()
        except DriveError as error:
            # A person at its panel has it, and sees whether it turns.
            if error.kind != "connection" and await drive.local():
                self._unread_from = None
            raise
        self._unread_from = None
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
        pause_s = PAUSE_S
        try:
            intruder = await drive.intruder()
            if intruder:
                pause_s = INTRUDER_PAUSE_S
                self._fall = None  # it may be the other one whom the drive obeys
                raise DriveError(
                    "drive", f"{intruder}; stopped until {pause_s:g} s after the last such word"
                )
            if time.monotonic() < self._reset_until:
                self._reset_until = -math.inf
                self._paused_until = -math.inf
                await drive.reset()
            speed = self._wanted()
            if speed is None or time.monotonic() < self._paused_until:
                await self._stop(drive)
            else:
                await self._run(drive, speed)
        except DriveError as error:
            if error.kind != "drive":
                raise
            await self._stop(drive)
            self._fail(str(error))
            self._paused_until = time.monotonic() + pause_s
            return str(error)
        return ""

    async def _run(self, drive: Drive, speed: float) -> None:
        try:
            await drive.run(speed, lambda: self._wanted() is not None)
        except DriveError as error:
            if error.kind != "drive":
                self._fall = None  # it may obey an order whose answer was lost
            raise
        self._fall = None

    async def _stop(self, drive: Drive) -> None:
        await drive.stop()
        self._fall = self._fall or _Fall()


class _Fall:
    """How the speed of a drive falls that is told to stop."""

    def __init__(self) -> None:
        self._lowest, self._fell_at = math.inf, time.monotonic()
        # For how long (s) it could be seen that it does not fall.
        self.seen_s = 0.0

    def still_s(self, status: DriveStatus) -> float:
        """Take in what the drive says now; return for how long its speed has not fallen (s)."""
        now = time.monotonic()
        if abs(status.speed) < self._lowest - SLOWER:
            self._lowest, self._fell_at, self.seen_s = abs(status.speed), now, 0.0
        return now - self._fell_at


async def _stand(drive: Drive, until: float) -> DriveStatus:
    """Stop a drive, and return what it says when it stands, or does not come to that.

    How long its ramp is, no drive file says; so it is waited for as long as the speed falls.
    """
    fall = _Fall()
    while True:
        await drive.stop()
        status = await drive.read()
        if status.stands or fall.still_s(status) > STILL_S or time.monotonic() > until:
            return status
        await asyncio.sleep(0.1)


def stop_drive(
    file: DriveFile, address: Address, *, driver: int | None = None, timeout_s: float = 0.5
) -> DriveStatus:
    """Stop a drive whose driver has died; blocks while its speed falls, `LEAVE_S` at most.

    The lock keeps others off meanwhile, but is not needed: a driver that hangs still has it, and
    where it cannot be had, or its holder not be known, to stop is safe.

    Args:
        file: what the drive is like.
        address: where it is.
        driver: the process of that driver, which may have the lock; None where there is none.
        timeout_s: longest wait for each answer (s).

    Returns:
        What the drive said when it was stopped, which may be that it does not stand.

    Raises:
        HeldError: another process runs it, and nothing was sent.
        DriveError: it could not be told to in three attempts; the message says why.
    """
    only = DriveLock(file, address)
    try:
        only.take()
    except HeldError as error:
        if error.holder not in (None, driver):
            raise
    except DriveError:
        pass
    try:
        return asyncio.run(_stop(file, address, timeout_s))
    finally:
        only.release()


async def _stop(file: DriveFile, address: Address, timeout_s: float) -> DriveStatus:
    asyncio.get_running_loop().set_exception_handler(lambda _loop, _context: None)
    attempts, until = 3, time.monotonic() + LEAVE_S
    while True:
        drive = Drive(file, address, timeout_s)
        try:
            await drive.connect()
            return await _stand(drive, until)
        except DriveError:
            attempts -= 1
            if not attempts:
                raise
            await asyncio.sleep(FIRST_WAIT_S)
        finally:
            await drive.close()
