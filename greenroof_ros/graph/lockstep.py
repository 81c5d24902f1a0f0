"""Lockstep over topics: a node acts once all of its inputs have their message of the tick.

Every topic of a tick has exactly one message per tick, k = 0..N. Only ``/clock`` carries the tick;
the others need not, since no node publishes tick k + 1 before it has acted on tick k. This is the
rule for every node except the recorder, which only counts:

1. *wait*: a message arrives, and its input is no longer awaited (:meth:`Lockstep.receiver`);
2. *act*: no input is awaited; from here on all are, for the next tick (:meth:`Lockstep.act`);
3. *publish*: the node publishes its own messages of the tick, one on every topic.

Readers that are discovered late receive earlier messages, since topics are transient local and 64
deep, and the plant is no more than 32 ticks ahead of the recorder. The following end a run:

- a message that does not arrive within the peer limit (or the start limit, before the first
  answers); the plant watches this, and names the topics that it is waiting for;
- a second publisher, or a second message before the node has acted;
- a second message after the node has acted. It counts for the next tick, and is found when that
  tick's own message arrives; after the last tick, any message ends the run. A message that only the
  recorder misses shows in its count.

A malformed message is dropped: the tick still awaits its proper message.

Before the first tick, the plant publishes ``/run`` with N, from which every node knows its last
tick. No timer or sleep delays a tick. Wall clocks only end a run that hangs.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import NamedTuple

from greenroof_ros.common.errors import OccupiedError
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.inputs import Input

CLOCK, RUN = "/clock", "/run"


class RunIdentity(NamedTuple):
    """What the nodes of one run share, as the plant publishes it on ``/run``.

    Attributes:
        identity: a random number chosen by the plant.
        last_tick: N, the last tick.
        speed: simulated time per wall time; 0 for as fast as possible.
    """

    identity: float
    last_tick: float
    speed: float

    @property
    def values(self) -> array[float]:
        """The numbers of the message."""
        return array("d", self)


class Lockstep:
    """Makes a node act when no input is awaited, and finish with its run.

    Attributes:
        run: the run that the node takes part in; None until the plant has published it.
        tick: the tick on which the node acts next.
        awaited: names of the inputs that have no message of this tick yet.
    """

    def __init__(
        self, act: Callable[[], None], finish: Callable[[], None],
        publishers_of: Callable[[str], str],
    ) -> None:
        """Begin before the run.

        Args:
            act: makes the node act.
            finish: called when the node has acted on the last tick.
            publishers_of: names the nodes that publish an input, for an error.
        """
        self.run: RunIdentity | None = None
        self.tick = 0
        self.awaited: set[str] = set()
        self._of_tick: set[str] = set()  # names of the inputs that the node acts on
        self._act, self._finish, self._publishers_of = act, finish, publishers_of

    def receiver(self, entry: Input) -> Callable[[bytes], None]:
        """Make the node wait for an input; return the receiver of its messages."""
        name, awaited = entry.topic.name, self.awaited
        self._of_tick.add(name)
        awaited.add(name)

        def receive(message: bytes) -> None:
            """Keep a message, and act if it was the last one awaited."""
            entry.receive(message)
            if name not in awaited:
                kind = LockstepError if self.tick else OccupiedError
                raise kind(
                    f"{entry.name} has a second message in tick {self.tick} "
                    f"({self._publishers_of(name)}); another publisher, or nodes from an earlier "
                    "run, are in this graph"
                )
            awaited.discard(name)
            if not awaited:
                self.act()

        return receive

    def act(self) -> None:
        """Let the node act on its inputs, and await the inputs of the next tick."""
        self.awaited |= self._of_tick
        self.tick += 1
        self._act()
        if self.done:
            self.awaited.clear()  # any further message ends the run
            self._finish()

    def join(self, values: array[float]) -> None:
        """Join the run that the plant has published.

        Raises:
            LockstepError: if this is another run, so that this node's run has ended; the plant has
                another version; or a message arrived after the last tick.
        """
        if len(values) != len(RunIdentity._fields) or not all(map(math.isfinite, values)):
            raise LockstepError(
                f"{RUN} has {len(values)} numbers, not {len(RunIdentity._fields)} finite ones: the "
                "plant has another version"
            )
        before, self.run = self.run, RunIdentity(*values)
        if before not in (None, self.run):
            raise LockstepError(
                "the plant was started again, or there are two; a run ends with its plant"
            )
        if before is None and self.done:  # /run arrived after the messages of the last tick
            end = round(self.run.last_tick) + 1
            early = self._of_tick if self.tick > end else self._of_tick - self.awaited
            if early:
                raise LockstepError(
                    f"{min(early)} has a second message in tick {end} (after the last)"
                )
            self.awaited.clear()
            self._finish()

    @property
    def done(self) -> bool:
        """Whether the node has acted on the last tick; False in the plant, which counts itself."""
        return self.run is not None and self.tick > self.run.last_tick
