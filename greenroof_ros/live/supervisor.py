"""Supervisor that starts, monitors, logs, restarts and ends the processes of a live site."""

from __future__ import annotations

import logging
import math
import os
import selectors
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import IO, cast

from greenroof_ros.base.command_line import EXIT_FAILED, EXIT_OCCUPIED, EXIT_USAGE
from greenroof_ros.base.disk import DISK
from greenroof_ros.base.processes import child_environment
from greenroof_ros.live import upkeep
from greenroof_ros.ros.alarms import RESTARTED
from greenroof_ros.ros.domain import LEASE
from greenroof_ros.ros.reports import PAUSE_S

# How long to wait for a process to end before it is killed (s). The actuators are given longer:
# they wait until the pump is stopped, while the speed falls.
ENDING_S, ACTUATORS_ENDING_S = 8.0, 40.0
# Longest time that killing a process may take (s).
KILLING_S = 5.0
# How long a process may be silent before its first heartbeat (s), since imports take seconds on a
# busy machine; and how long the actuators may be silent after that, while the pump may be running.
START_LIMIT_S, ACTUATORS_SILENT_S = 30.0, 2.0
_LAST_LINES, _MAX_READ = 15, 1 << 16
# Size at which a process's log is renamed to .log.1, replacing the previous one, since a live site
# runs for months.
_LOG_BYTES = 10_000_000
# How long after its restart a killed process still counts as a second publisher (s).
_LIVE_LEASE_S = "3"

# A function that stops the drive without the pump node. It takes the process id of that node, and
# whether that node has reached the drive; it returns whether the pump may be running after that,
# and the outcome in words.
StopDrive = Callable[[int, bool], tuple[bool, str]]


class NodeFailed(Exception):
    """Error raised if the site must end because of one of its processes.

    Attributes:
        code: the exit code for bringup.
    """

    def __init__(self, reason: str, code: int) -> None:
        """Create the error."""
        super().__init__(reason)
        self.code = code


class SiteProcess:
    """A process of the site: how it is started, and what it does.

    Attributes:
        name: name of the process.
        words: its Python module and its command-line arguments, without ROS arguments.
        silence_s: how long it may be silent (s).
        popen: the running process as far as known; None if it is not running.
        pid: its last process id.
        restarts: its recent restarts, and when it is started next.
        silent_at: time at which it will count as hung without another heartbeat (steady clock, s).
        beats: whether it has ever sent a heartbeat.
        reached: whether it has ever reached the pump's drive.
        failure: why it last failed; empty if it has not.
        last_lines: the last lines that it printed.
    """

    def __init__(self, name: str, words: Sequence[str], logs: Path, silence_s: float) -> None:
        """Describe the process, without starting it.

        Args:
            name: see the class.
            words: see the class.
            logs: existing directory for its standard error.
            silence_s: see the class.
        """
        self.name, self.words, self.silence_s = name, words, silence_s
        self.popen: subprocess.Popen[bytes] | None = None
        self.restarts = upkeep.Restarts()
        self.pid, self.silent_at = 0, 0.0
        self.beats = self.reached = False
        self.failure = ""
        self.last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._log = RotatingFileHandler(
            logs / f"{name}.log", maxBytes=_LOG_BYTES, backupCount=1, encoding="utf-8",
            errors="surrogateescape", delay=True,  # the file is opened with the first line
        )
        self._log.terminator = ""

    def receive(self, data: bytes) -> None:
        """Receive heartbeats."""
        self.silent_at, self.beats = time.monotonic() + self.silence_s, True
        self.reached |= any(data)

    def log(self, data: bytes) -> None:
        """Log the output of the process, and remember its last lines in case the disk fails."""
        self.last_lines.extend(filter(None, data.decode(errors="replace").splitlines()))
        record = logging.makeLogRecord({"msg": data.decode(errors="surrogateescape")})
        DISK.do(partial(self._log.emit, record), len(data))


