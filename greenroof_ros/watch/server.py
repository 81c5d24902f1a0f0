"""HTTP server for the page: its files, two documents that it polls, and the actions it can request.

Anyone who can reach the address can view the page and stop the pump. If a token has been set, it is
required for both. The page can release a hold only if releasing was allowed when the server
was started; this requires a token. The page can then also clear a fault that does not require a
person at the pump and, if the site file allows doses, request a dose.

Every path is a fixed route; no path is looked up in the file system. Other pages in the same
browser cannot make requests: a request must name this host (and not another name that resolves to
its address), and an action needs a header that only this page can send. No connection can block the
others: the number of connections is limited, and each has a time limit. Each of the two documents,
the state and the charts, is made once for all browsers, and has an ETag, so that what has not
changed is not sent again.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import math
import socket
import time
import traceback
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from aiohttp import ETag, web

from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.base.text import clean_text
from greenroof_ros.watch import words
from greenroof_ros.watch.document import HOURS, make_document, make_series
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import PumpRequestError
from greenroof_ros.watch.listening import Listener, listen
from greenroof_ros.watch.store import GraphStore

_PAGE = Path(__file__).resolve().parent / "page"
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
# Only what this server sends, and no inline scripts or styles.
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
# Maximum number of connections at a time. A browser opens up to six.
_MAX_CONNECTIONS = 128
# Longest time in which a connection may send its request and read the whole answer (s).
_ANSWER_S = 30.0
# For how long the server rests if no connection can be accepted (s).
_RETRY_S = 0.5
_BODY_S = 5.0
_MAX_BODY = 10_000
# For how long a document is current (s).
_STATE_S, _CHARTS_S = 0.5, 2.0

_STATE, _CHARTS = _DOCUMENTS = "/state", "/charts"

_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


# --- the documents -------------------------------------------------------------------------------


class _Document(NamedTuple):
    """A document as JSON, and the tag that changes with its content."""

    body: bytes
    tag: ETag


class _Documents:
    """The state, and the charts for each length of their history, made once for all browsers."""

    def __init__(self, store: GraphStore) -> None:
        self._store = store
        self._newest: dict[float | None, tuple[float, asyncio.Task[_Document]]] = {}

    async def read(self, hours: float | None = None) -> _Document:
        """Return the current state or, if the length of the history (h) is given, the charts."""
        made_at, task = self._newest.get(hours, (-math.inf, None))
        age = time.monotonic() - made_at
        if task is None or (task.done() and age >= (_STATE_S if hours is None else _CHARTS_S)):
            task = asyncio.create_task(asyncio.to_thread(self._make, hours))
            self._newest[hours] = time.monotonic(), task
        return await asyncio.shield(task)  # others wait for it as well

    def _make(self, hours: float | None) -> _Document:
        """Make a document; if that fails, print why, and answer requests for it with the reason.

        The page then keeps its stop button, and does not present old values as current.
        """
        try:
            content = (
                make_document(self._store, time.monotonic()) if hours is None
                else make_series(self._store, hours)
            )
            # Broken UTF-8 is escaped; a number that JSON does not know would be a bug.
            body = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        except Exception as error:
            print_seldom("document", traceback.format_exc())
            reason = clean_text(f"{type(error).__name__}: {error}", 200)
            raise web.HTTPInternalServerError(reason=reason) from error
        return _Document(body, ETag(hashlib.sha256(body).hexdigest()))


# --- connections ---------------------------------------------------------------------------------


class _Connections:
    """The connections of a server that always accepts new ones, dropping the oldest if needed.

    A new connection therefore has time for its request until a hundred others have connected. A
    stop request gets through, no matter how many clients connect and whether or not they send or
    read data.
    """

    def __init__(self, server: web.Server) -> None:
        self._server = server
        # Time by which each must have its whole answer (steady clock, s), the oldest first.
        self._until: dict[web.RequestHandler, float] = {}

    async def accept(self, listening: socket.socket) -> None:
        """Accept connections one after another, until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(listening)
            except OSError as error:  # the system has run out of files or memory
                print_seldom("accept", f"no connection can be accepted: {error.strerror}")
                await asyncio.sleep(_RETRY_S)
                continue
            self._make_room()
            # Until it is made, earlier requests are answered.
            with suppress(OSError):
                _, handler = await loop.connect_accepted_socket(self._server, connection)
                self._until[handler] = time.monotonic() + _ANSWER_S

    def _make_room(self) -> None:
        self._until = {
            handler: until for handler, until in self._until.items() if handler.transport
        }
        if len(self._until) >= _MAX_CONNECTIONS:
            self._drop(min(self._until, key=self._until.__getitem__))

    @contextmanager
    def keep(self, request: web.Request) -> Iterator[None]:
        """Suspend a connection's time limit during the response, and read nothing more from it."""
        if request.transport is not None:
            request.transport.pause_reading()
        self._until[request.protocol] = math.inf
        try:
            yield
        finally:
            self._until[request.protocol] = time.monotonic() + _ANSWER_S

    async def drop_overdue(self) -> None:
        """Periodically close connections that take too long."""
        while True:
            await asyncio.sleep(1.0)
            now = time.monotonic()
            for handler in [handler for handler, until in self._until.items() if until < now]:
                self._drop(handler)

    def drop_all(self) -> None:
        """End all connections."""
        for handler in list(self._until):
            self._drop(handler)

    def _drop(self, handler: web.RequestHandler) -> None:
        del self._until[handler]
        if handler.transport is not None:
            handler.transport.abort()


