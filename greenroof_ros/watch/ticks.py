"""The simulated time of each message that is heard, by the number that its publisher gave it.

In lockstep the j-th message of a topic belongs to tick j - 1. When messages come says less: the
plant's next clock may come before what moved in the tick before, and the watcher is not woken by
each.
"""

from __future__ import annotations

# The plant runs 32 ticks ahead of the recorder at most, and what is heard at one time is of fewer.
# A number further away is of a publisher that was started again, or of one that is none.
_FAR = 64


class Ticks:
    """Which time each message has; one for each run.

    Attributes:
        lost: whether a message did not come since that was last set to False.
        newest_ns: the newest time of the clock (ns since 1970); 0 before it was heard.
    """

    def __init__(self) -> None:
        """Begin before the first clock."""
        self.lost = False
        self.newest_ns = 0
        self._clock = 0  # the number of that message
        self._period = 0  # ns
        self._numbers: dict[str, int] = {}
        self._strangers: dict[str, int] = {}

    def clock(self, number: int | None, time_ns: int) -> None:
        """Hear the clock."""
        if number is None:
            number = self._clock + 1
        if self._clock and number > self._clock:
            self.lost |= number > self._clock + 1
            self._period = (time_ns - self.newest_ns) // (number - self._clock)
        self._clock, self.newest_ns = number, time_ns

    def time(self, topic: str, number: int | None, *, from_tick_0: bool) -> int | None:
        """Return the time of a message (ns since 1970); None where it cannot be known.

        Args:
            topic: its name.
            number: of the message.
            from_tick_0: whether its publisher's first message is that of tick 0, which a pump
                driver of somebody else's does not say.
        """
        if not self._period:
            return None  # less than two clocks were heard
        if number is None:
            return self.newest_ns
        before = self._numbers.get(topic)
        if before is not None and number > before + 1:
            self.lost = True
        self._numbers[topic] = number
        first = 0
        if not from_tick_0:
            if before is None or number <= before:
                ahead = number - self._clock
                # One that was there from the beginning has numbered as the plant has.
                self._strangers[topic] = 0 if abs(ahead) <= 1 else -ahead
            first = self._strangers.get(topic, 0)
        ahead = number + first - self._clock
        if abs(ahead) > _FAR:
            self.lost = True
            return None
        return self.newest_ns + ahead * self._period
