"""The graph that is watched, by its nodes' reports, and the times of its messages."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

from greenroof_ros.interface.states import PLANT
from greenroof_ros.interface.topics import Topic
from greenroof_ros.ros.reports import NodeReport, Reports, Status

# After this silence (s), a run without its plant is over.
_GONE_S = 10.0
# Shortest and longest time over which the speed of a simulation is measured (s).
_SPEED_S, _SPEED_MAX_S = 1.0, 3.0
# A message further than this from the clock (ticks) comes from a publisher that was restarted: the
# plant is at most 32 ticks ahead of the recorder, and messages received together are closer.
_FAR = 64


class Graph(Reports):
    """The nodes in one namespace, and the times of their messages.

    In a simulated graph, the time of a message is that of the tick; at a live site, it is the time
    of arrival. In lockstep, the j-th message on a topic belongs to tick j - 1, where j is the
    number assigned by its publisher. The order of arrival is less reliable, since the plant's next
    clock message may arrive before the messages of the previous tick.

    Attributes:
        runs: number of new runs, or of changes between a run and a live site.
        live: whether the current or last graph is live; None before the first graph.
        offered: names of the nodes that offer a hold service for the pump, and so may control it,
            whatever is reported, each with the number of nodes that have this name.
    """

    def __init__(self, namespace: str = "") -> None:
        """Start without nodes in a namespace such as ``/site1``; empty for none."""
        super().__init__(namespace)
        self.runs = 0
        self.live: bool | None = None
        self.offered: Mapping[str, int] = {}
        self._run_began: float | None = None
        self._ticks: deque[tuple[float, int]] = deque()
        self.forget_clock()

    def receive(
        self, wall: float, now: float, statuses: Sequence[Status], stamp_ns: int = 0
    ) -> None:
        """Receive the statuses from a message, and measure the speed of a run."""
        super().receive(wall, now, statuses, stamp_ns)
        plant = self.node(PLANT, wall)
        if plant is None or plant.received_at != wall:
            return
        if plant.began != self._run_began:
            self.runs += self._run_began is not None
            self._run_began = plant.began
            self._ticks.clear()
            self.time_ns = 0
            self.nodes = {name: node for name, node in self.nodes.items() if node.is_online(wall)}
        if isinstance(tick := plant.values.get("tick"), int):
            self._ticks.append((wall, tick))
        while self._ticks and wall - self._ticks[0][0] > _SPEED_MAX_S:
            self._ticks.popleft()

    def node(self, role: str, wall: float) -> NodeReport | None:
        """Return the node with a role: the first one that is there, or the last one that was."""
        nodes = [node for node in self.nodes.values() if node.role == role]
        online = [node for node in nodes if node.is_online(wall)]
        last = max(nodes, key=lambda node: node.received_at, default=None)
        return min(online, key=lambda node: node.began, default=last)

    def update(self, wall: float) -> str:
        """Return the kind of graph now: ``none``, ``simulated``, ``live`` or ``ended``."""
        plant, was_live = self.node(PLANT, wall), self.live
        here = plant is not None and not plant.has_ended and wall - plant.received_at < _GONE_S
        if here:
            mode, self.live = "simulated", False
        # A live site is not over: if its program ends or falls silent, nobody waters the roof.
        elif any("run_length" not in node.values for node in self.nodes.values()):
            mode, self.live = "live", True
        else:  # without a plant, nodes are waiting for theirs
            mode = "none" if plant is None else "ended"
        if was_live not in (None, self.live):
            self.runs += 1
        return mode

    def factor(self, tau: float) -> float | None:
        """Return the ratio of simulated to wall time over the last few seconds; None if unknown."""
        if len(self._ticks) < 2:
            return None
        (began, first), (ended, last) = self._ticks[0], self._ticks[-1]
        return None if ended - began < _SPEED_S else (last - first) * tau / (ended - began)

    @property
    def has_two_pumps(self) -> bool:
        """Whether more than one node may control the pump."""
        return sum(self.offered.values()) > 1

    def site(self, wall: float) -> Path | None:
        """Return the site file of the graph; None if it is not on this machine."""
        for role in (PLANT, "controller"):
            values = {} if (node := self.node(role, wall)) is None else node.values
            here = str(values.get("process")).rpartition(" ")[0] == socket.gethostname()
            text = values.get("site")
            if here and isinstance(text, str) and text.startswith("/") and "\0" not in text:
                try:
                    if (path := Path(text)).exists():
                        return path
                except OSError:
                    pass
        return None

    # --- times of messages ----------------------------------------------------------------------

    def forget_clock(self) -> None:
        """Forget all clock messages received so far."""
        self._newest_ns = 0  # time of the newest clock message (since 1970)
        self._clock = 0  # number of that message
        self._period = 0  # ns

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
        if self.live:
            return arrived_ns
        if not topic.per_tick:
            return self._newest_ns or None
        if not self._period:
            return None  # fewer than two clocks were received
        # A pump driver from another package may have begun at any tick, so the newest time applies.
        # There is no other plant, and its status may arrive after its first messages.
        own = topic.publishers == (PLANT,) or any(
            node.role in topic.publishers for node in self.nodes.values()
        )
        ahead = number - self._clock if own and number is not None else 0
        return None if abs(ahead) > _FAR else self._newest_ns + ahead * self._period
