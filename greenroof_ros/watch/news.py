"""What is pushed to browsers: made once for all of them, and never queued for one that is slow."""

from __future__ import annotations

import asyncio
import json
import threading
import time
import traceback
import zlib
from collections import Counter
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import Future
from functools import partial
from typing import Any, TypeVar

from greenroof_ros.watch.watched import Watched

_STATE_S = 0.5
_SERIES_S = 2.0
# A page that hears nothing for longer has lost its connection.
_AT_LEAST_S = 5.0

Result = TypeVar("Result")

# The head of a gzip file without name and time (RFC 1952).
GZIP_HEAD = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"


async def in_thread(call: Callable[[], Result]) -> Result:
    """Wait for a call that may take long, in a thread of its own; the process ends without it."""
    done: Future[Result] = Future()

    def work() -> None:
        done.set_running_or_notify_cancel()
        try:
            done.set_result(call())
        except BaseException as error:
            done.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return await asyncio.wrap_future(done)


class Message:
    """One server-sent event, as it is and compressed.

    Compressed ones can follow a :data:`GZIP_HEAD` in any choice and order, so that each is
    compressed once for all readers: none refers to an earlier one, and each ends with a full flush.

    Attributes:
        plain: as it is.
        compressed: raw deflate.
        made: when (steady clock, s).
        looked: when it was last found to be what still holds.
    """

    def __init__(self, name: str, content: dict[str, Any]) -> None:
        # Broken UTF-8 is escaped, and a number that JSON does not have is a mistake here.
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        self.plain = f"event: {name}\ndata: {text}\n\n".encode()
        press = zlib.compressobj(wbits=-zlib.MAX_WBITS)
        self.compressed = press.compress(self.plain) + press.flush(zlib.Z_FULL_FLUSH)
        self.made = self.looked = time.monotonic()


class News:
    """The document and the series, renewed while somebody reads them.

    A reader gets what is newest when it has taken what it got before. What came in between is gone,
    so that a thousand slow ones need no more memory than one.
    """

    def __init__(self, watched: Watched) -> None:
        """Renew nothing yet.

        Args:
            watched: what is shown.
        """
        self._watched = watched
        self._hours: Counter[float] = Counter()
        self._state: Message | None = None
        self._series: dict[float, Message] = {}
        self._changed = asyncio.Condition()
        self._failures = 0

    @property
    def readers(self) -> int:
        """How many read."""
        return self._hours.total()

    async def messages(self, hours: float) -> AsyncGenerator[Message, None]:
        """Yield news as they come, the newest only; ends where they cannot be made.

        Args:
            hours: of the past in the series.
        """
        old: list[Message | None] = [None, None]
        failures = self._failures
        self._hours[hours] += 1
        try:
            async with self._changed:
                self._changed.notify_all()  # what renews waits for a reader
            while True:
                async with self._changed:
                    while old == (new := [self._state, self._series.get(hours)]):
                        await self._changed.wait()
                        if self._failures != failures:
                            return
                for before, message in zip(old, new, strict=True):
                    if message is not before and message is not None:
                        yield message
                old = new
        finally:
            self._hours[hours] -= 1
            if not self._hours[hours]:
                del self._hours[hours]

    async def renew(self) -> None:
        """Renew for ever what is read.

        What cannot be made is printed, and ends every stream: a page says then that it is not
        connected, rather than showing something old as if it were now.
        """
        while True:
            async with self._changed:
                while not self._hours:
                    self._state, self._series = None, {}  # too old for whoever comes next
                    await self._changed.wait()
            begun = time.monotonic()
            wanted = list(self._hours)
            try:
                state, series = await in_thread(partial(self._make, wanted))
            except Exception:
                traceback.print_exc()
                self._state, self._series = None, {}
                self._failures += 1
            else:
                self._state, self._series = state, series
            async with self._changed:
                self._changed.notify_all()
            await asyncio.sleep(max(_STATE_S - (time.monotonic() - begun), 0.05))

    def _make(self, wanted: list[float]) -> tuple[Message, dict[float, Message]]:
        """Make what is newer than what there is."""
        now = time.monotonic()
        state = _newer(self._state, Message("state", self._watched.document(time.monotonic())))
        series = {}
        for hours in wanted:
            old = self._series.get(hours)
            if old is None or now - old.looked >= _SERIES_S:
                series[hours] = _newer(old, Message("series", self._watched.series(hours)))
            else:
                series[hours] = old
        return state, series


def _newer(old: Message | None, new: Message) -> Message:
    """Return the new one where it says something else, or the old one was long ago."""
    if old is not None and old.plain == new.plain and new.made - old.made < _AT_LEAST_S:
        old.looked = new.made
        return old
    return new
