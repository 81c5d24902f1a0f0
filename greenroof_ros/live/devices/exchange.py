"""Control of a drive or a relay from a separate thread, which stops it when requests cease."""

from __future__ import annotations

import math
import socket
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import read_yaml
from greenroof_ros.base.mqtt import parse_topic
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.processes import LockedError, acquire_name_lock
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.devices.drive import Drive, DriveEndpoint, DriveStatus
from greenroof_ros.live.devices.drive_file import (
    LIMIT_S,
    MAX_RAMP_S,
    read_drive_file,
    read_relay_file,
)
from greenroof_ros.live.devices.modbus_line import DeviceThread, DriveError, parse_drive_address
from greenroof_ros.live.devices.relay import Relay, RelayEndpoint

# Time between two rounds of requests (s), and how long each may wait for its response (s).
PERIOD_S, TIMEOUT_S = 0.1, 0.5
# Time without a request of the caller after which the drive is stopped (s).
DEAD_MAN_S = 1.0
# Longest time until a change is noticed (s): two rounds whose requests wait for their responses.
NOTICE_S = 1.0
# The connection is treated as lost after this many consecutive rounds without a valid answer.
LOST_AFTER = 2
# Wait before a new attempt to connect (s): the first, and the longest.
FIRST_WAIT_S, MAX_WAIT_S = 0.25, LIMIT_S / 2
# Time in which the drive must acknowledge its fault (s); after that, the fault counts again.
RESET_S = LIMIT_S / 2
# Interval at which the drive's safety-relevant settings are read again (s).
SETTINGS_S = MAX_RAMP_S
# By how much a silence exceeds the drive's own communication timeout (s).
SILENCE_MARGIN_S = NOTICE_S

# The minimum decrease of the speed that counts (share of the rated speed).
SLOWER = 0.005
# A drive that acknowledges *stop* has a fault if its speed has not fallen for RUNS_ON_S (s), which
# is longer than a drive needs to begin its ramp. It is left in silence once the fault has been
# visible for VISIBLE_S (s), which is longer than the caller's step, even if a connection breaks
# meanwhile. Together they do not exceed the default time for which pump control waits for a speed
# to follow beyond the ramp (follow_time).
RUNS_ON_S, VISIBLE_S = LIMIT_S, 2 * NOTICE_S
# Minimum time from a silence that did not help to the next one (s): the fault may need a person.
RUNS_ON_AGAIN_S = 2 * MAX_RAMP_S
# A drive whose speed cannot be read may still receive orders for this long (s); after that, a
# silence follows in which its own timeout can expire.
UNREAD_S = RUNS_ON_S + MAX_WAIT_S
# At the end, a drive that keeps its speed for longer than this (s) is treated as one that does not
# stop.
STEADY_S = 3 * NOTICE_S
# Longest time for which driver and supervisor each wait for a drive to come to rest (s): its ramp
# and the requests. It must fit into the 40 s that bringup gives the pump node to end. Both waits,
# one after the other, must fit into the 120 s of examples/greenroof.service.
REST_LIMIT_S = MAX_RAMP_S + STEADY_S

# How a user chooses a drive: parameters of the pump node, and options of bringup.
CHOICE = (
    Parameter(
        "drive", "", meaning="make of the drive: a name in config/drives/, or a drive file",
    ),
    Parameter(
        "address", "", meaning="address of the drive: tcp://HOST:PORT for its own Ethernet port, "
        "gateway://HOST:PORT for a gateway to its serial port, or a serial line such as "
        "/dev/ttyUSB0. If the device id differs from that in the drive file, append it after a "
        "comma: gateway://HOST:PORT,17. For a relay: mqtt://HOST[:PORT]/DEVICE, where DEVICE is "
        "the relay's topic at the broker; mqtts:// for TLS",
    ),
    Parameter(
        "broker_login", "", meaning="YAML file with the username and password for a relay's broker",
    ),
    Parameter(
        "broker_authority", "", meaning="file of trusted certificates (PEM) for a relay's broker, "
        "if the system does not trust its certificate",
    ),
)

Endpoint: TypeAlias = DriveEndpoint | RelayEndpoint
Connection: TypeAlias = Drive | Relay


