"""What is pushed to browsers: made once for all of them, and never queued for one that is slow."""

from __future__ import annotations

import asyncio
import json
import time
import traceback
import zlib
from collections import Counter
from collections.abc import AsyncGenerator
from typing import Any

from greenroof_ros.watch.document import document, series
from greenroof_ros.watch.store import Store

_STATE_S = 0.5
_SERIES_S = 2.0
# A page that hears nothing for longer has lost its connection.
_AT_LEAST_S = 5.0

# The head of a gzip file without name and time (RFC 1952).
GZIP_HEAD = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"


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

    def __init__(self, store: Store) -> None:
        """Renew nothing yet.

        Args:
            store: what is shown.
        """
        self._store = store
        self._hours: Counter[float] = Counter()
        self._newest: dict[float | None, Message] = {}  # series by their hours, and the document
        self._changed = asyncio.Condition()
        self._failures = 0

    @property
    def readers(self) -> int:
        """How many read."""
        return self._hours.total()

    async def messages(self, hours: float) -> AsyncGenerator[Message, None]:
        """Yield news as they come, the newest only; ends where they cannot be made.

        Args:
            hours: of the past in the series; 0 for the summary alone, of a page that nobody sees.
        """
        failures, old = self._failures, dict[float | None, Message]()
        wanted = (None, hours) if hours else (0.0,)
        self._hours[hours] += 1
        try:
            async with self._changed:
                self._changed.notify_all()  # what renews waits for a reader
            while True:
                async with self._changed:
                    while old == (new := {
                        key: self._newest[key] for key in wanted if key in self._newest
                    }):
                        await self._changed.wait()
                        if self._failures != failures:
                            return
                for key, message in new.items():
                    if old.get(key) is not message:
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
                    self._newest = {}  # too old for whoever comes next
                    await self._changed.wait()
            begun = time.monotonic()
            try:
                self._newest = await asyncio.to_thread(self._make, list(self._hours))
            except Exception:
                traceback.print_exc()
                self._newest = {}
                self._failures += 1
            async with self._changed:
                self._changed.notify_all()
            await asyncio.sleep(max(_STATE_S - (time.monotonic() - begun), 0.05))

    def _make(self, wanted: list[float]) -> dict[float | None, Message]:
        """Make what is newer than what there is."""
        now, before = time.monotonic(), self._newest
        state = document(self._store, now)
        made: dict[float | None, Message] = {
            None: _newer(before.get(None), Message("state", state)),
            0.0: _newer(before.get(0.0), Message("summary", state["tiles"]["summary"])),
        }
        for hours in filter(None, wanted):
            old = before.get(hours)
            if old is None or now - old.looked >= _SERIES_S:
                old = _newer(old, Message("series", series(self._store, hours)))
            made[hours] = old
        return made


def _newer(old: Message | None, new: Message) -> Message:
    """Return the new one where it says something else, or the old one was long ago."""
    if old is not None and old.plain == new.plain and new.made - old.made < _AT_LEAST_S:
        old.looked = new.made
        return old
    return new
