"""The page over HTTP: its files, what is pushed to it, and the things that can be asked.

Whoever reaches the address may look, and may stop the pump; where there is a token, only with that.
What was stopped here may be released here where that was allowed, which needs a token; and with it,
where the site file allows doses, a dose may be given.
Each path is a route, and none leads to a file. A page of somebody else in the same browser can do
nothing: a request has to name this host (so that no name of somebody's that leads here is one), and
to act it needs a header that only this page can send. No connection can hold others up: there is a
most of them and each has a time, and a browser that does not read is skipped.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import time
import traceback
import zlib
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

from greenroof_ros.common.processes import InterruptedRun, Signals
from greenroof_ros.graph.looker import StopFailedError
from greenroof_ros.watch.document import LEAST_HOURS, MOST_HOURS, document, series
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.listening import Place, listen
from greenroof_ros.watch.store import Store

_PAGE = Path(__file__).resolve().parent / "page"
_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
# Nothing but what this server sends, and no script or style within a page's own text.
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
# Connections at a time, and of these streams. A browser has up to six.
_MOST_CONNECTIONS = 128
_MOST_STREAMS = 32
# How long a connection may take for its first request, and for each answer and the next one (s).
_FIRST_S, _NEXT_S = 10.0, 60.0
# How long a stream's reader may take nothing before it has to connect again (s).
_UNREAD_S = 30.0
# How often it is looked whether he has (s).
_TAKEN_S = 0.05
_BODY_S = 5.0
_MOST_BODY = 10_000
_HOURS = "12"
# How often the document and the series are made (s); a page that hears nothing for longer than the
# third has lost its connection.
_STATE_S, _SERIES_S, _AT_LEAST_S = 0.5, 2.0, 5.0
# The head of a gzip file without name and time (RFC 1952).
GZIP_HEAD = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"

_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


# --- what is pushed: made once for all, and never queued for one that is slow --------------------


class Message:
    """One server-sent event, as it is and compressed.

    Compressed ones can follow a :data:`GZIP_HEAD` in any choice and order, so that each is
    compressed once for all readers: none refers to an earlier one, and each ends with a full flush.

    Attributes:
        plain: as it is.
        compressed: raw deflate.
        made: when (steady clock, s).
        looked: when it was last made, and found to be what still holds.
    """

    def __init__(self, name: str, content: dict[str, Any]) -> None:
        # Broken UTF-8 is escaped, and a number that JSON does not have is a mistake here.
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        self.plain = f"event: {name}\ndata: {text}\n\n".encode()
        press = zlib.compressobj(wbits=-zlib.MAX_WBITS)
        self.compressed = press.compress(self.plain) + press.flush(zlib.Z_FULL_FLUSH)
        self.made = self.looked = time.monotonic()


class News:
    """The document and the series, made again while somebody reads them.

    A reader gets what is newest when it has taken what it got before. What came in between is gone,
    so that a thousand slow ones need no more memory than one.

    Attributes:
        readers: how many read.
    """

    def __init__(self, store: Store) -> None:
        """Make nothing yet.

        Args:
            store: what is shown.
        """
        self.readers = 0
        self._store = store
        self._newest: dict[str | float, Message] = {}  # by name, of series by their hours
        self._making = asyncio.Lock()

    async def messages(self, hours: float) -> AsyncGenerator[Message, None]:
        """Yield news as they come, the newest only.

        What cannot be made is printed, and ends every stream: a page says then that it is not
        connected, rather than showing something old as if it were now.

        Args:
            hours: of the past in the series; 0 for the summary alone, of a page that nobody sees.
        """
        wanted: tuple[str | float, ...] = ("state", hours) if hours else ("summary",)
        sent: dict[str | float, Message] = {}
        self.readers += 1
        try:
            while True:
                for key in wanted:
                    message = await self._made(key)
                    if message is None:
                        return
                    if sent.get(key) is not message:
                        sent[key] = message
                        yield message
                await asyncio.sleep(_STATE_S)
        finally:
            self.readers -= 1

    async def _made(self, key: str | float) -> Message | None:
        """Return the newest message, which is made once for all readers; None if it cannot be."""
        async with self._making:
            now, lasts = time.monotonic(), _STATE_S if isinstance(key, str) else _SERIES_S
            self._newest = {  # what was made for others who have gone is let go of
                name: message for name, message in self._newest.items()
                if now - message.looked < _AT_LEAST_S
            }
            old = self._newest.get(key)
            if old is not None and now - old.looked < lasts:
                return old
            try:
                new = await asyncio.to_thread(self._make, key)
            except Exception:
                traceback.print_exc()
                return None
            if old is not None and old.plain == new.plain and new.made - old.made < _AT_LEAST_S:
                old.looked, new = new.made, old  # it says nothing else
            self._newest[key] = new
            return new

    def _make(self, key: str | float) -> Message:
        if not isinstance(key, str):
            return Message("series", series(self._store, key))
        shown = document(self._store, time.monotonic())
        return Message(key, shown if key == "state" else shown["tiles"]["summary"])


# --- who is served -------------------------------------------------------------------------------


class _Connections:
    """The connections of a server: where there is no room, the one idle for longest goes."""

    def __init__(self, server: web.Server) -> None:
        self._server = server
        # When each has to have its next request (steady clock, s); None while one is answered.
        self._until: dict[web.RequestHandler, float | None] = {}
        self._open: set[web.RequestHandler] = set()  # as they were seen last

    def accept(self) -> web.RequestHandler:
        """Make what handles another connection, for asyncio."""
        self._forget_closed()
        if len(self._until) >= _MOST_CONNECTIONS:  # those just accepted count, too
            idle = {handler: at for handler, at in self._until.items() if at is not None}
            if idle:
                self._drop(min(idle, key=idle.__getitem__))
        handler = self._server()
        self._until[handler] = time.monotonic() + _FIRST_S
        return handler

    async def answer(
        self, request: web.Request, call: Awaitable[web.StreamResponse]
    ) -> web.StreamResponse:
        """Keep the connection of a request for as long as that is answered."""
        self._until[request.protocol] = None
        try:
            return await call
        finally:
            self._until[request.protocol] = time.monotonic() + _NEXT_S

    async def drop_idle(self) -> None:
        """End for ever the connections that have had their time."""
        while True:
            await asyncio.sleep(1.0)
            self._forget_closed()
            now = time.monotonic()
            for handler, until in list(self._until.items()):
                if until is not None and until < now:
                    self._drop(handler)

    def drop_all(self) -> None:
        """End all of them."""
        for handler in list(self._until):
            self._drop(handler)

    def _forget_closed(self) -> None:
        """Forget those that were closed; one that was just accepted is not yet open."""
        before, self._open = self._open, set(self._server.connections)
        for handler in before - self._open:
            self._until.pop(handler, None)

    def _drop(self, handler: web.RequestHandler) -> None:
        del self._until[handler]
        if handler.transport is not None:
            handler.transport.abort()


class _Site:
    """Answers requests."""

    def __init__(
        self, store: Store, feed: Feed, names: frozenset[str] | None, token: str | None
    ) -> None:
        self._store, self._feed = store, feed
        self._names, self._token = names, token
        self._acting: dict[str, asyncio.Task[tuple[bool, str]]] = {}
        self._newest: asyncio.Task[tuple[bool, str]] | None = None
        self.connections: _Connections | None = None
        self.news = News(store)
        self.app = web.Application(
            middlewares=[self._refusals, self._this_host_alone], client_max_size=_MOST_BODY
        )
        for file in _PAGE.iterdir():
            if file.suffix in _TYPES:
                path = "/" if file.name == "index.html" else f"/{file.name}"
                self.app.router.add_get(path, _sends(file), allow_head=False)
        self.app.router.add_get("/events", self._events, allow_head=False)
        for action in ("stop", "release", "clear", "dose"):
            self.app.router.add_post(f"/{action}", self._act)
        self.app.router.add_post("/acknowledge", self._acknowledge)

    # --- who may ask ----------------------------------------------------------------------------

    @web.middleware
    async def _refusals(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Say in a sentence why a request is refused."""
        assert self.connections is not None
        try:
            return await self.connections.answer(request, handler(request))
        except web.HTTPException as error:
            answer = _said(False, error.reason, error.status)
            answer.force_close()
            return answer

    @web.middleware
    async def _this_host_alone(
        self, request: web.Request, handler: _Handler
    ) -> web.StreamResponse:
        """Refuse a request that names another host than this one, or that another page makes.

        A name of somebody's own that leads to this address would make his page one of this server's
        in a browser that shows it (DNS rebinding).
        """
        if self._names is not None and _host_of(request) not in self._names:
            raise web.HTTPForbidden(reason="this host is not known here; ask for localhost")
        if request.method == "POST" or request.path == "/events":
            given = request.headers.get("Authorization", "")
            if self._token is not None and not hmac.compare_digest(
                given.encode(errors="replace"), f"Bearer {self._token}".encode()
            ):
                raise web.HTTPUnauthorized(
                    reason="the address needs its token: open it as it was printed"
                )
            own = request.method == "GET" or request.headers.get("X-Greenroof") == "1"
            if not own or _of_another_page(request):
                raise web.HTTPForbidden(reason="only the page itself may ask for this")
        return await handler(request)

    # --- what is answered -----------------------------------------------------------------------

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """Push to one browser until it goes, or does not read."""
        hours = _hours(request.query.get("hours", _HOURS))
        if self.news.readers >= _MOST_STREAMS:
            raise web.HTTPServiceUnavailable(reason="too many pages look on; close one")
        compressed = "gzip" in request.headers.get("Accept-Encoding", "")
        answer = web.StreamResponse(headers={
            **_HEADERS,
            "Content-Type": "text/event-stream; charset=utf-8",
            "X-Accel-Buffering": "no",  # nginx: hand on at once
            **({"Content-Encoding": "gzip"} if compressed else {}),
        })
        transport, messages = request.transport, self.news.messages(hours)
        try:
            await answer.prepare(request)
            if compressed:
                await answer.write(GZIP_HEAD)
            async for message in messages:
                data = message.compressed if compressed else message.plain
                await asyncio.wait_for(_sent(answer, data, transport), _UNREAD_S)
        except (ConnectionError, asyncio.TimeoutError):
            if transport is not None:
                transport.abort()
        finally:
            await messages.aclose()
        return answer

    async def _acknowledge(self, request: web.Request) -> web.Response:
        identity = (await _body(request)).get("id")
        if not isinstance(identity, str):
            raise web.HTTPBadRequest(reason="id must be a text")
        known = await asyncio.to_thread(self._store.acknowledge, identity)
        return _said(known, "" if known else "This alarm is not listed any more.")

    async def _act(self, request: web.Request) -> web.Response:
        """Have the pump held off or released; who asks while that goes on gets the same answer.

        But for a dose: of two, who asked first has one.
        """
        body, action, given = await _body(request), request.path[1:], dict[str, float]()
        if action != "stop" and not (self._store.allow_release and self._token):
            raise web.HTTPForbidden(
                reason="nothing is released here: see greenroof watch --allow-release"
            )
        if action == "dose":
            given = {
                "volume": _number(body, "volume", "m3"), "asked_at": _number(body, "asked_at", "s"),
            }
        task = self._acting.get(action)
        # Nobody joins a stop that a release was asked for after.
        if task is None or task.done() or (task is not self._newest and not given):
            task = asyncio.create_task(self._ask(action, given, request.remote or ""))
            self._acting[action] = self._newest = task
        elif given:
            return _said(False, "Another dose was asked for a moment ago.")
        return _said(*await asyncio.shield(task))

    async def _ask(
        self, action: str, given: dict[str, float], asker: str
    ) -> tuple[bool, str]:
        """Ask the pump node, and say how that went; whoever asked may be gone by then."""
        try:
            ok, sentence = True, await asyncio.to_thread(self._feed.ask, action, **given)
        except StopFailedError as failure:
            ok, sentence = False, str(failure)
        event = f"{action.capitalize()}, from {asker}: {sentence}"
        await asyncio.to_thread(self._store.add_event, time.time(), event)
        return ok, sentence


