"""The processes of a graph's nodes: started, heard, logged, ended; on a live site started again."""

from __future__ import annotations

import atexit
import contextlib
import json
import logging
import math
import selectors
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, cast

from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_OCCUPIED,
    EXIT_USAGE,
)
from greenroof_ros.common.disk import DISK
from greenroof_ros.common.processes import asked_to_end_with_this
from greenroof_ros.common.times import boot_time
from greenroof_ros.drives.drive_file import LONGEST_RAMP_S
from greenroof_ros.drives.sensor_file import QUANTITIES, TANKS
from greenroof_ros.graph.domain import LEASE
from greenroof_ros.graph.supervision import PUMP, READY, RECORDER, SOCKET, read_report, read_socket

# How long to wait for a process that was asked to end, before the kernel ends it (s); and the pump
# node, which waits until the pump stands: as long as the speed falls.
ENDING_S, PUMP_ENDING_S = 8.0, 40.0
# How long the kernel may take (s).
KILLING_S = 5.0
# How long a node that was just started may say nothing (s): imports on a busy machine take seconds.
START_LIMIT_S = 30.0
_LAST_LINES = 15
# How often the pump node gets its permit (s).
PERMIT_S = 0.25
# Nodes that report four times a second fall silent for one reason within this time (s).
_SAME_SILENCE_S = 0.5
# Size at which a node's log becomes its .log.1 in place of the one before it: a live site runs for
# months. How long the end of nodes waits for what they printed to be written (s).
_LOG_BYTES, _WRITTEN_S = 10_000_000, 2.0
# A pause of this process itself (s): what it did not hear is not the nodes' silence.
_PAUSE_S = 1.0

# Of a live site: a node that says nothing for so long (s) stops the pump; reports come four times a
# second. A pump node that did not say that the pump stands is killed then.
SILENT_S = 2.0
# How long after the permit was withdrawn the pump node may say that it runs the pump (s); the pump
# may turn longer by its drive's ramp.
_OBEYS_S = 2.0
# The time before a restart (s): 1, 2, 4, ... to this, by the restarts of the last ten minutes.
_LONGEST_WAIT_S = 10.0
_WINDOW_S = 600.0
# A node that was killed is one of two publishers for so long (s) when it is started again.
_LIVE_LEASE_S = "3"
# Nodes without which the pump may run: what else needs a gauge says so itself.
_NOT_REQUIRED = {
    RECORDER, *(quantity.node for section, quantity in QUANTITIES.items() if section not in TANKS)
}

# A full disk is no error of a log: what it does not take is lost. At the end, a disk that hangs
# would be waited for; each line is flushed when it is written.
logging.raiseExceptions = False
atexit.unregister(logging.shutdown)

# Stops the drive without the pump node, given its process; returns whether the drive says
# that the pump stands, and what came of it, in words.
StopDrive = Callable[[int], tuple[bool, str]]


class NodeFailed(Exception):
    """A node ended or hangs, and the graph with it; the message quotes the node's last lines.

    Attributes:
        reason: the message without these lines.
        last_lines: these; empty where the reason says all.
        code: what the exit code should be.
    """

    def __init__(self, reason: str, last_lines: str, code: int | None) -> None:
        """Fail; of the exit codes of a node only wrong use and another graph are handed on."""
        super().__init__("\n".join(filter(None, (reason, last_lines))))
        self.reason = reason
        self.last_lines = last_lines
        self.code = code if code in (EXIT_USAGE, EXIT_OCCUPIED) else EXIT_FAILED


@dataclass(frozen=True)
class NodeStart:
    """A node that is to be started.

    Attributes:
        name: of the node; the pump node's decides that it gets a permit.
        module: that it is, such as greenroof_ros.nodes.weather.
        arguments: of the module's command line, beside those for ROS.
        parameters: that bringup decides, where they are not written elsewhere.
    """

    name: str
    module: str
    arguments: tuple[str, ...] = ()
    parameters: dict[str, Any] = field(default_factory=dict)


