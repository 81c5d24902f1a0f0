"""The nodes of a live site: restarted when they fail, and the pump held while one is missing."""

from __future__ import annotations

import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from greenroof_ros.common.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    EXIT_OCCUPIED,
    EXIT_USAGE,
)
from greenroof_ros.drives.drive_file import LONGEST_RAMP_S
from greenroof_ros.graph.node_processes import NodeFailed, NodeProcesses
from greenroof_ros.graph.permit import Permit
from greenroof_ros.graph.states import PUMP, READY, RECORDER

# A node that says nothing for so long (s) holds the pump; reports come four times a second. A pump
# node that did not say that the pump stands is killed then.
_SILENT_S = 2.0
# How long after the permit was withdrawn the pump node may say that it runs the pump (s); the pump
# may turn longer by its drive's ramp.
_OBEYS_S = 2.0
# How long a node that was just started may say nothing (s): imports take seconds.
_START_LIMIT_S = 30.0
# The time before a restart (s): 1, 2, 4, ... to this, by the restarts of the last ten minutes.
_LONGEST_WAIT_S = 10.0
_WINDOW_S = 600.0


@dataclass(frozen=True)
class Failure:
    """A node that failed, and what was done about it.

    Attributes:
        node: which.
        what: happened to it.
        done: about it.
    """

    node: str
    what: str
    done: str

    def __str__(self) -> str:
        """Return it without the node's name."""
        return f"{self.what}; {self.done}"


@dataclass
class _Node:
    """How a node is started, and how it has fared."""

    module: str
    arguments: tuple[str, ...]
    started: float = 0.0  # at what time (steady clock, s)
    starts_again: float | None = None  # at what time, where it does not run
    restarts: deque[float] = field(default_factory=deque)  # when, within the window
    was_ready: bool = False
    cannot_start: str = ""  # why the system gives no process for it


