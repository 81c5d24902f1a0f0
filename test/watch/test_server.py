"""The page's server: what it answers, what it refuses, and that no client holds it up."""

from __future__ import annotations

import gzip
import resource
import socket
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from graphs import wait_for
from page_inputs import SECOND, fail
from page_server import Answer, read_state, request, send, served

from greenroof_ros.watch import feed, server
from greenroof_ros.watch.document import make_document, make_series
from greenroof_ros.watch.listening import LOOPBACK
from greenroof_ros.watch.store import GraphStore

ACT = {"X_Greenroof": "1"}
RIGHT = {**ACT, "Authorization": "Bearer secret"}
GET, POST = (
    f"{method} HTTP/1.1\r\nHost: localhost\r\nX-Greenroof: 1\r\n".encode()
    for method in ("GET /state", "POST /stop")
)


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """No node answers here: a stop request must report that soon."""
    monkeypatch.setattr(feed, "_STOP_S", 0.5)


@pytest.fixture
def watched() -> GraphStore:
    return GraphStore()


@pytest.fixture
def port(watched: GraphStore) -> Iterator[int]:
    with served(watched) as number:
        yield number


def shown(watched: GraphStore) -> dict[str, Any]:
    return make_document(watched, time.monotonic())


def assert_goes_on(port: int) -> None:
    """Check that the server answers a new client."""
    assert request(port, "GET", "/").status == 200


# ------------------------------------------------------------------------------------- the page


def test_the_page_and_its_files_come_as_they_are_and_may_do_nothing_else(port: int) -> None:
    for file in (Path(server.__file__).parent / "page").iterdir():
        if file.name == "uPlot.LICENSE":
            assert request(port, "GET", f"/{file.name}").status == 404
            continue
        target = "/" if file.name == "index.html" else f"/{file.name}"
        answer = request(port, "GET", target)
        assert (answer.status, answer.body) == (200, file.read_bytes())
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self';")
        assert "unsafe" not in policy and "http" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cache-control"] == "no-store"
        assert not {"set-cookie", "access-control-allow-origin"} & answer.headers.keys()


# ------------------------------------------------------------------------------------- refusals


def test_no_path_leads_anywhere_else(port: int) -> None:
    for target in (
        "/../server.py", "/%2e%2e/server.py", "/..%2fserver.py", "/..\\server.py", "//etc/passwd",
        "/%2fetc%2fpasswd", "/page.js/../../server.py", "/page.js%00.html", "/server.py",
        "/index.html", "*", "/stop", "/" + "a" * 5000,
    ):
        answer = request(port, "GET", target)
        assert answer.status in (400, 404, 405), target
        assert b"import" not in answer.body and b"root:" not in answer.body
    assert_goes_on(port)


def test_a_request_names_this_host(port: int) -> None:
    """Otherwise a foreign name that resolves to this host would share the page's origin."""
    for host, status in (
        ("LOCALHOST:9000", 200), ("127.0.0.1:8080", 200), ("[::1]:8080", 200),
        ("evil.example", 403), ("127.0.0.1.evil.example", 403), ("192.168.0.1", 403), ("", 403),
        ("[", 403), (None, 400), ("localhost\r\nHost: evil.example", 400),
    ):
        for target in ("/", "/page.js"):
            assert request(port, "GET", target, host=host).status == status, host


@pytest.mark.parametrize(("token", "status", "refused", "right"), [
    (None, 403, (
        {}, {"X_Greenroof": "0"}, {**ACT, "Origin": "http://evil.example"},
        {**ACT, "Origin": "null"}, {**ACT, "Origin": "http://localhost:1"},
        {**ACT, "Sec_Fetch_Site": "same-site", "Origin": "http://localhost"},
    ), {**ACT, "Origin": "http://localhost", "Sec_Fetch_Site": "same-origin"}),
    ("secret", 401, (ACT, *({**ACT, "Authorization": given} for given in (
        "Bearer ", "Bearer secrex", "secret", "Bearer secr\xe9t", "Bearer " + "a" * 5000,
    ))), RIGHT),
], ids=["without-token", "with-token"])
def test_only_the_page_itself_acts(
    token: str | None, status: int, refused: tuple[dict[str, str], ...], right: dict[str, str],
    watched: GraphStore,
) -> None:
    """With a token nothing is shown without it; the page itself contains no secret."""
    with served(watched, token) as port:
        for headers in refused:
            answer = request(port, "POST", "/stop", b"{}", **headers)
            assert (answer.status, answer.json()["ok"]) == (status, False), headers
            if token:
                assert request(port, "GET", "/state", **headers).status == status
        assert shown(watched)["events"] == []
        assert request(port, "GET", "/").status == 200
        assert request(port, "GET", "/state", **right).status == 200
        assert request(port, "POST", "/stop", b"{}", **right).status == 200
    (event,) = shown(watched)["events"]
    assert event["what"].startswith("Stop, from ")


