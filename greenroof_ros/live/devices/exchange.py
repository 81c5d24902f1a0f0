"""Control of a drive or a relay from a separate thread, which stops it when requests cease."""

from __future__ import annotations

import logging
import math
import socket
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

from greenroof_ros.base.files import read_yaml
from greenroof_ros.base.mqtt import parse_topic
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.processes import LockedError, acquire_name_lock
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.devices.drive import TIMEOUT_S, Drive, DriveEndpoint, DriveStatus
from greenroof_ros.live.devices.drive_file import (
    LIMIT_S,
    MAX_RAMP_S,
    read_drive_file,
    read_relay_file,
)
from greenroof_ros.live.devices.modbus_line import DriveError, parse_address
from greenroof_ros.live.devices.relay import Relay, RelayEndpoint

# The connection is treated as lost after this many consecutive rounds without a valid answer.
LOST_AFTER = 2
# Time without a request of the caller after which the drive is stopped (s).
DEAD_MAN_S = LOST_AFTER * TIMEOUT_S
# Wait for the remainder of a late answer (s).
_REMAINDER_S = 0.1
# Wait before a new attempt to connect (s): the first, and the longest.
FIRST_WAIT_S, MAX_WAIT_S = TIMEOUT_S / 2, LIMIT_S / 2
# Time in which the drive must acknowledge its fault (s); after that, the fault counts again.
RESET_S = LIMIT_S / 2
# The minimum decrease of the speed that counts (share of the rated speed).
SLOWER = 0.005
# A drive that has not been seen to obey *stop* for LIMIT_S may still receive orders until the next
# failed attempt to connect (s); after that, a silence follows in which its own timeout can expire.
UNREAD_S = LIMIT_S + MAX_WAIT_S
# At the end, a drive that keeps its speed for longer than this (s) is left: nothing is sent to it
# any more, so its own timeout stops it.
STEADY_S = 3.0
# Longest time for which driver and supervisor each wait for a drive to come to rest (s): its ramp
# and the requests. It must fit into the 40 s that bringup gives the pump node to end. Both waits,
# one after the other, must fit into the 120 s of examples/greenroof.service.
REST_LIMIT_S = MAX_RAMP_S + STEADY_S

# How a user chooses a drive: parameters of the pump node, and options of bringup.
CHOICE = (
    Parameter("drive", "", meaning="make of the drive: a name in config/drives/, or a drive file"),
    Parameter(
        "address", "", meaning="address of the drive: tcp://HOST:PORT for its own Ethernet port, "
        "gateway://HOST:PORT for a gateway to its serial port, or a serial line such as "
        "/dev/ttyUSB0, with the device id after a comma if it differs from the drive file's; for a "
        "relay, mqtt://HOST[:PORT]/DEVICE with its topic, or mqtts:// for TLS",
    ),
    Parameter(
        "broker_login", "", meaning="YAML file with username and password for a relay's broker",
    ),
    Parameter(
        "broker_authority", "", meaning="file of trusted certificates (PEM) for a relay's broker",
    ),
)

Endpoint: TypeAlias = DriveEndpoint | RelayEndpoint


def read_endpoint(file: Path, at: str, key: str, login: str = "", authority: str = "") -> Endpoint:
    """Read a drive file or a relay file (recognized by its key ``protocol``), and add an address.

    Args:
        file: the drive file or relay file.
        at: address of the drive or relay. For a relay, this is ``mqtt://HOST[:PORT]/DEVICE``, or
            ``mqtts`` over TLS; for a drive, see
            :func:`greenroof_ros.live.devices.modbus_line.parse_address`.
        key: name of the option or parameter that gives the address, for messages.
        login: file with ``username`` and ``password`` for a relay's broker; empty for none.
        authority: file of trusted certificates (PEM) for a relay's broker; empty to use those of
            the system.

    Raises:
        ConfigurationError: if the file or the address is invalid.
    """
    if "protocol" in read_yaml(file):
        return RelayEndpoint(read_relay_file(file), *parse_topic(at, key, login, authority))
    return DriveEndpoint(read_drive_file(file), parse_address(at, key))


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
        return acquire_name_lock(f"drive-{drive.lock_name()}")
    except LockedError as error:
        raise DriveInUseError(
            f"{drive}: process {error.holder or 'unknown'} on this computer is already running "
            "this drive; once that process ends, this one continues automatically", error.holder,
        ) from None
    except OSError as error:
        raise DriveError(
            "connection",
            f"{drive}: cannot be locked ({error.strerror}), and without its lock two programs "
            "could run the same drive",
        ) from error


