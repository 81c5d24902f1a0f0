"""Requests to services on the internet, with limits of time and size, and why one has failed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from functools import partial
from http.client import HTTPException
from queue import Empty, SimpleQueue
from typing import NamedTuple
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import urlopen

from greenroof_ros.common.errors import ConfigurationError

ANSWER_S = 60.0
"""longest answer (s)"""
# Longest silence (s), and the largest answer (bytes): 64 members of 36 days are 3 MB.
_SILENCE_S, _MAX_BYTES = 30.0, 50_000_000
# Refusals that end by themselves: a slow request, and too many of them; and errors of the server.
_PASSING = (408, 429, *range(500, 600))


class ServiceError(Exception):
    """A service gave no usable answer; the message states why.

    Attributes:
        wait: how long the service asks to be left alone (s); None if it does not state this.
        is_passing: whether the same request can succeed later.
    """

    def __init__(self, why: str, wait: float | None = None, *, is_passing: bool = True) -> None:
        super().__init__(why)
        self.wait = wait
        self.is_passing = is_passing


class Answer(NamedTuple):
    """What a service sent."""

    body: bytes
    date: str
    """its clock, as in the header; empty if there is none"""


def check_url(url: str) -> str:
    """Return a URL, which must be of the web.

    Raises:
        ConfigurationError: it is not.
    """
    if not url.startswith(("http://", "https://")):
        raise ConfigurationError("must begin with http:// or https://", key="url", value=url)
    return url


def request(url: str, parameters: Mapping[str, str | float]) -> Answer:
    """Return a service's answer.

    Args:
        url: of the interface, as :func:`check_url` passes it.
        parameters: of the query.

    Raises:
        ServiceError: the service cannot be reached, refuses, breaks off, or sends too much or too
            slowly.
    """
    try:
        return _within(ANSWER_S, partial(_request, url, f"{url}?{urlencode(parameters)}"))
    except (HTTPException, OSError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise ServiceError(f"{url}: {why}") from error


def _request(name: str, url: str) -> Answer:
    """Return the answer to a URL, which is called by a shorter name in messages."""
    until = time.monotonic() + ANSWER_S
    try:
        response = urlopen(url, timeout=_SILENCE_S)  # noqa: S310 - of the web, as was checked
    except HTTPError as error:
        response = error
    body = b""
    with response:
        while part := response.read1(1 << 16):
            body += part
            if len(body) > _MAX_BYTES:
                raise ServiceError(f"{name}: sent more than {_MAX_BYTES} bytes")
            if time.monotonic() > until:
                raise _late(ANSWER_S)
    if response.status != 200:
        raise ServiceError(
            f"{name}: {response.status} {response.reason}: {read_reason(body)}",
            _read_wait(response.headers.get("Retry-After", ""), datetime.now(timezone.utc)),
            is_passing=response.status in _PASSING,
        )
    length = response.headers.get("Content-Length", "")
    if length.isdecimal() and len(body) < int(length):
        raise ServiceError(f"{name}: broke off after {len(body)} of {length} bytes")
    return Answer(body, response.headers.get("Date", ""))


def _late(seconds: float) -> TimeoutError:
    return TimeoutError(f"gave no complete answer within {seconds:g} s")


def _within(seconds: float, get: Callable[[], Answer]) -> Answer:
    """Return what a request returns, or raise what it raises; give up after a time (s).

    The library's timeout is for each part of the answer, and its head may come byte by byte.

    Raises:
        TimeoutError: it took longer. Its thread ends when the service does.
    """
    results: SimpleQueue[Answer | Exception] = SimpleQueue()

    def work() -> None:
        try:
            results.put(get())
        except Exception as error:  # raised by the caller
            results.put(error)

    threading.Thread(target=work, daemon=True).start()
    try:
        result = results.get(timeout=seconds)
    except Empty:
        raise _late(seconds) from None
    if isinstance(result, Exception):
        raise result
    return result


def read_reason(body: bytes) -> str:
    """Return the text of a refusal, cut to a line."""
    return " ".join(body.decode("utf-8", "replace").split())[:200]


def _read_wait(text: str, now: datetime) -> float | None:
    """Return the wait (s) in a Retry-After header, seconds or a date; None if it is neither."""
    if text.isascii() and text.isdecimal():
        return float(text)
    try:
        return max(0.0, (parsedate_to_datetime(text) - now).total_seconds())
    except (ValueError, TypeError):
        return None
