"""Nodes as processes of this one: started, heard, logged, and ended without leaving any behind."""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import selectors
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

from greenroof_ros.common.disk import DISK
from greenroof_ros.common.processes import asked_to_end_with_this
from greenroof_ros.graph.states import PUMP, REPORT_PIPE, read_report

# How long to wait for a process that was asked to end, before the kernel ends it (s); and the pump
# node, which waits until the pump stands: as long as the speed falls.
_ENDING_S, _PUMP_ENDING_S = 8.0, 40.0
# How long the kernel may take (s).
_KILLING_S = 5.0
_LAST_LINES = 15
# Size at which a node's log becomes its .log.1 in place of the one before it: a live site runs for
# months. How long the end of nodes waits for what they printed to be written (s).
_LOG_BYTES, _WRITTEN_S = 10_000_000, 2.0
# A pause of this process itself (s): what it did not hear is not the nodes' silence.
_PAUSE_S = 1.0

# At the end it would wait for a disk that hangs; each line of a log is flushed when it is written.
atexit.unregister(logging.shutdown)


class NodeFailed(Exception):
    """A node ended or hangs, and the graph with it; the message quotes the node's last lines.

    Attributes:
        reason: the message without these lines.
        last_lines: these; empty where the reason says all.
        code: what the exit code should be.
        nodes: which; of those that hang the ones that were stopped, where any was.
        how: they ended, in a few words.
    """

    def __init__(
        self, reason: str, last_lines: str, code: int, nodes: Sequence[str], how: str
    ) -> None:
        super().__init__("\n".join(filter(None, (reason, last_lines))))
        self.reason = reason
        self.last_lines = last_lines
        self.code = code
        self.nodes = nodes
        self.how = how


@dataclass
class NodeProcess:
    """One node that was started.

    Attributes:
        process: that runs it.
        heard: when it last said something, or was started (steady clock, s).
        spoke: whether it has said anything.
        last_lines: that it printed.
    """

    process: subprocess.Popen[bytes]
    heard: float
    spoke: bool = False
    last_lines: deque[str] = field(default_factory=lambda: deque(maxlen=_LAST_LINES))
    _cut: bytes = b""

    def take_reports(self, data: bytes) -> list[dict[str, Any]]:
        """Return the reports that end in what came through its pipe."""
        self.spoke = True
        self.heard = time.monotonic()
        *lines, self._cut = (self._cut + data).split(b"\n")
        # A line that did not fit into a full pipe is cut short; the next one says it again.
        return [report for report in map(read_report, lines) if report is not None]

    @property
    def is_stopped(self) -> bool:
        """Whether it was stopped, by Ctrl-Z or a debugger."""
        with contextlib.suppress(OSError):  # it ends just now
            stat = Path(f"/proc/{self.process.pid}/stat").read_text()
            return stat.rpartition(")")[2].split()[0] in "Tt"
        return False

    def how_it_ended(self) -> str | None:
        """Return its exit code or signal, for people; None while it runs."""
        code = self.process.poll()
        if code is None:
            return None
        return f"exit code {code}" if code >= 0 else signal.Signals(-code).name

    def kill(self) -> None:
        """Have the kernel end it."""
        self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # the kernel is busy with it
            self.process.wait(1.0)


class _Log(RotatingFileHandler):
    """What a node prints, in a file; a full disk is no error, and what it does not take is lost."""

    terminator = ""

    def __init__(self, path: Path) -> None:
        super().__init__(
            path, maxBytes=_LOG_BYTES, backupCount=1, encoding="utf-8", errors="surrogateescape",
            delay=True,
        )

    def write(self, data: bytes) -> None:
        """Add what came, as it is."""
        self.emit(logging.makeLogRecord({"msg": data.decode(errors="surrogateescape")}))

    def handleError(self, record: logging.LogRecord) -> None:
        """Let the file go; it is opened anew with what comes next."""
        with contextlib.suppress(OSError, ValueError):  # it may be closed already
            self.close()


def _pipe(our_ends: contextlib.ExitStack, its_ends: contextlib.ExitStack) -> tuple[int, int]:
    """Open a pipe from another process to this one, each end of which is closed with its stack."""
    reading, writing = os.pipe()
    our_ends.callback(os.close, reading)
    its_ends.callback(os.close, writing)
    return reading, writing