def test_a_stop_that_did_not_take_hold_reports_it_and_many_are_one(
    port: int, watched: GraphStore
) -> None:
    """No request waits for the others."""
    begun = time.monotonic()
    with ExitStack() as stack:
        for _ in range(20):
            asker = stack.enter_context(socket.create_connection((LOOPBACK, port)))
            asker.sendall(POST + b"Content-Length: 2\r\n\r\n{}")
        answer = request(port, "POST", "/stop", b"{}", **ACT)
        assert time.monotonic() - begun < 20
    assert answer.status == 200
    assert answer.json() == {
        "ok": False,
        "sentence":
            "The watcher is busy, so no request was sent to the pump node and nothing was done.",
    }
    (event,) = shown(watched)["events"]
    assert "Stop, from 127.0.0.1" in event["what"]


def test_nothing_is_released_unless_that_was_allowed_with_a_token(watched: GraphStore) -> None:
    """Behind a proxy every request seems to come from this machine."""
    body, actions = f'{{"volume": 0.2, "asked_at": {time.time()}}}'.encode(), ("release", "clear",
                                                                              "dose")
    for allowed, token, status in (
        (False, "secret", 403), (True, None, 403), (True, "secret", 200),
    ):
        watched.allow_release = allowed
        with served(watched, token) as port:
            for action in actions:
                assert request(port, "POST", f"/{action}", body, **RIGHT).status == status
                if token:
                    assert request(port, "POST", f"/{action}", body, **ACT).status == 401
                another = {**RIGHT, "Sec_Fetch_Site": "cross-site"}
                assert request(port, "POST", f"/{action}", body, **another).status == 403
    said = [event["what"].partition(",")[0] for event in reversed(shown(watched)["events"])]
    assert said == [action.capitalize() for action in actions]


def test_who_asks_for_a_stop_after_a_release_does_not_join_the_stop_before_it(
    watched: GraphStore
) -> None:
    """Otherwise the earlier stop would answer it, and the release would be the last action."""
    watched.allow_release = True
    with served(watched, "secret") as port, ThreadPoolExecutor() as askers:
        for action in ("stop", "stop", "release", "stop"):
            askers.submit(request, port, "POST", f"/{action}", b"{}", **RIGHT)
            time.sleep(0.3)
        askers.shutdown()
    said = [event["what"].partition(",")[0] for event in shown(watched)["events"]]
    assert sorted(said) == ["Release", "Stop", "Stop"]


def test_a_dose_without_volume_or_time_is_refused(watched: GraphStore) -> None:
    watched.allow_release = True
    with served(watched, "secret") as port:
        for name, unit in (("volume", "m3"), ("asked_at", "s")):
            for wrong in ('"0.2"', "true", "1" + 400 * "0"):
                body = {"volume": "0.2", "asked_at": "1.0"} | {name: wrong}
                text = ", ".join(f'"{key}": {value}' for key, value in body.items())
                answer = request(port, "POST", "/dose", f"{{{text}}}".encode(), **RIGHT)
                assert (answer.status, answer.json()["sentence"]) == (
                    400, f"{name} must be a number ({unit})"
                ), wrong
    assert shown(watched)["events"] == []


