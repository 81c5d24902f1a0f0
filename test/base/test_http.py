"""Requests to a real server: redirections and large answers."""

from __future__ import annotations

from contextlib import closing
from http.server import BaseHTTPRequestHandler

import pytest
from http_service import HttpService

from greenroof_ros.base import http


class Redirecting(HttpService):
    """Answers "there", after a redirection of some paths."""

    def respond(self, request: BaseHTTPRequestHandler) -> None:
        """Answer a request."""
        place = {"/once": "/there", "/ftp": "ftp://127.0.0.1/", "/loop": "/loop"}.get(
            request.path.partition("?")[0]
        )
        if place:
            self.send(request, 302, b"", {"Location": place})
        else:
            self.send(request, 200, b"there")


@pytest.mark.parametrize(("path", "reason"), [
    ("ftp", "Not supported URL scheme ftp"),
    ("loop", "302 Found"),
    ("large", "sent more than 4 bytes"),
])
def test_redirections_and_large_answers(
    monkeypatch: pytest.MonkeyPatch, path: str, reason: str
) -> None:
    with closing(Redirecting()) as service:
        assert http.request(f"{service.address}/once", {"a": 1.0}) == b"there"
        monkeypatch.setattr(http, "_MAX_BYTES", 4)
        with pytest.raises(http.ServiceError, match=f"^{service.address}/{path}: {reason}"):
            http.request(f"{service.address}/{path}", {})