class NodeProcess:
    """A process of a node, and what it has said.

    Attributes:
        process: that runs it.
        socket: to it.
        heard: when it last said something of itself, or was started (steady clock, s).
        spoke: whether it has.
        last: that it said of itself; empty before.
        last_lines: that it printed.
    """

    def __init__(
        self, process: subprocess.Popen[bytes], to_it: socket.socket, log: RotatingFileHandler
    ) -> None:
        self.process, self.socket = process, to_it
        self.heard = time.monotonic()
        self.spoke = False
        self.last: dict[str, Any] = {}
        self.last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._log = log
        self._cut = b""

    def hear(self, data: bytes) -> None:
        """Take what came through the socket."""
        self.spoke = True
        self.heard = time.monotonic()
        *lines, self._cut = (self._cut + data).split(b"\n")
        for line in lines:
            # One that did not fit into a full socket is cut short; the next one says it again.
            self.last = read_report(line) or self.last

    def log(self, data: bytes) -> None:
        """Keep what it prints: in its log, and in memory should the disk be full or hang."""
        self.last_lines.extend(data.decode(errors="replace").splitlines())
        record = logging.makeLogRecord({"msg": data.decode(errors="surrogateescape")})
        DISK.do(partial(self._log.emit, record), len(data))

    @property
    def is_stopped(self) -> bool:
        """Whether it was stopped, by Ctrl-Z or a debugger."""
        with contextlib.suppress(OSError):  # it ends just now
            stat = Path(f"/proc/{self.process.pid}/stat").read_text()
            return stat.rpartition(")")[2].split()[0] in "Tt"
        return False

    def kill(self) -> None:
        """Have the kernel end it."""
        self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # the kernel is busy with it
            self.process.wait(1.0)