class NodeProcesses:
    """Node processes, each with a pipe on which it says every quarter of a second how it is.

    Discovery in the graph can take seconds, and who watches over nodes must not miss a word.

    Attributes:
        nodes: those that were started, by name.
        last: the last report of each node that has said something.
        awake_since: when this process itself last stood still (steady clock, s), or began.
    """

    def __init__(self, logs: Path, parameters: Sequence[Path], namespace: str) -> None:
        """Start nothing yet.

        Args:
            logs: the directory for what the nodes print, one file each; must exist.
            parameters: ROS 2 parameter files of all nodes; what a later one says counts.
            namespace: of all nodes, such as ``/site1``; empty for none.
        """
        self.nodes: dict[str, NodeProcess] = {}
        self.last: dict[str, dict[str, Any]] = {}
        self._directory = logs
        self._logs: dict[str, _Log] = {}
        self._ros_arguments = ["--ros-args"]
        for file in parameters:
            self._ros_arguments += ["--params-file", str(file)]
        if namespace:
            self._ros_arguments += ["-r", f"__ns:={namespace}"]
        self._pipes = selectors.DefaultSelector()
        self._reports: list[tuple[str, dict[str, Any]]] = []
        self._looked = self.awake_since = time.monotonic()

    def start(
        self, node: str, module: str, *arguments: str, pipes: Mapping[str, int] | None = None,
    ) -> None:
        """Start one node; it does not see the terminal's Ctrl-C, which is this process's.

        Args:
            node: its name.
            module: that it is, such as greenroof_ros.nodes.weather.
            arguments: of the module's command line, beside those for ROS.
            pipes: further file descriptors that it gets, by the environment variable that holds
                the number; here they are closed.

        Raises:
            OSError: the system has no process or file descriptor to give; nothing is left open.
        """
        self._forget(node)
        with contextlib.ExitStack() as its_ends, contextlib.ExitStack() as our_ends:
            given = dict(pipes or {})
            for number in given.values():
                its_ends.callback(os.close, number)
            reading, given[REPORT_PIPE] = _pipe(our_ends, its_ends)
            out_reading, out_writing = _pipe(our_ends, its_ends)
            process = subprocess.Popen(
                [sys.executable, "-m", module, *arguments, *self._ros_arguments],
                stdin=subprocess.DEVNULL,
                stdout=out_writing,
                stderr=subprocess.STDOUT,
                env=asked_to_end_with_this() | {name: str(end) for name, end in given.items()},
                pass_fds=given.values(),
                start_new_session=True,
            )
            our_ends.pop_all()
        self.nodes[node] = NodeProcess(process, time.monotonic())
        for pipe, use in ((reading, self._take_reports), (out_reading, self._log)):
            os.set_blocking(pipe, False)
            self._pipes.register(pipe, selectors.EVENT_READ, (node, use))

    def _forget(self, node: str) -> None:
        """Log what an earlier process of a node has printed, and forget what it has said."""
        self.read_all(node)
        self._reports = [said for said in self._reports if said[0] != node]
        self.last.pop(node, None)
        for key in self._pipes_of(node):
            self._pipes.unregister(key.fd)
            os.close(key.fd)

    def reports(self) -> list[tuple[str, dict[str, Any]]]:
        """Return what the nodes said since the last call, after at most a tenth of a second."""
        self._read_pipes(0.1)  # which, where this process was stopped in it, may find nothing
        now = time.monotonic()
        if now - self._looked > _PAUSE_S:
            self.awake_since = now
            for node in self.nodes.values():
                node.heard = now
        self._looked = now
        found, self._reports = self._reports, []
        return found

    def _read_pipes(self, timeout: float) -> None:
        """Read what the nodes say, after at most so long (s)."""
        for key, _ in self._pipes.select(timeout):
            self._read(key)

    def _read(self, key: selectors.SelectorKey) -> None:
        """Read what a pipe holds; at its end let it go."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            data = os.read(key.fd, 1 << 20)
            if not data:
                self._pipes.unregister(key.fd)
                os.close(key.fd)
        node, use = key.data
        if data:
            use(node, data)

    def _take_reports(self, node: str, data: bytes) -> None:
        for report in self.nodes[node].take_reports(data):
            self.last[node] = report
            self._reports.append((node, report))

    def _log(self, node: str, data: bytes) -> None:
        """Keep what a node prints: in its log, and in memory should the disk be full or hang."""
        self.nodes[node].last_lines.extend(data.decode(errors="replace").splitlines())
        if node not in self._logs:
            self._logs[node] = _Log(self._directory / f"{node}.log")
        DISK.do(partial(self._logs[node].write, data), len(data))

    def read_all(self, node: str) -> None:
        """Read all that a node has said."""
        for key in self._pipes_of(node):
            self._read(key)

    def _pipes_of(self, node: str) -> list[selectors.SelectorKey]:
        return [key for key in self._pipes.get_map().values() if key.data[0] == node]

    def quoted(self, node: str) -> str:
        """Read all that a node has said, and return its last lines."""
        self.read_all(node)
        quoted = [f"  {line}" for line in self.nodes[node].last_lines] or ["  (none)"]
        return "\n".join([f"last lines of {node}:", *quoted])

    def end(self, nodes: Collection[str]) -> None:
        """Ask these nodes to end, and after a while have the kernel end them.

        Not by SIGINT: what a shell starts in its background ignores it, and so would a node that
        just begins.
        """
        asked = time.monotonic()
        limits = {
            node: _PUMP_ENDING_S if node == PUMP else _ENDING_S
            for node in nodes if self.nodes[node].process.poll() is None
        }
        for node in limits:
            self.nodes[node].process.send_signal(signal.SIGTERM)
        killed = set()
        while limits:
            self._read_pipes(0.02)
            passed = time.monotonic() - asked
            for node, limit in list(limits.items()):
                process = self.nodes[node].process
                if process.poll() is not None or passed > limit + _KILLING_S:
                    del limits[node]
                elif passed > limit and node not in killed:
                    killed.add(node)
                    process.kill()
        self._read_pipes(0.0)
        if all(node.process.poll() is not None for node in self.nodes.values()):
            DISK.wait(_WRITTEN_S)
