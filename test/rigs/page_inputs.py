"""What the tests of the page need: nodes' messages, values, a store, and its server."""

from __future__ import annotations

import json
import math
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import strategies as st
from paper import PAPER_SITE

from greenroof_ros.base.processes import InterruptedRun
from greenroof_ros.interface.alarm import ERROR, OK, WARN
from greenroof_ros.ros.reports import Status
from greenroof_ros.site.horizon import growing_steps
from greenroof_ros.site.site import Site
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.listening import LOOPBACK, listen
from greenroof_ros.watch.server import PageServer
from greenroof_ros.watch.store import PLAN, RAIN_FORECAST, GraphStore

SECOND = 10**9
START = 1_626_757_200 * SECOND  # 2021-07-20 05:00 UTC, a multiple of 20 s
HELD = "a hold by the operator"
HOLD = {"owner": "the operator", "reason": "", "until": None, "sentence": HELD}


def node(
    name: str, role: str, *, process: str = "host 1", state: str = "ready", **values: Any
) -> list[Status]:
    """Return what a node reports of itself on /diagnostics."""
    pairs = {"role": role, "process": process, **values}
    return [Status(name, OK, state, {key: json.dumps(value) for key, value in pairs.items()})]


def alarm(
    name: str, role: str, code: str, sentence: str, level: int = ERROR, *,
    since: str = "2021-07-20T05:00:30+00:00", **values: str,
) -> Status:
    """Return the status of an alarm on /alarms."""
    pairs = {
        "number": "1", "role": role, "code": code, "since": since,
        "serious": "true" if level != WARN else "false", **values,
    }
    return Status(name, level, sentence, {key: text for key, text in pairs.items() if text})


def pump(text: str, **values: Any) -> list[Status]:
    """Return what a pump node reports: a state with its reason; it is at rest unless given."""
    state, _, why = text.partition(": ")
    report = {"pump_state": state, "pump_why": why, "at_rest": True, **values}
    return node("/pump", "pump", **report)


def valve(text: str, **values: Any) -> list[Status]:
    """Return what a valve node reports: a state with its reason; it is closed unless given."""
    state, _, why = text.partition(": ")
    report = {"valve_state": state, "valve_why": why, "at_rest": True, "position": 0, "speed": 0.0}
    return node("/valve", "valve", **(report | values))


def store(
    mode: str = "simulated", site: Site = PAPER_SITE, *alarms: Status, steady: float = 100.0
) -> GraphStore:
    """Return a store that knows only the site of its graph, and its alarms at a time."""
    graph = GraphStore()
    graph.mode, graph.site, graph.site_note, graph.factor = mode, site, "", 30.0
    graph.steady, graph.system = steady, START / SECOND + 60
    graph.add_alarms(steady, alarms)
    return graph


def add_values(
    graph: GraphStore, first: int, last: int, values: Mapping[str, Any], every: int = 1
) -> None:
    """Add each topic's value, or its values, from one second to another (not included)."""
    seconds = range(first, last, every)
    for topic, value in values.items():
        for second, each in zip(seconds, np.broadcast_to(value, len(seconds)), strict=True):
            graph.add(topic, START + second * SECOND, float(each))


def rows(values: Any, front: Any = ()) -> Any:
    """Return rows of numbers as they are received, with the numbers before them."""
    return SimpleNamespace(values=np.asarray(values), front=np.asarray(front, float))


def add_plan(graph: GraphStore, second: int, *steps: tuple[float, float, float]) -> None:
    """Add a plan: of each step its end (s), flow (m3/s) and level (m); none fills the roof."""
    graph.add(PLAN, START + second * SECOND, rows([(*step, 0.0) for step in steps]))


def add_forecast(graph: GraphStore, second: int, rain: Any, hours: float = 12) -> None:
    """Add a forecast with growing steps, up to this many hours ahead."""
    front = [math.nan, *growing_steps(hours)[1:]]
    graph.add(RAIN_FORECAST, START + second * SECOND, rows(rain, front))


def fail(*_: Any, **__: Any) -> Any:
    """Stand for a part of the package with a bug."""
    raise ZeroDivisionError("a bug")


# --- the server, on real sockets, and clients that send raw bytes ---------------------------------


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


# --- messages on /diagnostics as anyone on the network may send them ------------------------------

TEXTS = st.text(max_size=30) | st.sampled_from([
    "/pump", "/pump: drive", "ready", "ended", "starting", "", ": ", "/", "\ud800\x00\u202e",
    "[" * 2000, "9" * 401, "1e999", "NaN", '"pump"', '"controller"', "{}", "[[1]]", '["x"]',
    '{"/a": 9' + "9" * 400 + "}", "null", "true", "-Infinity", "mqtt://\u202e/x", "1", "hold",
    '{"owner": "x", "since": 1e300, "until": -1e300}', '{"volume": 1e300, "delivered": -1e300}',
    "runs_on", "2021-07-20T05:00:30+00:00", "9999-12-31T23:59:59+00:00",
])
KEYS = st.sampled_from([
    "role", "process", "waiting", "failure", "up_s", "tick", "topics", "code", "age_s", "hold",
    "fault", "dose", "min_dose", "max_dose", "flow", "number", "since", "ended", "about", "follows",
])
STATUSES = st.lists(st.builds(
    Status, TEXTS, st.sampled_from(range(4)), TEXTS,
    st.dictionaries(KEYS | TEXTS, TEXTS, max_size=8), TEXTS,
), max_size=4)
