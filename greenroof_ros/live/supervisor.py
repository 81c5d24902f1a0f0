"""Supervisor that starts, monitors, logs, restarts and ends the node processes of a live site."""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, NamedTuple, cast

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_OCCUPIED,
    EXIT_USAGE,
)
from greenroof_ros.base.disk import DISK
from greenroof_ros.base.processes import child_environment
from greenroof_ros.interface.states import PUMP, READY, RECORDER, DriveState
from greenroof_ros.live import restarts
from greenroof_ros.live.devices.sensor_file import QUANTITIES, TANKS
from greenroof_ros.live.restarts import Restarts
from greenroof_ros.live.supervisor_socket import SOCKET, read_report
from greenroof_ros.ros.domain import LEASE, ros_arguments

# How long to wait for a process to end before it is killed (s). The pump node is given longer: it
# waits until the pump is stopped, while the speed falls.
ENDING_S, PUMP_ENDING_S = 8.0, 40.0
# Longest time that killing a process may take (s).
KILLING_S = 5.0
# How long a started node may be silent at first (s), since imports take seconds on a busy machine.
START_LIMIT_S = 30.0
_LAST_LINES = 15
# Size of the largest report of a node, and of what is read from a socket at a time, which is more
# than it holds (bytes). A longer line is not a report.
_MAX_REPORT, _MAX_READ = 10_000_000, 1 << 18
# Size at which a node's log is renamed to .log.1, replacing the previous one, since a live site
# runs for months. How long to wait, after the nodes have ended, until their output is written (s).
_LOG_BYTES, _WRITTEN_S = 10_000_000, 2.0
# A gap longer than this means that this process was paused (s), so the nodes were not silent.
_PAUSE_S = 1.0

# A pump node that is silent for this long (s) is killed, unless it last reported that the pump is
# stopped; nodes report four times a second.
SILENT_S = 2.0
# How long after its restart a killed node still counts as a second publisher (s).
_LIVE_LEASE_S = "3"
# The process with all nodes but the pump's and the controller's.
STATION = "station"
# Nodes that the site can do without; a node that needs a gauge itself reports its absence.
_NOT_REQUIRED = {
    RECORDER, *(quantity.node for section, quantity in QUANTITIES.items() if section not in TANKS)
}

# A function that stops the drive without the pump node. It takes the process id of that node, and
# whether that node has reached the drive; it returns whether the pump may be running after that,
# and the outcome in words.
StopDrive = Callable[[int, bool], tuple[bool, str]]


class NodeFailed(Exception):
    """Error raised if a node has ended or is hanging, so that the graph must end.

    Attributes:
        last_lines: the last lines that the node printed.
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
            returns the arguments with which it is started from then on; None if the site then ends.
    """

    name: str
    module: str
    arguments: tuple[str, ...]
    nodes: Mapping[str, NodeSetup]
    instead: Callable[[str], tuple[str, ...]] | None = None


class NodeProcess:
    """Running process that contains one or more nodes, with their reports and output.

    Attributes:
        process: the operating-system process.
        last_report_at: time of the process's last report or of its start, or time at which the
            supervisor's process resumed (steady clock, s).
        has_reported: whether the process has reported.
        reports: last report of each node that has reported, by name.
        last_lines: last lines that the process printed.
    """

    def __init__(
        self, name: str, process: subprocess.Popen[bytes], log: RotatingFileHandler
    ) -> None:
        self._name, self.process = name, process
        self.last_report_at = time.monotonic()
        self.has_reported = False
        self.reports: dict[str, dict[str, Any]] = {}
        self.last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._log = log
        self._partial_line = b""

    def receive(self, data: bytes) -> None:
        """Receive data from the socket."""
        self.has_reported = True
        self.last_report_at = time.monotonic()
        *lines, cut = (self._partial_line + data).split(b"\n")
        self._partial_line = cut[-_MAX_REPORT:]
        for report in filter(None, map(read_report, lines)):
            self.reports[report.get("node", self._name)] = report

    def log(self, data: bytes) -> None:
        """Log the output of the process, and remember its last lines in case the disk fails."""
        self.last_lines.extend(data.decode(errors="replace").splitlines())
        record = logging.makeLogRecord({"msg": data.decode(errors="surrogateescape")})
        DISK.do(partial(self._log.emit, record), len(data))

    def kill(self) -> None:
        """Kill the process, and wait at most 1 s for it to end."""
        self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # the kernel may take longer
            self.process.wait(1.0)


