"""Lockstep over topics: a node acts as soon as every input has received its message of the tick.

Every topic of a tick has exactly one message per tick, k = 0..N. Only ``/clock`` identifies the
tick; the other messages need no tick number, since no node publishes tick k + 1 before it has acted
on tick k. Every node except the recorder, which only counts messages, follows these steps:

1. *wait*: when a message arrives, its input is no longer awaited (:meth:`Lockstep.receiver`);
2. *act*: when no input is awaited any more, the node acts, and all inputs are awaited again, for
   the next tick (:meth:`Lockstep.act`);
3. *publish*: the node publishes its own messages of the tick, one on each of its topics.

Readers that are discovered late receive the earlier messages, since topics are transient local with
a history depth of 64, and the plant is at most 32 ticks ahead of the recorder. The following faults
end a run:

- a message that does not arrive within the peer limit (or, before the first responses, within the
  start limit); the plant detects this fault, and names the topics that it is waiting for;
- a second publisher, or a second message before the node has acted;
- a second message after the node has acted. This message counts for the next tick, and is detected
  when the actual message of the next tick arrives; after the last tick, any message ends the run.
  A message that does not reach the recorder is detected by the recorder's message count.

A malformed message is dropped, and the node still waits for a valid message of the tick.

Before the first tick, the plant publishes ``/run`` with N, from which every node knows its last
tick. No timer or sleep delays a tick. The steady clock is used only to end a run that hangs.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import NamedTuple

from greenroof_ros.base.errors import OccupiedError
from greenroof_ros.ros.errors import LockstepError
from greenroof_ros.ros.inputs import Input

CLOCK, RUN = "/clock", "/run"


class RunIdentity(NamedTuple):
    """The data that the nodes of a run share, published by the plant on ``/run``.

    Attributes:
        identity: a random number chosen by the plant.
        last_tick: the number N of the last tick.
        speed: simulated time divided by wall time; 0 for as fast as possible.
    """

    identity: float
    last_tick: float
    speed: float

    @property
    def values(self) -> array[float]:
        """The numbers in the message on ``/run``."""
        return array("d", self)


class Lockstep:
    """Lockstep of a node, which lets the node act when no input is awaited, and ends with the run.

    Attributes:
        run: the run that the node takes part in; None until the plant has published it.
        tick: the next tick on which the node will act.
        awaited: names of the inputs that have not yet received their message of this tick.
    """

    def __init__(
        self, act: Callable[[], None], finish: Callable[[], None],
        publishers_of: Callable[[str], str],
    ) -> None:
        """Create the lockstep of a node before the run.

        Args:
            act: function that makes the node act.
            finish: callback that is called after the node has acted on the last tick.
            publishers_of: function that returns the names of the nodes that publish an input, for
                errors.
        """
        self.run: RunIdentity | None = None
        self.tick = 0
        self.awaited: set[str] = set()
        self._of_tick: set[str] = set()  # names of the inputs that the node acts on
        self._act, self._finish, self._publishers_of = act, finish, publishers_of

    def receiver(self, entry: Input) -> Callable[[bytes], None]:
        """Make the node wait for an input, and return the callback for its messages."""
        name, awaited = entry.topic.name, self.awaited
        self._of_tick.add(name)
        awaited.add(name)

        def receive(message: bytes) -> None:
            """Store a message, and let the node act if no other message is awaited."""
            entry.receive(message)
            if name not in awaited:
                kind = LockstepError if self.tick else OccupiedError
                raise kind(
                    f"{entry.name} has a second message in tick {self.tick} "
                    f"({self._publishers_of(name)}); another publisher, or a node of an earlier "
                    "run, is in this graph"
                )
            awaited.discard(name)
            if not awaited:
                self.act()

        return receive

    def act(self) -> None:
        """Let the node act on its inputs, and mark all inputs as awaited for the next tick."""
        self.awaited |= self._of_tick
        self.tick += 1
        self._act()
        if self.done:
            self.awaited.clear()  # any further message ends the run
            self._finish()

    def join(self, values: array[float]) -> None:
        """Join the run that the plant has published.

        Raises:
            LockstepError: if the node has already joined another run, which has therefore ended; if
                the plant is from another version of the package; or if a message arrived after the
                last tick.
        """
        if len(values) != len(RunIdentity._fields) or not all(map(math.isfinite, values)):
            raise LockstepError(
                f"{RUN} has {len(values)} numbers instead of {len(RunIdentity._fields)} finite "
                "numbers: the plant is from another version of this package"
            )
        before, self.run = self.run, RunIdentity(*values)
        if before not in (None, self.run):
            raise LockstepError(
                "the plant was restarted, or there are two plants; a run ends when its plant stops"
            )
        if before is None and self.done:  # /run arrived after the messages of the last tick
            end = round(self.run.last_tick) + 1
            early = self._of_tick if self.tick > end else self._of_tick - self.awaited
            if early:
                raise LockstepError(
                    f"{min(early)} has a second message in tick {end} (after the last tick)"
                )
            self.awaited.clear()
            self._finish()

    @property
    def done(self) -> bool:
        """Whether the node has acted on the last tick; always False in the plant."""
        return self.run is not None and self.tick > self.run.last_tick