class _PageApplication:
    def __init__(
        self, store: GraphStore, feed: Feed, names: frozenset[str] | None, token: str | None
    ) -> None:
        self._store, self._feed = store, feed
        self._names, self._token = names, token
        self._acting: dict[str, asyncio.Task[tuple[bool, str]]] = {}
        self._newest: asyncio.Task[tuple[bool, str]] | None = None
        self.connections: _Connections  # once it is served
        self._documents = _Documents(store)
        self.app = web.Application(
            middlewares=[self._refusals, self._check_origin], client_max_size=_MAX_BODY
        )
        for file in _PAGE.iterdir():
            if file.suffix in _TYPES:
                path = "/" if file.name == "index.html" else f"/{file.name}"
                self.app.router.add_get(path, _make_file_handler(file), allow_head=False)
        for document in _DOCUMENTS:
            self.app.router.add_get(document, self._read_document, allow_head=False)
        for action in ("stop", "release", "clear", "dose"):
            self.app.router.add_post(f"/{action}", self._act)

    # --- access ---------------------------------------------------------------------------------

    @web.middleware
    async def _refusals(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Answer a rejected request with the reason; close every connection after its answer."""
        try:
            answer = await handler(request)
        except web.HTTPException as error:
            answer = _make_response(False, error.reason, error.status)
        answer.force_close()
        return answer

    @web.middleware
    async def _check_origin(
        self, request: web.Request, handler: _Handler
    ) -> web.StreamResponse:
        """Reject a request that names a host other than this one, or that comes from another page.

        If the name of another host resolved to this address, a browser would treat a page from that
        host as a page of this server (DNS rebinding).
        """
        if self._names is not None and _read_host(request) not in self._names:
            raise web.HTTPForbidden(
                reason="the host name in the address is not recognized; use localhost"
            )
        if request.method == "POST" or request.path in _DOCUMENTS:
            given = request.headers.get("Authorization", "")
            if self._token is not None and not hmac.compare_digest(
                given.encode(errors="replace"), f"Bearer {self._token}".encode()
            ):
                raise web.HTTPUnauthorized(
                    reason="the address is not valid without its token; open it exactly as printed"
                )
            own = request.method == "GET" or request.headers.get("X-Greenroof") == "1"
            if not own or _is_of_another_page(request):
                raise web.HTTPForbidden(reason="only the page itself may make this request")
        return await handler(request)

    # --- answers --------------------------------------------------------------------------------

    async def _read_document(self, request: web.Request) -> web.Response:
        """Send a document, unless the browser has already received it as it is."""
        hours = None if request.path == _STATE else _read_hours(request.query.get("hours", ""))
        document = await self._documents.read(hours)
        known = document.tag in (request.if_none_match or ())
        answer = web.Response(
            status=304 if known else 200, body=None if known else document.body,
            content_type="application/json", headers=_HEADERS | {"Cache-Control": "no-cache"},
        )
        answer.etag = document.tag
        return answer

    async def _act(self, request: web.Request) -> web.Response:
        """Carry out an action on the pump; a request repeated meanwhile gets the same answer.

        Doses are an exception: if a dose is requested twice, only the first request is carried out.
        """
        body, action, given = await _read_body(request), request.path[1:], dict[str, float]()
        if action != "stop" and not (self._store.allow_release and self._token):
            raise web.HTTPForbidden(
                reason="this page may only stop the pump; to allow other actions, start "
                "greenroof watch with --allow-release"
            )
        if action == "dose":
            given = {
                "volume": _read_number(body, "volume", "m3"),
                "asked_at": _read_number(body, "asked_at", "s"),
            }
        task = self._acting.get(action)
        # A request joins the one under way only if no other action has been requested since.
        if task is None or task.done() or (task is not self._newest and not given):
            task = asyncio.create_task(self._request_action(action, given, request.remote or ""))
            self._acting[action] = self._newest = task
        elif given:
            return _make_response(False, "Another dose was requested a moment ago.")
        with self.connections.keep(request):
            return _make_response(*await asyncio.shield(task))

    async def _request_action(
        self, action: str, given: dict[str, float], asker: str
    ) -> tuple[bool, str]:
        """Request an action from the pump node; return the result, even if the client is gone."""
        try:
            request = {"owner": "the page"} if action == "stop" else given
            answer = await asyncio.to_thread(self._feed.request_action, action, **request)
            ok, sentence = True, answer
        except PumpRequestError as failure:
            ok, sentence = False, str(failure)
        except Exception as error:
            print_seldom(action, traceback.format_exc())
            ok = False
            sentence = (
                "It is unknown whether the request was carried out: the watcher failed "
                f"({type(error).__name__}: {error})."
            )
        sentence = words.clean_sentence(sentence)
        event = f"{action.capitalize()}, from {asker}: {sentence}"
        await asyncio.to_thread(self._store.add_event, event)
        return ok, sentence


def _make_file_handler(file: Path) -> _Handler:
    """Return a handler that sends a file of the page as it was when the server started."""
    content, kind = file.read_bytes(), _TYPES[file.suffix]

    async def send(_: web.Request) -> web.Response:
        return web.Response(body=content, content_type=kind, charset="utf-8", headers=_HEADERS)

    return send


def _make_response(ok: bool, sentence: str, status: int = 200) -> web.Response:
    return web.json_response(
        {"ok": ok, "sentence": sentence}, status=status, headers=_HEADERS
    )


def _read_host(request: web.Request) -> str | None:
    """Return the host name in a request without the port, which differs behind a tunnel."""
    headers = request.headers.getall("Host", [])
    with suppress(ValueError):
        return urlsplit(f"//{headers[0]}").hostname if len(headers) == 1 else None
    return None


def _is_of_another_page(request: web.Request) -> bool:
    """Return whether, according to the browser, the request comes from a page of another site.

    Browsers report the origin of a request in Sec-Fetch-Site, but over plain HTTP to another
    machine only in Origin.
    """
    site, origin = (request.headers.get(name) for name in ("Sec-Fetch-Site", "Origin"))
    if site is not None:
        return site != "same-origin"
    return origin is not None and origin.partition("://")[2] != request.headers.get("Host")


def _read_number(body: Mapping[str, object], name: str, unit: str) -> float:
    """Return a number from a request for a dose; the pump node checks the range."""
    try:
        return Range().check(body.get(name))
    except ValueError as error:
        raise web.HTTPBadRequest(reason=f"{name} {error} ({unit})") from None


def _read_hours(text: str) -> int:
    """Return the requested length of the history (h)."""
    if text not in map(str, HOURS):
        raise web.HTTPBadRequest(reason=f"hours must be one of {', '.join(map(str, HOURS))}")
    return int(text)


async def _read_body(request: web.Request) -> dict[str, Any]:
    if (request.content_length or 0) > _MAX_BODY:
        raise web.HTTPRequestEntityTooLarge(_MAX_BODY)
    try:
        content = json.loads(await asyncio.wait_for(request.read(), _BODY_S))
    except TimeoutError:
        raise web.HTTPRequestTimeout(reason="the request was not completed within 5 s") from None
    except (ValueError, RecursionError, web.RequestPayloadError):
        content = None
    if not isinstance(content, dict):
        raise web.HTTPBadRequest(reason="the request must be a JSON object")
    return content


@asynccontextmanager
async def run_server(
    store: GraphStore, feed: Feed, listener: Listener, token: str | None
) -> AsyncIterator[None]:
    """Serve the page on a listener, in the running event loop."""
    site, loop = _PageApplication(store, feed, listener.names, token), asyncio.get_running_loop()
    # A request that cannot be read is answered, but not reported on the terminal.
    quiet = logging.getLogger(__name__)
    quiet.addHandler(logging.NullHandler())
    quiet.propagate = False
    runner = web.AppRunner(
        site.app, access_log=None, auto_decompress=False, handler_cancellation=True,
        lingering_time=1.0, logger=quiet, shutdown_timeout=1.0,
    )
    await runner.setup()
    assert runner.server is not None
    site.connections = connections = _Connections(runner.server)
    tasks = [
        loop.create_task(work)
        for work in (connections.accept(listener.socket), connections.drop_overdue())
    ]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        listener.socket.close()
        connections.drop_all()
        await runner.cleanup()


def serve(
    store: GraphStore,
    feed: Feed,
    *,
    host: str,
    port: int | None,
    token: str | None,
    on_ready: Callable[[str], None],
    signals: Signals,
) -> None:
    """Serve the page until a signal arrives.

    Args:
        store: state of the graph to show.
        feed: feed of the store, through which the pump is stopped.
        host: address or name on which to listen.
        port: TCP port; 0 for any free port, None for the first free port from 8080 on.
        token: the token that a page must send; None if no token is required.
        on_ready: callback that receives the address for a browser, including the token, once the
            page is served.
        signals: signals that stop the server.

    Raises:
        ConfigurationError: if the address or the port cannot be used.
    """
    async def run() -> None:
        listener = listen(host, port)
        async with run_server(store, feed, listener, token):
            on_ready(listener.url + (f"#token={token}" if token else ""))
            while True:
                signals.check()
                await asyncio.sleep(0.1)

    with suppress(InterruptedRun):
        asyncio.run(run())
