"""The page's server: what it answers, what it refuses, and that no client holds it up."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from graphs import wait_for
from page_inputs import pump as pump_says
from page_inputs import request, served
from page_inputs import valve as valve_says

from greenroof_ros.watch import server
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import RequestError
from greenroof_ros.watch.listening import LOOPBACK
from greenroof_ros.watch.store import GraphStore

ACT = {"X_Greenroof": "1"}
RIGHT = {**ACT, "Authorization": "Bearer secret"}
DOSE = b'{"volume": 0.2, "asked_at": 7}'


class Pump:
    """The pump node's answers, in place of a graph.

    Attributes:
        done: the requests that it was sent.
        answers: set to answer.
    """

    def __init__(self) -> None:
        self.done: list[tuple[str, dict[str, Any]]] = []
        self.answers = threading.Event()
        self.answers.set()
        self._one = threading.Lock()

    def request_action(self, action: str, **request: Any) -> str:
        with self._one:
            self.done.append((action, request))
            self.answers.wait(60)
            if action == "clear":
                raise RequestError("not this one")
            return f"{action} done"


@pytest.fixture
def pump(monkeypatch: pytest.MonkeyPatch) -> Pump:
    pump = Pump()
    monkeypatch.setattr(Feed, "request_action", pump.request_action)
    return pump


@pytest.fixture
def watched() -> GraphStore:
    """A store in which everything may be requested of a pump that is held and at rest."""
    store = GraphStore()
    store.steady = time.monotonic()
    store.add_statuses(time.monotonic() + 1e6, 0, pump_says(
        "held: x", hold={"owner": "x"}, fault="slow", no_clear="", max_dose=1.0, no_dose="",
    ))
    store.add_statuses(time.monotonic() + 1e6, 0, valve_says("closed: dry"))
    return store


@pytest.fixture
def port(watched: GraphStore, pump: Pump) -> Iterator[int]:
    with served(watched) as number:
        yield number


def test_the_page_and_its_files_come_as_they_are_and_may_do_nothing_else(port: int) -> None:
    for file in (Path(server.__file__).parent / "page").iterdir():
        answer = request(port, "GET", "/" if file.name == "index.html" else f"/{file.name}")
        if file.suffix == ".LICENSE":
            assert answer.status == 404
            continue
        assert (answer.status, answer.body) == (200, file.read_bytes())
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert "unsafe" not in policy and "http" not in policy
        assert not {"set-cookie", "access-control-allow-origin"} & answer.headers.keys()
    for target in ("/../server.py", "/%2e%2e/server.py", "//etc/passwd", "/index.html", "/stop"):
        assert request(port, "GET", target).status in (400, 404, 405), target


def test_a_document_is_sent_only_if_it_has_changed(port: int, watched: GraphStore) -> None:
    tag = request(port, "GET", "/state").headers["etag"]
    assert request(port, "GET", "/state", If_None_Match=f'"other", {tag}').status == 304
    watched.add("/roof/level", watched.system, 0.03)
    wait_for(
        lambda: request(port, "GET", "/state", If_None_Match=tag).status == 200, 60, "a new state"
    )


# ------------------------------------------------------------------------------------- refusals


def test_a_request_names_this_host(port: int) -> None:
    """Otherwise a foreign name that resolves to this host would share the page's origin."""
    for host, status in (
        ("LOCALHOST:9000", 200), ("127.0.0.1:8080", 200), ("[::1]:8080", 200),
        ("evil.example", 403), ("127.0.0.1.evil.example", 403), ("", 403), ("[", 403), (None, 400),
        ("localhost\r\nHost: evil.example", 400),
    ):
        assert request(port, "GET", "/", host=host).status == status, host