def _sends(file: Path) -> _Handler:
    """Return what sends a file of the page, as it is when the server starts."""
    content, kind = file.read_bytes(), _TYPES[file.suffix]

    async def send(_: web.Request) -> web.Response:
        return web.Response(body=content, content_type=kind, charset="utf-8", headers=_HEADERS)

    return send


def _said(ok: bool, sentence: str, status: int = 200) -> web.Response:
    return web.json_response(
        {"ok": ok, "sentence": sentence}, status=status, headers=_HEADERS
    )


def _host_of(request: web.Request) -> str | None:
    """Return which host a request names, without its port: a tunnel has another one."""
    headers = request.headers.getall("Host", [])
    with suppress(ValueError):
        return urlsplit(f"//{headers[0]}").hostname if len(headers) == 1 else None
    return None


def _of_another_page(request: web.Request) -> bool:
    """Return whether a browser says that another site's page asks.

    Browsers do so by Sec-Fetch-Site, over plain HTTP to another machine by Origin alone.
    """
    site, origin = (request.headers.get(name) for name in ("Sec-Fetch-Site", "Origin"))
    if site is not None:
        return site != "same-origin"
    return origin is not None and origin.partition("://")[2] != request.headers.get("Host")


async def _sent(
    answer: web.StreamResponse, data: bytes, transport: asyncio.Transport | None
) -> None:
    """Send, and wait until all is on its way: what waits here becomes old."""
    await answer.write(data)
    while transport is not None and transport.get_write_buffer_size():
        await asyncio.sleep(_TAKEN_S)


