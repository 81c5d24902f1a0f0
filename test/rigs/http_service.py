"""A simulated service on the web: a port of this machine, in a thread, and what spoils answers."""

from __future__ import annotations

import gzip
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class HttpService:
    """Answers as its subclass does; open from the start.

    Attributes:
        address: of the port, as the beginning of a URL.
    """

    def __init__(self) -> None:
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                with suppress(OSError):  # the client has left
                    outer.respond(self)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def respond(self, request: BaseHTTPRequestHandler) -> None:
        """Answer a request."""
        raise NotImplementedError

    def send(
        self, request: BaseHTTPRequestHandler, status: int, body: bytes,
        headers: Mapping[str, str] | None = None, fault: str = "",
    ) -> None:
        """Send an answer, compressed if requested.

        Args:
            request: what is answered.
            status: of the answer.
            body: of the answer.
            headers: beside its length and encoding.
            fault: "half" of the answer, then the connection ends; "slow": a few bytes per second;
                "slow head".
        """
        if fault == "slow head":
            for byte in b"HTTP/1.1 200 OK\r\nX: ":
                request.wfile.write(bytes([byte]))
                time.sleep(0.4)
        request.send_response_only(status)
        if body and "gzip" in request.headers.get("Accept-Encoding", ""):
            body = gzip.compress(body)
            request.send_header("Content-Encoding", "gzip")
        for name, value in {**(headers or {}), "Content-Length": str(len(body))}.items():
            request.send_header(name, value)
        request.end_headers()
        if fault == "half":
            body = body[: len(body) // 2]
            request.close_connection = True
        step = 8 if fault == "slow" else len(body) or 1
        for at in range(0, len(body), step):
            request.wfile.write(body[at : at + step])
            time.sleep(1.0 if fault == "slow" else 0.0)

    def close(self) -> None:
        """Close the port."""
        self._server.shutdown()
        self._server.server_close()
