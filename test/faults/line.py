"""A Modbus TCP line that goes bad: it sits between a client and a simulator, which knows nothing.

For what the simulators cannot be asked for: faults of the level sensors' lines, and connections
to a drive that do not last.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import threading
import time

_HEADER = 6  # transaction, protocol, length
_WRITES = (5, 6, 15, 16)
_SLOW_S, _LATE_S, _BYTE_S = 0.2, 1.5, 0.005
_FAILURE = 4
# PX4's: on for 2 s, off for 7 s.
ON_S, OFF_S = 2.0, 7.0
# How long a connection lasts that breaks again and again: shorter than it takes to judge a drive.
LASTS_S = 3.0


class Line:
    """Listens at a port and asks a simulator at another, in a thread of its own.

    Attributes:
        fault: what is wrong with it: one of `cases.WIRE`, ``breaks`` or ``none``.
    """

    def __init__(self, port: int, behind: int) -> None:
        self.fault = "none"
        self._since = 0.0
        self._port, self._behind = port, behind
        self._random = random.Random(0)
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def inject(self, fault: str) -> None:
        """Let a fault stand; connections that there are meet it, too."""
        self.fault, self._since = fault, time.monotonic()
        if fault == "refused":
            self._loop.call_soon_threadsafe(self._drop_all)

    def close(self) -> None:
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(3)

    def _drop_all(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    def _work(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.set_exception_handler(lambda loop, context: None)
        self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        server: asyncio.Server | None = None
        while not self._ended.is_set():
            if self.fault == "refused" and server is not None:
                server.close()
                server = None
            elif self.fault != "refused" and server is None:
                server = await asyncio.start_server(
                    self._client, "127.0.0.1", self._port, reuse_address=True
                )
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._ended.wait(), 0.02)
        if server is not None:
            server.close()
        self._drop_all()

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        behind: asyncio.StreamWriter | None = None
        try:
            answers, behind = await asyncio.open_connection("127.0.0.1", self._behind)
            began = time.monotonic()
            while True:
                request = await _frame(reader)
                if self.fault == "dropped":
                    writer.transport.abort()
                    return
                # Never at an order, so that it is known that *stop* was taken.
                lasted = time.monotonic() - max(began, self._since) > LASTS_S
                if self.fault == "breaks" and lasted and request[7] not in _WRITES:
                    writer.transport.abort()
                    return
                if self.fault == "half_open":
                    continue
                behind.write(request)
                answer = await _frame(answers)
                if self.fault == "exception":
                    answer = request[:4] + b"\0\3" + request[6:7]
                    answer += bytes([request[7] | 0x80, _FAILURE])
                await self._answer(writer, answer)
        except (OSError, asyncio.IncompleteReadError):
            return  # either end has gone
        finally:
            self._writers.discard(writer)
            writer.close()
            if behind is not None:
                behind.close()

    async def _answer(self, writer: asyncio.StreamWriter, answer: bytes) -> None:
        """Send an answer, or what the fault makes of it."""
        fault = self.fault
        off = (time.monotonic() - self._since) % (ON_S + OFF_S) > ON_S
        if fault == "silence" or (fault == "intermittent" and off):
            return
        if fault == "wrong_unit":
            answer = answer[:6] + bytes([answer[6] % 247 + 1]) + answer[7:]
        elif fault == "wrong_function":
            answer = answer[:7] + bytes([answer[7] + 1]) + answer[8:]
        elif fault == "wrong_length":
            answer = answer[:4] + (len(answer) - 7).to_bytes(2, "big") + answer[6:-1]
        elif fault == "garbage":
            answer = self._random.randbytes(16)
        if fault in ("slow", "late"):
            delay = _SLOW_S if fault == "slow" else _LATE_S
            self._loop.call_later(delay, writer.write, answer)
        elif fault == "split":
            for byte in answer:
                writer.write(bytes([byte]))
                await asyncio.sleep(_BYTE_S)
        else:
            writer.write(answer)


async def _frame(reader: asyncio.StreamReader) -> bytes:
    """Return the next message of Modbus TCP."""
    header = await reader.readexactly(_HEADER)
    return header + await reader.readexactly(int.from_bytes(header[4:], "big"))
