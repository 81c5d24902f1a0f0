"""The nodes of a simulated run: started together, watched, and ended with the first that fails."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_OCCUPIED,
    EXIT_USAGE,
)
from greenroof_ros.graph.node_processes import NodeFailed, NodeProcesses
from greenroof_ros.graph.permit import Permit
from greenroof_ros.graph.states import PUMP, RECORDER

# Nodes that report four times a second fall silent for one reason within this time (s).
_SAME_SILENCE_S = 0.5


class Supervisor(NodeProcesses):
    """The node processes of one run. Leaving its ``with`` block ends them all.

    Where the pump node dies, it cannot stop the drive any more: that is then done from here; and at
    the end, whatever the pump node says.

    Attributes:
        permit: for the pump node, where there is one.
        may_run: that the pump may run after the end, and what protects; empty where it stands.
    """

    def __init__(
        self, logs: Path, parameters: Sequence[Path], namespace: str,
        stop_drive: Callable[[int], tuple[bool, str]] | None,
    ) -> None:
        """Make the directory for what the nodes print, one file each.

        Args:
            logs: that directory.
            parameters: ROS 2 parameter files of all nodes; what a later one says counts.
            namespace: of all nodes, such as ``/site1``; empty for none.
            stop_drive: stops the drive without the pump node, whose process it is told, and returns
                whether it stands and what came of it, in words; None where there is none.
        """
        super().__init__(logs, parameters, namespace)
        self.permit = Permit()
        self.may_run = ""
        self._stop_drive = stop_drive
        logs.mkdir()

    def __enter__(self) -> Supervisor:
        """Nothing runs yet."""
        return self

    def __exit__(self, _kind: object, error: object, _traceback: object) -> None:
        """End all processes, and see that the drive is off."""
        # A stopped process hears nothing else, and the others' last words wait for it.
        for node in self.nodes.values():
            node.process.send_signal(signal.SIGCONT)
        # The recorder last, so that its bag holds all that the others said.
        for group in (self.nodes.keys() - {RECORDER}, self.nodes.keys() & {RECORDER}):
            self.end(group)
        self.permit.close()
        if PUMP in self.nodes:
            self._see_drive_off(said=self.nodes[PUMP].process.returncode != EXIT_DONE)
        # A recorder whose middleware locked up (SIGALRM) had closed its bag before, or logged why
        # it could not.
        recorder = self.nodes.get(RECORDER)
        closed = (
            recorder is None or not recorder.spoke
            or recorder.process.returncode in (EXIT_DONE, -signal.SIGALRM)
        )
        if not closed and not isinstance(error, NodeFailed):
            print("error: the recorder could not close its bag", file=sys.stderr)
            print(self.quoted(RECORDER), file=sys.stderr)

    def add(self, node: str, module: str, *arguments: str) -> None:
        """Start a node; see :meth:`NodeProcesses.start`."""
        pipes = self.permit.open() if node == PUMP else {}
        self.start(node, module, *arguments, pipes=pipes)

    def _see_drive_off(self, *, said: bool) -> None:
        """Stop the drive, and print what came of it where that is wanted, or the pump may run."""
        if self._stop_drive is None:
            return
        stands, what = self._stop_drive(self.nodes[PUMP].process.pid)
        self.may_run = "" if stands else what
        if said or not stands:
            print(what, file=sys.stderr)

    def check(self, limit: float) -> None:
        """Look whether all nodes live and speak.

        Args:
            limit: longest silence (s); half a second later, when all that it silenced are silent
                for as long, it is reported.

        Raises:
            NodeFailed: one has ended, or some were silent for longer.
        """
        for name, node in self.nodes.items():
            how = node.how_it_ended()
            if how is not None:
                last_lines = self.quoted(name)
                why = self.last.get(name, {}).get("failure")
                code = node.process.returncode
                raise NodeFailed(
                    f"node {name} ended ({how})" + (f": {why}" if why else ""), last_lines,
                    code if code in (EXIT_USAGE, EXIT_OCCUPIED) else EXIT_FAILED,
                    [name], how,
                )
        now = time.monotonic()
        silent = {
            name: now - node.heard for name, node in self.nodes.items()
            if now - node.heard > limit
        }
        # A node that is stopped silences those that wait for it: all of them are named, and which
        # of them is stopped.
        if max(silent.values(), default=0.0) > limit + _SAME_SILENCE_S:
            stopped = [name for name in silent if self.nodes[name].is_stopped]
            raise NodeFailed(
                "; ".join(
                    f"node {name}{' (stopped)' if name in stopped else ''} "
                    f"has not answered for {limit:g} s"
                    for name in silent
                ),
                "\n".join(map(self.quoted, silent)),
                EXIT_FAILED,
                stopped or list(silent),
                f"{'stopped, ' if stopped else ''}silent for {limit:g} s",
            )
