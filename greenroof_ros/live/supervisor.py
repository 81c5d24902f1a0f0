"""Supervisor that starts, monitors, logs, restarts and ends the processes of a live site."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import selectors
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.base.command_line import EXIT_DONE, EXIT_FAILED, EXIT_OCCUPIED, EXIT_USAGE
from greenroof_ros.base.disk import DISK
from greenroof_ros.base.processes import child_environment
from greenroof_ros.interface.states import PUMP
from greenroof_ros.live import restarts
from greenroof_ros.live.heartbeat import PIPE, Beat
from greenroof_ros.live.restarts import Restarts
from greenroof_ros.ros.alarms import RESTARTED
from greenroof_ros.ros.domain import LEASE
from greenroof_ros.ros.reports import PAUSE_S

# How long to wait for a process to end before it is killed (s). The pump node is given longer: it
# waits until the pump is stopped, while the speed falls.
ENDING_S, PUMP_ENDING_S = 8.0, 40.0
# Longest time that killing a process may take (s).
KILLING_S = 5.0
# How long a started process may be silent at first (s), since imports take seconds on a busy
# machine.
START_LIMIT_S = 30.0
# The pump's process is killed after this silence (s), unless it last said that the pump is at rest.
SILENT_S = 2.0
_LAST_LINES, _MAX_READ = 15, 1 << 16
# Size at which a process's log is renamed to .log.1, replacing the previous one, since a live site
# runs for months. How long to wait, after the end, until all output is written (s).
_LOG_BYTES, _WRITTEN_S = 10_000_000, 2.0
# How long after its restart a killed process still counts as a second publisher (s).
_LIVE_LEASE_S = "3"
# The process with all nodes but the pump's and the controller's.
STATION = "station"

# A function that stops the drive without the pump node. It takes the process id of that node, and
# whether that node has reached the drive; it returns whether the pump may be running after that,
# and the outcome in words.
StopDrive = Callable[[int, bool], tuple[bool, str]]


class NodeFailed(Exception):
    """Error raised if a process has ended or is hanging, so that the site must end.

    Attributes:
        last_lines: the last lines that the process printed.
        code: the exit code for bringup.
    """

    def __init__(self, reason: str, last_lines: str, code: int) -> None:
        """Create the error."""
        super().__init__(reason)
        self.last_lines, self.code = last_lines, code


class NodeSetup(NamedTuple):
    """A node, as bringup starts it."""

    module: str
    """Python module of the node, such as greenroof_ros.live.weather"""
    parameters: dict[str, Any]
    """parameters that bringup sets"""


@dataclass(frozen=True)
class ProcessStart:
    """Process to be started, which runs one or more nodes.

    Attributes:
        name: name of the process.
        module: Python module of the process, such as greenroof_ros.live.station.
        arguments: command-line arguments of the process, without ROS arguments.
        nodes: the nodes, by name.
        instead: function that receives the reason why the process can no longer be used, and
            returns the arguments with which it is started from then on; None if it then stays off.
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    nodes: Mapping[str, NodeSetup]
    instead: Callable[[str], tuple[str, ...]] | None = None