def test_what_reports_nothing_is_refused(port: int) -> None:
    """A body that is not an object with a text, impossible hours, and any other method."""
    for method in ("PUT", "OPTIONS", "HEAD", "BREW"):
        answer = request(port, method, "/stop", **ACT, Origin="http://evil.example")
        assert answer.status in (400, 404, 405)
        assert not any(name.startswith("access-control") for name in answer.headers)
    for body in (b"", b"{", b"[]", b"\xff\xfe", b"[" * 9000, b"1" * 9000):
        assert request(port, "POST", "/stop", body, **ACT).status == 400, body[:20]
    for hours in ("-1", "nan", "5", "1_2", "x", ""):
        assert request(port, "GET", f"/charts?hours={hours}").status == 400, hours
    assert_goes_on(port)


# -------------------------------------------------------------------------------- too much load


def test_a_body_of_100_megabytes_is_refused_unread(port: int) -> None:
    length = b"Content-Length: 100000000\r\n\r\n"
    # It is refused at once, without a byte of the body.
    assert Answer(send(port, POST + b"Connection: close\r\n" + length)).status == 413
    chunk = b"f4240\r\n" + bytes(1_000_000) + b"\r\n"
    packed = gzip.compress(bytes(9_500_000))  # this is not unpacked
    assert len(packed) < 10_000
    before = _memory()
    with socket.create_connection((LOOPBACK, port), timeout=300) as connection:
        connection.sendall(POST + b"Transfer-Encoding: chunked\r\n\r\n")
        with suppress(ConnectionError, TimeoutError):
            for _ in range(100):
                connection.sendall(chunk)
    answer = request(port, "POST", "/stop", packed, **ACT, Content_Encoding="gzip")
    assert answer.status == 400
    assert _memory() - before < 9e6
    assert_goes_on(port)


