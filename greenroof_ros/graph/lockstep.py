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
  comes too, or as one after the last tick. One that only the recorder misses, its count shows.

Second publishers, and a plant that has gone, :mod:`greenroof_ros.graph.peers` finds. There are no
timers and no sleeps on the way of a tick; the only wall clocks end a run which hangs, and the pump
node's own stop its drive.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

from greenroof_ros.common.errors import OccupiedError
from greenroof_ros.graph.inputs import Input
from greenroof_ros.graph.messages import LockstepError

CLOCK, RUN = "/clock", "/run"
PLANT = "plant"


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


class Lockstep:
    """Makes a node act when no input is awaited, and finish with its run.

    Attributes:
        run: the one that the node takes part in; None before the plant has said it.
        tick: on which the node acts next.
        awaited: names of the inputs whose message of the tick is to come.
        due_in: until it is to look at the clock (s): never, but for the plant, which has a pace.
    """

    def __init__(self, role: str, act: Callable[[], None], finish: Callable[[], None]) -> None:
        """Begin before the run.

        Args:
            role: of the node.
            act: has it act.
            finish: says that the run is over for it.
        """
        self.run: RunIdentity | None = None
        self.tick = 0
        self.due_in = math.inf
        self.awaited: set[str] = set()
        self._of_tick: set[str] = set()  # names of the inputs that the node acts on
        self._role, self._act, self._finish = role, act, finish

    def receiver(
        self, entry: Input, callback: Callable[[Any], None] | None
    ) -> Callable[[bytes], None]:
        """Have the node act on an input; returns what receives its messages.

        Args:
            entry: the input.
            callback: has its values instead, and nothing waits for them.
        """
        if callback is not None:
            return entry.hand_on_to(callback)
        name, awaited = entry.topic.name, self.awaited
        self._of_tick.add(name)
        awaited.add(name)

        def receive(message: bytes) -> None:
            """Take a message, and act where it was the last that was awaited."""
            second = name not in awaited
            if second and not entry.tolerates_second:
                kind = LockstepError if self.tick else OccupiedError
                raise kind(
                    f"{entry.name} came twice in tick {self.tick} "
                    f"({', '.join(entry.publishers.names())}); another publisher, or nodes from "
                    "an earlier run, are in this graph"
                )
            entry.receive(message)
            awaited.discard(name)
            if not (awaited or second):
                self.act()

        return receive

    def act(self) -> None:
        """Let the node act on its inputs, and await the inputs of the next tick."""
        self.awaited |= self._of_tick
        self.tick += 1
        self._act()
        if self.is_over:
            self.awaited.clear()  # whatever comes now is one too many
            self._finish()

    def hear_run(self, values: array[float]) -> None:
        """Take part in a run.

        Raises:
            LockstepError: with another plant another run begins, and this one has ended; or it is
                of another version.
        """
        if len(values) != len(RunIdentity._fields):
            raise LockstepError(
                f"{RUN} has {len(values)} numbers, not {len(RunIdentity._fields)}: the plant is "
                "of another version"
            )
        before, self.run = self.run, RunIdentity(*values)
        if before not in (None, self.run):
            raise LockstepError(
                "the plant was started again, or there are two; a run ends with its plant"
            )
        if before is None and self.is_over:  # heard behind the last tick
            over = round(self.run.last_tick) + 1
            early = self._of_tick if self.tick > over else self._of_tick - self.awaited
            if early:
                raise LockstepError(f"{min(early)} came twice in tick {over} (after the last)")
            self.awaited.clear()

    @property
    def is_over(self) -> bool:
        """Whether the node has acted on the last tick; the plant finds that out by itself."""
        return self.run is not None and self.tick > self.run.last_tick and self._role != PLANT