def read_endpoint(
    file: Path, at: str, key: str, login: str = "", authority: str = ""
) -> Endpoint:
    """Read a drive file or a relay file (recognized by its key ``protocol``), and add an address.

    Args:
        file: the drive file or relay file.
        at: address of the drive or relay. For a relay, this is ``mqtt://HOST[:PORT]/DEVICE``, or
            ``mqtts`` over TLS; for a drive, see
            :func:`greenroof_ros.live.devices.modbus_line.parse_drive_address`.
        key: name of the option or parameter that gives the address, for messages.
        login: file with ``username`` and ``password`` for a relay's broker; empty for none.
        authority: file of trusted certificates (PEM) for a relay's broker; empty to use those of
            the system.

    Raises:
        ConfigurationError: if the file or the address is invalid.
    """
    if "protocol" in read_yaml(file):
        return RelayEndpoint(read_relay_file(file), *parse_topic(at, key, login, authority))
    if login or authority:
        raise ConfigurationError(
            "has no broker to log in to: a login and certificates are only used for a relay on "
            "MQTT",
            key=key, value=at,
        )
    return DriveEndpoint(read_drive_file(file), parse_drive_address(at, key))


class DriveInUseError(DriveError):
    """Error for a drive that another process controls.

    Attributes:
        holder: id of the process that holds the lock; None if it is unknown.
    """

    def __init__(self, message: str, holder: int | None) -> None:
        super().__init__("drive", message)
        self.holder = holder


def acquire_drive_lock(drive: Endpoint) -> socket.socket:
    """Acquire the lock of a drive, and return it; closing the socket releases the lock.

    Only one process on this machine, regardless of its user, can hold the lock at a time. A serial
    line is locked as a whole, with all devices on it. The lock does not exclude a driver on another
    computer, or in a container with its own network.

    Raises:
        DriveInUseError: if another process holds the lock.
        DriveError: if the system denies the lock or the host is unknown.
    """
    try:
        name = drive.lock_name()
    except OSError as error:
        raise DriveError(
            "connection", f"{drive}: cannot connect: the host was not found ({error.strerror})"
        ) from error
    try:
        return acquire_name_lock(f"drive-{name}")
    except LockedError as error:
        raise DriveInUseError(
            f"{drive}: process {error.holder or 'unknown'} on this computer is already running "
            "this drive; once that process ends, this one continues automatically", error.holder,
        ) from None
    except OSError as error:
        raise DriveError(
            "drive",
            f"{drive}: its lock cannot be acquired ({error.strerror}); without the lock, two "
            "programs could run the same drive",
        ) from error


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
        self, status: DriveStatus, now: float, flows_at_rest: bool = False
    ) -> DriveStatus:
        """Return a drive's status, with a fault added if the drive runs on after *stop*.

        Args:
            status: the status.
            now: the time.
            flows_at_rest: whether the pump is running although the drive reports standstill.

        Raises:
            RunsOnError: if the fault has been visible for long enough or is certain.
        """
        fall, reported_at, self._reported_at = self._fall, self._reported_at, math.inf
        if flows_at_rest and fall is not None and status.at_rest:
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


@dataclass(frozen=True)
class DriveSnapshot:
    """A snapshot of a drive and of the exchange with it.

    Attributes:
        read_at: time of the drive's last response (s, `boot_time`, which keeps running while the
            computer is suspended).
        problem: description of the last problem if it persists; otherwise empty.
        connected: whether the drive is connected and responding; after `close`, it is not.
        status: last status of the drive; None without a connection. After `close`, this is the
            status at the time when the drive was released, possibly before it reached standstill,
            or None if the status could not be read.
        identity: nameplate of the drive; empty until it has been read.
        timeout_s: communication timeout of the drive (s); None if it is off.
        timeout_known: whether the timeout could be read.
        timeout_note: reason why the timeout is treated as off or could not be read.
        unguarded: diagnosis that the connected drive is kept off because its own timeout may not be
            effective yet; None if the timeout is effective.
        second_master: diagnosis that another program or a person controls the drive, which is
            therefore kept off; None if nobody else controls the drive.
        start_failed: reason why the drive was stopped although a speed was requested; None once
            *off* is requested.
        errors: number of failures since the thread was started.
    """

    read_at: float = -math.inf
    problem: str = "not yet connected"
    connected: bool = False
    status: DriveStatus | None = None
    identity: str = ""
    timeout_s: float | None = None
    timeout_known: bool = False
    timeout_note: str = ""
    unguarded: Diagnosis | None = None
    second_master: Diagnosis | None = None
    start_failed: Diagnosis | None = None
    errors: int = 0

    def status_at(self, now: float) -> DriveStatus | None:
        """Return the drive's last status; None if the status is too old at the given time."""
        return self.status if now - self.read_at < LIMIT_S else None

    def absence_at(self, now: float) -> Diagnosis | None:
        """Return the reason why there is no status at the given time; None if one is available."""
        if self.status_at(now) is not None:
            return None
        if self.problem:
            return Diagnosis.of("drive_lost", "problem", problem=self.problem)
        return Diagnosis.of("drive_lost", "silent", time=LIMIT_S)


