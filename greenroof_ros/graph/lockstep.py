"""Lockstep over topics: a node acts once each of its inputs has its message of the tick.

Each topic of a tick has exactly one message per tick, k = 0..N, and but for ``/clock`` says nothing
of its tick: none is needed, since no node publishes tick k + 1 before it has acted on tick k. The
rule, for every node but the recorder, which only counts:

1. *wait*: a message arrives, and its input is awaited no more (:meth:`Lockstep.receiver`);
2. *act*: no input is awaited; from here on all are, of the next tick (:meth:`Lockstep.act`);
3. *publish*: the node says its own messages of the tick, one on each topic.

Readers that are discovered late get what was said before: topics are transient local and 64 deep,
and the plant is at most 32 ticks ahead of the recorder. Awaited are the inputs without a callback.
What ends a run:

- a message that does not come within the peer limit (before a node's first answer the start limit);
  the plant names what it awaits itself;
- a second publisher, or a second message before its node has acted. Only the pump node tolerates
  either of commands, and stops the pump; the plant, which hears both, ends the run;
- a second message after the node has acted: it counts for the next tick, and is found when that
  comes too, or at the end by the count, as is one that only the recorder misses.

There are no timers and no sleeps on the way of a tick; the only wall clocks here end a run which
hangs, and the pump node's own stop its drive.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from greenroof_ros.common.errors import OccupiedError
from greenroof_ros.common.interface import Topic
from greenroof_ros.graph.inputs import Input, Inputs, root_causes
from greenroof_ros.graph.messages import LockstepError
from greenroof_ros.graph.reports import Reports
from greenroof_ros.graph.supervision import FINISHED
from greenroof_ros.pumping.input_rules import LevelRule

CLOCK, RUN = "/clock", "/run"
PLANT = "plant"
# How often publishers are counted (s): asking takes a tenth of a millisecond and more.
_COUNT_S = 0.25
# How long somebody must be missing before it is said, and how often it is said again (s).
_PATIENCE_S, _AGAIN_S = 2.0, 5.0


class RunIdentity(NamedTuple):
    """What the nodes of one run have in common, as the plant says it on ``/run``.

    Attributes:
        identity: a random number of the plant's.
        last_tick: N.
        speed: simulated per wall time; 0 for as fast as it goes.
    """

    identity: float
    last_tick: float
    speed: float

    @property
    def values(self) -> array[float]:
        """The message's numbers."""
        return array("d", self)


class LockstepNode(Protocol):
    """What lockstep needs of its node; see :class:`greenroof_ros.graph.link.LinkedNode`."""

    role: str
    acted: bool
    over: bool
    inputs: Inputs
    interface: dict[str, Topic]
    reports: Reports

    def act(self) -> None:
        """Act."""

    def finish(self) -> None:
        """Say that the run is over for the node."""

    def all_arrived(self) -> bool:
        """Whether all that the node said has come to who hears it."""

    def get_logger(self) -> Any:
        """Return what it logs to."""

    def count_publishers(self, topic_name: str) -> int:
        """Return how many publishers of a topic ROS knows."""


