"""Lockstep over topics: a node acts as soon as every input has received its message of the tick.

Every topic of a tick has exactly one message per tick, k = 0..N. Only ``/clock`` identifies the
tick; the other messages need no tick number, since no node publishes tick k + 1 before it has acted
on tick k. Every node except the recorder, which only counts messages, follows these steps:

1. *wait*: when a message arrives, its input is no longer awaited (:meth:`LockstepNode.subscribe`);
2. *act*: when no input is awaited any more, the node acts, and all inputs are awaited again, for
   the next tick;
3. *publish*: the node publishes its own messages of the tick, one on each of its topics.

Readers that are discovered late receive the earlier messages, since topics are transient local with
a history depth of 64, and the plant is at most 32 ticks ahead of the recorder. The following faults
end a run:

- a message that does not arrive within the peer limit (before the first responses: within 30 s, if
  that is longer); the plant detects this fault, and names the topics that it is waiting for;
- an incompatible or second publisher, or a second message before the node has acted;
- a second message after the node has acted. This message counts for the next tick, and is detected
  when the actual message of the next tick arrives; after the last tick, any message ends the run.
  A message that does not reach the recorder is detected by the plant, which waits for its bag.

A value out of its range and a malformed message are messages of the tick; they act as 0.

Before the first tick, the plant publishes ``/run`` with N, which every node awaits before it acts
on tick 0, and from which it knows its last tick. No timer or sleep delays a tick. The steady clock
is used only to end a run that hangs.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from rclpy.duration import Duration

from greenroof_ros.base.errors import LockstepError, OccupiedError
from greenroof_ros.interface.states import FINISHED, PLANT
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.ros.graph_node import GraphNode, Publishers
from greenroof_ros.ros.messages import Input, decoder, qos_profile

CLOCK, RUN = "/clock", "/run"
# A topic is discovered at most this long (s) before the name of its node.
_NAMES_S = 0.5


class LockstepNode(GraphNode):
    """A node of a simulated graph, which acts in lockstep and ends with the run.

    A subclass opens its topics with :meth:`open_outputs` and :meth:`subscribe`, using their names
    in the interface. A subclass overrides :meth:`on_inputs` and, if necessary, the other ``on_``
    methods, ``progress`` and ``summary``. If it subscribes to ``/clock``, the time of the tick is
    its time.

    Attributes:
        run: what the plant has published on ``/run``: a random number, the number N of the last
            tick, and the simulated time divided by the wall time (0 for as fast as possible); empty
            until then.
        last_tick: the number N of the last tick; infinite until it is known.
        awaited: names of the inputs that have not yet received their message of this tick.
        result: values that the node adds to the summary of the run; empty until the run is over.
        time_ns: the simulated time (ns since 1970); 0 before the first tick.
    """

    time_ns = 0

    def __init__(self, name: str, role: str) -> None:
        """Join the graph.

        Args:
            name: the node's name.
            role: the node's role in the interface: its name, or ``controller``.

        Raises:
            ConfigurationError: if the ROS arguments or a parameter file is invalid.
        """
        super().__init__(name, role, read_topics())
        self.inputs: dict[str, Input] = {}
        self.run: Sequence[float] = ()
        self.last_tick = math.inf
        self._always["run_length"] = None
        self.awaited: set[str] = set()
        self.result: dict[str, Any] = {}
        if role != PLANT:
            self.awaited.add(RUN)
            decode = decoder(self.interface[RUN].type)
            self.open(RUN, lambda message: self._join(tuple(decode(message))))

    # --- to override ------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Act on the inputs, all of which have received their messages of the tick."""

    def summary(self) -> dict[str, Any]:
        """Return the values that the node adds to the summary of the run at its end."""
        return {}

    # --- setting up -------------------------------------------------------------------------

    def subscribe(self, name: str) -> Input:
        """Open an input that the node waits for in every tick, and return it.

        Args:
            name: name of the topic in the interface.
        """
        awaited, full_name = self.awaited, self.resolve_topic_name(self.interface[name].graph_name)
        entry = self.inputs[name] = Input(self.interface[name], full_name)
        awaited.add(name)

        def receive(message: bytes) -> None:
            """Store a message, and let the node act if no other message is awaited."""
            entry.receive(message)
            if name not in awaited:
                time.sleep(_NAMES_S)
                raise self.conflict(
                    f"{entry.name} has a second message in tick {self.tick} "
                    f"({', '.join(self.peers[name].names())}); another publisher, or a node of "
                    "an earlier run, is in this graph"
                )
            awaited.discard(name)
            if not awaited:
                self._act()

        self.open(name, receive)
        return entry

    def open(self, name: str, callback: Callable[[bytes], None]) -> None:
        """Pass every serialised message of a topic to a callback, without waiting for it."""
        topic = self.interface[name]
        required = replace(topic.qos, lease_s=math.inf)  # no lease in a simulation
        self.peers[name] = Publishers(self, topic, required)
        self.open_subscription(topic, callback, qos_profile(required))

    # --- running ----------------------------------------------------------------------------

    def _join(self, run: Sequence[float]) -> None:
        if not self.run:
            self.run, self.last_tick = run, run[1]
            self._always["run_length"] = round(self.last_tick)
            self.awaited.discard(RUN)
            if self.inputs and not self.awaited:
                self._act()
        elif run != self.run:
            raise LockstepError(
                "the plant was restarted, or there are two plants; a run ends when its plant stops"
            )

    def _act(self) -> None:
        """Act on the inputs, and await all inputs again, for the next tick."""
        self.awaited.update(self.inputs)
        self.tick += 1
        if (clock := self.inputs.get(CLOCK)) is not None:
            self.time_ns = clock.value
        self.on_inputs()
        if self.tick > self.last_tick:
            self.awaited.clear()  # any further message ends the run
            self.finish()

    def conflict(self, what: str) -> Exception:
        """Return the error for a conflict: before the run a wrong set-up, later a failure."""
        return (LockstepError if self.acted else OccupiedError)(what)

    def finish(self) -> None:
        """Set the state to finished, and report it."""
        self.result = self.summary()
        self.reports.state = FINISHED
        self.report_state()

    def check_peers(self) -> None:
        """Refuse an incompatible publisher of an input, and a second one.

        Raises:
            LockstepError: if there is such a publisher; an OccupiedError before the run.
        """
        for peer in () if self.finished else self.peers.values():
            if conflict := peer.describe_conflict():
                time.sleep(_NAMES_S)
                raise self.conflict(f"{peer.full_name} {peer.describe_conflict() or conflict}")

    # --- ending -----------------------------------------------------------------------------

    @property
    def may_end(self) -> bool:
        """Whether the node may stop: its run is over, and its readers have all its messages.

        The plant stops first; until then, other nodes may still need the messages of this node.

        Raises:
            LockstepError: if the plant stopped before the run was over.
        """
        plant_ended = CLOCK in self.peers and not self.peers[CLOCK].count
        if not self.finished:
            if self.run and plant_ended:
                raise LockstepError("the plant has stopped, which ends the run")
            return False
        return self.all_arrived() and (self.role == PLANT or plant_ended)

    def all_arrived(self) -> bool:
        """Return True if all subscribers have received all messages of the node."""
        now = Duration()
        return all(publisher.wait_for_all_acked(now) for publisher, *_ in self._outputs.values())
