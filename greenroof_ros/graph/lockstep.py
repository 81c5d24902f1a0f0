"""Lockstep over topics: a node acts once each of its inputs has its message of the tick.

Each topic of a tick has exactly one message per tick, k = 0..N, and but for ``/clock`` says nothing
of its tick: none is needed, since no node publishes tick k + 1 before it has acted on tick k. The
rule, for every node but the recorder, which only counts:

1. *wait*: a message arrives (:meth:`Lockstep.receive`), and its input is fresh;
2. *act*: all inputs are fresh; they are stale again from here on (:meth:`Lockstep.act`);
3. *publish*: the node says its own messages of the tick, one on each topic.

Readers that are discovered late get what was said before: topics are transient local and 64 deep,
and the plant is at most 32 ticks ahead of the recorder. A second message of one tick, a second
publisher, and a message that does not come within the peer limit each end the run. There are no
timers and no sleeps on the way of a tick; the only wall clocks here end a run which hangs.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.node import Node

from greenroof_ros.common.errors import OccupiedError
from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.inputs import Inputs, root_causes
from greenroof_ros.graph.publishers import Publishers
from greenroof_ros.graph.reports import Reports
from greenroof_ros.graph.states import FINISHED
from greenroof_ros.graph.validation import Input

CLOCK, RUN = "/clock", "/run"
PLANT = "plant"
# How often publishers are counted in the run (s): asking takes a tenth of a millisecond.
_COUNT_S = 0.25
# How long somebody must be missing before it is said, and how often it is said again (s).
_PATIENCE_S, _AGAIN_S = 2.0, 5.0


@dataclass(frozen=True)
class RunIdentity:
    """What the nodes of one run have in common, as the plant says it on ``/run``.

    Attributes:
        identity: a random number of the plant's.
        last_tick: N.
    """

    identity: float
    last_tick: int

    @classmethod
    def of(cls, values: array[float]) -> RunIdentity:
        """Return it from the message's numbers."""
        return cls(values[0], round(values[1]))

    @property
    def values(self) -> array[float]:
        """The message's numbers."""
        return array("d", [self.identity, self.last_tick])


class LockstepNode(Protocol):
    """What lockstep needs of its node; see :class:`greenroof_ros.graph.link.LinkedNode`."""

    role: str
    acted: bool
    over: bool
    error: Exception | None
    inputs: Inputs
    interface: dict[str, Topic]
    reports: Reports

    def on_inputs(self) -> None:
        """Act."""

    def finish(self) -> None:
        """Say that the run is over for the node."""

    def all_arrived(self) -> bool:
        """Whether all that the node said has come to who hears it."""