def _number(body: Mapping[str, object], name: str, unit: str) -> float:
    """Return a number of a dose that is asked for; what it may be, the pump node knows."""
    value = body.get(name)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        with suppress(OverflowError):
            return float(value)
    raise web.HTTPBadRequest(reason=f"{name} must be a number ({unit})")


def _hours(text: str) -> float:
    """Return how much of the past is asked for (h); 0 for the summary alone."""
    with suppress(ValueError):
        hours = float(text)
        if hours == 0 or LEAST_HOURS <= hours <= MOST_HOURS:
            return hours
    raise web.HTTPBadRequest(
        reason=f"hours must be from {LEAST_HOURS:g} to {MOST_HOURS:g}, or 0"
    )


async def _body(request: web.Request) -> dict[str, Any]:
    """Read the JSON that a request carries."""
    if (request.content_length or 0) > _MOST_BODY:
        raise web.HTTPRequestEntityTooLarge(_MOST_BODY)
    try:
        content = json.loads(await asyncio.wait_for(request.read(), _BODY_S))
    except asyncio.TimeoutError:
        raise web.HTTPRequestTimeout(reason="the request did not come to its end") from None
    except (ValueError, RecursionError, web.RequestPayloadError):
        content = None
    if not isinstance(content, dict):
        raise web.HTTPBadRequest(reason="must be a JSON object")
    return content