def test_a_body_that_does_not_come_is_waited_for_only_some_time(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_BODY_S", 0.5)
    begun = time.monotonic()
    assert Answer(send(port, POST + b"Content-Length: 10\r\n\r\n{")).status == 408
    assert time.monotonic() - begun < 5


BROKEN = [
    b"\0" * 5000, b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: local\0host\r\n\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # TLS
    b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 20_000 + b"\r\n",
    b"GET /" + b"a" * 1_000_000 + b" HTTP/1.1\r\n\r\n",
    POST + b"Content-Length: -1\r\n\r\n",
    POST + b"Content-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n{}",
    POST + b"Transfer-Encoding: chunked\r\n\r\nzzzz\r\n",
    GET + b"Upgrade: websocket\r\nConnection: Upgrade\r\n\r\n\x81\xfe\xff\xff\xff\xff",
]


def test_broken_requests_stop_nothing(
    port: int, watched: GraphStore, capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nor do they keep other clients away, all at the same time."""
    monkeypatch.setattr(server, "_ANSWER_S", 1.0)
    with ExitStack() as stack:
        connections = []
        for data in BROKEN:
            connection = socket.create_connection((LOOPBACK, port), timeout=300)
            connections.append(stack.enter_context(connection))
            with suppress(ConnectionError):
                connection.sendall(data)
        assert_goes_on(port)
        for connection in connections:
            with suppress(ConnectionError):
                connection.recv(1 << 16)
    assert shown(watched)["events"] == []  # nothing was stopped
    assert "Traceback" not in capfd.readouterr().err


HOSTILE = {
    "silent": b"", "half a request": b"GET / HT",
    "endless body": POST + b"Content-Length: 9\r\n\r\n{",
    "unread answers": 300 * b"GET /uPlot.js HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "unread states": 300 * (GET + b"\r\n"), "broken": b"GET\r\n\r\n",
}


@pytest.mark.parametrize("data", HOSTILE.values(), ids=HOSTILE)
def test_hostile_connections_keep_no_stop_away(
    data: bytes, port: int, watched: GraphStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three times the permitted number, none of which reads; an open page continues."""
    monkeypatch.setattr(server, "_ANSWER_S", 1.0)
    before, memory = _open_files(), _memory()
    with ExitStack() as stack:
        hostile = []
        for number in range(3 * server._MAX_CONNECTIONS):
            connection = socket.create_connection((LOOPBACK, port), timeout=300)
            hostile.append(stack.enter_context(connection))
            connection.settimeout(0.0)
            with suppress(OSError):  # no room for all of it, or it was ended
                connection.sendall(data)
            if number % 100 == 0:
                began = time.monotonic()
                assert request(port, "POST", "/stop", b"{}", **ACT).status == 200
                assert time.monotonic() - began < 5  # 1.5 s of them without a pump node
        assert _open_files() - before - len(hostile) <= server._MAX_CONNECTIONS + 10
        assert _memory() - memory < 50e6
        watched.update(time.monotonic())
        watched.add("/roof/level", SECOND, 0.03)
        wait_for(
            lambda: read_state(port)["tiles"]["roof"]["number"] == 0.03, 60, "the newest level"
        )
        wait_for(lambda: not _count_open(port, hostile), 60, "the end of all")


def test_too_many_open_files_are_one_line(port: int, capfd: pytest.CaptureFixture[str]) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as connection:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (connection.fileno() + 1, hard))
            connection.connect((LOOPBACK, port))
            time.sleep(2.0)  # it has tried again
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert connection.recv(12) == b"HTTP/1.1 200"
    assert capfd.readouterr().err == "no connection can be accepted: Too many open files\n"


# ---------------------------------------------------------------------------------- the documents


def test_documents_are_made_once_for_all_and_sent_only_if_they_have_changed(
    watched: GraphStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state at most twice a second, and the charts every 2 s, whoever asks."""
    made: list[Any] = []

    def document(store: GraphStore, wall: float) -> dict[str, Any]:
        made.append("state")
        return make_document(store, wall)

    def series(store: GraphStore, hours: float) -> dict[str, Any]:
        made.append("charts")
        return make_series(store, hours)

    monkeypatch.setattr(server, "make_document", document)
    monkeypatch.setattr(server, "make_series", series)
    with served(watched) as port, ThreadPoolExecutor(8) as pages:
        begun = time.monotonic()
        asked = ["/state", "/charts?hours=3"] * 40
        first, *others = pages.map(lambda path: request(port, "GET", path), asked)
        lasted = time.monotonic() - begun
        assert {answer.status for answer in (first, *others)} == {200}
        assert made.count("state") <= lasted / 0.5 + 1
        assert made.count("charts") <= lasted / 2 + 1
        for _ in range(20):  # until the state stays the same between two requests
            tag = request(port, "GET", "/state").headers["etag"]
            known = request(port, "GET", "/state", If_None_Match=f'"other", {tag}')
            if known.status == 304:
                break
        assert (known.status, known.body, known.headers["etag"]) == (304, b"", tag)
        watched.update(time.monotonic())
        watched.add("/roof/level", SECOND, 0.03)
        changed = wait_for(
            lambda: (answer := request(port, "GET", "/state", If_None_Match=tag)).status == 200
            and answer, 60, "a new state",
        )
        assert changed.json()["tiles"]["roof"]["number"] == 0.03
        assert (changed.headers["cache-control"], changed.headers["etag"] == tag) == (
            "no-cache", False
        )


def test_a_document_that_cannot_be_made_is_reported(
    port: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Rather than an old one being sent; the stop and the other document go on."""
    monkeypatch.setattr(server, "make_series", fail)
    answer = request(port, "GET", "/charts?hours=12")
    assert (answer.status, answer.json()["sentence"]) == (500, "ZeroDivisionError: a bug")
    # Another thread writes it.
    wait_for(lambda: "a bug" in capfd.readouterr().err, 60, "the report")
    assert read_state(port)["mode"] == "none"
    assert request(port, "POST", "/stop", b"{}", **ACT).status == 200


def _count_open(port: int, connections: Iterable[socket.socket]) -> int:
    """Return how many the server has not closed; data may still be on its way."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    here = {
        remote.partition(":")[2] for _, local, remote, state, *_ in lines
        if local.endswith(f":{port:04X}") and state == "01"
    }
    return len(here & {f"{connection.getsockname()[1]:04X}" for connection in connections})


def _open_files() -> int:
    return len([*Path("/proc/self/fd").iterdir()])


def _memory() -> int:
    """Return the resident memory of this process (bytes)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096