class Supervisor:
    """Node processes, each with a socket on which it says every quarter of a second how it is.

    Discovery in the graph can take seconds, and who watches over nodes must not miss a word. Where
    the pump node dies, it cannot stop the drive any more: leaving the ``with`` block ends all nodes
    and does that, whatever the pump node says.

    Attributes:
        nodes: those that were started, by name.
        awake_since: when this process itself last stood still (steady clock, s), or began.
        may_run: that the pump may run after the end, and what protects; empty where it stands.
    """

    def __init__(
        self, logs: Path, parameters: Sequence[Path], namespace: str,
        stop_drive: StopDrive | None, on_failure: Callable[[str, str], None],
    ) -> None:
        """Start nothing yet.

        Args:
            logs: the directory for what the nodes print, one file each; must exist.
            parameters: ROS 2 parameter files of all nodes; what a later one says counts.
            namespace: of all nodes, such as ``/site1``; empty for none.
            stop_drive: None where there is none, or the pump is somebody else's.
            on_failure: called where a node failed and the run goes on, with its name, and what
                happened and was done about it.
        """
        self.nodes: dict[str, NodeProcess] = {}
        self.may_run = ""
        self._permitted = -math.inf  # when the pump node last got its permit (s)
        self._inhibit = ""
        self._stop_drive = stop_drive
        self._on_failure = on_failure
        self._directory = logs
        self._logs: dict[str, RotatingFileHandler] = {}
        self._environment: dict[str, str] = {}
        # rcl writes files of its own on the node's thread: besides what a node prints, they would
        # grow for months, and a disk that hangs would stop the node.
        self._ros_arguments = ["--ros-args", "--disable-external-lib-logs"]
        for file in parameters:
            self._ros_arguments += ["--params-file", str(file)]
        if namespace:
            self._ros_arguments += ["-r", f"__ns:={namespace}"]
        self._ears = selectors.DefaultSelector()
        self._looked = self.awake_since = time.monotonic()

    def __enter__(self) -> Supervisor:
        """Nothing runs yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all: the pump node first, the recorder last, whose bag holds all that was said."""
        for node in self.nodes.values():
            node.process.send_signal(signal.SIGCONT)  # one that is stopped hears nothing else
        names = self.nodes.keys()
        self._end(names & {PUMP})
        if self._stop_drive is not None and PUMP in names:
            self._see_drive_off(self._stop_drive)
        self._end(names - {PUMP, RECORDER})
        self._end(names & {RECORDER})

    def _see_drive_off(self, stop_drive: StopDrive) -> None:
        """Stop the drive, and tell it where the pump node did not end well, or the pump may run."""
        process = self.nodes[PUMP].process
        stands, message = stop_drive(process.pid)
        self.may_run = "" if stands else message
        if self.may_run or process.returncode != EXIT_DONE:
            self._on_failure(PUMP, f"{self.ended(PUMP)}; {message}")

    # --- starting -------------------------------------------------------------------------------

    def start(self, node: NodeStart) -> None:
        """Start one node; it does not see the terminal's Ctrl-C, which is this process's.

        Raises:
            OSError: the system has no process or file descriptor to give; nothing is left open.
        """
        name = node.name
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
                    **asked_to_end_with_this(), **self._environment, SOCKET: str(theirs.fileno()),
                },
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
            ends.pop_all()
        for end in (theirs, printing):
            end.close()
        self.nodes[name] = running = NodeProcess(process, ours, self._logs[name])
        self._ears.register(ours, selectors.EVENT_READ, running.hear)
        self._ears.register(printed, selectors.EVENT_READ, running.log)

    def permit(self, inhibit: str) -> None:
        """Tell the pump node, if there is one, whether it may run, when that is new or due.

        Args:
            inhibit: why it may not; empty where it may.
        """
        now, node = boot_time(), self.nodes.get(PUMP)
        if node and (inhibit != self._inhibit or now - self._permitted >= PERMIT_S):
            self._permitted, self._inhibit = now, inhibit
            line = json.dumps({"inhibit": inhibit, "at": now})
            with contextlib.suppress(OSError):  # it does not read, or has ended
                node.socket.send(f"{line}\n".encode(), socket.MSG_DONTWAIT)

    # --- hearing --------------------------------------------------------------------------------

    @property
    def last(self) -> dict[str, dict[str, Any]]:
        """The last report of each node that has said something."""
        return {name: node.last for name, node in self.nodes.items() if node.last}

    def listen(self) -> None:
        """Hear what the nodes say, for at most a tenth of a second."""
        self._read(0.1)  # which, where this process was stopped in it, may find nothing
        now = time.monotonic()
        if now - self._looked > _PAUSE_S:
            self.awake_since = now
            for node in self.nodes.values():
                node.heard = now
        self._looked = now

    def _read(self, seconds: float) -> None:
        """Read what the nodes say, after at most so long (s): all that waits by then."""
        for key, _ in self._ears.select(seconds):
            data = read_socket(key.fd)
            if data:
                key.data(data)
            else:
                self._ears.unregister(key.fileobj)
                cast(socket.socket, key.fileobj).close()

    def quoted(self, node: str) -> str:
        """Read all that a node has said, and return its last lines."""
        self._read(0.0)
        quoted = [f"  {line}" for line in self.nodes[node].last_lines] or ["  (none)"]
        return "\n".join([f"last lines of {node}:", *quoted])

    def ended(self, node: str) -> str:
        """Return how a node ended, and why if it said so; empty while it runs."""
        code = self.nodes[node].process.poll()
        if code is None:
            return ""
        self._read(0.0)
        ending = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        why = self.nodes[node].last.get("failure")
        return f"ended ({ending})" + (f": {why}" if why else "")

    def check(self, limit: float) -> None:
        """Look whether all nodes live and speak.

        Args:
            limit: longest silence (s); half a second later, when all that it silenced are silent
                for as long, it is reported.

        Raises:
            NodeFailed: one has ended, or some were silent for longer.
        """
        for name, node in self.nodes.items():
            ended = self.ended(name)
            if ended:
                raise NodeFailed(f"node {name} {ended}", self.quoted(name), node.process.returncode)
        now = time.monotonic()
        silent = {
            name: now - node.heard for name, node in self.nodes.items() if now - node.heard > limit
        }
        # A node that is stopped silences those that wait for it: all of them are named, and which
        # of them is stopped.
        if max(silent.values(), default=0.0) > limit + _SAME_SILENCE_S:
            raise NodeFailed(
                "; ".join(
                    f"node {name}{' (stopped)' if self.nodes[name].is_stopped else ''} "
                    f"has not answered for {limit:g} s"
                    for name in silent
                ),
                "\n".join(map(self.quoted, silent)), EXIT_FAILED,
            )

    # --- ending ---------------------------------------------------------------------------------

    def _end(self, nodes: Collection[str]) -> None:
        """Ask these nodes to end, and after a while have the kernel end them.

        Not by SIGINT: what a shell starts in its background ignores it, and so would a node that
        just begins.
        """
        began = time.monotonic()
        limits = {
            node: PUMP_ENDING_S if node == PUMP else ENDING_S
            for node in nodes if self.nodes[node].process.poll() is None
        }
        for node in limits:
            self.nodes[node].process.send_signal(signal.SIGTERM)
        while limits:
            self._read(0.02)
            passed = time.monotonic() - began
            for node, limit in list(limits.items()):
                process = self.nodes[node].process
                if process.poll() is not None or passed > limit + KILLING_S:
                    del limits[node]
                elif passed > limit:
                    process.kill()
        self._read(0.0)
        if all(node.process.poll() is not None for node in self.nodes.values()):
            DISK.wait(_WRITTEN_S)