def test_only_the_page_itself_acts(watched: GraphStore, pump: Pump) -> None:
    """Another page cannot set the header, as nothing allows it to. A token is needed for all."""
    wrong = ({**ACT, "Authorization": given} for given in ("Bearer secrex", "secret", "\xe9"))
    for token, status, seen, refused, right in (
        (None, 403, 200, ({}, {"X_Greenroof": "0"}), ACT),
        ("secret", 401, 401, (ACT, *wrong), RIGHT),
    ):
        with served(watched, token) as port:
            for headers in refused:
                assert request(port, "POST", "/stop", **headers).status == status, headers
                assert request(port, "GET", "/state", **headers).status == seen
            answer = request(port, "OPTIONS", "/stop", **ACT, Origin="http://evil.example")
            assert not any(name.startswith("access-control") for name in answer.headers)
            assert pump.done == []
            assert request(port, "GET", "/state", **right).status == 200
            assert request(port, "POST", "/stop", **right).json()["sentence"] == "stop done"
        assert pump.done.pop() == ("stop", {"owner": "the page"})


def test_nothing_else_is_done_unless_that_was_allowed_with_a_token(
    watched: GraphStore, pump: Pump
) -> None:
    """Behind a proxy every request seems to come from this machine. Nor is a dose without numbers.

    Nor is anything that the pump node's report does not allow now.
    """
    for allowed, token, status in (
        (False, "secret", 403), (True, None, 403), (True, "secret", 200),
    ):
        watched.allow_release = allowed
        with served(watched, token) as port:
            assert request(port, "POST", "/valve_close", **RIGHT).status == 200
            assert pump.done.pop() == ("valve_close", {"owner": "the page"})
            for action in ("release", "clear", "dose", "valve_open"):
                assert request(port, "POST", f"/{action}", DOSE, **RIGHT).status == status
    assert pump.done.pop() == ("valve_open", {"owner": "the page"})
    assert pump.done == [("release", {}), ("clear", {}), ("dose", {"volume": 0.2, "asked_at": 7.0})]
    with served(watched, "secret") as port:
        for wrong in (b"{", b"[]", b"[" * 9000, b'{"volume": 1}'):
            assert request(port, "POST", "/dose", wrong, **RIGHT).status == 400, wrong
        watched.nodes.clear()
        assert request(port, "POST", "/release", **RIGHT).status == 403
    assert len(pump.done) == 3


def test_a_stop_goes_before_all_else(watched: GraphStore, pump: Pump) -> None:
    """What is requested while it waits is not done after it, which would undo it.

    It waits for one other action at most; many stops at a time are one.
    """
    watched.allow_release = True
    pump.answers.clear()
    with served(watched, "secret") as port, ThreadPoolExecutor(30) as askers:
        asked = []
        for action in ("clear", "release", "stop", "dose", "release", *["stop"] * 20):
            asked.append((action, askers.submit(
                request, port, "POST", f"/{action}", DOSE, **RIGHT
            )))
            time.sleep(0.1)
        pump.answers.set()
        answers = [(action, done.result().json()["sentence"]) for action, done in asked]
    assert [action for action, _ in pump.done] == ["clear", "stop"]
    refused = "Nothing was done: another request is under way."
    assert answers == [
        ("clear", "not this one"), ("release", refused), ("stop", "stop done"), ("dose", refused),
        ("release", refused), *[("stop", "stop done")] * 20,
    ]


POST = b"POST /stop HTTP/1.1\r\nHost: localhost\r\nX-Greenroof: 1\r\n"
BROKEN = [
    b"\0" * 5000, b"GET / HTTP/9.9\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 20_000 + b"\r\n",
    POST + b"Content-Length: -1\r\n\r\n",
    POST + b"Content-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n{}",
]


def test_hostile_clients_stop_nothing_and_keep_no_stop_away(port: int, pump: Pump) -> None:
    """Hundreds that send nothing, many requests or broken ones, and read no answer."""
    many = [100 * f"GET /{path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
            for path in ("uPlot.js", "state", "charts?hours=168", "nowhere")]
    with ExitStack() as stack:
        for data in 50 * [b"", *many, *BROKEN]:
            connection = stack.enter_context(socket.socket())
            with suppress(OSError):
                connection.settimeout(5.0)
                connection.connect((LOOPBACK, port))
                connection.setblocking(False)
                connection.send(data)
        assert pump.done == []
        for _ in range(3):
            assert request(port, "POST", "/stop", **ACT).status == 200
    assert pump.done == [("stop", {"owner": "the page"})] * 3
