"""The watcher's server in this process, on real sockets, and clients that send raw bytes."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.listening import LOOPBACK, listen
from greenroof_ros.watch.server import run_server
from greenroof_ros.watch.store import GraphStore


@contextmanager
def served(store: GraphStore, token: str | None = None, port: int = 0) -> Iterator[int]:
    """Serve the store's content on loopback without a graph; yield the port."""
    feed = Feed(store)  # not entered: there are no updates and no commands
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    def run(call: Callable[[], Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(call(), loop).result(20)

    place = listen(LOOPBACK, port)
    context = run_server(store, feed, place, token)
    run(context.__aenter__)
    try:
        yield place.socket.getsockname()[1]
    finally:
        run(lambda: context.__aexit__(None, None, None))
        run(_cancel_others)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(20)
        loop.close()


async def _cancel_others() -> None:
    """Cancel what still runs in this loop, as at the end of a program."""
    tasks = asyncio.all_tasks() - {asyncio.current_task()}
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


class Answer:
    """A server's answer: status, headers in lower case, and body."""

    def __init__(self, data: bytes) -> None:
        head, _, self.body = data.partition(b"\r\n\r\n")
        first, *lines = head.decode("latin-1").split("\r\n")
        self.status = int(first.split()[1]) if first else 0
        pairs = (line.partition(":") for line in lines)
        self.headers = {name.lower(): value.strip() for name, _, value in pairs}

    def json(self) -> Any:
        return json.loads(self.body)


def send(port: int, data: bytes) -> bytes:
    """Send bytes, and return all that comes until the other side closes.

    Raises:
        TimeoutError: it does not close, perhaps because its answer is an endless stream.
    """
    until = time.monotonic() + 60
    with socket.create_connection((LOOPBACK, port), timeout=60) as connection:
        connection.sendall(data)
        parts = []
        try:
            while part := connection.recv(1 << 16):
                parts.append(part)
                if time.monotonic() > until:
                    raise TimeoutError("still answering after 60 s")
        except ConnectionResetError:
            pass
        return b"".join(parts)


def request(
    port: int, method: str, target: str, body: bytes = b"", *, host: str | None = "localhost",
    **headers: str,
) -> Answer:
    """Send one request, with the target exactly as given."""
    lines = [f"{method} {target} HTTP/1.1", "Connection: close"]
    if host is not None:
        lines.append(f"Host: {host}")
    if body or method == "POST":
        lines.append(f"Content-Length: {len(body)}")
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    return Answer(send(port, "\r\n".join([*lines, "", ""]).encode("latin-1") + body))


class Stream:
    """An event stream of the page."""

    def __init__(self, port: int, hours: str = "12", receiving: int | None = None,
                 **headers: str) -> None:
        self.socket = socket.socket()
        if receiving is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receiving)
        self.socket.settimeout(60)
        self.socket.connect((LOOPBACK, port))
        lines = [f"GET /events?hours={hours} HTTP/1.1", "Host: localhost"]
        lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
        self.socket.sendall("\r\n".join([*lines, "", ""]).encode())
        self._file = self.socket.makefile("rb")
        self._head: str | None = None

    def head(self) -> str:
        """Return the head of the answer."""
        if self._head is None:
            self._head = ""
            while (line := self._file.readline()) not in (b"\r\n", b""):
                self._head += line.decode()
        return self._head

    def chunks(self) -> Iterator[bytes]:
        """Yield the chunks until the stream ends."""
        self.head()
        while size := int(self._file.readline() or b"0", 16):
            yield self._file.read(size)
            self._file.readline()

    def events(self) -> Iterator[tuple[str, Any]]:
        """Yield the name and content of each event."""
        for chunk in self.chunks():
            name, data, *_ = chunk.decode().split("\n")
            yield name.removeprefix("event: "), json.loads(data.removeprefix("data: "))

    def close(self) -> None:
        self._file.close()
        self.socket.close()
