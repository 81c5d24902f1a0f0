"""The watcher's server in this process, on real sockets, and clients that send raw bytes."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.listening import LOOPBACK, listen
from greenroof_ros.watch.server import PageServer
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
    context = PageServer(store, feed, place, token).running()
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
    """Send bytes, and return all that comes until the other side closes."""
    with socket.create_connection((LOOPBACK, port), timeout=60) as connection:
        connection.sendall(data)
        parts = []
        try:
            while part := connection.recv(1 << 16):
                parts.append(part)
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


def read_state(port: int, **headers: str) -> dict[str, Any]:
    """Return the newest state."""
    answer = request(port, "GET", "/state", X_Greenroof="1", **headers)
    assert answer.status == 200, answer.body
    state: dict[str, Any] = answer.json()
    return state
