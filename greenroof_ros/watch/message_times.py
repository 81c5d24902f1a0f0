"""Times of messages in the watched graph."""

from __future__ import annotations

from greenroof_ros.interface.states import PLANT
from greenroof_ros.interface.topics import Topic
from greenroof_ros.watch.registry import Registry

# A message further than this from the clock (ticks) comes from a publisher that was restarted: the
# plant is at most 32 ticks ahead of the recorder, and messages received together are closer.
_FAR = 64


class MessageTimes:
    """Detection of the graph that is running, and of the time of each message.

    In a simulated graph, the time of a message is that of the tick; at a live site, it is the time
    of arrival.

    In lockstep, the j-th message on a topic belongs to tick j - 1, where j is the number assigned
    by its publisher. The order of arrival is less reliable, since the plant's next clock message
    may arrive before the messages of the previous tick.

    Attributes:
        mode: kind of graph, as reported by the registry.
        live: whether the current or last graph is live; None before the first graph.
    """

    def __init__(self, registry: Registry) -> None:
        """Start without any messages, with the registry of the nodes."""
        self.mode = "none"
        self.live: bool | None = None
        self._registry = registry
        self._runs = 0
        self.forget_clock()

    def forget_clock(self) -> None:
        """Forget all clock messages received so far."""
        self._newest_ns = 0  # time of the newest clock message (since 1970)
        self._clock = 0  # number of that message
        self._period = 0  # ns

    def update(self, wall: float) -> bool:
        """Return whether a new run or graph has started by the time ``wall`` (steady clock, s)."""
        was_live, self.mode = self.live, self._registry.mode(wall)
        self.live = {"simulated": False, "live": True}.get(self.mode, was_live)
        if self._registry.runs == self._runs and was_live in (None, self.live):
            return False
        self._runs = self._registry.runs
        self.forget_clock()
        return True

    def receive_clock(self, number: int | None, time_ns: int) -> None:
        """Receive a clock message and its number, as counted by its publisher."""
        number = self._clock + 1 if number is None else number
        if self._clock and number > self._clock:
            self._period = (time_ns - self._newest_ns) // (number - self._clock)
        self._clock, self._newest_ns = number, time_ns

    def time_of(self, topic: Topic, number: int | None, arrived_ns: int) -> int | None:
        """Return the time of a message (ns since 1970); None if it cannot be determined yet.

        Args:
            topic: topic of the message.
            number: number of the message, counted by its publisher from 1; None if unknown.
            arrived_ns: time of arrival (ns since 1970).
        """
        if self.mode == "live":
            return arrived_ns
        if not topic.per_tick:
            return self._newest_ns or None
        if not self._period:
            return None  # fewer than two clocks were received
        # A pump driver from another package may have begun at any tick, so the newest time applies.
        # There is no other plant, and its status may arrive after its first messages.
        own = topic.publishers == (PLANT,) or any(map(self._registry.node, topic.publishers))
        ahead = number - self._clock if own and number is not None else 0
        return None if abs(ahead) > _FAR else self._newest_ns + ahead * self._period