class LiveSupervisor:
    """Supervisor of the processes of a live site, which starts, restarts and ends them.

    Each process sends heartbeats on a pipe. A process that ends or is silent for too long is
    restarted after an increasing delay; after too many restarts, it stays off, and the others live
    on. Only without the station, whose alarms nobody else reports, does the site end. A start that
    the system refuses, for instance for lack of processes or descriptors, is no failure of the
    process, and is tried again every 10 s.

    The supervisor has no influence on whether the pump may run. A pump node that has died cannot
    stop the drive, so the supervisor stops the drive. The supervisor also stops the drive at the
    end, whatever the pump node reports.

    Attributes:
        may_run: warning that the pump may still be running after the end; empty if the pump is
            stopped.
    """

    def __init__(
        self, processes: Sequence[SiteProcess],
        ros_arguments: Collection[str], stop_drive: StopDrive | None, tell: Callable[[str], None],
        prepare: Callable[[], Mapping[str, str]],
    ) -> None:
        """Start nothing yet.

        Args:
            processes: the processes, in the order in which they end. The first one drives the pump,
                watches the user's own pump driver or, at a site without a pump, moves the valve;
                the last one is the station, which reports the alarms.
            ros_arguments: ROS arguments of all processes.
            stop_drive: function that stops the drive; None if there is no drive or the user runs
                the pump.
            tell: function that receives what the processes print on standard output, which is for
                human readers, and what happens to a process.
            prepare: function called before every start of a process; it returns additions to its
                environment, or raises an :class:`OSError`.
        """
        self.may_run = ""
        self._actuators, self._station = processes[0], processes[-1]
        self._processes = processes
        self._ros_arguments, self._prepare = ros_arguments, prepare
        self._stop_drive, self._tell = stop_drive, tell
        self._stopper = ThreadPoolExecutor(1)
        self._stopper.submit(int)  # start its thread now: the system may be out of threads later
        self._stopping: Future[tuple[bool, str]] | None = None
        # When to stop the drive without the pump node (steady clock, s), and the last outcome.
        self._stop_at, self._stop_message = math.inf, ""
        self._selector = selectors.DefaultSelector()
        self._updated_at = time.monotonic()

    def end(self) -> None:
        """End all processes: the actuators first, and the station last, which completes the bag.

        Two simultaneous stops of the drive would collide, so a stop in progress is completed first.
        """
        if self._stopping is not None:
            self._stopping.result()
        for process in self._processes:
            how = self._end(process)
            if process is self._actuators and self._stop_drive is not None and process.pid:
                may_run, message = self._stop_drive(process.pid, process.reached)
                self.may_run = message if may_run else ""
                self._tell(f"{process.name}: {how}; {message}")

    def _end(self, process: SiteProcess) -> str:
        """Stop a process with SIGTERM, or kill it if it takes too long; return how it ended.

        SIGINT is not used, because background processes of a shell ignore it, as would a process
        that is just starting.
        """
        if (popen := process.popen) is None:
            return process.failure
        for number in (signal.SIGCONT, signal.SIGTERM):  # a stopped process must receive the latter
            popen.send_signal(number)
        limit = ACTUATORS_ENDING_S if process is self._actuators else ENDING_S
        kill_at = time.monotonic() + limit
        while popen.poll() is None and time.monotonic() < kill_at + KILLING_S:
            self.read(0.02)
            if time.monotonic() > kill_at:
                popen.kill()
        self.read(0.0)
        return _describe_end(popen)

    # --- starting and reading -------------------------------------------------------------------

    def _start(self, process: SiteProcess) -> None:
        """Start a process in its own session, so that Ctrl-C at the terminal does not reach it.

        Raises:
            OSError: if the system has no processes or file descriptors left, or the process's files
                cannot be written; nothing is left open.
        """
        additions = self._prepare()
        reading, writing = os.pipe()
        os.set_blocking(writing, False)
        try:
            popen = subprocess.Popen(
                [sys.executable, "-m", *process.words, *self._ros_arguments],
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                env={
                    **child_environment(), **additions, LEASE: _LIVE_LEASE_S,
                    upkeep.PIPE: str(writing), RESTARTED: process.failure,
                    "PYTHONFAULTHANDLER": "1",  # so that a crash in compiled code shows its place
                },
                pass_fds=[writing], start_new_session=True,
            )
        except OSError:
            os.close(reading)
            raise
        finally:
            os.close(writing)
        process.popen, process.pid = popen, popen.pid
        process.silent_at = time.monotonic() + max(process.silence_s, START_LIMIT_S)
        for source, reader in (
            (os.fdopen(reading, "rb", 0), process.receive), (popen.stderr, process.log),
            (popen.stdout, lambda data: self._tell(data.decode(errors="replace").rstrip("\n"))),
        ):
            self._selector.register(cast("IO[bytes]", source), selectors.EVENT_READ, reader)

    def read(self, seconds: float = 0.1) -> None:
        """Read heartbeats and output, waiting for them for at most the given time (s)."""
        for key, _ in self._selector.select(seconds):
            if data := os.read(key.fd, _MAX_READ):
                key.data(data)
            else:
                self._selector.unregister(key.fileobj)
                cast("IO[bytes]", key.fileobj).close()

    # --- keeping them running -------------------------------------------------------------------

    def update(self) -> None:
        """Start what is due, and restart what failed; called repeatedly, each time after a read.

        After a pause of this process, in which the others may have been paused too, none of them
        counts as silent yet.

        Raises:
            NodeFailed: if the station was restarted too often, or if a process ended because of
                invalid parameters or another graph before its first heartbeat.
        """
        now = time.monotonic()
        paused, self._updated_at = now - self._updated_at > PAUSE_S, now
        for process in self._processes:
            if paused:
                process.silent_at = max(process.silent_at, now + process.silence_s)
            if (popen := process.popen) is not None:
                if failure := _find_failure(popen, now >= process.silent_at):
                    self._handle_failure(process, failure, popen.returncode, now)
            elif now >= process.restarts.due and not (
                process is self._actuators and self._stopping is not None
            ):
                try:
                    self._start(process)
                except OSError as error:
                    wait = upkeep.MAX_WAIT_S
                    process.restarts.due = now + wait
                    why = f"cannot be started: {error.strerror}"
                    self._tell(f"{process.name}: {why}; is tried again in {wait:g} s")
        self._stop_if_due(now)

    def _handle_failure(
        self, process: SiteProcess, failure: str, code: int | None, now: float
    ) -> None:
        """Report that a process failed, and schedule its restart; for the pump, stop the drive.

        Raises:
            NodeFailed: if the site must end.
        """
        self.read(0.0)  # its last lines and heartbeats
        process.popen, process.failure = None, failure
        then = process.restarts.postpone(now)
        if process.beats or code not in (EXIT_USAGE, EXIT_OCCUPIED):
            code = EXIT_FAILED
        if code != EXIT_FAILED or (process is self._station and math.isinf(process.restarts.due)):
            self._tell("\n  ".join([f"last lines of {process.name}:", *process.last_lines]))
            raise NodeFailed(f"{process.name} {failure}", code)
        self._tell(f"{process.name}: {failure}; {then}")
        if process is self._actuators:
            self._stop_at, self._stop_message = now, ""

    def _stop_if_due(self, now: float) -> None:
        """Stop the drive while there is no pump node to do so, again and again until it stands."""
        pump = self._actuators
        if self._stopping is not None and self._stopping.done():
            may_run, message = self._stopping.result()
            if message != self._stop_message:
                self._tell(f"{pump.name}: did not stop the drive; {message}")
            self._stopping, self._stop_message = None, message
            self._stop_at = now + upkeep.MAX_WAIT_S if may_run else math.inf
        if self._stop_drive is not None and pump.popen is None and now >= self._stop_at:
            self._stop_at = math.inf
            self._stopping = self._stopper.submit(self._stop_drive, pump.pid, pump.reached)


def _find_failure(popen: subprocess.Popen[bytes], is_silent: bool) -> str:
    """Return why a process has failed; empty if it has not. A silent process is killed."""
    if popen.poll() is not None:
        return _describe_end(popen)
    if is_silent:
        popen.kill()
        with suppress(subprocess.TimeoutExpired):  # the kernel may take longer
            popen.wait(1.0)
        return "did not respond: killed"
    return ""


def _describe_end(popen: subprocess.Popen[bytes]) -> str:
    """Return how a process has ended."""
    code = popen.returncode
    if code is None:
        return "cannot be killed"
    return f"ended ({f'exit code {code}' if code >= 0 else signal.Signals(-code).name})"