class LiveSupervisor(NodeProcesses):
    """The node processes of a live site. Leaving its ``with`` block ends them all.

    A node that ends, or says nothing for too long, is started again, after a while that grows; one
    that needs that too often is given up, and the site with it, the pump stopped. The pump node is
    told four times a second whether it may run. Where it dies, falls silent or does not obey, it is
    killed, and the drive is stopped from here; and at the end, whatever the pump node says. The
    recorder is never given up, and ends nothing: recording must not stop control.

    Attributes:
        inhibit: why the pump may not run; empty where it may.
        may_run: that the pump may run after the end, and what protects; empty where it stands.
    """

    def __init__(
        self,
        logs: Path,
        parameters: Sequence[Path],
        namespace: str,
        *,
        silence_s: float,
        restarts: int,
        stop_drive: Callable[[int], tuple[bool, str]] | None,
        on_failure: Callable[[Failure], None],
    ) -> None:
        """Start nothing yet.

        Args:
            logs: the directory for what the nodes print, one file each; must exist.
            parameters: ROS 2 parameter files of all nodes; what a later one says counts.
            namespace: of all nodes, such as ``/site1``; empty for none.
            silence_s: how long a node may say nothing before it is killed (s).
            restarts: of one node within ten minutes; one more, and the site is stopped.
            stop_drive: stops the drive without the pump node, whose process it is told, and returns
                whether it stands and what came of it, in words; None where the pump is somebody
                else's.
            on_failure: called with each.
        """
        super().__init__(logs, parameters, namespace)
        # Files of rcl's own, besides what a node prints, would grow for months.
        self._ros_arguments.append("--disable-external-lib-logs")
        self.inhibit = "starting"
        self.may_run = ""
        self._inhibited_since = time.monotonic()
        self._met = False
        self._known: dict[str, _Node] = {}
        self._silence_s = silence_s
        self._restarts = restarts
        self._stop_drive = stop_drive
        self._stopper = ThreadPoolExecutor(1)
        self._stopper.submit(int)  # its thread is here before the system may have none to give
        self._stopping: Future[tuple[bool, str]] | None = None
        self._on_failure = on_failure
        self._permit = Permit()

    def __enter__(self) -> LiveSupervisor:
        """Nothing runs yet."""
        return self

    def __exit__(self, *_: object) -> None:
        """End all: the pump node first, the recorder last; and see that the drive is off."""
        for node in self.nodes.values():
            if node.process.poll() is None:
                node.process.send_signal(signal.SIGCONT)
        names = self.nodes.keys()
        self.end(names & {PUMP})
        if self._stop_drive is not None and PUMP in names:
            self._see_drive_off(self._stop_drive)
        self.end(names - {PUMP, RECORDER})
        self.end(names & {RECORDER})
        self._permit.close()

    def _see_drive_off(self, stop_drive: Callable[[int], tuple[bool, str]]) -> None:
        """Stop the drive at the end, and note it where the pump node did not end well, or fails."""
        if self._stopping is not None:
            self._stopping.result()  # two at once would be in each other's way
        pump = self.nodes[PUMP]
        stands, said = stop_drive(pump.process.pid)
        self.may_run = "" if stands else said
        if pump.process.returncode != EXIT_DONE:
            self._note(PUMP, f"did not end well ({pump.how_it_ended()})", said)
        elif not stands:
            self._note(PUMP, "ended", said)

    def add(self, node: str, module: str, *arguments: str) -> None:
        """Start a node, now and whenever it has failed; see :meth:`NodeProcesses.start`."""
        self._known[node] = _Node(module, arguments)
        self._start(node, time.monotonic())

    def _start(self, name: str, now: float) -> None:
        """Start a node; one for which the system has no process or file is tried again for ever."""
        known = self._known[name]
        known.started, known.starts_again = now, None
        try:
            pipes = self._permit.open() if name == PUMP else {}
            self.start(name, known.module, *known.arguments, pipes=pipes)
            known.cannot_start = ""
        except OSError as error:
            known.starts_again = now + _LONGEST_WAIT_S
            why, before = error.strerror or str(error), known.cannot_start
            known.cannot_start = why
            if why != before:
                done = f"tried again every {_LONGEST_WAIT_S:g} s"
                self._note(name, f"cannot be started: {why}", done + _unrecorded(name))

    def look(self) -> None:
        """Restart what failed, and tell the pump node whether it may run; called all the time.

        Raises:
            NodeFailed: a node was restarted too often, or was never ready and says that its
                parameters are wrong.
        """
        now = time.monotonic()
        for name, known in self._known.items():
            if known.starts_again is not None:
                drive_is_being_stopped = name == PUMP and self._stopping is not None
                if now >= known.starts_again and not drive_is_being_stopped:
                    self._start(name, now)
                continue
            node = self.nodes[name]
            known.was_ready |= self._is_ready(name)
            how = node.how_it_ended()
            limit = self._silence_s if node.spoke else max(self._silence_s, _START_LIMIT_S)
            if name == PUMP and node.spoke and not self._says_it_stands():
                limit = _SILENT_S
            disobeys = self._disobeys(now) if name == PUMP else ""
            if how is not None:
                self.read_all(name)
                self._failed(name, self._why_ended(name, how), now)
            elif now - node.heard > limit:
                stopped = " (stopped)" if node.is_stopped else ""
                node.kill()
                self._failed(name, f"had not answered for {limit:g} s{stopped}: killed", now)
            elif disobeys:
                node.kill()
                self._failed(name, f"{disobeys}: killed", now)
        if self._stopping is not None and self._stopping.done():
            self._note(PUMP, "could not stop the drive", self._stopping.result()[1])
            self._stopping = None
        before, self.inhibit = self.inhibit, self._reason_to_inhibit(now)
        if self.inhibit and not before:
            self._inhibited_since, self._met = now, False
        self._permit.tell(self.inhibit)

    def _pump_state(self) -> str:
        """Return the state of the pump that its node said last; empty before it said one."""
        return str(self.last.get(PUMP, {}).get("pump_state", ""))

    def _says_it_stands(self) -> bool:
        """Whether the pump node said last that the pump stands: it was seen to, or must by now."""
        return self.last.get(PUMP, {}).get("stands") is True

    def _disobeys(self, now: float) -> str:
        """Return what the pump node does although it may not; empty where it does nothing such.

        A pump that turns although the node says that it is told to stop is met once while the pump
        is held: the node is right perhaps, and another stop no use.
        """
        if not self.inhibit or self._says_it_stands():
            return ""
        passed = now - max(self._inhibited_since, self._known[PUMP].started, self.awake_since)
        state = self._pump_state()
        if passed > _OBEYS_S and state in ("running", "starting"):
            return f"ran the pump for {_OBEYS_S:g} s after it was forbidden ({self.inhibit})"
        if passed > _OBEYS_S + LONGEST_RAMP_S and state and not self._met:
            self._met = True
            return f"did not stop the pump within {_OBEYS_S + LONGEST_RAMP_S:g} s ({self.inhibit})"
        return ""

    @property
    def all_ready(self) -> bool:
        """Whether every node runs and has all that it needs, but for a recorder that failed."""
        return all(
            self._is_ready(name) for name, known in self._known.items()
            if name != RECORDER or not (known.restarts or known.cannot_start)
        )

    @property
    def ready(self) -> set[str]:
        """The nodes that run and have all that they need."""
        return {
            name for name, known in self._known.items()
            if known.starts_again is None and self._is_ready(name)
        }

    def _is_ready(self, name: str) -> bool:
        return self.last.get(name, {}).get("state") == READY

    def _why_ended(self, name: str, how: str) -> str:
        why = self.last.get(name, {}).get("failure")
        return f"ended ({how})" + (f": {why}" if why else "")

    def _failed(self, name: str, what: str, now: float) -> None:
        """Note that a node failed, and when it starts again.

        Raises:
            NodeFailed: not at all.
        """
        known, code = self._known[name], self.nodes[name].process.returncode
        while known.restarts and now - known.restarts[0] > _WINDOW_S:
            known.restarts.popleft()
        too_often = len(known.restarts) >= self._restarts
        needed = name != RECORDER
        if needed and not known.was_ready and code in (EXIT_USAGE, EXIT_OCCUPIED):
            raise NodeFailed(f"node {name} {what}", self.quoted(name), code, [name], what)
        if needed and too_often:
            raise NodeFailed(
                f"node {name} {what}; it was restarted {len(known.restarts)} times in the last "
                f"{_WINDOW_S / 60:g} minutes, and is given up",
                self.quoted(name), EXIT_FAILED, [name], what,
            )
        wait = _WINDOW_S if too_often else min(2.0 ** len(known.restarts), _LONGEST_WAIT_S)
        known.restarts.append(now)
        known.starts_again = now + wait
        self._note(name, what, f"starts again in {wait:g} s{_unrecorded(name)}")
        if name == PUMP and self._stop_drive is not None:
            self._stopping = self._stopper.submit(self._stop_drive, self.nodes[name].process.pid)

    def _note(self, node: str, what: str, done: str) -> None:
        self._on_failure(Failure(node, what, done))

    def _reason_to_inhibit(self, now: float) -> str:
        """Return why the pump may not run; empty where it may."""
        reasons = []
        for name, known in self._known.items():
            if name in (PUMP, RECORDER):
                continue
            if known.starts_again is not None or self.nodes[name].how_it_ended() is not None:
                reasons.append(f"{name} is missing")
            elif not self._is_ready(name):
                waiting = self.last.get(name, {}).get("waiting")
                reasons.append(
                    f"{name} waits for {', '.join(waiting)}" if waiting else f"{name} is starting"
                )
            elif now - self.nodes[name].heard > _SILENT_S:
                reasons.append(f"{name} is silent")
        return ", ".join(reasons)


def _unrecorded(name: str) -> str:
    return "; nothing is recorded until then" if name == RECORDER else ""