class _Process:
    """A process of the site: how it is started, and what it does.

    Attributes:
        popen: the operating-system process; None before the first start.
        runs: whether it is running as far as known; if not, it is started when that is due.
        due: time of the next start (steady clock, s); None if the process stays off.
        state: content of its last heartbeat.
        beat_at: time of its last heartbeat or start (steady clock, s).
        limit: how long it may be silent (s).
    """

    def __init__(self, start: ProcessStart, log: Path) -> None:
        self.start = start
        self.popen: subprocess.Popen[bytes] | None = None
        self.runs, self.was_ready, self.restarts = False, False, Restarts()
        self.due: float | None = 0.0
        self.state, self.beat_at, self.beats = Beat(0), 0.0, False
        self.failure = ""  # why it was restarted, or cannot be started
        self.last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        # The file is opened with the first line.
        self._log = RotatingFileHandler(
            log, maxBytes=_LOG_BYTES, backupCount=1, encoding="utf-8", errors="surrogateescape",
            delay=True,
        )
        self._log.terminator = ""

    def receive(self, data: bytes) -> None:
        """Receive heartbeats."""
        self.state, self.beat_at, self.beats = Beat(data[-1]), time.monotonic(), True
        self.was_ready |= Beat.READY in self.state

    def log(self, data: bytes) -> None:
        """Log the output of the process, and remember its last lines in case the disk fails."""
        self.last_lines.extend(filter(None, data.decode(errors="replace").splitlines()))
        record = logging.makeLogRecord({"msg": data.decode(errors="surrogateescape")})
        DISK.do(partial(self._log.emit, record), len(data))

    @property
    def is_alive(self) -> bool:
        """Whether the operating-system process has not ended."""
        return self.popen is not None and self.popen.poll() is None

    def describe_end(self) -> str:
        """Return a description of the end; empty if the process has not ended."""
        code = None if self.popen is None else self.popen.poll()
        if code is None:
            return ""
        return f"ended ({f'exit code {code}' if code >= 0 else signal.Signals(-code).name})"

    def kill(self) -> None:
        """Kill the process, and wait at most 1 s for it to end."""
        assert self.popen is not None
        self.popen.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # the kernel may take longer
            self.popen.wait(1.0)