@asynccontextmanager
async def serving(
    store: Store, feed: Feed, place: Place, token: str | None
) -> AsyncIterator[None]:
    """Serve the page at a place, in the loop that runs."""
    site, loop = _Site(store, feed, place.names, token), asyncio.get_running_loop()
    # A request that cannot be read is answered, and is no news for the terminal.
    quiet = logging.getLogger(__name__)
    quiet.addHandler(logging.NullHandler())
    quiet.propagate = False
    runner = web.AppRunner(
        site.app, access_log=None, auto_decompress=False, handler_cancellation=True,
        keepalive_timeout=_NEXT_S, lingering_time=1.0, logger=quiet, shutdown_timeout=1.0,
    )
    await runner.setup()
    assert runner.server is not None
    site.connections = connections = _Connections(runner.server)
    server = await loop.create_server(connections.accept, sock=place.socket)
    dropping = loop.create_task(connections.drop_idle())
    try:
        yield
    finally:
        server.close()
        dropping.cancel()
        connections.drop_all()
        await runner.cleanup()


def serve(
    store: Store,
    feed: Feed,
    *,
    host: str,
    port: int | None,
    token: str | None,
    on_ready: Callable[[str], None],
    signals: Signals,
) -> None:
    """Serve the page until a signal comes.

    Args:
        store: what is shown.
        feed: stops the pump.
        host: address or name to listen on.
        port: TCP port; 0 for any that is free, None for the first free one from 8080 on.
        token: that a page must send; None for none.
        on_ready: is given the address for a browser, with the token, once the page can be had.
        signals: that end it.

    Raises:
        ConfigurationError: the address or the port is not to be had.
    """
    async def run() -> None:
        place = listen(host, port)
        async with serving(store, feed, place, token):
            on_ready(place.url + (f"#token={token}" if token else ""))
            while True:
                signals.check()
                await asyncio.sleep(0.1)

    with suppress(InterruptedRun):
        asyncio.run(run())