class Fall:
    """The fall of a drive's speed after *stop*.

    Attributes:
        since: when the speed last fell (s, `time.monotonic`), or *stop* became the order.
    """

    def __init__(self) -> None:
        self._lowest, self.since = math.inf, time.monotonic()

    def lasts(self, speed: float) -> float:
        """Process the drive's speed, and return the time since it last fell (s)."""
        if abs(speed) < self._lowest - SLOWER:
            self._lowest, self.since = abs(speed), time.monotonic()
        return time.monotonic() - self.since


@dataclass(frozen=True)
class DriveSnapshot:
    """A snapshot of a drive and of the exchange with it.

    Attributes:
        read_at: time of the drive's last response (s, `boot_time`, which keeps running while the
            computer is suspended).
        problem: description of the last problem if it persists; otherwise empty.
        connected: whether the drive is connected and responding; after `close`, it is not.
        status: last status of the drive; None without a connection, unless the drive is left in
            silence because it runs on, and no reset was requested since. After `close`, this is the
            status at the time when the drive was released, possibly before it reached standstill,
            or None if it could not be read.
        timeout_s: communication timeout of the drive (s); None if it is off.
        unguarded: diagnosis that the drive's own timeout is unusable, or may not be effective yet;
            None if the timeout is effective.
        second_master: diagnosis that another program or a person controls the drive, which is
            therefore kept off; None if nobody else controls the drive.
        start_failed: reason why the drive was stopped although a speed was requested; None once
            *off* is requested.
    """

    read_at: float = -math.inf
    problem: str = "not yet connected"
    connected: bool = False
    status: DriveStatus | None = None
    timeout_s: float | None = None
    unguarded: Diagnosis | None = None
    second_master: Diagnosis | None = None
    start_failed: Diagnosis | None = None

    def status_at(self, now: float) -> DriveStatus | None:
        """Return the drive's last status; None if the status is too old at the given time."""
        return self.status if now - self.read_at < LIMIT_S else None


