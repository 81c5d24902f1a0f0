"""The processes of a run: started together, watched, and ended without leaving anything behind."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Any

from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_OCCUPIED,
    EXIT_USAGE,
)
from greenroof_ros.common.processes import end_with_parent
from greenroof_ros.graph.shared_memory import remove_left, segments_of
from greenroof_ros.graph.states import REPORT_PIPE

# How long to wait for a process that was asked to end, before the next, harder signal (s). Not
# SIGINT: what a shell starts in its background ignores it, and so would a node that just begins.
_ENDING_S = {signal.SIGTERM: 5.0, signal.SIGKILL: 5.0}
_LAST_LINES = 15
# Nodes that report four times a second fall silent for one reason within this time (s).
_SAME_SILENCE_S = 0.5


class NodeFailed(Exception):
    """A node of the run ended or hangs; the message names it and quotes its last lines.

    Attributes:
        reason: the message without these lines.
        code: what the run's exit code should be.
    """

    def __init__(self, reason: str, last_lines: str, code: int = EXIT_FAILED) -> None:
        super().__init__(f"{reason}\n{last_lines}")
        self.reason = reason
        self.code = code


def _is_stopped(pid: int) -> bool:
    """Return whether a process was stopped, by Ctrl-Z or a debugger."""
    with contextlib.suppress(OSError):  # it ends just now
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    return False


class Supervisor:
    """The node processes of one run. Leaving its ``with`` block ends them all.

    Each node has a pipe to this process, on which it says every quarter of a second how it is:
    discovery in the graph can take seconds, and a supervisor must not miss a word.

    Attributes:
        nodes: the processes, by node.
        last: the last report of each node that has said something.
    """

    def __init__(self, logs: Path, parameters: Path, namespace: str) -> None:
        """Make the directory for what the nodes print, one file each.

        Args:
            logs: that directory.
            parameters: ROS 2 parameter file of all nodes.
            namespace: of all nodes, such as ``/site1``; empty for none.
        """
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        self.last: dict[str, dict[str, Any]] = {}
        self._logs = logs
        self._ros_arguments = ["--ros-args", "--params-file", str(parameters)]
        if namespace:
            self._ros_arguments += ["-r", f"__ns:={namespace}"]
        self._pipes = selectors.DefaultSelector()
        self._reports: list[tuple[str, dict[str, Any]]] = []
        self._last_lines: dict[str, deque[str]] = {}
        self._heard: dict[str, float] = {}
        self._cut: dict[str, bytes] = {}
        self._looked = time.monotonic()
        self._segments: dict[str, set[str]] = {}
        self._spoke: set[str] = set()  # by then a node has all the shared memory that it will have
        logs.mkdir()

    def __enter__(self) -> Supervisor:
        """Nothing runs yet."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End all processes and clear away the shared memory that they left."""
        # A stopped process hears nothing else, and the others' last words wait for it.
        for process in self.nodes.values():
            process.send_signal(signal.SIGCONT)
        # The recorder last, so that its bag holds all that the others said.
        for group in (self.nodes.keys() - {"recorder"}, self.nodes.keys() & {"recorder"}):
            self._end([self.nodes[node] for node in group])
        # A recorder whose middleware locked up (SIGALRM) had closed its bag before, or logged why
        # it could not.
        closed = "recorder" not in self._spoke or self.nodes["recorder"].returncode in (
            EXIT_DONE, -signal.SIGALRM,
        )
        if not closed and not isinstance(error, NodeFailed):
            print("error: the recorder could not close its bag", file=sys.stderr)
            print(self._quoted("recorder"), file=sys.stderr)
        remove_left(set().union(*self._segments.values()))

    def start(self, node: str, module: str, *arguments: str) -> None:
        """Start one node; it does not see the terminal's Ctrl-C, which is this process's.

        Args:
            node: its name.
            module: of :mod:`greenroof_ros.nodes`.
            arguments: of the module's command line, beside those for ROS.
        """
        reading, writing = os.pipe()
        self.nodes[node] = process = subprocess.Popen(
            [
                sys.executable, "-m", f"greenroof_ros.nodes.{module}", *arguments,
                *self._ros_arguments,
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, REPORT_PIPE: str(writing)},
            pass_fds=(writing,),
            start_new_session=True,
            preexec_fn=end_with_parent,
        )
        os.close(writing)
        assert process.stdout is not None
        for pipe, use in ((reading, self._take_reports), (process.stdout.fileno(), self._log)):
            os.set_blocking(pipe, False)
            self._pipes.register(pipe, selectors.EVENT_READ, (node, use))
        self._heard[node] = time.monotonic()
        self._segments[node] = set()
        self._last_lines[node] = deque(maxlen=_LAST_LINES)

    def reports(self) -> list[tuple[str, dict[str, Any]]]:
        """Return what the nodes said since the last call, after at most a tenth of a second."""
        now = time.monotonic()
        if now - self._looked > 1:
            # This process itself was stopped; what it did not hear is not the nodes' silence.
            self._heard = dict.fromkeys(self._heard, now)
        self._looked = now
        for node in self.nodes.keys() - self._spoke:
            self._note_segments(node)
        self._read_pipes(0.1)
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
        node, use = key.data
        if data:
            use(node, data)

    def _take_reports(self, node: str, data: bytes) -> None:
        if node not in self._spoke:
            self._note_segments(node)
            self._spoke.add(node)
        self._heard[node] = time.monotonic()
        *lines, self._cut[node] = (self._cut.get(node, b"") + data).split(b"\n")
        for line in lines:
            # A line that did not fit into a full pipe is cut short; the next one says it again.
            with contextlib.suppress(json.JSONDecodeError):
                self.last[node] = json.loads(line)
                self._reports.append((node, self.last[node]))

    def _note_segments(self, node: str) -> None:
        """Note a node's shared memory while it lives: after a kill -9 it is unknown."""
        self._segments[node] |= segments_of(self.nodes[node].pid)

    def _log(self, node: str, data: bytes) -> None:
        """Keep what a node prints: in its log, and in memory should the disk be full."""
        self._last_lines[node].extend(data.decode(errors="replace").splitlines())
        with contextlib.suppress(OSError), (self._logs / f"{node}.log").open("ab") as log:
            log.write(data)

    def check(self, limit: float) -> None:
        """Look whether all nodes live and speak.

        Args:
            limit: longest silence (s); half a second later, when all that it silenced are silent
                for as long, it is reported.

        Raises:
            NodeFailed: one has ended, or some were silent for longer.
        """
        for node, process in self.nodes.items():
            code = process.poll()
            if code is not None:
                how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
                last_lines = self._quoted(node)
                why = self.last.get(node, {}).get("failure")
                raise NodeFailed(
                    f"node {node} ended ({how})" + (f": {why}" if why else ""), last_lines,
                    code if code in (EXIT_USAGE, EXIT_OCCUPIED) else EXIT_FAILED,
                )
        now = time.monotonic()
        silent = {node: now - heard for node, heard in self._heard.items() if now - heard > limit}
        # A node that is stopped while it holds a lock of Fast DDS's shared memory silences those
        # that want it: all of them are named, and which of them is stopped.
        if max(silent.values(), default=0.0) > limit + _SAME_SILENCE_S:
            raise NodeFailed(
                "; ".join(
                    f"node {node}{' (stopped)' if _is_stopped(self.nodes[node].pid) else ''} "
                    f"has not answered for {limit:g} s"
                    for node in silent
                ),
                "\n".join(map(self._quoted, silent)),
            )

    def _quoted(self, node: str) -> str:
        """Read all that a node has said, and return its last lines."""
        for key in list(self._pipes.get_map().values()):
            if key.data[0] == node:
                self._read(key)
        quoted = [f"  {line}" for line in self._last_lines[node]] or ["  (none)"]
        return "\n".join([f"last lines of {node}:", *quoted])

    def _end(self, processes: list[subprocess.Popen[bytes]]) -> None:
        for number, limit in _ENDING_S.items():
            running = [process for process in processes if process.poll() is None]
            for process in running:
                process.send_signal(number)
            until = time.monotonic() + limit
            for process in running:
                while process.poll() is None and time.monotonic() < until:
                    self._read_pipes(0.02)
        self._read_pipes(0.0)