class DriveExchange(DeviceThread):
    """A thread that keeps a drive running at the last requested speed, or off.

    In every period, the thread writes the control word and reads the status, so the drive's own
    communication timeout does not expire. If the thread dies, that timeout stops the drive.

    Every connection begins with *stop*. The drive runs only while a speed is requested: it is
    stopped if off is requested, a call to `request_speed` is late, the drive fails to start, or
    another program controls it. After a failed start, or if the connection is lost while a speed is
    requested, the drive stays off until `request_speed` requests off. The caller, which limits the
    number of starts, decides when to start the drive again.

    The connection is lost after two rounds without a valid answer, or if it is closed. If *stop* is
    rejected on two connections, or the speed does not fall, or is unknown, a silence follows:
    nothing is sent for longer than the drive's own timeout, which then stops the drive; any message
    might restart that timeout. A timeout above the limit is treated as unknown. `stop` ends a
    silence early. `close` may be called at any time, and stops the drive. From the first connection
    until `close`, no other program on this machine can use the drive.

    Attributes:
        endpoint: the drive.
        flows_at_rest: whether the caller knows that the pump is running although the drive reports
            standstill.
    """

    def __init__(
        self, endpoint: Endpoint, *, timeout_limit_s: float = LIMIT_S, stops_locally: bool = False
    ) -> None:
        """Prepare the exchange.

        Args:
            endpoint: the drive.
            timeout_limit_s: maximum usable communication timeout of the drive (s), which is also
                the length of a silence if the timeout is longer, unknown or off.
            stops_locally: whether the operator has confirmed that local settings of the drive,
                which cannot be read, stop the pump.

        Raises:
            ConfigurationError: if a library is not installed or a login file is invalid.
        """
        super().__init__("communication with the drive")
        self._snapshot, self._lock = DriveSnapshot(), threading.Lock()
        self.endpoint, self.flows_at_rest = endpoint, False
        self._drive: Connection = endpoint.connection(TIMEOUT_S)
        self._drive_lock: socket.socket | None = None
        self._period_s = max(PERIOD_S, endpoint.period)
        self._timeout_limit_s, self._stops_locally = timeout_limit_s, stops_locally
        # Read and written as a whole, so no lock is needed.
        self._requested: tuple[float | None, float] = (None, -math.inf)
        # Time until which a fault may be acknowledged.
        self._reset_until = -math.inf
        self._rest_deadline = math.inf
        # When to connect next, how long to wait after that attempt, and whether it is the last one.
        self._connect_at, self._wait_s = -math.inf, FIRST_WAIT_S
        self._last_attempt = False
        self._stop_requested = False
        # Time until which another writer is given way.
        self._other_until = -math.inf
        self._settings_read_at = -math.inf
        # Number of consecutive rounds without a valid answer.
        self._unanswered = 0
        self._stop_monitor = StopMonitor(str(endpoint))
        guard = endpoint.guard
        self._unguarded_s = 0.0 if guard is None else guard.unguarded_after_power_up_s
        self._guarded_from = -math.inf

    @property
    def snapshot(self) -> DriveSnapshot:
        """The latest snapshot."""
        return self._snapshot

    def close(self) -> None:
        """Stop the drive, check for standstill, and release it; `snapshot` contains the result.

        The call waits while the speed is falling, for at most `REST_LIMIT_S`. If the speed does not
        fall, or the drive does not respond, the drive is released after a few seconds.
        """
        self._requested = (None, -math.inf)
        self._rest_deadline = time.monotonic() + REST_LIMIT_S
        if not self._stop_thread(REST_LIMIT_S + MAX_WAIT_S):
            self._fail("could not confirm that the pump has stopped: the connection hangs",
                       connected=False, status=None)
        elif self._drive_lock is not None:
            self._drive_lock.close()

    def outcome(self) -> str:
        """Return a message about the release of the drive, after `close`.

        Raises:
            OSError: if the drive did not respond at the end or is not at standstill.
        """
        snapshot = self.snapshot
        status = snapshot.status
        problem = f"the drive was not stopped at the end of the connection: {status}"
        if status is None or snapshot.connected:
            # If still connected, the thread has not read that the drive is stopped.
            why = snapshot.problem or "no final response"
            problem = f"the drive did not respond at the end of the connection ({why})"
        elif status.at_rest:
            return f"released the drive: {status}"
        timeout = "off" if snapshot.timeout_known else "unknown"
        ending = f"it can now only be stopped at its panel; its communication timeout is {timeout}"
        if snapshot.timeout_s is not None:
            ending = f"its own timeout of {snapshot.timeout_s:g} s must stop it"
        raise OSError(f"{problem}; {ending}")

    def timeout_problem(self, snapshot: DriveSnapshot) -> Diagnosis | None:
        """Return a diagnosis if the drive's own communication timeout is unusable, or None."""
        guard, seconds, limit_s = self.endpoint.guard, snapshot.timeout_s, self._timeout_limit_s
        values: dict[str, float | str] = {}
        if not snapshot.timeout_known:
            case, values["note"] = "unread", snapshot.timeout_note
        elif seconds is None:
            case, values["note"] = "none", snapshot.timeout_note
        elif seconds > limit_s:
            case, values = "long", {"timeout": seconds, "limit": limit_s}
        elif guard is not None and guard.local_settings_decide and not self._stops_locally:
            case = "local"
        else:
            return None
        more = {} if guard is None else {"repair": guard.how_to_set, "traps": guard.traps}
        cases = [name for name, text in more.items() if text]
        return Diagnosis.of("drive_timeout", case, *cases, **values, **more)

    def request_speed(self, speed: float | None) -> None:
        """Request a speed (share of the rated speed), or off (None); valid for `DEAD_MAN_S`.

        A speed outside the range from 0 to 1 is reported as a problem, and treated as off.
        """
        if speed is not None and not 0 <= speed <= 1:
            self._fail(f"request rejected: {speed} is not a share of the rated speed (0 to 1)")
            speed = None
        before = self._requested[0]
        self._requested = (speed, boot_time())
        if (speed is None) != (before is None):
            self._wake.set()

    def stop(self) -> None:
        """Try to stop the drive now, even during a silence, when `request_speed` has no effect.

        This method serves an operator's request to stop; the caller must also request off. If the
        attempt fails during a silence, another silence begins.
        """
        self._stop_requested = True
        self._wake.set()

    def reset(self) -> None:
        """Request that the thread stop the drive and acknowledge its fault.

        Only a fault that is active now is acknowledged: the request expires if there is no
        connection, or if it cannot be carried out within `RESET_S`.
        """
        self._reset_until = time.monotonic() + RESET_S
        self._wake.set()

    # --- in the thread ----------------------------------------------------------------------------

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._snapshot = replace(self._snapshot, **changes)

    def _fail(self, problem: str, **changes: Any) -> None:
        self._update(problem=problem, errors=self._snapshot.errors + 1, **changes)

    def _must_not_wait(self) -> bool:
        return self._closing or self._stop_requested

    def _target_speed(self) -> float | None:
        speed, at = self._requested
        fresh = boot_time() - at <= DEAD_MAN_S  # a suspension counts
        return speed if fresh and not self._closing and self._unguarded() is None else None

    def _unguarded(self) -> Diagnosis | None:
        """Return the reason why the connected drive must not run yet; None if it may run.

        The drive may have lost power since the last connection; a cut cable cannot be distinguished
        from a power failure.
        """
        if time.monotonic() >= self._guarded_from:
            return None
        return Diagnosis.of("drive_guards_later", time=self._unguarded_s)

    def _step(self) -> None:
        """Connect, and control the drive until the connection is lost or the exchange is closed."""
        self._pause_until(self._connect_at)
        self._stop_requested, self._last_attempt = False, self._closing
        if self._drive_lock is None:
            self._acquire_lock()
            return
        self._connect()
        while not self._closing:
            self._run_cycle()
        status = _stop_until_at_rest(self._drive, self._rest_deadline)
        self._done = True
        self._update(connected=False, status=status, read_at=boot_time())
        self._drive.line.close()

    def _handle_failure(self, error: Exception, problem: str) -> None:
        """Close the connection; begin a silence, schedule the next attempt or end the thread."""
        now, drive = time.monotonic(), self._drive
        if self._requested[0] is not None:
            self._update(start_failed=Diagnosis.of("start_failed", "lost", problem=problem))
        why = self._stop_monitor.connection_lost(drive.stopped, now)
        if isinstance(error, RunsOnError):
            why = ""  # the error already gives the reason
        self._done = self._last_attempt
        if why is None or self._done:
            # A drive that closes its connections is given as much time as one that does not answer:
            # two closed connections in quick succession must not lead to a silence.
            closes = drive.stopped is False and not drive.line.connected
            self._connect_at = now + self._wait_s + (TIMEOUT_S if closes else 0.0)
            self._wait_s = min(2 * self._wait_s, MAX_WAIT_S)
            self._fail(problem, connected=False, status=None)
        else:
            silence_s, timeout = self._silence()
            self._connect_at = now + silence_s
            self._stop_monitor.silence_started(self._connect_at)
            self._fail(
                f"{problem}{why}, so nothing is sent for {silence_s:g} s, during which the drive's "
                f"own communication timeout ({timeout}) must stop it; any message could restart "
                "that timeout",
                connected=False, status=None,
            )
        drive.line.close()

    def _silence(self) -> tuple[float, str]:
        """Return the length of a silence (s), and a description of the drive's own timeout.

        A timeout above the limit is treated as unknown, since it may have been misread. No silence
        is longer than the limit.
        """
        limit_s, own_s = self._timeout_limit_s, self._snapshot.timeout_s
        if own_s is None:
            return limit_s, f"assumed to be at most {limit_s:g} s"
        if own_s > limit_s:
            return limit_s, (
                f"read as {own_s:g} s, which is above the limit of {limit_s:g} s and is not trusted"
            )
        return min(own_s + SILENCE_MARGIN_S, limit_s), f"{own_s:g} s"

    def _connect(self) -> None:
        """Connect and stop the drive; then read its nameplate and its own timeout."""
        self._drive = drive = self.endpoint.connection(TIMEOUT_S)
        self._unanswered = 0
        drive.line.connect()
        self._guarded_from = time.monotonic() + self._unguarded_s
        try:
            self._stop()
            # Learn whether the control word can be read back: no other master has had time to write
            # yet.
            drive.second_master()
            status = self._stop_monitor.check(self._read(), time.monotonic())
        except DriveError as error:
            # Still try to read the timeout, which decides how long a silence must be.
            if error.kind != "connection" and not self._snapshot.timeout_known:
                self._read_settings()
            raise
        try:
            identity = drive.identify()
        except DriveError as error:
            if error.kind == "connection":
                raise
            identity = self._snapshot.identity or "unknown"
        self._read_settings()
        self._reset_until = -math.inf
        self._wait_s = FIRST_WAIT_S
        self._update(
            connected=True, status=status, read_at=boot_time(), problem="", identity=identity,
            unguarded=self._unguarded(),
        )

    def _acquire_lock(self) -> None:
        """Try to acquire the drive's lock; after a failure, set the time of the next attempt."""
        self._done = self._closing
        if not self._done:
            try:
                self._drive_lock = acquire_drive_lock(self.endpoint)
            except DriveError as error:
                self._fail(str(error))
                self._connect_at = time.monotonic() + NOTICE_S

    def _read_settings(self) -> None:
        """Read the safety-relevant settings again, since they may be changed at the panel."""
        try:
            (seconds, note), timeout_known = self._drive.timeout(), True
        except DriveError as error:
            if error.kind == "connection":
                raise
            seconds, note, timeout_known = None, str(error), False
        self._settings_read_at = time.monotonic()
        self._update(timeout_s=seconds, timeout_known=timeout_known, timeout_note=note)

    def _run_cycle(self) -> None:
        """Write the requested speed or *stop*, and read the drive's status."""
        started = time.monotonic()
        self._stop_requested = False
        try:
            problem = self._write_order()
            status = self._read()
            if time.monotonic() - self._settings_read_at > SETTINGS_S:
                self._read_settings()
        except DriveError as error:
            self._unanswered += 1
            if self._unanswered >= LOST_AFTER or not self._drive.line.connected:
                raise
            self._fail(str(error))
            # The remainder of a late answer must not be read as the next answer.
            time.sleep(self._period_s)
            return
        self._unanswered = 0
        status = self._stop_monitor.check(status, time.monotonic(), self.flows_at_rest)
        self._update(
            status=status, read_at=boot_time(), problem=problem, unguarded=self._unguarded()
        )
        if not self._closing:
            self._pause(self._period_s - (time.monotonic() - started))

    def _read(self) -> DriveStatus:
        """Return the drive's status; first acknowledge a trip of its communication timeout.

        The lost connection that caused the trip has been restored, so the trip is no longer
        relevant.
        """
        drive = self._drive
        try:
            status = drive.read()
        except DriveError as error:
            # In local control, a person at the panel sees whether it turns.
            if error.kind != "connection" and drive.local():
                self._stop_monitor.speed_read()
            raise
        self._stop_monitor.speed_read()
        if status.timed_out:
            self._fail(f"the drive had stopped by itself: {status.fault}")
            try:
                drive.reset()
            except DriveError as error:
                if error.kind != "drive":
                    raise
            status = drive.read()
        return status

    def _write_order(self) -> str:
        """Write the current request; return the reason why the drive is kept off despite it."""
        now, other = time.monotonic(), self._drive.second_master()
        if other is not None:
            self._other_until = now + LIMIT_S
            self._stop_monitor.order_changed()  # the drive may obey the other writer
            self._fail(other.sentence, second_master=other)
        elif now >= self._other_until:
            self._update(second_master=None)
        if self._requested[0] is None:
            self._update(start_failed=None)
        against = self._snapshot.second_master or self._snapshot.start_failed
        try:
            if other is None and now < self._reset_until:
                self._reset_until = -math.inf
                self._drive.reset()
            speed = self._target_speed()
            if speed is None or against:
                self._stop()
            else:
                self._run(speed)
        except DriveError as error:
            if error.kind != "drive":
                raise
            self._stop()
            self._fail(str(error))
            return str(error)
        return against.sentence if against else ""

    def _run(self, speed: float) -> None:
        try:
            self._drive.run(speed, lambda: self._target_speed() is not None)
        except DriveError as error:
            if error.kind == "drive":
                failed = Diagnosis.of("start_failed", "failed", problem=str(error))
                self._update(start_failed=failed)
            else:
                self._stop_monitor.order_changed()  # it may obey although the answer was lost
            raise
        self._stop_monitor.order_changed()

    def _stop(self) -> None:
        self._drive.stop()
        self._stop_monitor.stop_written(time.monotonic())


