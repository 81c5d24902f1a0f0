"""A serial line that is not there: two pseudo-terminals, joined."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import tty


class PseudoLine:
    """A line with two ends, each the path of a device that can be opened as a serial line.

    Attributes:
        ends: of the line.
    """

    def __init__(self) -> None:
        """Open it."""
        pairs = [pty.openpty() for _ in range(2)]
        for _, device in pairs:
            tty.setraw(device)
        # The devices stay open here, so that an end may be closed and opened again.
        self._masters, self._devices = zip(*pairs, strict=True)
        self.ends = tuple(os.ttyname(device) for device in self._devices)
        for master in self._masters:
            os.set_blocking(master, False)

    def join(self) -> None:
        """Hand on, in the running loop, what is sent at either end."""
        loop = asyncio.get_running_loop()
        for one, other in (self._masters, self._masters[::-1]):
            loop.add_reader(one, self._hand_on, one, other)

    @staticmethod
    def _hand_on(one: int, other: int) -> None:
        data = os.read(one, 4096)
        with contextlib.suppress(BlockingIOError):  # nobody reads there: as on a line, it is lost
            os.write(other, data)
