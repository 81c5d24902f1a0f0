"""The processes of a run: started together, watched, and ended without leaving anything behind."""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType

# Patience with a process that was told to end, before the next, harder signal (s).
_PATIENCE_S = {signal.SIGINT: 4.0, signal.SIGTERM: 1.0, signal.SIGKILL: 5.0}
_LAST_LINES = 15
_SHARED_MEMORY = Path("/dev/shm")
_PR_SET_PDEATHSIG = 1


class NodeFailed(Exception):
    """A node of the run ended or hangs; the message names it and quotes its last lines."""


def _end_with_parent() -> None:
    """Have the kernel interrupt this process when its parent dies, even by kill -9."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)


class Supervisor:
    """The node processes of one run. Leaving its ``with`` block ends them all."""

    def __init__(self, logs: Path) -> None:
        """Make the directory for what the nodes print, one file each."""
        self._logs = logs
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._segments: set[str] = set()
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
        self.stop()

    def start(self, node: str, arguments: list[str]) -> None:
        """Start one node; it does not see the terminal's Ctrl-C, which is this process's."""
        with (self._logs / f"{node}.log").open("wb") as log:
            self._processes[node] = subprocess.Popen(
                [sys.executable, "-m", f"greenroof_ros.nodes.{node}", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_end_with_parent,
            )

    def check(self) -> None:
        """Raise :class:`NodeFailed` if a node has ended."""
        for node, process in self._processes.items():
            code = process.poll()
            if code is None:
                continue
            how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
            raise NodeFailed(self._with_last_lines(node, f"node {node} ended ({how})"))

    def hangs(self, node: str, limit: float) -> NodeFailed:
        """Return the error for a node that has not answered within the limit (s)."""
        return NodeFailed(
            self._with_last_lines(node, f"node {node} has not answered for {limit:g} s")
        )

    def _with_last_lines(self, node: str, message: str) -> str:
        log = self._logs / f"{node}.log"
        lines = log.read_text(errors="replace").splitlines()[-_LAST_LINES:]
        return "\n".join([f"{message}; its last lines ({log}):", *(f"  {line}" for line in lines)])

    def note_segments(self) -> None:
        """Note which shared-memory files the nodes hold, for none may stay behind them."""
        for process in self._processes.values():
            try:
                for entry in Path(f"/proc/{process.pid}/fd").iterdir():
                    target = Path(os.readlink(entry))
                    if target.parent == _SHARED_MEMORY and target.name.endswith("_el"):
                        self._segments.add(target.name.removesuffix("_el"))
            except OSError:
                continue  # it ends just now, or this is no Linux

    def stop(self) -> None:
        """End all processes, the recorder last, so that its bag holds all that was said."""
        self.note_segments()
        recorder = [self._processes[node] for node in self._processes if node == "recorder"]
        others = [self._processes[node] for node in self._processes if node != "recorder"]
        for group in (others, recorder):
            for number, patience in _PATIENCE_S.items():
                running = [process for process in group if process.poll() is None]
                for process in running:
                    process.send_signal(number)
                    process.send_signal(signal.SIGCONT)  # a stopped process hears nothing else
                until = time.monotonic() + patience
                for process in running:
                    try:
                        process.wait(max(0.0, until - time.monotonic()))
                    except subprocess.TimeoutExpired:
                        continue

    def clear_shared_memory(self) -> None:
        """Remove shared-memory files of this run that no living process holds.

        A process that ends well removes its own; one killed by ``kill -9`` cannot. Fast DDS locks
        the file ``NAME_el`` as long as the owner of ``NAME`` lives.
        """
        for name in self._segments:
            lock = _SHARED_MEMORY / f"{name}_el"
            try:
                with lock.open("rb") as stream:
                    fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except FileNotFoundError:
                pass
            except OSError:
                continue  # its owner lives
            for left in (lock, _SHARED_MEMORY / name, _SHARED_MEMORY / f"sem.{name}_mutex"):
                left.unlink(missing_ok=True)