def _stop_until_at_rest(drive: Connection, until: float) -> DriveStatus:
    """Stop a drive; return its status at standstill, or as soon as its speed fails to fall.

    Drive files do not specify the ramp time, so the call waits for as long as the speed keeps
    falling.
    """
    fall = Deceleration()
    while True:
        drive.stop()
        status, now = drive.read(), time.monotonic()
        if status.at_rest or fall.update(status, now) > STEADY_S or now > until:
            return status
        time.sleep(0.1)


def stop_drive(endpoint: Endpoint, *, driver: int | None = None) -> DriveStatus:
    """Stop a drive after its driver has died; the call takes at most `REST_LIMIT_S`.

    The lock excludes other drivers during the call. If the lock cannot be acquired because the
    hung driver or an unknown process holds it, the drive is stopped nevertheless, which is always
    safe.

    Args:
        endpoint: the drive.
        driver: process id of the dead or hung driver, which may hold the lock; None for none.

    Returns:
        The drive's status after *stop*; the drive may not be at standstill.

    Raises:
        DriveInUseError: if another process controls the drive; in this case, nothing was sent.
        DriveError: if three attempts to write *stop* and read the status failed.
    """
    with ExitStack() as lock:
        try:
            lock.enter_context(acquire_drive_lock(endpoint))
        except DriveInUseError as error:
            if error.holder not in (None, driver):
                raise
        except DriveError:
            pass
        return _stop(endpoint)


def _stop(endpoint: Endpoint) -> DriveStatus:
    attempts, until = 3, time.monotonic() + REST_LIMIT_S
    while True:
        drive = endpoint.connection()
        try:
            drive.line.connect()
            return _stop_until_at_rest(drive, until)
        except DriveError:
            attempts -= 1
            if not attempts:
                raise
            time.sleep(FIRST_WAIT_S)
        finally:
            drive.line.close()
