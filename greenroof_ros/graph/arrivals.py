"""The messages that come to a node before it acts, each with the tick to which it belongs.

A node that is started in a run is sent the last messages of each topic again. A publisher numbers
its messages from 1 on, and says from which tick K it answers; its j-th message is that of tick
K + j - 1.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from greenroof_ros.graph.errors import LockstepError

# What rclpy calls the number in what it says of a message, and when it was published (ns).
_NUMBER, _PUBLISHED = "publication_sequence_number", "source_timestamp"
# More messages are kept than a publisher sends again.
_KEPT = 512


class Arrivals:
    """The messages of one topic.

    Attributes:
        name: of the topic on the wire.
        first: the tick of its publisher's first message; None as long as it is unknown.
        next: the tick that is wanted next; None as long as the node does not know its own.
        due: the messages of the ticks that were wanted, up to the one before ``next``.
    """

    def __init__(self, name: str) -> None:
        """Begin without any."""
        self.name = name
        self.first: int | None = None
        self.next: int | None = None
        self.due: deque[bytes] = deque()
        # Number, time of publication, and message.
        self._kept: deque[tuple[int, int, bytes]] = deque(maxlen=_KEPT)
        self._number = 0

    def take(self, message: bytes, information: dict[str, Any]) -> None:
        """Keep a message.

        Args:
            message: serialised.
            information: what rclpy says of it. A middleware that does not number messages is fine
                as long as no node is started again.
        """
        number = information[_NUMBER]
        if number is None:
            number = self._number + 1
        if number <= self._number:
            self._kept.clear()  # they were of a publisher that went
        self._number = number
        self._kept.append((number, information[_PUBLISHED], message))
        self.sort()

    def sort(self) -> None:
        """Find the ticks of the messages, as soon as they can be known.

        Raises:
            LockstepError: one is missing.
        """
        if self.first is None or self.next is None:
            return
        for number, _, message in self._kept:
            tick = self.first + number - 1
            if tick > self.next:
                raise LockstepError(
                    f"{self.name} of tick {self.next} is lost, and {tick} came: this node was "
                    "started too late to go on in this run; end all nodes and start it again"
                )
            if tick == self.next:
                self.due.append(message)
                self.next += 1
        self._kept.clear()

    def of_another(self, silent_at: int) -> None:
        """Forget the publisher, which was started again, and what it said of unknown ticks.

        Args:
            silent_at: when the present one had published nothing yet (ns of the system clock).
        """
        self.first = None
        while self._kept and self._kept[0][1] <= silent_at:
            self._kept.popleft()
        self._number = self._kept[-1][0] if self._kept else 0

    def forget(self) -> None:
        """Begin anew: the run is over."""
        self.first = self.next = None
        self.due.clear()
        self._kept.clear()
        self._number = 0

    @property
    def came(self) -> bool:
        """Whether there is any message."""
        return bool(self._kept or self.due)

    def begin_with_newest(self) -> None:
        """Take the newest message for that of tick 0, since nobody says of which tick it is."""
        self.first, self.next = 1 - self._number, 0
        self.sort()