class Lockstep:
    """Makes a node act when every input is fresh, and end with its run.

    Attributes:
        run: the one that the node takes part in; None before the plant has said it.
        tick: on which the node acts next.
    """

    simulated_time = True

    def __init__(self, node: LockstepNode, ros_node: Node) -> None:
        """Begin before the run.

        Args:
            node: that is to act.
            ros_node: the same, as rclpy has it.
        """
        self.run: RunIdentity | None = None
        self.tick = 0
        self._node = node
        self._act_on_inputs = node.on_inputs
        self._ros_node = ros_node
        self._entries: list[Input] = []
        self._bits: dict[str, int] = {}  # of the inputs that must be fresh
        self._fresh = self._all = 0
        self._watched: list[Publishers] = []
        self._counted = 0.0
        self._missing: list[str] = []
        self._missing_since = self._said_at = 0.0
        self._said: list[str] = []

    def open(
        self, entry: Input, callback: Callable[[Any], None] | None, *, raw: bool, heals: bool,
        **rules_of_live_graphs: object,
    ) -> tuple[Publishers, Callable[[bytes], None]]:
        """Prepare an input; see :meth:`greenroof_ros.graph.link.LinkedNode.subscribe`.

        Args:
            entry: the input.
            callback: called with each value; without it the input must be fresh.
            raw: the callback gets the message.
            heals: the node itself refuses a second publisher, as long as there is one.
            rules_of_live_graphs: none of these counts here.

        Returns:
            What counts its publishers, and what receives its messages.
        """
        self._entries.append(entry)
        publishers = Publishers(self._ros_node, entry.topic)
        if not heals:
            self._watched.append(publishers)
        if callback is not None:
            return publishers, callback if raw else _with_value(entry, callback)
        self._bits[entry.topic.name] = bit = 1 << len(self._bits)
        self._all |= bit
        return publishers, self.receive(entry, bit, publishers, heals=heals)

    def receive(
        self, entry: Input, bit: int, publishers: Publishers, *, heals: bool
    ) -> Callable[[bytes], None]:
        """Return what takes the messages of an input, and acts on the last one missing."""
        take = entry.receive

        def on_message(message: bytes) -> None:
            if self._fresh & bit and not heals:
                self._refuse(
                    f"{entry.name} came twice in tick {self.tick} "
                    f"({', '.join(publishers.names())}); another publisher, or nodes of an earlier "
                    "run, are in this graph"
                )
                return
            take(message)
            self._fresh |= bit
            if self._fresh == self._all:
                self.act()

        return on_message

    def act(self) -> None:
        """Let the node act on its inputs, which are stale from then on."""
        self._fresh = 0
        self.tick += 1
        self._node.acted = True
        self._act_on_inputs()
        if self._is_over():
            self._node.finish()

    def _is_over(self) -> bool:
        """Whether the node has acted on the last tick; the plant finds that out by itself."""
        return self.run is not None and self.tick > self.run.last_tick and (
            self._node.role != PLANT
        )

    def hear_run(self, values: array[float]) -> None:
        """Take part in a run; with another plant another run begins, and this one has ended."""
        run = RunIdentity.of(values)
        if self.run is not None and self.run != run:
            self._node.error = self._node.error or LockstepError(
                "the plant was started again, or there are two; a run ends with its plant"
            )
        self.run = run

    def good(self) -> bool:
        """Whether no input's present value was refused."""
        return all(entry.good for entry in self._entries)

    def missing(self) -> str:
        """Name the topics that the node waits for, and who should publish them.

        Those of a node that waits itself for another one of them are left out.
        """
        inputs = self._node.inputs
        silent = inputs.by_role([n for n, bit in self._bits.items() if not self._fresh & bit])
        causes = root_causes(silent, self._node.interface.values())
        return inputs.say({role: silent[role] for role in silent if role in causes})

    def due_in(self) -> float:
        """How long until the node must act whatever comes (s): it need not."""
        return math.inf

    def act_if_due(self) -> None:
        """A node in lockstep acts on messages alone."""

    def look(self, now: float) -> None:
        """Count publishers, say who is missing, and end with the run.

        A node that somebody supervises ends when it is asked to: the supervisor needs the last word
        of each, and names the node that failed first.

        Args:
            now: of the steady clock (s).

        Raises:
            LockstepError: the plant went in the run, or a second publisher came.
            OccupiedError: a second publisher was there before the run.
        """
        node = self._node
        if node.acted and now - self._counted < _COUNT_S:
            return
        self._counted = now
        if node.reports.state == FINISHED:
            node.over = not node.reports.supervised and self._may_leave()
            return
        for publishers in self._watched:
            if publishers.count > 1 and publishers.heard > 1:
                self._refuse(f"{publishers.full_name} {publishers.problem(now)}")
        if self._is_over():  # what the plant says of the run came behind the last tick
            node.finish()
            return
        if not node.acted:
            self._say_missing(now)
        if self.run is not None and not node.reports.supervised and self._plant_has_gone():
            raise LockstepError("plant has ended, and the run with it")

    def _plant_has_gone(self) -> bool:
        clock = self._node.inputs.publishers.get(CLOCK)
        return clock is not None and clock.count == 0

    def _may_leave(self) -> bool:
        """Whether nobody needs the node any more: the plant leaves first."""
        return self._node.all_arrived() and (self._node.role == PLANT or self._plant_has_gone())

    def _refuse(self, message: str) -> None:
        """Refuse a second publisher: a wrong set-up before the run, in it a failure of the run."""
        kind = LockstepError if self._node.acted else OccupiedError
        self._node.error = self._node.error or kind(message)

    def waiting(self) -> list[str]:
        """Return the roles for whom the node waits; where it has all, for whom the others do."""
        node = self._node
        own = node.inputs.absent()
        if own:
            return list(own)
        return sorted({
            topic.publishers[0] for topic in node.interface.values()
            if topic.per_tick and not topic.optional and node.role not in topic.publishers
            and not self._ros_node.count_publishers(topic.graph_name)
        })

    def _say_missing(self, now: float) -> None:
        """Say who is missing before the run: after 2 s, when it changes, and every 5 s."""
        node = self._node
        topics = node.inputs.publishers
        missing = sorted(
            node.inputs.call(role, [n for n in topics if role in node.interface[n].publishers])
            for role in self.waiting()
        )
        if missing != self._missing:
            self._missing, self._missing_since = missing, now
        if now - self._missing_since < _PATIENCE_S:
            return
        if missing != self._said or (missing and now - self._said_at > _AGAIN_S):
            self._ros_node.get_logger().info(
                f"waiting for {', '.join(missing)}" if missing else "all nodes are here"
            )
            self._said, self._said_at = missing, now


def _with_value(entry: Input, callback: Callable[[Any], None]) -> Callable[[bytes], None]:
    """Return what receives an input and hands its value on."""

    def on_message(message: bytes) -> None:
        entry.receive(message)
        callback(entry.value)

    return on_message
