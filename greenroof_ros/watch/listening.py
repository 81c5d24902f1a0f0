"""Socket on which the page is served, host names that requests may use, and access token."""

from __future__ import annotations

import ipaddress
import os
import re
import secrets
import socket
from pathlib import Path
from typing import NamedTuple

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import check_private

LOOPBACK = "127.0.0.1"
# The ports to try unless one is specified; the first free one is used.
PORTS = range(8080, 8100)
# How many connections may wait to be accepted.
_WAITING = 4096
# Characters of a token that need no escape in an address, and the minimum number of them.
_TOKEN = re.compile(r"[A-Za-z0-9_-]{32,}")


class Listener(NamedTuple):
    """A listening socket, and the address at which a browser reaches it.

    Attributes:
        socket: the listening socket.
        url: address for a browser.
        names: host names that are allowed in a request; None if all names are allowed, as with a
            wildcard address.
        is_loopback: whether only this machine can reach the address.
    """

    socket: socket.socket
    url: str
    names: frozenset[str] | None
    is_loopback: bool


def listen(host: str, port: int | None, key: str = "--host, --port") -> Listener:
    """Listen on a single address of this machine.

    Args:
        host: address or name; 0.0.0.0 means all addresses.
        port: TCP port; 0 for any free port, None for the first free port from 8080 on.
        key: option to name in an error.

    Raises:
        ConfigurationError: if the host is not this machine, or the port cannot be used.
    """
    try:
        first = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        raise ConfigurationError(
            "is not an address or name of this machine; 0.0.0.0 means all addresses",
            key="--host", value=host,
        ) from error
    address = ipaddress.ip_address(str(first[4][0]).partition("%")[0])
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    for number in PORTS if port is None else [port]:
        try:
            listening = socket.create_server(
                (str(address), number), family=family, backlog=_WAITING
            )
            break
        except OSError as error:
            why = error
    else:
        raise ConfigurationError(
            f"cannot be used: {os.strerror(why.errno or 0)}; choose another address or port",
            key=key, value=f"{host}, {number}",
        ) from why
    listening.setblocking(False)
    shown = socket.gethostname() if address.is_unspecified else host
    url = f"http://{f'[{shown}]' if ':' in shown else shown}:{listening.getsockname()[1]}/"
    names = None if address.is_unspecified else frozenset(
        {host.lower(), str(address), LOOPBACK, "::1", "localhost"}
    )
    return Listener(listening, url, names, address.is_loopback)


def new_token() -> str:
    """Return an unguessable token with 192 random bits."""
    return secrets.token_urlsafe(24)


def read_token(file: Path) -> str:
    """Return the token in a file; if there is no file, create one with a new token.

    Raises:
        ConfigurationError: if the file cannot be used, or if other users are able to read or change
            the file.
    """
    try:
        if not file.exists():
            with open(file, "x", opener=lambda path, flags: os.open(path, flags, 0o600)) as made:
                made.write(f"{new_token()}\n")
        check_private(file)
        token = file.read_text(encoding="ascii", errors="replace").strip()
    except OSError as error:
        why = f"cannot be used: {error.strerror}"
    else:
        if _TOKEN.fullmatch(token):
            return token
        why = "must contain a token of at least 32 letters, digits, - or _"
    raise ConfigurationError(why, key="--token-file", value=str(file))