class DriveExchange:
    """A thread that keeps a drive running at the last requested speed, or off.

    In every period, the thread writes the control word and reads the status, so the drive's own
    communication timeout does not expire. If the thread dies, that timeout stops the drive.

    Every connection begins with *stop*. The drive runs only while a speed is requested: it is
    stopped if off is requested, a call to `request_speed` is late, the drive fails to start, or
    another program controls it. After a failed start, or if the connection is lost while a speed is
    requested, the drive stays off until `request_speed` requests off. The caller, which limits the
    number of starts, decides when to start the drive again.

    The connection is lost after two rounds without a valid answer, or if it is closed. A silence
    follows if *stop* is rejected on two connections, if the drive has not been seen to obey *stop*
    for `LIMIT_S` (its speed does not fall or is unknown, or it closes each connection), or if water
    flows although it reports standstill: nothing is sent for the longest timeout that the drive may
    have, which then stops the drive; any message might restart that timeout. `stop` ends a silence
    early. `close` may be called at any time, and stops the drive. From the first connection until
    `close`, no other program on this machine can use the drive.

    Attributes:
        endpoint: the drive.
        snapshot: the latest snapshot.
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
                the length of a silence.
            stops_locally: whether the operator has confirmed that local settings of the drive,
                which cannot be read, stop the pump.

        Raises:
            ConfigurationError: if a library is not installed or a login file is invalid.
        """
        self._closing = self._done = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._work, name="drive", daemon=True)
        self.snapshot, self._lock = DriveSnapshot(), threading.Lock()
        self.endpoint, self.flows_at_rest = endpoint, False
        self._drive: Drive | Relay = endpoint.connection()
        self._drive_lock: socket.socket | None = None
        self._timeout_limit_s, self._stops_locally = timeout_limit_s, stops_locally
        # Read and written as a whole, so no lock is needed.
        self._requested: tuple[float | None, float] = (None, -math.inf)
        self._reset_requested = self._stop_requested = False
        # When to connect next, how long to wait after that attempt, and whether it is the last one.
        self._connect_at, self._wait_s = -math.inf, FIRST_WAIT_S
        self._last_attempt = False
        # Time until which another writer is given way, from which the drive's own timeout is
        # effective, and at which the settings were read.
        self._other_until = self._guarded_from = self._settings_read_at = -math.inf
        self._useless: Diagnosis | None = None  # why its own timeout is unusable
        # Number of consecutive rounds without a valid answer.
        self._unanswered = 0
        # Whether the last *stop* on this connection was taken, None before any, and the number of
        # consecutive connections on which it was not.
        self._stopped: bool | None = None
        self._refusals = 0
        # The fall of the speed since *stop* became the last order; None if the drive runs, is at
        # rest, or is left to another master or to a person at its panel.
        self._fall: Fall | None = None

    @property
    def started(self) -> bool:
        """Whether the thread was started, even if it has ended."""
        return self._thread.ident is not None

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the drive, check for standstill, and release it; `snapshot` contains the result.

        The call waits while the speed is falling, for at most `REST_LIMIT_S`. If the speed does not
        fall, or the drive does not respond, the drive is released after a few seconds.
        """
        self._requested, self._closing = (None, -math.inf), True
        self._wake.set()
        if self.started:
            self._thread.join(REST_LIMIT_S + MAX_WAIT_S)
        if self._thread.is_alive():
            problem = "could not confirm that the pump has stopped: the connection hangs"
            self._update(problem=problem, connected=False, status=None)
        elif self._drive_lock is not None:
            self._drive_lock.close()

    def outcome(self) -> str:
        """Return a message about the release of the drive, after `close`.

        Raises:
            OSError: if the drive did not respond at the end or is not at standstill.
        """
        snapshot, status = self.snapshot, self.snapshot.status
        if status is not None and status.at_rest:
            return f"released the drive: {status}"
        timeout = f" or its own timeout ({snapshot.timeout_s:g} s)" if snapshot.timeout_s else ""
        raise OSError(
            "the drive was not stopped at the end of the connection: "
            f"{status or snapshot.problem}; now only a person at its panel{timeout} can stop it"
        )

    def judge_timeout(self, seconds: float | None, note: str) -> Diagnosis | None:
        """Return a diagnosis if the drive's own communication timeout is unusable, or None.

        Args:
            seconds: the timeout (s); None if it is off.
            note: the reason why it is off.
        """
        guard = self.endpoint.guard
        if seconds is not None and seconds > self._timeout_limit_s:
            note = f"it is {seconds:g} s, but must be at most {self._timeout_limit_s:g} s"
        elif seconds is not None and guard.local_settings_decide:
            note = "" if self._stops_locally else (
                "it depends on drive settings that cannot be read: set the drive to stop the pump, "
                "check that it does, and confirm this (local_settings_stop_the_pump: true)"
            )
        return Diagnosis.of("drive_timeout", note=note, repair=guard.how_to_set) if note else None

    def request_speed(self, speed: float | None) -> None:
        """Request a speed (share of the rated speed), or off (None); valid for `DEAD_MAN_S`.

        A speed of 0 or above 1 is treated as off.
        """
        wanted = speed if speed is not None and 0 < speed <= 1 else None
        before, self._requested = self._requested[0], (wanted, boot_time())
        if (wanted is None) != (before is None):
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
        connection, or another program controls the drive. A drive in silence is judged anew after
        the silence; until then, its status is unknown.
        """
        self._reset_requested = True
        if not self.snapshot.connected:
            self._update(status=None)
        self._wake.set()

    # --- in the thread ----------------------------------------------------------------------------

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self.snapshot = replace(self.snapshot, **changes)

    def _pause(self, seconds: float) -> None:
        """Wait for a given time (s), or until the thread is woken."""
        self._wake.wait(max(0.0, seconds))
        self._wake.clear()

    def _target_speed(self) -> float | None:
        speed, at = self._requested
        fresh = boot_time() - at <= DEAD_MAN_S  # a suspension counts
        may_run = fresh and self.snapshot.connected and not self._closing
        return speed if may_run and self._unguarded() is None else None

    def _unguarded(self) -> Diagnosis | None:
        """Return the reason why the connected drive must not run yet; None if it may run.

        The drive may have lost power since the last connection; a cut cable cannot be distinguished
        from a power failure.
        """
        if time.monotonic() >= self._guarded_from:
            return None
        time_s = self.endpoint.guard.unguarded_after_power_up_s
        return Diagnosis.of("drive_guards_later", time=time_s)

    def _work(self) -> None:
        while not self._done:
            try:
                self._step()
            except Exception as error:  # whatever the error, the next step follows
                problem = str(error)
                if not isinstance(error, DriveError):
                    problem = f"communication with the drive failed: {error!r}"
                    logging.getLogger(__name__).exception("communication with the drive failed")
                with suppress(OSError):  # a connection that cannot be closed
                    self._handle_failure(problem)

    def _step(self) -> None:
        """Connect, and control the drive until the connection is lost or the exchange is closed."""
        while not (self._closing or self._stop_requested) and time.monotonic() < self._connect_at:
            self._pause(self._connect_at - time.monotonic())
        self._stop_requested, self._last_attempt = False, self._closing
        if self._drive_lock is None:
            if self._closing:
                self._done = True
                return
            self._drive_lock = acquire_drive_lock(self.endpoint)
        self._connect()
        while not self._closing:
            self._run_cycle()
        status = _stop_until_at_rest(self._drive, time.monotonic() + REST_LIMIT_S)
        self._done = True
        self._update(connected=False, status=status, read_at=boot_time())
        self._drive.line.close()

    def _handle_failure(self, problem: str) -> None:
        """Close the connection; begin a silence, schedule the next attempt or end the thread."""
        now, fall = time.monotonic(), self._fall
        if self._requested[0] is not None:
            self._update(start_failed=Diagnosis.of("start_failed", "lost", problem=problem))
        # What a closed connection does not take is a refusal only if that lasts.
        self._refusals += self._stopped is False and self._drive.line.connected
        unseen = fall is not None and now - fall.since > LIMIT_S and self._stopped is not None
        wait_s, self._wait_s = self._wait_s, min(2 * self._wait_s, MAX_WAIT_S)
        if unseen or self._refusals > 1:
            wait_s = self._timeout_limit_s
            problem += f"; nothing is sent for {wait_s:g} s, so its own timeout must stop it"
            if fall is not None:  # that timeout may ramp it down
                fall.since = now + wait_s + MAX_RAMP_S
        self._connect_at, self._done = now + wait_s, self._last_attempt
        status = self.snapshot.status if unseen else None
        self._update(problem=problem, connected=False, status=status)
        self._drive.line.close()

    def _connect(self) -> None:
        """Connect, and stop the drive."""
        self._drive = drive = self.endpoint.connection()
        drive.may_run = lambda: self._target_speed() is not None
        self._unanswered, self._stopped, self._reset_requested = 0, None, False
        drive.line.connect()
        self._settings_read_at = -math.inf
        self._guarded_from = time.monotonic() + self.endpoint.guard.unguarded_after_power_up_s
        self._stop()
        # Learn whether the control word can be read back: no other master has had time to write
        # yet.
        drive.second_master()

    def _read_settings(self) -> None:
        """Read the safety-relevant settings again, since they may be changed at the panel."""
        try:
            seconds, note = self._drive.timeout()
        except DriveError as error:
            if error.kind == "connection":
                raise
            seconds, note = None, str(error)
        self._settings_read_at = time.monotonic()
        self._update(timeout_s=seconds)
        self._useless = self.judge_timeout(seconds, note)

    def _run_cycle(self) -> None:
        """Write the requested speed or *stop*, and read the drive's status."""
        started = time.monotonic()
        self._stop_requested = False
        try:
            problem = self._write_order()
            status = self._drive.read()
            if started - self._settings_read_at > MAX_RAMP_S:
                self._read_settings()
        except DriveError as error:
            self._unanswered += 1
            if self._unanswered >= LOST_AFTER or not self._drive.line.connected:
                raise
            self._update(problem=str(error))
            # The remainder of a late answer must not be read as the next answer.
            time.sleep(_REMAINDER_S)
            return
        self._check_stop(status)
        self._unanswered, self._wait_s = 0, FIRST_WAIT_S
        # The lost connection that caused such a trip has been restored, so it is acknowledged.
        self._reset_requested |= status.timed_out
        self._update(
            connected=True, status=status, read_at=boot_time(), problem=problem,
            unguarded=self._useless or self._unguarded(),
        )
        if not self._closing:
            self._pause(self.endpoint.period - (time.monotonic() - started))

    def _check_stop(self, status: DriveStatus) -> None:
        """Raise an error if the drive does not obey *stop*, after which it is left in silence.

        A drive obeys if its speed falls, however slowly. A drive under local control is left to the
        person at its panel.
        """
        where, fall = self.endpoint, self._fall
        if fall is None:
            return
        if status.at_rest and self.flows_at_rest and self.snapshot.connected:
            fall.since = -math.inf
            raise DriveError("drive", f"{where}: the drive reports standstill, but water flows")
        if status.at_rest or not status.remote:
            self._fall = None
        elif fall.lasts(status.speed) > LIMIT_S:
            fault = f"the drive acknowledges *stop*, but its speed has not fallen for {LIMIT_S:g} s"
            status = replace(status, fault=fault, timed_out=False, runs_on=True)
            self._update(status=status, read_at=boot_time())
            raise DriveError("drive", f"{where}: {fault} (the speed is {status.speed:.1%})")

    def _write_order(self) -> str:
        """Write the current request; return the reason why the drive is kept off despite it."""
        now, other = time.monotonic(), self._drive.second_master()
        reset, self._reset_requested = self._reset_requested, False
        if other is not None:
            self._other_until = now + LIMIT_S
            self._fall = None  # the drive may obey the other writer
            self._update(problem=other.sentence, second_master=other)
        elif now >= self._other_until:
            self._update(second_master=None)
        if self._requested[0] is None:
            self._update(start_failed=None)
        if reset and other is None:
            self._drive.reset()
        speed, against = self._target_speed(), (
            self.snapshot.second_master or self.snapshot.start_failed)
        if speed is None or against:
            self._stop()
            return against.sentence if against else ""
        self._fall = None
        try:
            self._drive.run(speed)
        except DriveError as error:
            if error.kind != "drive":
                raise
            self._stop()
            failed = Diagnosis.of("start_failed", "failed", problem=str(error))
            self._update(problem=failed.sentence, start_failed=failed)
            return failed.sentence
        return ""

    def _stop(self) -> None:
        self._stopped, self._fall = False, self._fall or Fall()
        self._drive.stop()
        self._stopped, self._refusals = True, 0


def _stop_until_at_rest(drive: Drive | Relay, until: float) -> DriveStatus:
    """Stop a drive; return its status at standstill, or as soon as its speed fails to fall.

    Drive files do not specify the ramp time, so the call waits for as long as the speed keeps
    falling.
    """
    fall = Fall()
    while True:
        drive.stop()
        status = drive.read()
        steady = fall.lasts(status.speed) > STEADY_S
        if status.at_rest or steady or time.monotonic() > until:
            return status
        time.sleep(FIRST_WAIT_S)


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
        except DriveError as error:
            if getattr(error, "holder", None) not in (None, driver):
                raise
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
