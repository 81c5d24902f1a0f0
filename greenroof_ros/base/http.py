"""Requests to internet services with limits on time and size, and descriptions of failures."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as LateError
from contextlib import suppress
from urllib.parse import parse_qsl, quote_plus, unquote, urlencode, urlsplit
from urllib.request import getproxies, proxy_bypass

from urllib3 import PoolManager, ProxyManager, Retry, Timeout
from urllib3.exceptions import HTTPError, InvalidHeader, LocationParseError
from urllib3.util import Url, make_headers, parse_url

from greenroof_ros.base.errors import ConfigurationError, FailedError
from greenroof_ros.base.text import clean_text

ANSWER_S = 60.0
"""maximum time for a complete answer (s)"""
# Maximum silence (s) and maximum size of an answer (bytes): 64 members of 36 days are 3 MB.
_SILENCE, _MAX_BYTES = Timeout(30.0), 50_000_000
# Maximum length of an error message, and of a service's reason in it (characters).
_MAX_MESSAGE, _MAX_REASON = 800, 200
# A value in a URL's own query that is at least this long may be a key, and is shown to no one.
_KEY_LENGTH = 6
# Statuses below 500 that pass by themselves: a slow request and too many requests.
_PASSING = (408, 429)
# Open-Meteo's words for a request that it will never answer (ForecastapiError in its source). It
# also sends the status 400 for failures of its own: "Something went wrong.", or "Could not read
# reference weight file" with the name of a variable. So the name of a variable decides nothing.
_OWN_FAULT = re.compile(
    r"\bmust (not )?(be|have|exceed)\b|\binvalid (timezone|\w+ value)\b|\bis invalid\b"
    r"|\bout of allowed range\b|\bmutually exclusive\b|\bnot (yet )?support"
    r"|\b(value|key) required\b|\bno data is available for this location\b", re.IGNORECASE,
)
# Only redirections are followed at once; the caller tries again, after a day at most.
_RETRY = Retry(
    None, connect=False, read=False, redirect=5, raise_on_redirect=False, retry_after_max=86_400,
)


class ServiceError(FailedError):
    """Raised if a service sends no usable response; the message states the reason.

    Attributes:
        wait: time for which the service asks clients to wait (s); 0 if it states no time.
        is_final: True if the same request would fail again.
    """

    def __init__(self, why: str, wait: float = 0.0, *, is_final: bool = False) -> None:
        super().__init__(clean_text(why, _MAX_MESSAGE))
        self.wait = wait
        self.is_final = is_final


def check_url(url: str) -> str:
    """Check a URL and return it; it must use http or https, and may contain a query with a key.

    Raises:
        ConfigurationError: if the URL does not use http or https.
    """
    parts = Url()
    with suppress(LocationParseError):
        parts = parse_url(url)
    is_address = parts.scheme in ("http", "https") and parts.host and not parts.auth
    if not is_address or " " in url or not (url.isascii() and url.isprintable()):
        raise ConfigurationError(
            "must begin with http:// or https:// and a server address in ASCII characters, without "
            "spaces or a user name, such as https://example.org/v1/archive?apikey=KEY", key="url",
        )
    return url


def name_url(url: str) -> str:
    """Return a URL for display, without its query, because the query may contain a key."""
    return urlsplit(url)._replace(query="", fragment="").geturl()


def request(url: str, parameters: Mapping[str, str | float]) -> bytes:
    """Request data from a service, and return its response.

    Args:
        url: URL of the interface, checked by :func:`check_url`.
        parameters: parameters to add to the URL's own query; each replaces one of the same name.

    Raises:
        ServiceError: if the service cannot be reached, rejects the request, breaks off the
            response, sends too much data, or sends data too slowly.
    """
    own = dict(parse_qsl(urlsplit(url).query, keep_blank_values=True))
    whole = f"{name_url(url)}?{urlencode({**own, **parameters})}"
    result: Future[bytes] = Future()

    def work() -> None:
        try:
            result.set_result(_get(whole))
        except Exception as error:  # raised again by the caller
            result.set_exception(error)

    # urllib3's timeout applies to each part of a response, and even the header may arrive byte by
    # byte. The thread ends when the connection closes.
    threading.Thread(target=work, daemon=True).start()
    try:
        return result.result(ANSWER_S)
    except LateError:
        error, why = ServiceError(""), f"sent no complete response within {ANSWER_S:g} s"
    except ServiceError as caught:
        error, why = caught, str(caught)
    except (HTTPError, OSError) as caught:
        error, why = ServiceError(""), str(caught.__cause__ or caught.__context__ or caught)
    for key in own.values():
        if len(key) >= _KEY_LENGTH:  # a service may repeat it in its response
            why = why.replace(key, "***").replace(quote_plus(key), "***")
    raise ServiceError(f"{name_url(url)}: {why}", error.wait, is_final=error.is_final) from None


def _get(url: str) -> bytes:
    """Return the response from a URL.

    Raises:
        ServiceError: if the status is not 200, or if the response is too large.
        HTTPError: if there is no response, or only a part of one.
    """
    until, body = time.monotonic() + ANSWER_S, bytearray()
    with _find_pool(url).request("GET", url, preload_content=False) as response:
        for part in response.stream(1 << 12):
            body += part
            if len(body) > _MAX_BYTES:
                raise ServiceError(f"sent more than {_MAX_BYTES} bytes")
            if time.monotonic() > until:
                raise LateError  # nobody waits for it
    if response.status == 200:
        return bytes(body)
    reason = " ".join(body.decode("utf-8", "replace").split())[:_MAX_REASON]
    wait = 0.0
    with suppress(InvalidHeader):
        wait = _RETRY.parse_retry_after(response.headers.get("Retry-After", "0"))
    raise ServiceError(
        f"{response.status} {response.reason}: {reason}", wait,
        is_final=response.status < 500 and response.status not in _PASSING
        and (response.status != 400 or _OWN_FAULT.search(reason) is not None),
    )


def _find_pool(url: str) -> PoolManager:
    """Return the connections to a URL's server, through the proxy of the environment if any."""
    parts = urlsplit(url)
    address = getproxies().get(parts.scheme)
    if not address or proxy_bypass(parts.hostname or ""):
        return PoolManager(timeout=_SILENCE, retries=_RETRY)
    proxy = parse_url(address if "://" in address else f"http://{address}")
    login = make_headers(proxy_basic_auth=unquote(proxy.auth)) if proxy.auth else None
    return ProxyManager(proxy.url, proxy_headers=login, timeout=_SILENCE, retries=_RETRY)
