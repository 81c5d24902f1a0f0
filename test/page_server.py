"""The watcher's server in this process, on real sockets, and clients that send raw bytes."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import SimpleNamespace
from typing import Any

from greenroof_ros.base.processes import InterruptedRun
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.listening import LOOPBACK, listen
from greenroof_ros.watch.server import PageServer
from greenroof_ros.watch.store import GraphStore


@contextmanager
def running(run: Callable[[Any], None]) -> Iterator[None]:
    """Run a server in a thread; at the end of the block, a signal ends it."""
    ended = threading.Event()

    def check() -> None:
        if ended.is_set():
            raise InterruptedRun("interrupted")

    def act() -> None:
        with suppress(InterruptedRun):
            run(SimpleNamespace(check=check))

    thread = threading.Thread(target=act)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(60)
    assert not thread.is_alive()


@contextmanager
def served(store: GraphStore, token: str | None = None, port: int = 0) -> Iterator[int]:
    """Serve the store's content on loopback; without a graph there are no updates and commands."""
    listener = listen(LOOPBACK, port)
    number = listener.socket.getsockname()[1]
    with running(PageServer(store, Feed(store), listener, token).serve):
        yield number


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