def _log_file(path: Path) -> RotatingFileHandler:
    """Return what writes a node's log, opened with the first line."""
    log = RotatingFileHandler(
        path, maxBytes=_LOG_BYTES, backupCount=1, encoding="utf-8", errors="surrogateescape",
        delay=True,
    )
    log.terminator = ""
    return log


@dataclass
class _Kept:
    """A node of a live site: how it is started, and how it has fared."""

    start: NodeStart
    started: float = 0.0  # at what time (steady clock, s)
    starts_again: float | None = None  # at what time, where it does not run
    restarts: deque[float] = field(default_factory=deque)  # when, within the window
    was_ready: bool = False
    cannot_start: str = ""  # why the system gives no process for it


class LiveSupervisor(Supervisor):
    """The node processes of a live site, and whether the pump may run.

    A node that ends, or says nothing for too long, is started again, after a while that grows; one
    that needs that too often is given up, and the site with it, the pump stopped. The pump node
    gets a permit four times a second. Where it dies, falls silent or does not obey, it is
    killed, and the drive is stopped from here. The recorder is never given up, and ends nothing:
    recording must not stop control.

    Attributes:
        inhibit: why the pump may not run; empty where it may.
    """

    def __init__(
        self,
        logs: Path,
        parameters: Sequence[Path],
        namespace: str,
        stop_drive: StopDrive | None,
        on_failure: Callable[[str, str], None],
        *,
        silence_s: float,
        restarts: int,
    ) -> None:
        """Start nothing yet.

        Args:
            logs: see :class:`Supervisor`, also for the next four.
            parameters: likewise.
            namespace: likewise.
            stop_drive: likewise.
            on_failure: likewise.
            silence_s: how long a node may say nothing before it is killed (s).
            restarts: of one node within ten minutes; one more, and the site is stopped.
        """
        super().__init__(logs, parameters, namespace, stop_drive, on_failure)
        self._environment[LEASE] = _LIVE_LEASE_S
        self.inhibit = "starting"
        self._inhibited_since = time.monotonic()
        self._met = False
        self._kept: dict[str, _Kept] = {}
        self._silence_s = silence_s
        self._restarts = restarts
        self._stopper = ThreadPoolExecutor(1)
        self._stopper.submit(int)  # its thread is here before the system may have none to give
        self._stopping: Future[tuple[bool, str]] | None = None

    def __exit__(self, *error: object) -> None:
        """End all; a stop of the drive that lasts first: two would be in each other's way."""
        if self._stopping is not None:
            self._stopping.result()
        super().__exit__(*error)

    def add(self, node: NodeStart) -> None:
        """Start a node, now and whenever it has failed; see :meth:`start`."""
        self._kept[node.name] = _Kept(node)
        self._start(node.name, time.monotonic())

    def _start(self, name: str, now: float) -> None:
        """Start a node; one for which the system has no process or file is tried again for ever."""
        record = self._kept[name]
        record.started, record.starts_again = now, None
        try:
            self.start(record.start)
            record.cannot_start = ""
        except OSError as error:
            record.starts_again = now + _LONGEST_WAIT_S
            why, before = error.strerror or str(error), record.cannot_start
            record.cannot_start = why
            if why != before:
                again = f"tried again every {_LONGEST_WAIT_S:g} s{_unrecorded(name)}"
                self._on_failure(name, f"cannot be started: {why}; {again}")

    def look(self) -> None:
        """Restart what failed, and tell the pump node whether it may run; called all the time.

        Raises:
            NodeFailed: a node was restarted too often, or was never ready and says that its
                parameters are wrong.
        """
        now = time.monotonic()
        for name, record in self._kept.items():
            if record.starts_again is None:
                record.was_ready |= self._is_ready(name)
                failure = self.ended(name) or self._killed(name, now)
                if failure:
                    self._failed(name, failure, now)
            elif now >= record.starts_again and not (name == PUMP and self._stopping is not None):
                self._start(name, now)
        if self._stopping is not None and self._stopping.done():
            _, message = self._stopping.result()
            self._on_failure(PUMP, f"could not stop the drive; {message}")
            self._stopping = None
        before, self.inhibit = self.inhibit, self._reason_to_inhibit(now)
        if self.inhibit and not before:
            self._inhibited_since, self._met = now, False
        self.permit(self.inhibit)

    def _killed(self, name: str, now: float) -> str:
        """Kill a node that hangs or does not obey, and return why; empty where it does neither."""
        node = self.nodes[name]
        limit = self._silence_s if node.spoke else max(self._silence_s, START_LIMIT_S)
        if name == PUMP and node.spoke and not self._says_it_stands():
            limit = SILENT_S
        why = self._disobeys(now) if name == PUMP else ""
        if now - node.heard > limit:
            why = f"had not answered for {limit:g} s{' (stopped)' if node.is_stopped else ''}"
        if not why:
            return ""
        node.kill()
        return f"{why}: killed"

    def _says_it_stands(self) -> bool:
        """Whether the pump node said last that the pump stands: it was seen to, or must by now."""
        return self.nodes[PUMP].last.get("stands") is True

    def _disobeys(self, now: float) -> str:
        """Return what the pump node does although it may not; empty where it does nothing such.

        A pump that turns although the node says that it was ordered to stop is met once while the
        pump may not run: the node is right perhaps, and another stop no use.
        """
        if not self.inhibit or self._says_it_stands():
            return ""
        passed = now - max(self._inhibited_since, self._kept[PUMP].started, self.awake_since)
        state = self.nodes[PUMP].last.get("pump_state")
        if passed > _OBEYS_S and state in ("running", "starting"):
            return f"ran the pump for {_OBEYS_S:g} s after it was forbidden ({self.inhibit})"
        if passed > _OBEYS_S + LONGEST_RAMP_S and state and not self._met:
            self._met = True
            return f"did not stop the pump within {_OBEYS_S + LONGEST_RAMP_S:g} s ({self.inhibit})"
        return ""

    def _failed(self, name: str, failure: str, now: float) -> None:
        """Tell that a node failed, and when it starts again.

        Raises:
            NodeFailed: not at all.
        """
        record, code = self._kept[name], self.nodes[name].process.returncode
        while record.restarts and now - record.restarts[0] > _WINDOW_S:
            record.restarts.popleft()
        too_often = len(record.restarts) >= self._restarts
        if name not in _NOT_REQUIRED:
            if not record.was_ready and code in (EXIT_USAGE, EXIT_OCCUPIED):
                raise NodeFailed(f"node {name} {failure}", self.quoted(name), code)
            if too_often:
                raise NodeFailed(
                    f"node {name} {failure}; it was restarted {len(record.restarts)} times in the "
                    f"last {_WINDOW_S / 60:g} minutes, and is given up",
                    self.quoted(name), EXIT_FAILED,
                )
        wait = _WINDOW_S if too_often else min(2.0 ** len(record.restarts), _LONGEST_WAIT_S)
        record.restarts.append(now)
        record.starts_again = now + wait
        self._on_failure(name, f"{failure}; starts again in {wait:g} s{_unrecorded(name)}")
        if name == PUMP and self._stop_drive is not None:
            self._stopping = self._stopper.submit(self._stop_drive, self.nodes[name].process.pid)

    @property
    def all_ready(self) -> bool:
        """Whether every node that the pump needs runs and has all that it needs."""
        return self._kept.keys() - _NOT_REQUIRED <= self.ready

    @property
    def ready(self) -> set[str]:
        """The nodes that run and have all that they need."""
        return {
            name for name, record in self._kept.items()
            if record.starts_again is None and self._is_ready(name)
        }

    def _is_ready(self, name: str) -> bool:
        return self.nodes[name].last.get("state") == READY

    def _reason_to_inhibit(self, now: float) -> str:
        """Return why the pump may not run; empty where it may."""
        reasons = []
        for name, record in self._kept.items():
            if name == PUMP or name in _NOT_REQUIRED:
                continue
            if record.starts_again is not None or self.nodes[name].process.poll() is not None:
                reasons.append(f"{name} is missing")
            elif not self._is_ready(name):
                waiting = self.nodes[name].last.get("waiting")
                reasons.append(
                    f"{name} waits for {', '.join(waiting)}" if waiting else f"{name} is starting"
                )
            elif now - self.nodes[name].heard > SILENT_S:
                reasons.append(f"{name} is silent")
        return ", ".join(reasons)


def _unrecorded(name: str) -> str:
    return "; nothing is recorded until then" if name == RECORDER else ""