class Lockstep:
    """Makes a node act when no input is awaited, and end with its run.

    Attributes:
        run: the one that the node takes part in; None before the plant has said it.
        tick: on which the node acts next.
        has_begun: always true: to be ready it needs its peers alone, and no first act as live.
        due_in: until it acts by the clock (s): never, it acts on messages.
    """

    has_begun, due_in = True, math.inf

    def __init__(self, node: LockstepNode) -> None:
        """Begin before the run.

        Args:
            node: that is to act.
        """
        self.run: RunIdentity | None = None
        self.tick = 0
        self._node = node
        self._of_tick: set[str] = set()  # names of the inputs that the node acts on
        self._awaited: set[str] = set()  # those of them whose message of the tick is to come
        self._counted = 0.0
        self._missing: list[str] = []
        self._say_at = math.inf

    # --- a tick -----------------------------------------------------------------------------

    def receiver(
        self, entry: Input, level: LevelRule | None, callback: Callable[[Any], None] | None
    ) -> Callable[[bytes], None]:
        """Have the node act on an input; returns what receives its messages.

        Args:
            entry: the input.
            level: for a live graph.
            callback: has its values instead, and nothing waits for them.
        """
        if callback is not None:
            return entry.hand_on_to(callback)
        name, awaited = entry.topic.name, self._awaited
        self._of_tick.add(name)
        awaited.add(name)

        def receive(message: bytes) -> None:
            """Take a message, and act where it was the last that was awaited."""
            if name not in awaited and not entry.tolerates_second:
                raise self._refusal(
                    f"{entry.name} came twice in tick {self.tick} "
                    f"({', '.join(entry.publishers.names())}); another publisher, or nodes of an "
                    "earlier run, are in this graph"
                )
            entry.receive(message)
            awaited.discard(name)
            if not awaited:
                self.act()

        return receive

    def act(self) -> None:
        """Let the node act on its inputs, and await those of the next tick."""
        self._awaited |= self._of_tick
        self.tick += 1
        self._node.act()
        if self._is_over():
            self._node.finish()

    # --- the run ----------------------------------------------------------------------------

    def hear_run(self, values: array[float]) -> None:
        """Take part in a run.

        Raises:
            LockstepError: with another plant another run begins, and this one has ended; or it is
                of another version.
        """
        if len(values) != len(RunIdentity._fields):
            raise LockstepError(
                f"{RUN} has {len(values)} numbers and not {len(RunIdentity._fields)}: the plant is "
                "of another version"
            )
        before, self.run = self.run, RunIdentity(*values)
        if before not in (None, self.run):
            raise LockstepError(
                "the plant was started again, or there are two; a run ends with its plant"
            )

    def _is_over(self) -> bool:
        """Whether the node has acted on the last tick; the plant finds that out by itself."""
        return self.run is not None and self.tick > self.run.last_tick and (
            self._node.role != PLANT
        )

    def act_every(self, period: float) -> None:
        """Act on messages all the same."""

    def judge(self) -> None:
        """Leave the inputs as they are: no time passes for them."""

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
        if now - self._counted < _COUNT_S:
            return
        self._counted = now
        alone = not node.reports.supervised
        if node.reports.state == FINISHED:
            # The plant leaves first: until then somebody may need what the node said.
            node.over = alone and node.all_arrived() and (
                node.role == PLANT or self._plant_has_gone()
            )
            return
        for entry in node.inputs.by_name.values():
            publishers = entry.publishers
            if not entry.tolerates_second and publishers.count > 1 and publishers.heard > 1:
                raise self._refusal(publishers.said(now))
        if self._is_over():  # what the plant says of the run came behind the last tick
            node.finish()
            return
        if not node.acted:
            self._say_missing(now)
        if self.run is not None and alone and self._plant_has_gone():
            raise LockstepError("plant has ended, and the run with it")

    def _plant_has_gone(self) -> bool:
        clock = self._node.inputs.by_name.get(CLOCK)
        return clock is not None and clock.publishers.count == 0

    def _refusal(self, message: str) -> Exception:
        """Return how a second publisher ends it: a wrong set-up before the run, then a failure."""
        return LockstepError(message) if self._node.acted else OccupiedError(message)

    # --- who is missing ---------------------------------------------------------------------

    def missing(self) -> str:
        """Name the topics that the node waits for, and who should publish them.

        Those of a node that waits itself for another one of them are left out.
        """
        inputs = self._node.inputs
        silent = inputs.by_role([name for name in inputs.by_name if name in self._awaited])
        causes = root_causes(silent, self._node.interface.values())
        return inputs.say({role: silent[role] for role in silent if role in causes})

    def _say_missing(self, now: float) -> None:
        """Say who is missing before the run: once that lasts, and again and again."""
        node = self._node
        inputs = node.inputs.by_name
        missing = sorted(
            node.inputs.call(role, [n for n, one in inputs.items() if role in one.topic.publishers])
            for role in self._waiting()
        )
        if missing != self._missing:
            self._missing, self._say_at = missing, now + _PATIENCE_S
        if now > self._say_at:
            node.get_logger().info(
                f"waiting for {', '.join(missing)}" if missing else "all nodes are here"
            )
            self._say_at = now + _AGAIN_S if missing else math.inf

    def _waiting(self) -> set[str]:
        """Return the roles for whom the node waits; where it has all, for whom the others do."""
        node = self._node
        return set(node.inputs.absent()) or {
            topic.publishers[0] for topic in node.interface.values()
            if topic.per_tick and not topic.optional and node.role not in topic.publishers
            and not node.count_publishers(topic.graph_name)
        }
