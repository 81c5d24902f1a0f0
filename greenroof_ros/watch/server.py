"""HTTP server for the page: files, pushed events, and the actions that the page can request.

Anyone who can reach the address can view the page and stop the pump. If a token has been set, it is
required for both. The page can release a hold only if releasing was allowed when the server
was started; this requires a token. The page can then also clear a fault that does not require a
person at the pump and, if the site file allows doses, request a dose.

Every path is a fixed route; no path is looked up in the file system. Other pages in the same
browser cannot make requests: a request must name this host (and not another name that resolves to
its address), and an action needs a header that only this page can send. No connection can block the
others: the number of connections is limited, each has a time limit, and a browser that does not
read its data is skipped.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import math
import select
import socket
import time
import traceback
import zlib
from collections.abc import (
    AsyncGenerator,
    AsyncIterator,
    Awaitable,
    Callable,
    Iterator,
    Mapping,
)
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.base.ranges import Range, read_number
from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.watch import words
from greenroof_ros.watch.document import HOURS, make_document, make_series
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import PumpRequestError
from greenroof_ros.watch.listening import Listener, listen
from greenroof_ros.watch.parts import Parts
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
# Maximum number of connections at a time, and of streams among them. A browser opens up to six.
_MAX_CONNECTIONS = 128
_MAX_STREAMS = 32
# Longest time in which a connection may send its request and read the whole answer (s).
_ANSWER_S = 30.0
# For how long the server rests if no connection can be accepted (s).
_RETRY_S = 0.5
# For how long a stream's reader may take nothing before it is disconnected (s).
_UNREAD_S = 30.0
# Interval at which that is checked (s).
_DRAIN_S = 0.05
_BODY_S = 5.0
_MAX_BODY = 10_000
_HOURS = "12"
# Intervals at which the document and the series are made, and at which they are sent even if
# unchanged (s): a page that receives nothing for longer than that has lost its connection.
_STATE_S, _SERIES_S, _RENEW_S = 0.5, 2.0, 5.0
# The head of a gzip file without name and time (RFC 1952).
GZIP_HEAD = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"

_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


# --- what is pushed: made once for all readers, and never queued for a slow one ------------------


class ServerEvent:
    """One server-sent event, both plain and compressed.

    Each event is compressed once for all readers. Compressed events can follow a :data:`GZIP_HEAD`
    in any order, since no event refers to an earlier event and each event ends with a full flush.

    Attributes:
        plain: the event without compression.
        compressed: the event as raw deflate data.
        made_at: time at which the event was made (steady clock, s).
        checked_at: time at which the event was last found unchanged (steady clock, s).
    """

    def __init__(self, name: str, content: dict[str, Any]) -> None:
        # Broken UTF-8 is escaped; a number that JSON does not know would be a bug of this package.
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        self.plain = f"event: {name}\ndata: {text}\n\n".encode()
        press = zlib.compressobj(wbits=-zlib.MAX_WBITS)
        self.compressed = press.compress(self.plain) + press.flush(zlib.Z_FULL_FLUSH)
        self.made_at = self.checked_at = time.monotonic()


class EventStream:
    """A stream of events with the document and the series, updated while there are readers.

    A reader receives the latest event as soon as it has read the previous one. Intermediate events
    are dropped, so a thousand slow readers need no more memory than a single reader.

    Attributes:
        readers: number of readers.
    """

    def __init__(self, store: GraphStore) -> None:
        """Start without events.

        Args:
            store: state of the graph to show.
        """
        self.readers = 0
        self._store = store
        self._newest: dict[str | float, ServerEvent] = {}  # by name; series by their hours
        self._making = asyncio.Lock()

    async def events(self, hours: float) -> AsyncGenerator[ServerEvent, None]:
        """Yield new events as they are made, skipping all but the latest.

        Charts that cannot be made are replaced by an error message. If no document can be made at
        all, the error is printed and every stream ends. The page then keeps its stop button, and
        reports that it is not connected, rather than presenting old values as current.

        Args:
            hours: length of the history in the series (h).
        """
        wanted: tuple[str | float, ...] = ("state", hours)
        sent: dict[str | float, ServerEvent] = {}
        self.readers += 1
        try:
            while True:
                for key in wanted:
                    event = await self._newest_event(key)
                    if event is None:
                        return
                    if sent.get(key) is not event:
                        sent[key] = event
                        yield event
                await asyncio.sleep(_STATE_S)
        finally:
            self.readers -= 1

    async def _newest_event(self, key: str | float) -> ServerEvent | None:
        """Return the latest event, made once for all readers; None if it cannot be made."""
        async with self._making:
            now, lifetime = time.monotonic(), _STATE_S if isinstance(key, str) else _SERIES_S
            self._newest = {  # events for readers who have gone are dropped
                name: event for name, event in self._newest.items()
                if now - event.checked_at < _RENEW_S
            }
            old = self._newest.get(key)
            if old is not None and now - old.checked_at < lifetime:
                return old
            try:
                new = await asyncio.to_thread(self._build_event, key)
            except Exception:
                print_seldom("event", traceback.format_exc())
                return None
            if old is not None and old.plain == new.plain and (
                new.made_at - old.made_at < _RENEW_S
            ):
                old.checked_at, new = new.made_at, old  # nothing has changed
            self._newest[key] = new
            return new

    def _build_event(self, key: str | float) -> ServerEvent:
        if not isinstance(key, str):
            parts = Parts()
            content = parts.make("Series", lambda: make_series(self._store, key), {})
            return ServerEvent("series", content or {"problem": parts.failed["Series"]})
        return ServerEvent(key, make_document(self._store, time.monotonic()))


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

    def drop_gone(self) -> bool:
        """Close one open connection whose reader is gone or reads nothing; return False if none."""
        for handler, until in self._until.items():
            transport = handler.transport
            if until < math.inf or transport is None:
                continue
            poll = select.poll()
            poll.register(transport.get_extra_info("socket"), select.POLLRDHUP)
            if poll.poll(0) or transport.get_write_buffer_size():
                self._drop(handler)
                return True
        return False

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
        self.event_stream = EventStream(store)
        self.app = web.Application(
            middlewares=[self._refusals, self._check_origin], client_max_size=_MAX_BODY
        )
        for file in _PAGE.iterdir():
            if file.suffix in _TYPES:
                path = "/" if file.name == "index.html" else f"/{file.name}"
                self.app.router.add_get(path, _make_file_handler(file), allow_head=False)
        self.app.router.add_get("/events", self._events, allow_head=False)
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
        if request.method == "POST" or request.path == "/events":
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

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """Push events to one browser until it disconnects or stops reading."""
        hours = _read_hours(request.query.get("hours", _HOURS))
        if self.event_stream.readers >= _MAX_STREAMS and not self.connections.drop_gone():
            raise web.HTTPServiceUnavailable(reason="too many pages are open; close one")
        compressed = "gzip" in request.headers.get("Accept-Encoding", "")
        answer = web.StreamResponse(headers={
            **_HEADERS,
            "Content-Type": "text/event-stream; charset=utf-8",
            "X-Accel-Buffering": "no",  # nginx: pass on immediately
            **({"Content-Encoding": "gzip"} if compressed else {}),
        })
        transport, events = request.transport, self.event_stream.events(hours)
        try:
            await answer.prepare(request)
            if compressed:
                await answer.write(GZIP_HEAD)
            with self.connections.keep(request):
                async for event in events:
                    data = event.compressed if compressed else event.plain
                    await asyncio.wait_for(_send(answer, data, transport), _UNREAD_S)
        except (TimeoutError, ConnectionError):
            if transport is not None:
                transport.abort()
        finally:
            await events.aclose()
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


async def _send(
    answer: web.StreamResponse, data: bytes, transport: asyncio.Transport | None
) -> None:
    """Send data, and wait until the buffer, where data would become outdated, is empty."""
    await answer.write(data)
    while transport is not None and transport.get_write_buffer_size():
        await asyncio.sleep(_DRAIN_S)


def _read_number(body: Mapping[str, object], name: str, unit: str) -> float:
    """Return a number from a request for a dose; the pump node checks the range."""
    try:
        return Range().check(body.get(name))
    except ValueError as error:
        raise web.HTTPBadRequest(reason=f"{name} {error} ({unit})") from None


def _read_hours(text: str) -> float:
    """Return the requested length of the history (h)."""
    with suppress(ValueError):
        hours = read_number(text)
        if hours in HOURS:
            return hours
    raise web.HTTPBadRequest(reason=f"hours {HOURS.expected()}")


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
