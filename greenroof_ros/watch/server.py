"""The page over HTTP: its files, what is pushed to it, and the two things that can be asked.

Whoever reaches the address may look, and may stop the pump; on another address than this machine's
own only with the token. What is asked for is looked up in a table: no path leads to a file. A page
of somebody else in the same browser can do nothing: a request has to name this host (so that no
name of somebody's that leads here is one), and to act it needs a header that only this page can
send. No connection can hold others up: there is a most of them and each has a time, and a browser
that does not read is skipped.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import math
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

from greenroof_ros.common.processes import InterruptedRun, Signals
from greenroof_ros.graph.looker import StopFailedError
from greenroof_ros.watch.charts_script import charts_script
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.listening import Place, listen
from greenroof_ros.watch.news import GZIP_HEAD, News, in_thread
from greenroof_ros.watch.watched import Watched

_PAGE = Path(__file__).resolve().parent / "page"
_TYPES = {
    ".html": "text/html", ".css": "text/css", ".js": "text/javascript",
}
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
# How long a stream's reader may take nothing before it has to connect anew (s).
_UNREAD_S = 30.0
# How often it is looked whether he has (s).
_TAKEN_S = 0.05
_BODY_S = 5.0
_MOST_BODY = 10_000
# The past that a series may have (h).
_LEAST_HOURS, _MOST_HOURS, _HOURS = 0.1, 168.0, 12.0


class _Refused(Exception):
    """A request is not answered; the message says why.

    Attributes:
        status: of HTTP.
    """

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


@dataclass
class _Connection:
    """One connection to the server.

    Attributes:
        transport: of it.
        since: when it was opened, or its last request was answered (steady clock, s).
        asked: whether it has sent a request.
        held: whether it is served now for as long as that takes.
        stream: what pushes to it.
    """

    transport: asyncio.Transport
    since: float
    asked: bool = False
    held: bool = False
    stream: asyncio.Task[Any] | None = None


class _Connections(web.Server):
    """A server that has room for another connection: one that is idle for longest goes."""

    def __init__(self, handler: Callable[[web.BaseRequest], Any]) -> None:
        # A request that cannot be read is answered, and is no news for the terminal.
        quiet = logging.getLogger(__name__)
        quiet.addHandler(logging.NullHandler())
        quiet.propagate = False
        super().__init__(
            handler, access_log=None, auto_decompress=False, keepalive_timeout=_NEXT_S,
            lingering_time=1.0, logger=quiet,
        )
        self.open: dict[web.RequestHandler, _Connection] = {}

    def connection_made(
        self, handler: web.RequestHandler, transport: asyncio.Transport
    ) -> None:
        """Take one, and drop another one for it where there is no room."""
        super().connection_made(handler, transport)
        self.open[handler] = _Connection(transport, time.monotonic())
        if len(self.open) > _MOST_CONNECTIONS:
            idle = (each for each, connection in self.open.items() if not connection.held)
            self._drop(min(idle, key=lambda each: self.open[each].since))

    def connection_lost(
        self, handler: web.RequestHandler, exc: BaseException | None = None
    ) -> None:
        """Forget one that has ended, and make room for another stream."""
        super().connection_lost(handler, exc)
        connection = self.open.pop(handler, None)
        if connection is not None and connection.stream is not None:
            connection.stream.cancel()

    @contextmanager
    def held(self, request: web.BaseRequest) -> Iterator[_Connection]:
        """Keep the connection of a request for as long as that is served."""
        connection = self.open.get(request.protocol)
        if connection is None:
            raise ConnectionResetError
        connection.held = True
        try:
            yield connection
        finally:
            connection.held = False
            connection.since = time.monotonic()

    def drop_idle(self) -> None:
        """End the connections that have had their time."""
        now = time.monotonic()
        for handler, each in list(self.open.items()):
            if not each.held and now - each.since > (_NEXT_S if each.asked else _FIRST_S):
                self._drop(handler)

    def _drop(self, handler: web.RequestHandler) -> None:
        """End a connection, and count it no longer: its end is heard of later."""
        self.open.pop(handler).transport.abort()


class _Site:
    """Answers requests."""

    def __init__(self, watched: Watched, feed: Feed, names: frozenset[str] | None,
                 token: str | None) -> None:
        self._watched = watched
        self._feed = feed
        self._names = names
        self._token = token
        self._files = {
            f"/{file.name}": (_TYPES[file.suffix], file.read_bytes())
            for file in _PAGE.iterdir() if file.suffix in _TYPES
        }
        self._files["/"] = self._files.pop("/index.html")
        self._charts: bytes | None = None
        self._charts_lock = asyncio.Lock()
        self._stopping: asyncio.Task[dict[str, Any]] | None = None
        self.news = News(watched)
        self.connections = _Connections(self._answer)

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        connection = self.connections.open.get(request.protocol)
        if connection is not None:
            connection.asked, connection.since = True, time.monotonic()
        try:
            self._refuse_other_hosts(request)
            if request.method == "GET":
                return await self._get(request)
            if request.method == "POST":
                return _said(await self._post(request))
            raise _Refused(405, "only GET and POST are answered")
        except _Refused as refusal:
            answer = _said({"ok": False, "sentence": str(refusal)}, refusal.status)
            answer.force_close()
            return answer

    def _refuse_other_hosts(self, request: web.BaseRequest) -> None:
        """Refuse a request that names another host than this one.

        A name of somebody's own that leads to this address would make his page one of this server's
        in a browser that shows it (DNS rebinding).
        """
        host = _host_of(request.headers.getall("Host", []))
        if self._names is not None and host not in self._names:
            raise _Refused(403, "this host is not known here; ask for localhost")

    def _refuse_strangers(self, request: web.BaseRequest) -> None:
        """Refuse a request without the token, where there is one."""
        given = request.headers.get("Authorization", "")
        if self._token is not None and not hmac.compare_digest(
            given.encode(errors="replace"), f"Bearer {self._token}".encode()
        ):
            raise _Refused(401, "the address needs its token: open it as it was printed")

    async def _get(self, request: web.BaseRequest) -> web.StreamResponse:
        path = request.path
        if path in self._files:
            kind, content = self._files[path]
            return web.Response(body=content, content_type=kind, charset="utf-8", headers=_HEADERS)
        if path == "/vega.js":
            return await self._charts_script()
        if path == "/events":
            self._refuse_strangers(request)
            return await self._stream(request)
        raise _Refused(404, "there is nothing here")

    async def _charts_script(self) -> web.Response:
        """Return Vega, which is looked for when it is first asked for."""
        async with self._charts_lock:
            if self._charts is None:
                try:
                    self._charts = await in_thread(charts_script)
                except (ImportError, OSError, subprocess.SubprocessError) as error:
                    raise _Refused(
                        503, "the charts need vl_convert: pip install 'greenroof_ros[watch]'"
                    ) from error
        headers = {**_HEADERS, "Content-Encoding": "gzip", "Cache-Control": "max-age=3600"}
        return web.Response(
            body=self._charts, content_type=_TYPES[".js"], charset="utf-8", headers=headers
        )

    async def _stream(self, request: web.BaseRequest) -> web.StreamResponse:
        """Push to one browser until it goes, or does not read."""
        hours = _hours(request.query.get("hours"))
        if self.news.readers >= _MOST_STREAMS:
            raise _Refused(503, "too many pages look on; close one")
        compressed = "gzip" in request.headers.get("Accept-Encoding", "")
        answer = web.StreamResponse(headers={
            **_HEADERS,
            "Content-Type": "text/event-stream; charset=utf-8",
            "X-Accel-Buffering": "no",  # nginx: hand on at once
            **({"Content-Encoding": "gzip"} if compressed else {}),
        })
        messages = self.news.messages(hours)
        with self.connections.held(request) as connection:
            connection.stream = asyncio.current_task()
            try:
                await answer.prepare(request)
                if compressed:
                    await answer.write(GZIP_HEAD)
                async for message in messages:
                    data = message.compressed if compressed else message.plain
                    await asyncio.wait_for(_sent(answer, data, connection.transport), _UNREAD_S)
            except (ConnectionError, asyncio.TimeoutError):
                connection.transport.abort()
            finally:
                connection.stream = None
                await messages.aclose()
        return answer

    async def _post(self, request: web.BaseRequest) -> dict[str, Any]:
        if request.path not in ("/acknowledge", "/stop"):
            raise _Refused(404, "there is nothing here")
        self._refuse_strangers(request)
        if request.headers.get("X-Greenroof") != "1" or _of_another_page(request.headers):
            raise _Refused(403, "only the page itself may ask for this")
        content = await _body(request)
        with self.connections.held(request):
            if request.path == "/stop":
                return await self._stop(request.remote or "")
            identity = content.get("id")
            if not isinstance(identity, str):
                raise _Refused(400, "id must be a text")
            known = await in_thread(lambda: self._watched.acknowledge(identity))
            return {"ok": known, "sentence": "" if known else "This alarm is not listed any more."}

    async def _stop(self, asker: str) -> dict[str, Any]:
        """Have the pump held off; who asks while that goes on gets the same answer."""
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.create_task(self._ask_to_stop(asker))
        return await asyncio.shield(self._stopping)

    async def _ask_to_stop(self, asker: str) -> dict[str, Any]:
        """Ask the pump node, and say how that went; whoever asked may be gone by then."""
        try:
            ok, sentence = True, await in_thread(self._feed.stop_pump)
        except StopFailedError as failure:
            ok, sentence = False, str(failure)
        event = f"Stop, from {asker}: {sentence}"
        await in_thread(lambda: self._watched.add_event(time.time(), event))
        return {"ok": ok, "sentence": sentence}


def _said(content: dict[str, Any], status: int = 200) -> web.Response:
    return web.Response(
        text=json.dumps(content), status=status, content_type="application/json", headers=_HEADERS
    )


def _host_of(headers: list[str]) -> str | None:
    """Return which host a request names, without its port: a tunnel has another one."""
    if len(headers) != 1:
        return None
    try:
        return urlsplit(f"//{headers[0]}").hostname
    except ValueError:
        return None


def _of_another_page(headers: Mapping[str, str]) -> bool:
    """Return whether a browser says that another site's page asks.

    Browsers do so by Sec-Fetch-Site, over plain HTTP to another machine by Origin alone.
    """
    site, origin = headers.get("Sec-Fetch-Site"), headers.get("Origin")
    if site is not None:
        return site != "same-origin"
    return origin is not None and origin.partition("://")[2] != headers.get("Host")


async def _sent(
    answer: web.StreamResponse, data: bytes, transport: asyncio.Transport
) -> None:
    """Send, and wait until all is on its way: what waits here becomes old."""
    await answer.write(data)
    while transport.get_write_buffer_size():
        await asyncio.sleep(_TAKEN_S)


def _hours(text: str | None) -> float:
    """Return how much of the past is asked for (h)."""
    try:
        hours = _HOURS if text is None else float(text)
    except ValueError:
        hours = math.nan
    if not _LEAST_HOURS <= hours <= _MOST_HOURS:
        raise _Refused(400, f"hours must be from {_LEAST_HOURS:g} to {_MOST_HOURS:g}")
    return hours


async def _body(request: web.BaseRequest) -> dict[str, Any]:
    """Read the JSON that a request carries."""
    too_large = _Refused(413, f"at most {_MOST_BODY} bytes are taken")
    if (request.content_length or 0) > _MOST_BODY:
        raise too_large
    try:
        # One more, to see whether there is one more.
        data = await asyncio.wait_for(_read(request, _MOST_BODY + 1), _BODY_S)
        if len(data) > _MOST_BODY:
            raise too_large
        content = json.loads(data)
    except asyncio.TimeoutError:
        raise _Refused(408, "the request did not come to its end") from None
    except (ValueError, RecursionError, web.RequestPayloadError):
        content = None
    if not isinstance(content, dict):
        raise _Refused(400, "must be a JSON object")
    return content


async def _read(request: web.BaseRequest, most: int) -> bytes:
    """Return the body of a request, at most so many bytes of it."""
    data = b""
    while len(data) < most:
        part = await request.content.read(most - len(data))
        if not part:
            break
        data += part
    return data


@asynccontextmanager
async def serving(
    watched: Watched, feed: Feed, place: Place, token: str | None
) -> AsyncIterator[None]:
    """Serve the page at a place, in the loop that runs."""
    site = _Site(watched, feed, place.names, token)
    loop = asyncio.get_running_loop()
    server = await loop.create_server(site.connections, sock=place.socket)
    tasks = [loop.create_task(site.news.renew()), loop.create_task(_drop_idle(site.connections))]
    try:
        yield
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        for connection in list(site.connections.open.values()):
            connection.transport.abort()


async def _drop_idle(connections: _Connections) -> None:
    while True:
        await asyncio.sleep(1.0)
        connections.drop_idle()


def serve(
    watched: Watched,
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
        watched: what is shown.
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
        async with serving(watched, feed, place, token):
            on_ready(place.url + (f"#token={token}" if token else ""))
            while True:
                signals.check()
                await asyncio.sleep(0.1)

    with suppress(InterruptedRun):
        asyncio.run(run())