class LiveSupervisor:
    """Supervisor of the processes of a live site, which starts, restarts and ends them.

    Each process sends heartbeats on a pipe. A process that ends or is silent for too long is
    restarted after an increasing delay; after too many restarts, it stays off, and the others live
    on. Only without the station, whose alarms nobody else reports, does the site end.

    The supervisor has no influence on whether the pump may run. A pump node that has died cannot
    stop the drive, so the supervisor stops the drive. The supervisor also stops the drive at the
    end, whatever the pump node reports.

    Attributes:
        may_run: warning that the pump may still be running after the end; empty if the pump is
            stopped.
    """

    def __init__(
        self, processes: Iterable[ProcessStart], logs: Path, ros_arguments: Collection[str],
        stop_drive: StopDrive | None, tell: Callable[[str], None], *,
        silence_s: float, prepare: Callable[[], Mapping[str, str]],
    ) -> None:
        """Start nothing yet.

        Args:
            processes: the processes of the site.
            logs: existing directory for the output, with one file per process.
            ros_arguments: ROS arguments of all processes.
            stop_drive: function that stops the drive; None if there is no drive or the user runs
                the pump.
            tell: function that receives what the station prints for human readers, and what
                happens to a process.
            silence_s: time for which a process may be silent before it is killed (s).
            prepare: function called before every start of a process; it returns additions to its
                environment, or raises an :class:`OSError`.
        """
        self.may_run = ""
        self._processes = {
            start.name: _Process(start, logs / f"{start.name}.log") for start in processes
        }
        self._ros_arguments, self._stop_drive, self._tell = ros_arguments, stop_drive, tell
        self._silence_s, self._prepare = silence_s, prepare
        self._stopper = ThreadPoolExecutor(1)
        self._stopper.submit(int)  # start its thread now: the system may be out of threads later
        self._stopping: Future[tuple[bool, str]] | None = None
        self._stop_message, self._stop_again_at = "", math.inf
        self._drive_reached = False
        self._selector = selectors.DefaultSelector()
        self._read_at = time.monotonic()

    def __enter__(self) -> LiveSupervisor:
        """Return the supervisor without starting a process."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all processes: the pump's first, and the station last, so that the bag is complete.

        Two simultaneous stops of the drive would collide, so a stop in progress is completed first.
        """
        if self._stopping is not None:
            self._stopping.result()
        for process in self._processes.values():
            if process.is_alive and process.popen is not None:
                # A stopped process would not receive SIGTERM.
                process.popen.send_signal(signal.SIGCONT)
        names = self._processes.keys()
        self._end_processes(names & {PUMP})
        pump = self._processes.get(PUMP)
        if self._stop_drive is not None and pump is not None and pump.popen is not None:
            may_run, message = self._stop_drive(pump.popen.pid, self._drive_reached)
            self.may_run = message if may_run else ""
            if self.may_run or pump.popen.returncode != EXIT_DONE:
                self._tell(f"{PUMP}: {pump.describe_end()}; {message}")
        self._end_processes(names - {PUMP, STATION})
        self._end_processes(names & {STATION})

    def _end_processes(self, names: Collection[str]) -> None:
        """Stop the given processes with SIGTERM, and kill them if they take too long.

        SIGINT is not used, because background processes of a shell ignore it, as would a process
        that is just starting.
        """
        began_at = time.monotonic()
        ending = {
            name: popen for name in names
            if (popen := self._processes[name].popen) is not None and popen.poll() is None
        }
        for popen in ending.values():
            popen.send_signal(signal.SIGTERM)
        while ending:
            self.read(0.02)
            passed = time.monotonic() - began_at
            for name, popen in list(ending.items()):
                limit = PUMP_ENDING_S if name == PUMP else ENDING_S
                if popen.poll() is not None or passed > limit + KILLING_S:
                    del ending[name]
                elif passed > limit:
                    popen.kill()
        self.read(0.0)
        if not any(process.is_alive for process in self._processes.values()):
            DISK.wait(_WRITTEN_S)

    # --- starting and reading -------------------------------------------------------------------

    def _start(self, process: _Process) -> None:
        """Start a process in its own session, so that Ctrl-C at the terminal does not reach it.

        What the station prints on standard output is for the person at the terminal.

        Raises:
            OSError: if the system has no processes or file descriptors left, or the process's files
                cannot be written; nothing is left open.
        """
        additions = dict(self._prepare())
        if process.failure and process.start.name == STATION:
            additions[RESTARTED] = process.failure
        readers = [process.receive, process.log, *(
            [lambda data: self._tell(data.decode(errors="replace").rstrip("\n"))]
            if process.start.name == STATION else []
        )]
        with contextlib.ExitStack() as ours, contextlib.ExitStack() as theirs:
            pipes = []
            for _ in readers:
                reading, writing = os.pipe()
                ours.callback(os.close, reading)
                theirs.callback(os.close, writing)
                pipes.append((reading, writing))
            beats, prints = pipes[0][1], [writing for _, writing in pipes[1:]]
            os.set_blocking(beats, False)
            process.popen = subprocess.Popen(
                [
                    sys.executable, "-m", process.start.module, *process.start.arguments,
                    *self._ros_arguments,
                ],
                stdin=subprocess.DEVNULL,
                stdout=prints[-1],
                stderr=prints[0],
                env={
                    **child_environment(), **additions, LEASE: _LIVE_LEASE_S, PIPE: str(beats),
                    "PYTHONFAULTHANDLER": "1",  # so that a crash in compiled code shows its place
                },
                pass_fds=[beats],
                start_new_session=True,
            )
            ours.pop_all()
        process.runs, process.beats, process.state = True, False, Beat(0)
        process.beat_at = time.monotonic()
        for (reading, _), reader in zip(pipes, readers, strict=True):
            self._selector.register(reading, selectors.EVENT_READ, reader)

    def read(self, seconds: float = 0.1) -> None:
        """Read heartbeats and output, waiting for them for at most the given time (s)."""
        for key, _ in self._selector.select(seconds):
            if data := os.read(key.fd, _MAX_READ):
                key.data(data)
            else:
                self._selector.unregister(key.fd)
                os.close(key.fd)
        now = time.monotonic()
        if now - self._read_at > PAUSE_S:  # this process was paused, so no other was silent
            for process in self._processes.values():
                process.beat_at = now
        self._read_at = now

    # --- keeping them running -------------------------------------------------------------------

    @property
    def unready(self) -> str:
        """Text that names the processes that are not ready; empty if all are ready."""
        return ", ".join(
            f"{name} is {'starting' if process.runs else 'missing'}"
            for name, process in self._processes.items()
            if not (process.runs and Beat.READY in process.state)
        )

    def update(self) -> None:
        """Start what is due, and restart what failed; called repeatedly.

        Raises:
            NodeFailed: if the station was restarted too often, or if a process was never ready and
                ended because of invalid parameters or another graph.
        """
        now = time.monotonic()
        for name, process in self._processes.items():
            self._drive_reached |= Beat.REACHED in process.state
            waits = name == PUMP and self._stopping is not None
            if process.runs:
                if failure := process.describe_end() or self._kill_if_silent(process, now):
                    self._handle_failure(process, failure, now)
            elif process.due is not None and now >= process.due and not waits:
                self._try_to_start(process, now)
        if self._stopping is not None and self._stopping.done():
            may_run, message = self._stopping.result()
            if not self._stop_message or message != self._stop_message:
                self._tell(f"{PUMP}: did not stop the drive; {message}")
            self._stopping, self._stop_message = None, message
            if may_run and self._processes[PUMP].due is None:  # nobody else stops it any more
                self._stop_again_at = now + restarts.MAX_WAIT_S
        if now >= self._stop_again_at and (popen := self._processes[PUMP].popen) is not None:
            self._begin_stop(popen.pid)

    def _try_to_start(self, process: _Process, now: float) -> None:
        """Start a process; if there are no processes or file descriptors, try again in 10 s."""
        try:
            self._start(process)
        except OSError as error:
            process.due = now + restarts.MAX_WAIT_S
            before, process.failure = process.failure, f"cannot be started: {error.strerror}"
            if process.failure != before:
                again = f"another attempt is made every {restarts.MAX_WAIT_S:g} s"
                self._tell(f"{process.start.name}: {process.failure}; {again}")

    def _kill_if_silent(self, process: _Process, now: float) -> str:
        """Kill a process if it hangs, and return the reason; empty if it does not hang."""
        limit = self._silence_s if process.beats else max(self._silence_s, START_LIMIT_S)
        if process.start.name == PUMP and process.beats and Beat.AT_REST not in process.state:
            limit = SILENT_S
        if now - process.beat_at <= limit:
            return ""
        process.kill()
        return f"had not answered for {limit:g} s: killed"

    def _handle_failure(self, process: _Process, failure: str, now: float) -> None:
        """Report that a process failed, and schedule its restart; for the pump, stop the drive.

        Raises:
            NodeFailed: if the site must end.
        """
        self.read(0.0)  # its last lines and heartbeats
        self._drive_reached |= Beat.REACHED in process.state
        start, name, popen = process.start, process.start.name, process.popen
        assert popen is not None
        wrong = popen.returncode in (EXIT_USAGE, EXIT_OCCUPIED)
        wait, how = process.restarts.wait(now), ""
        if start.instead and (wait is None or (wrong and process.was_ready)):
            # The last line of a program that rejects its set-up is the reason.
            reason = ", ".join([failure, *list(process.last_lines)[-1:]]) if wrong else failure
            process.start = replace(start, arguments=start.instead(reason), instead=None)
            process.restarts, wait, how = Restarts(), restarts.FIRST_WAIT_S, "given up: "
        process.runs, process.failure, process.state = False, failure, Beat(0)
        process.due = None if wait is None else now + wait
        too_often = (
            f"it has been restarted {restarts.MAX_RESTARTS} times in the last "
            f"{restarts.WINDOW_S / 60:g} minutes"
        )
        if (wrong and not process.was_ready) or (wait is None and name == STATION):
            more = "" if wrong else f"; {too_often}, and will not be restarted again"
            code = popen.returncode if wrong else EXIT_FAILED
            lines = [f"  {line}" for line in process.last_lines] or ["  (none)"]
            raise NodeFailed(
                f"{name} {failure}{more}", "\n".join([f"last lines of {name}:", *lines]), code
            )
        self._tell(f"{name}: {failure}; " + (
            f"{how}starts again in {wait:g} s" if wait is not None
            else f"{too_often}, and stays off until the site is restarted"
        ))
        if name == PUMP:
            self._stop_message = ""
            self._begin_stop(popen.pid)

    def _begin_stop(self, pump_node: int) -> None:
        """Begin to stop the drive without the pump node, whose process id is given."""
        self._stop_again_at = math.inf
        if self._stop_drive is not None:
            self._stopping = self._stopper.submit(
                self._stop_drive, pump_node, self._drive_reached
            )