@dataclass
class _NodeRecord:
    """Start command of a node of a live site, and the history of the node's starts."""

    start: ProcessStart
    starts_again: float | None = None  # when its restart is due; None while it runs
    restarts: Restarts = field(default_factory=Restarts)
    was_ready: bool = False
    cannot_start: str = ""  # why the system could not start the process


class LiveSupervisor:
    """Supervisor of the node processes of a live site, which starts, restarts and ends them.

    Each process has a socket on which it reports its state every quarter of a second. Topics are
    not used, since discovery can take seconds, and a supervisor must not miss a report.

    The supervisor has no influence on whether the pump may run. A process that ends or is silent
    for too long is restarted after an increasing delay. If a process needs too many restarts, the
    supervisor stops the pump and ends the site. A controller is replaced if it needs too many
    restarts, or if its node can no longer run it. A pump node that has died cannot stop the drive,
    so the supervisor stops the drive. The supervisor also stops the drive at the end, whatever the
    pump node reports.

    Attributes:
        nodes: processes of the nodes that have been started, by name.
        may_run: warning that the pump may still be running after the end; empty if the pump is
            stopped.
    """

    def __init__(
        self, logs: Path, parameters: Sequence[Path], namespace: str,
        stop_drive: StopDrive | None, on_failure: Callable[[str, str], None], *,
        silence_s: float, prepare: Callable[[], Mapping[str, str]],
    ) -> None:
        """Start nothing yet.

        Args:
            logs: existing directory for the nodes' output, with one file per node.
            parameters: ROS 2 parameter files for all nodes; later files override earlier ones.
            namespace: namespace of the nodes, such as ``/site1``; empty for none.
            stop_drive: function that stops the drive; None if there is no drive or the user runs
                the pump.
            on_failure: function that receives a node's name and a text if the node failed without
                ending the run, or if the drive had to be stopped in the node's place.
            silence_s: time for which a node may be silent before it is killed (s).
            prepare: function called before every start of a node; it returns additions to the
                node's environment, or raises an :class:`OSError`.
        """
        self.nodes: dict[str, NodeProcess] = {}
        self.may_run = ""
        self._stop_drive = stop_drive
        self._on_failure = on_failure
        self._directory = logs
        self._logs: dict[str, RotatingFileHandler] = {}
        self._records: dict[str, _NodeRecord] = {}
        self._silence_s = silence_s
        self._prepare = prepare
        self._stopper = ThreadPoolExecutor(1)
        self._stopper.submit(int)  # start its thread now: the system may be out of threads later
        self._stopping: Future[tuple[bool, str]] | None = None
        self._drive_reached = False
        self._ros_arguments = ros_arguments(parameters, namespace)
        self._selector = selectors.DefaultSelector()
        self._read_at = time.monotonic()

    def __enter__(self) -> LiveSupervisor:
        """Return the supervisor without starting a node."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all nodes: the pump node first, and the station last, so that the bag is complete.

        Two simultaneous stops of the drive would collide, so a stop in progress is completed first.
        """
        if self._stopping is not None:
            self._stopping.result()
        for node in self.nodes.values():
            node.process.send_signal(signal.SIGCONT)  # a stopped process would not receive SIGTERM
        names = self.nodes.keys()
        self._stop_nodes(names & {PUMP})
        if self._stop_drive is not None and PUMP in names:
            self._confirm_drive_stopped(self._stop_drive)
        self._stop_nodes(names - {PUMP, STATION})
        self._stop_nodes(names & {STATION})

    def _confirm_drive_stopped(self, stop_drive: StopDrive) -> None:
        """Stop the drive, and report if the pump node failed or the pump may still be running."""
        process = self.nodes[PUMP].process
        may_run, message = stop_drive(process.pid, self._drive_reached)
        self.may_run = message if may_run else ""
        if self.may_run or process.returncode != EXIT_DONE:
            self._on_failure(PUMP, f"{self.exit_status(PUMP)}; {message}")

    # --- starting -------------------------------------------------------------------------------

    def start(self, node: ProcessStart) -> None:
        """Start a node in its own session, so that Ctrl-C at the terminal does not reach it.

        Raises:
            OSError: if the system has no processes or file descriptors left, or the node's files
                cannot be written; nothing is left open.
        """
        name, additions = node.name, self._prepare()
        if name not in self._logs:
            self._logs[name] = _log_file(self._directory / f"{name}.log")
        with contextlib.ExitStack() as ends:
            ours, theirs, printed, printing = (
                ends.enter_context(end) for _ in range(2) for end in socket.socketpair()
            )
            process = subprocess.Popen(
                [sys.executable, "-m", node.module, *node.arguments, *self._ros_arguments],
                stdin=subprocess.DEVNULL,
                stdout=printing.fileno(),
                stderr=subprocess.STDOUT,
                env={
                    **child_environment(), **additions, LEASE: _LIVE_LEASE_S,
                    SOCKET: str(theirs.fileno()),
                    "PYTHONFAULTHANDLER": "1",  # so that a crash in compiled code shows its place
                },
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
            ends.pop_all()
        for end in (theirs, printing):
            end.close()
        self.nodes[name] = running = NodeProcess(name, process, self._logs[name])
        self._selector.register(ours, selectors.EVENT_READ, running.receive)
        self._selector.register(printed, selectors.EVENT_READ, running.log)

    # --- reading --------------------------------------------------------------------------------

    @property
    def last(self) -> dict[str, dict[str, Any]]:
        """Last report of each node that has reported."""
        return {
            name: report for node in self.nodes.values() for name, report in node.reports.items()
        }

    def read_reports(self, seconds: float = 0.1) -> None:
        """Read the nodes' reports and output, waiting for them for at most the given time (s)."""
        self._read(seconds)  # finds nothing if this process was paused during the wait
        now = time.monotonic()
        if now - self._read_at > _PAUSE_S:
            for node in self.nodes.values():
                node.last_report_at = now
        self._read_at = now

    def _read(self, seconds: float) -> None:
        """Wait for data from the nodes for a limited time (s), and read all available data."""
        for key, _ in self._selector.select(seconds):
            data = os.read(key.fd, _MAX_READ)
            if data:
                key.data(data)
            else:
                self._selector.unregister(key.fileobj)
                cast(socket.socket, key.fileobj).close()

    def last_lines_of(self, node: str) -> str:
        """Read the nodes' remaining output, and return the last lines of one node."""
        self._read(0.0)
        last_lines_of = [f"  {line}" for line in self.nodes[node].last_lines] or ["  (none)"]
        return "\n".join([f"last lines of {node}:", *last_lines_of])

    def exit_status(self, node: str) -> str:
        """Return a description of a node's end, with the reason if known; empty if it is alive."""
        code = self.nodes[node].process.poll()
        if code is None:
            return ""
        self._read(0.0)
        ending = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        reports = self.nodes[node].reports.values()
        why = next(filter(None, (report.get("failure") for report in reports)), None)
        return f"ended ({ending})" + (f": {why}" if why else "")

    # --- ending ---------------------------------------------------------------------------------

    def _stop_nodes(self, nodes: Collection[str]) -> None:
        """Stop the given nodes with SIGTERM, and kill them if they take too long.

        SIGINT is not used, because background processes of a shell ignore it, as would a node that
        is just starting.
        """
        started_at = time.monotonic()
        limits = {
            node: PUMP_ENDING_S if node == PUMP else ENDING_S
            for node in nodes if self.nodes[node].process.poll() is None
        }
        for node in limits:
            self.nodes[node].process.send_signal(signal.SIGTERM)
        while limits:
            self._read(0.02)
            passed = time.monotonic() - started_at
            for node, limit in list(limits.items()):
                process = self.nodes[node].process
                if process.poll() is not None or passed > limit + KILLING_S:
                    del limits[node]
                elif passed > limit:
                    process.kill()
        self._read(0.0)
        if all(node.process.poll() is not None for node in self.nodes.values()):
            DISK.wait(_WRITTEN_S)

    # --- keeping them running -------------------------------------------------------------------

    def add(self, node: ProcessStart) -> None:
        """Start a node now, and restart it whenever it has failed; see :meth:`start`."""
        self._records[node.name] = _NodeRecord(node)
        self._start(node.name, time.monotonic())

    def _start(self, name: str, now: float) -> None:
        """Start a node; if no processes or file descriptors are available, try again every 10 s."""
        record = self._records[name]
        record.starts_again = None
        try:
            self.start(record.start)
            record.cannot_start = ""
        except OSError as error:
            record.starts_again = now + restarts.MAX_WAIT_S
            why, before = error.strerror or str(error), record.cannot_start
            record.cannot_start = why
            if why != before:
                again = f"another attempt is made every {restarts.MAX_WAIT_S:g} s"
                self._on_failure(name, f"cannot be started: {why}; {again}")

    def update(self) -> None:
        """Restart failed nodes; called repeatedly.

        Raises:
            NodeFailed: if a required node was restarted too often, or if it was never ready and
                ended because of invalid parameters or another graph.
        """
        now = time.monotonic()
        drive_state = self.last.get(PUMP, {}).get("drive_state")
        self._drive_reached |= drive_state not in (None, DriveState.CONNECTING.value)
        for name, record in self._records.items():
            if record.starts_again is None:
                record.was_ready |= self._is_ready(name)
                failure = self.exit_status(name) or self._kill_if_silent(name, now)
                if failure:
                    self._handle_failure(name, failure, now)
            elif now >= record.starts_again and not (name == PUMP and self._stopping is not None):
                self._start(name, now)
        if self._stopping is not None and self._stopping.done():
            _, message = self._stopping.result()
            self._on_failure(PUMP, f"did not stop the drive; {message}")
            self._stopping = None

    def _kill_if_silent(self, name: str, now: float) -> str:
        """Kill a node if it hangs, and return the reason; empty if it does not hang."""
        node = self.nodes[name]
        limit = self._silence_s if node.has_reported else max(self._silence_s, START_LIMIT_S)
        at_rest = self.last.get(PUMP, {}).get("stands") is True  # read, or due to its timeout
        if name == PUMP and node.has_reported and not at_rest:
            limit = SILENT_S
        if now - node.last_report_at <= limit:
            return ""
        node.kill()
        return f"had not answered for {limit:g} s: killed"

    def _handle_failure(self, name: str, failure: str, now: float) -> None:
        """Report that a node failed, and schedule its restart; for the pump node, stop the drive.

        Raises:
            NodeFailed: if the node is not restarted and the site must end.
        """
        record, code = self._records[name], self.nodes[name].process.returncode
        wait, instead = record.restarts.wait(now), record.start.instead
        given_up = wait is None or (record.was_ready and code == EXIT_USAGE)
        replaced = instead(self._reason(name, failure)) if instead and given_up else ()
        if replaced:
            record.start = replace(record.start, arguments=replaced, instead=None)
            record.restarts, wait = Restarts(), restarts.FIRST_WAIT_S
        if not record.was_ready and code in (EXIT_USAGE, EXIT_OCCUPIED):
            raise NodeFailed(f"node {name} {failure}", self.last_lines_of(name), code)
        if wait is None:
            raise NodeFailed(
                f"node {name} {failure}; it has been restarted {restarts.MAX_RESTARTS} times in "
                f"the last {restarts.WINDOW_S / 60:g} minutes, and will not be restarted again",
                self.last_lines_of(name), EXIT_FAILED,
            )
        record.starts_again = now + wait
        how = "given up: " if replaced else ""
        self._on_failure(name, f"{failure}; {how}starts again in {wait:g} s")
        if name == PUMP and self._stop_drive is not None:
            self._stopping = self._stopper.submit(
                self._stop_drive, self.nodes[name].process.pid, self._drive_reached
            )

    def _reason(self, name: str, failure: str) -> str:
        """Return a description of a failure, with its location in the code if Python printed it."""
        lines = map(str.strip, self.nodes[name].last_lines)
        places = [line for line in lines if line.startswith('File "')]
        return ", ".join([failure, *places[:1]])

    def _is_ready(self, name: str) -> bool:
        reports = self.nodes[name].reports
        return all(
            reports.get(node, {}).get("state") == READY for node in self._records[name].start.nodes
        )

    @property
    def unready(self) -> str:
        """Text that names the nodes required by the pump that are not ready, with the reasons."""
        return ", ".join(
            f"{node} {why}" for name, record in self._records.items() for node in record.start.nodes
            if node not in _NOT_REQUIRED and (why := self._why_unready(name, node))
        )

    def _why_unready(self, name: str, node: str) -> str:
        record = self._records[name]
        if record.starts_again is not None or self.nodes[name].process.poll() is not None:
            return "is missing"
        report = self.nodes[name].reports.get(node, {})
        if report.get("state") == READY:
            return ""
        waiting = report.get("waiting")
        return f"waits for {', '.join(waiting)}" if waiting else "is starting"


def _log_file(path: Path) -> RotatingFileHandler:
    """Return the handler that writes a node's log; it opens the file with the first line."""
    log = RotatingFileHandler(
        path, maxBytes=_LOG_BYTES, backupCount=1, encoding="utf-8", errors="surrogateescape",
        delay=True,
    )
    log.terminator = ""
    return log
