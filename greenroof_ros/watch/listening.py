"""Socket on which the page is served, host names that requests may use, and access token."""

from __future__ import annotations

import errno
import ipaddress
import os
import re
import secrets
import socket
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import check_private

LOOPBACK = "127.0.0.1"
# The ports to try unless one is specified; the first free one is used.
PORTS = range(8080, 8100)
# How much the kernel may hold for a slow reader (bytes), as data that waits would be old when it
# arrives; how much may arrive before it is read, as a request has at most 10 kB; and for how long
# the kernel sends to someone who takes nothing, even after the connection was closed (ms).
_SENDING, _RECEIVING, _UNREAD_MS = 65_536, 16_384, 30_000
# How many connections may wait to be accepted.
_WAITING = 4096
# An address for documentation (RFC 5737), the route to which reveals this machine's own address.
_ELSEWHERE = ("192.0.2.1", 9)
# Characters of a token that need no escape in an address, and the minimum number of them.
_TOKEN = re.compile(r"[A-Za-z0-9_-]{32,}")


@dataclass(frozen=True)
class Listener:
    """A listening socket, and the address at which a browser reaches it.

    Attributes:
        socket: the listening socket.
        url: address for a browser.
        names: host names that are allowed in a request; None if all names are allowed, as with a
            wildcard address.
    """

    socket: socket.socket
    url: str
    names: frozenset[str] | None


def _resolve(host: str) -> list[tuple[socket.AddressFamily, str]]:
    """Return the addresses of a host in the order in which they should be tried.

    Raises:
        ConfigurationError: if the host has no address.
    """
    try:
        known = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise ConfigurationError(
            "is not an address or name of this machine; 0.0.0.0 means all addresses",
            key="--host", value=host,
        ) from error
    return [(family, str(address[0])) for family, _, _, _, address in known]


def is_loopback(host: str) -> bool:
    """Return whether a host's addresses can be reached only from this machine.

    Raises:
        ConfigurationError: if the host has no address.
    """
    return all(ipaddress.ip_address(text.split("%")[0]).is_loopback for _, text in _resolve(host))


def listen(host: str, port: int | None) -> Listener:
    """Listen on a single address of this machine.

    Args:
        host: address or name; 0.0.0.0 means all addresses.
        port: TCP port; 0 for any free port, None for the first free port from 8080 on.

    Raises:
        ConfigurationError: if the host is not this machine, or the port cannot be used.
    """
    family, address = _resolve(host)[0]
    ports = PORTS if port is None else [port]
    for number in ports:
        try:
            listening = socket.create_server((address, number), family=family, backlog=_WAITING)
        except OSError as error:
            if error.errno == errno.EADDRINUSE and number != ports[-1]:
                continue
            key, value = ("--host", host) if error.errno == errno.EADDRNOTAVAIL else (
                "--port", f"{ports[0]} to {ports[-1]}" if port is None else str(port)
            )
            raise ConfigurationError(
                f"cannot be used: {os.strerror(error.errno or 0)}; choose another",
                key=key, value=value,
            ) from error
        break
    listening.setblocking(False)
    for level, option, setting in (  # which connections inherit
        (socket.SOL_SOCKET, socket.SO_SNDBUF, _SENDING),
        (socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVING),
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNREAD_MS),
    ):
        listening.setsockopt(level, option, setting)
    anywhere = ipaddress.ip_address(address.split("%")[0]).is_unspecified
    shown = _find_own_address(address) if anywhere else host
    url = f"http://{f'[{shown}]' if ':' in shown else shown}:{listening.getsockname()[1]}/"
    names = None if anywhere else frozenset({host.lower(), address, LOOPBACK, "::1", "localhost"})
    return Listener(listening, url, names)


def new_token() -> str:
    """Return an unguessable token with 192 random bits."""
    return secrets.token_urlsafe(24)


def read_token(file: Path) -> str:
    """Return the token in a file; if there is no file, create one with a new token.

    Raises:
        ConfigurationError: if the file cannot be used, or if other users are able to read or change
            the file.
    """
    def refuse(why: str) -> ConfigurationError:
        return ConfigurationError(why, key="--token-file", value=str(file))

    try:
        with (
            suppress(FileExistsError),
            open(file, "x", opener=lambda path, flags: os.open(path, flags, 0o600)) as made,
        ):
            made.write(f"{new_token()}\n")
            made.flush()
            os.fsync(made.fileno())
        check_private(file)
        token = file.read_text(encoding="ascii", errors="replace").strip()
    except OSError as error:
        raise refuse(f"cannot be used: {error.strerror}") from error
    if not _TOKEN.fullmatch(token):
        raise refuse(
            "must contain a token of at least 32 letters, digits, - or _; if you remove the file, "
            "a new token is created at the next start"
        )
    return token


def _find_own_address(wildcard: str) -> str:
    """Return this machine's network address, or else its name, without sending data."""
    if ":" in wildcard:
        return socket.gethostname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(_ELSEWHERE)
        except OSError:  # no network at all
            return socket.gethostname()
        return str(probe.getsockname()[0])
