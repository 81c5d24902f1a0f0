"""A cable to a broker that can be cut without anybody noticing: bytes wait until it is whole."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress


class Cable:
    """Hands on, in a thread of its own, what is sent between a port and another."""

    def __init__(self, port: int, behind: int) -> None:
        self.port, self._behind = port, behind
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._ready.wait(10)

    def cut(self, on: bool) -> None:
        """Hold back what is sent, or deliver it and go on; connections stay open."""
        self._loop.call_soon_threadsafe(self._whole.clear if on else self._whole.set)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._whole = asyncio.Event()
        self._whole.set()
        server = self._loop.run_until_complete(
            asyncio.start_server(self._connected, "127.0.0.1", self.port)
        )
        self._ready.set()
        self._loop.run_forever()
        server.close()

    async def _connected(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self._behind)
        except OSError:
            writer.close()
            return
        await asyncio.gather(self._hand_on(reader, back), self._hand_on(there, writer))

    async def _hand_on(self, source: asyncio.StreamReader, to: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await source.read(4096):
                await self._whole.wait()
                to.write(data)
                await to.drain()
        await self._whole.wait()
        to.close()
