"""HTTP server for the page: its files, two documents that it polls, and the actions it can request.

Anyone who can reach the address can view the page, stop the pump and close the outlet valve. If a
token has been set, it is required for all of this. The page can release a hold only if releasing
was allowed when the server was started; this requires a token. The page can then also open the
valve, clear a fault that does not require a person at the pump and, if the site file allows doses,
request a dose.

Every path is a fixed route; no path is looked up in the file system. Other pages in the same
browser cannot make requests: a request must name this host (and not another name that resolves to
its address), and an action needs a header that only this page can send. No connection can block the
others: their number is limited, and a new one closes the oldest one. Each of the two documents, the
state and the charts, is made once for all browsers, and has an ETag, so that what has not changed
is not sent again.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import math
import time
import traceback
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from aiohttp import ETag, web

from greenroof_ros.base.processes import Signals
from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.base.text import clean_text
from greenroof_ros.watch.document import HOURS, describe_stop, make_document, make_series
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import HOLDS, RequestError
from greenroof_ros.watch.listening import Listener
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
# For how long the server rests if no connection can be accepted (s).
_RETRY_S = 0.5
# For how long a document is current (s).
_CURRENT_S = 0.5

# The documents: the state, and the charts by the length of their history (h).
_DOCUMENTS = {"/state": 0} | {f"/charts?hours={hours}": hours for hours in HOURS}
_DOCUMENT_PATHS = "/state", "/charts"

_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class PageServer:
    """The page's server, which always accepts new connections, dropping the oldest if needed.

    A new connection therefore has time for its request until a hundred others have connected. A
    stop request gets through, no matter how many clients connect and whether or not they send or
    read data.
    """

    def __init__(
        self, store: GraphStore, feed: Feed, listener: Listener, token: str | None
    ) -> None:
        """Prepare the server without accepting connections.

        Args:
            store: state of the graph to show.
            feed: feed of the store, through which the pump is stopped.
            listener: where to serve the page.
            token: the token that a page must send; None if no token is required.
        """
        self._store, self._feed = store, feed
        self._listener, self._token = listener, token
        self._acting: dict[str, asyncio.Task[str]] = {}  # by action
        # The state (at 0) and the charts for each length of their history (h), made once for all
        # browsers, each with the time at which it was begun.
        self._documents: dict[int, tuple[float, asyncio.Task[tuple[bytes, ETag]]]] = {}
        # The open connections, the oldest first; True while the pump node's answer is awaited.
        self._open: dict[web.RequestHandler, bool] = {}
        self._app = web.Application(middlewares=[self._answer_all])
        for file in _PAGE.iterdir():
            if file.suffix in _TYPES:
                path = "/" if file.name == "index.html" else f"/{file.name}"
                self._app.router.add_get(path, _make_file_handler(file), allow_head=False)
        for path in _DOCUMENT_PATHS:
            self._app.router.add_get(path, self._read_document, allow_head=False)
        for action in ("stop", "release", "clear", "dose"):
            self._app.router.add_post(f"/{action}", self._act)
        for action in ("close", "release", "open"):
            self._app.router.add_post(f"/valve_{action}", self._act)

    def serve(self, signals: Signals) -> None:
        """Serve the page until a signal arrives.

        Raises:
            InterruptedRun: if a signal arrives.
        """
        asyncio.run(self._serve(signals))

    async def _serve(self, signals: Signals) -> None:
        runner = web.AppRunner(
            self._app, access_log=None, auto_decompress=False, handler_cancellation=True,
            lingering_time=1.0, shutdown_timeout=1.0,
            # A request that cannot be read is answered, but not reported on the terminal.
            logger=logging.Logger("page", logging.CRITICAL),
        )
        await runner.setup()
        assert runner.server is not None
        accepting = asyncio.create_task(self._accept(runner.server))
        try:
            while True:
                signals.check()
                await asyncio.sleep(0.1)
        finally:
            accepting.cancel()
            await asyncio.gather(accepting, return_exceptions=True)
            self._listener.socket.close()
            await runner.cleanup()

    async def _accept(self, server: web.Server) -> None:
        """Accept connections one after another, until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(self._listener.socket)
            except OSError as error:  # the system has run out of files or memory
                print_seldom("accept", f"no connection can be accepted: {error.strerror}")
                await asyncio.sleep(_RETRY_S)
                continue
            self._open = {each: kept for each, kept in self._open.items() if each.transport}
            if len(self._open) >= _MAX_CONNECTIONS:
                oldest = min(self._open, key=self._open.__getitem__)
                del self._open[oldest]
                if oldest.transport is not None:
                    oldest.transport.abort()
            # Until it is made, earlier requests are answered.
            with suppress(OSError):
                _, handler = await loop.connect_accepted_socket(server, connection)
                self._open[handler] = False

    # --- access ---------------------------------------------------------------------------------

    @web.middleware
    async def _answer_all(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Answer every request, if need be with what failed, and close its connection then.

        The page then keeps its stop button, and does not present old values as current.
        """
        try:
            self._check(request)
            answer = await handler(request)
        except RequestError as failure:
            answer = _make_response(False, str(failure))
        except web.HTTPException as error:
            answer = _make_response(False, error.reason, error.status)
        except Exception as error:
            print_seldom("request", traceback.format_exc())
            answer = _make_response(False, f"{type(error).__name__}: {error}", 500)
        answer.force_close()
        return answer

    def _check(self, request: web.Request) -> None:
        """Reject a request that names a host other than this one, or that comes from another page.

        If the name of another host resolved to this address, a browser would treat a page from that
        host as a page of this server (DNS rebinding).
        """
        names = self._listener.names
        if names is not None and _read_host(request) not in names:
            raise web.HTTPForbidden(
                reason="the host name in the address is not recognized; use localhost"
            )
        if request.method == "POST" or request.path in _DOCUMENT_PATHS:
            given = request.headers.get("Authorization", "")
            if self._token is not None and not hmac.compare_digest(
                given.encode(errors="replace"), f"Bearer {self._token}".encode()
            ):
                raise web.HTTPUnauthorized(
                    reason="the address is not valid without its token; open it exactly as printed"
                )
            if request.method == "POST" and request.headers.get("X-Greenroof") != "1":
                raise web.HTTPForbidden(reason="only the page itself may make this request")

    # --- answers --------------------------------------------------------------------------------

    async def _read_document(self, request: web.Request) -> web.Response:
        """Send a document, unless the browser has already received it as it is."""
        hours = _DOCUMENTS.get(request.path_qs)
        if hours is None:
            raise web.HTTPBadRequest(reason=f"the documents are {', '.join(_DOCUMENTS)}")
        begun_at, task = self._documents.get(hours, (-math.inf, None))
        age = time.monotonic() - begun_at
        if task is None or (task.done() and age >= _CURRENT_S):
            task = asyncio.create_task(asyncio.to_thread(self._make_document, hours))
            self._documents[hours] = time.monotonic(), task
        body, tag = await asyncio.shield(task)  # others wait for it as well
        known = tag in (request.if_none_match or ())
        answer = web.Response(
            status=304 if known else 200, body=None if known else body,
            content_type="application/json", headers=_HEADERS | {"Cache-Control": "no-cache"},
        )
        answer.etag = tag
        return answer

    def _make_document(self, hours: int) -> tuple[bytes, ETag]:
        """Return a document as JSON, and the tag that changes with its content."""
        store = self._store
        content = make_series(store, hours) if hours else make_document(store, time.monotonic())
        # Broken UTF-8 is escaped; a number that JSON does not know would be a bug.
        body = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        return body, ETag(hashlib.sha256(body).hexdigest())

    async def _act(self, request: web.Request) -> web.Response:
        """Carry out an action on the pump or the valve.

        A stop that is requested while one is under way gets the answer to that one. Any other
        action is refused while one is under way, so nothing is done after a stop that was requested
        before it, and a stop waits for one other action at most, and the closing of the valve.
        """
        action = request.path[1:]
        name = action.removeprefix("valve_")
        if name not in HOLDS:
            with self._store.lock:
                offered = describe_stop(self._store)["actions"]
            # Behind a proxy, every request comes from this machine, so it needs a token.
            if self._token is None or action not in offered:
                raise web.HTTPForbidden(reason="this action is not offered now")
        given: dict[str, Any] = {"owner": "the page"} if name in (*HOLDS, "open") else {}
        if action == "dose":
            try:
                body = json.loads(await request.read())
                given = {name: float(body[name]) for name in ("volume", "asked_at")}
            except (LookupError, TypeError, ValueError, OverflowError, RecursionError):
                reason = "volume (m3) and asked_at (s) must be numbers"
                raise web.HTTPBadRequest(reason=reason) from None
        under_way = {name for name, task in self._acting.items() if not task.done()}
        if name not in HOLDS and under_way:
            return _make_response(False, "Nothing was done: another request is under way.")
        if action not in under_way:
            self._acting[action] = asyncio.create_task(
                asyncio.to_thread(self._feed.request_action, action, **given)
            )
        if request.transport is not None:
            request.transport.pause_reading()  # nothing else is answered on this connection
        self._open[request.protocol] = True
        return _make_response(True, await asyncio.shield(self._acting[action]))


def _make_file_handler(file: Path) -> _Handler:
    """Return a handler that sends a file of the page as it was when the server started."""
    content, kind = file.read_bytes(), _TYPES[file.suffix]

    async def send(_: web.Request) -> web.Response:
        return web.Response(body=content, content_type=kind, charset="utf-8", headers=_HEADERS)

    return send


def _make_response(ok: bool, sentence: str, status: int = 200) -> web.Response:
    return web.json_response(
        {"ok": ok, "sentence": clean_text(sentence)}, status=status, headers=_HEADERS
    )


def _read_host(request: web.Request) -> str | None:
    """Return the host name in a request without the port, which differs behind a tunnel."""
    with suppress(ValueError):
        return urlsplit(f"//{request.host}").hostname
    return None
