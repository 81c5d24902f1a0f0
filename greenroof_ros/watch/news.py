"""What is pushed to browsers: made once for all of them, and never queued for one that is slow."""

from __future__ import annotations

import asyncio
import json
import time
import traceback
import zlib
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
        looked: when it was last made, and found to be what still holds.
    """

    def __init__(self, name: str, content: dict[str, Any]) -> None:
        # Broken UTF-8 is escaped, and a number that JSON does not have is a mistake here.
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        self.plain = f"event: {name}\ndata: {text}\n\n".encode()
        press = zlib.compressobj(wbits=-zlib.MAX_WBITS)
        self.compressed = press.compress(self.plain) + press.flush(zlib.Z_FULL_FLUSH)
        self.made = self.looked = time.monotonic()


class News:
    """The document and the series, made anew while somebody reads them.

    A reader gets what is newest when it has taken what it got before. What came in between is gone,
    so that a thousand slow ones need no more memory than one.

    Attributes:
        readers: how many read.
    """

    def __init__(self, store: Store) -> None:
        """Make nothing yet.

        Args:
            store: what is shown.
        """
        self.readers = 0
        self._store = store
        self._newest: dict[str | float, Message] = {}  # by name, of series by their hours
        self._making = asyncio.Lock()

    async def messages(self, hours: float) -> AsyncGenerator[Message, None]:
        """Yield news as they come, the newest only.

        What cannot be made is printed, and ends every stream: a page says then that it is not
        connected, rather than showing something old as if it were now.

        Args:
            hours: of the past in the series; 0 for the summary alone, of a page that nobody sees.
        """
        wanted: tuple[str | float, ...] = ("state", hours) if hours else ("summary",)
        sent: dict[str | float, Message] = {}
        self.readers += 1
        try:
            while True:
                for key in wanted:
                    message = await self._made(key)
                    if sent.get(key) is not message:
                        sent[key] = message
                        yield message
                await asyncio.sleep(_STATE_S)
        except _CannotBeMadeError:
            return
        finally:
            self.readers -= 1

    async def _made(self, key: str | float) -> Message:
        """Return the newest message, which is made once for all readers."""
        async with self._making:
            now, lasts = time.monotonic(), _STATE_S if isinstance(key, str) else _SERIES_S
            self._newest = {  # what was made for others who have gone is let go of
                each: one for each, one in self._newest.items() if now - one.looked < _AT_LEAST_S
            }
            old = self._newest.get(key)
            if old is None or now - old.looked >= lasts:
                try:
                    old = _newer(old, await asyncio.to_thread(self._make, key))
                except Exception as error:
                    traceback.print_exc()
                    raise _CannotBeMadeError from error
                self._newest[key] = old
            return old

    def _make(self, key: str | float) -> Message:
        if not isinstance(key, str):
            return Message("series", series(self._store, key))
        shown = document(self._store, time.monotonic())
        return Message(key, shown if key == "state" else shown["tiles"]["summary"])


class _CannotBeMadeError(Exception):
    """A message cannot be made."""


def _newer(old: Message | None, new: Message) -> Message:
    """Return the new one where it says something else, or the old one was long ago."""
    if old is not None and old.plain == new.plain and new.made - old.made < _AT_LEAST_S:
        old.looked = new.made
        return old
    return new
