"""Requests to internet services with limits on time and size, and descriptions of failures."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from functools import partial
from http.client import HTTPException
from queue import Empty, SimpleQueue
from typing import NamedTuple
from urllib.error import HTTPError
from urllib.parse import parse_qsl, quote_plus, urlencode, urlsplit
from urllib.request import urlopen

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.text import clean_text

ANSWER_S = 60.0
"""maximum time for a complete answer (s)"""
# Maximum silence (s) and maximum size of an answer (bytes): 64 members of 36 days are 3 MB.
_SILENCE_S, _MAX_BYTES = 30.0, 50_000_000
# Maximum length of an error message, and of a service's reason in it (characters).
_MAX_MESSAGE, _MAX_REASON = 800, 200
# A value in a URL's own query that is at least this long may be a key, and is shown to no one.
_KEY_LENGTH = 6
# Status codes that pass by themselves: a slow request, too many requests, and server errors.
_PASSING = (408, 429, *range(500, 600))


class ServiceError(Exception):
    """Raised if a service sends no usable response; the message states the reason.

    Attributes:
        wait: time for which the service asks clients to wait (s); None if the service states no
            time.
        is_passing: True if the same request may succeed later.
    """

    def __init__(self, why: str, wait: float | None = None, *, is_passing: bool = True) -> None:
        super().__init__(clean_text(why, _MAX_MESSAGE))
        self.wait = wait
        self.is_passing = is_passing


class Answer(NamedTuple):
    """The response of a service."""

    body: bytes
    date: str
    """the service's clock, from the header; empty if there is none"""


def check_url(url: str, parameters: Collection[str]) -> str:
    """Check a URL and return it; it must use http or https, and may contain a query with a key.

    Args:
        url: URL of a service's interface.
        parameters: names of the parameters that requests add to the query.

    Raises:
        ConfigurationError: if the URL does not use http or https, or if its query contains one of
            the parameters.
    """
    if not url.startswith(("http://", "https://")):
        raise ConfigurationError("must begin with http:// or https://", key="url")
    try:
        parts = urlsplit(url)
        is_address = bool(parts.hostname) and parts.username is None and parts.port != 0
    except ValueError:  # no such host or port
        is_address = False
    if not is_address or " " in url or not (url.isascii() and url.isprintable()):
        raise ConfigurationError(
            "must be a server address in ASCII characters, without spaces or a user name, such as "
            "https://example.org/v1/archive?apikey=KEY", key="url",
        )
    for name, _ in parse_qsl(parts.query, keep_blank_values=True):
        if name in parameters:
            raise ConfigurationError(
                f"must not contain {clean_text(name)} in its query, since every request sets it",
                key="url", value=name_url(url),
            )
    return url


def name_url(url: str) -> str:
    """Return a URL for display, without its query, because the query may contain a key."""
    return urlsplit(url)._replace(query="", fragment="").geturl()


def request(url: str, parameters: Mapping[str, str | float]) -> Answer:
    """Request data from a service, and return the response.

    Args:
        url: URL of the interface, checked by :func:`check_url`.
        parameters: parameters to add to the URL's own query.

    Raises:
        ServiceError: if the service cannot be reached, rejects the request, breaks off the
            response, sends too much data, or sends data too slowly.
    """
    name, parts = name_url(url), urlsplit(url)
    own = parse_qsl(parts.query, keep_blank_values=True)
    query = urlencode([*own, *parameters.items()])
    keys = [value for _, value in own if len(value) >= _KEY_LENGTH]
    try:
        return _within(
            ANSWER_S,
            partial(_request, name, parts._replace(query=query, fragment="").geturl()),
        )
    except ServiceError as error:
        raise ServiceError(
            _hide(str(error), keys), error.wait, is_passing=error.is_passing
        ) from None
    except (HTTPException, OSError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise ServiceError(_hide(f"{name}: {why}", keys)) from None


def _hide(text: str, keys: Collection[str]) -> str:
    """Remove keys from a text, because a service may repeat them in its response."""
    for key in keys:
        text = text.replace(key, "***").replace(quote_plus(key), "***")
    return text


def _request(name: str, url: str) -> Answer:
    """Return the response from a URL; messages contain the given name instead of the URL."""
    until = time.monotonic() + ANSWER_S
    try:
        response = urlopen(url, timeout=_SILENCE_S)  # noqa: S310 - http or https, as checked before
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
        raise ServiceError(f"{name}: the response ended after {len(body)} of {length} bytes")
    return Answer(body, response.headers.get("Date", ""))


def _late(seconds: float) -> TimeoutError:
    return TimeoutError(f"sent no complete response within {seconds:g} s")


def _within(seconds: float, get: Callable[[], Answer]) -> Answer:
    """Run a request in a thread; return its response or raise its error within a time limit (s).

    The library's timeout applies to each part of a response, and even the header may arrive byte by
    byte.

    Raises:
        TimeoutError: if the request takes longer. The thread ends when the connection closes.
    """
    results: SimpleQueue[Answer | Exception] = SimpleQueue()

    def work() -> None:
        try:
            results.put(get())
        except Exception as error:  # raised again by the caller
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
    """Return the text of an error response as one line of limited length."""
    return " ".join(body.decode("utf-8", "replace").split())[:_MAX_REASON]


def _read_wait(text: str, now: datetime) -> float | None:
    """Return the wait (s) in a Retry-After header (a number or a date); None if it is neither."""
    if text.isascii() and text.isdecimal():
        return float(text)
    try:
        return max(0.0, (parsedate_to_datetime(text) - now).total_seconds())
    except (ValueError, TypeError):
        return None
