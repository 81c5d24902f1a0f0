"""The address of an MQTT broker, a client that connects to it, and values in JSON messages.

The client uses MQTT 3.1.1 with a clean session, so the broker stores no messages for a disconnected
client. The client connects automatically, and tries again after every failure. Messages with
quality of service 0 that are published while the client is not connected are dropped.
"""

from __future__ import annotations

import re
import secrets
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.files import as_started, check_private, read_yaml

if TYPE_CHECKING:
    from paho.mqtt.client import Client

_ADDRESS = re.compile(
    r"([a-z]+)://([A-Za-z0-9_-]{1,63}(?:\.[A-Za-z0-9_-]{1,63})*\.?|\[[0-9A-Fa-f:]+\])"
    r"(?::(\d{1,5}))?/?"
)
_PORT, _TLS_PORT = 1883, 8883
# Keep-alive (s): a broker that is silent for one and a half times as long is treated as lost.
_KEEP_ALIVE_S = 5
# Waits between two attempts to connect (s): the first and the longest.
_FIRST_WAIT_S, _MAX_WAIT_S = 1, 5
# The reason code when a connection ends without one.
_UNSPECIFIED = 0x80


@dataclass(frozen=True)
class Broker:
    """The address of an MQTT broker, and the login data.

    Attributes:
        host: host name or IP address.
        port: TCP port.
        tls: True if the connection is encrypted and the broker's certificate is checked.
        login: file with ``username`` and ``password``, readable by one user only; empty for no
            login.
        authority: file with trusted certificates (PEM); empty for the system's certificates.
    """

    host: str
    port: int
    tls: bool = False
    login: str = ""
    authority: str = ""

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{host}:{self.port}"


def parse_host(text: str) -> tuple[str, str, int | None] | None:
    """Return the scheme, host and port of ``SCHEME://HOST[:PORT]``; None for any other text."""
    match = _ADDRESS.fullmatch(text)
    if match is None or not 0 < int(match[3] or 1) < 65536:
        return None
    return match[1], match[2].strip("[]"), int(match[3]) if match[3] else None


def parse_broker(text: str, key: str, login: str = "", authority: str = "") -> Broker:
    """Return the broker that has the given address.

    Args:
        text: ``mqtt://HOST[:PORT]``, or ``mqtts://HOST[:PORT]`` over TLS.
        key: name of the address for error messages.
        login: file with ``username`` and ``password``; empty for no login.
        authority: file with trusted certificates (PEM); empty for the system's certificates.

    Raises:
        ConfigurationError: if the text is not such an address, or if certificates are given for an
            address without TLS.
    """
    scheme, host, port = parse_host(text) or ("", "", None)
    if scheme not in ("mqtt", "mqtts"):
        raise ConfigurationError(
            "must be mqtt://HOST[:PORT], or mqtts://HOST[:PORT] over TLS", key=key, value=text
        )
    tls = scheme == "mqtts"
    if authority and not tls:
        raise ConfigurationError(
            "certificates can be used only with mqtts://HOST[:PORT]", key=key, value=text
        )
    return Broker(host, port or (_TLS_PORT if tls else _PORT), tls, login, authority)


def parse_topic(text: str, key: str, login: str = "", authority: str = "") -> tuple[Broker, str]:
    """Return the broker and the topic in an address ``mqtt://HOST[:PORT]/TOPIC``.

    Args:
        text: the address.
        key: see :func:`parse_broker`.
        login: see :func:`parse_broker`.
        authority: see :func:`parse_broker`.

    Raises:
        ConfigurationError: if the text is not such an address.
    """
    scheme, mark, rest = text.partition("://")
    place, _, topic = rest.partition("/")
    if not topic or set(topic) & set("#+\0"):
        raise ConfigurationError(
            "must be mqtt://HOST[:PORT]/TOPIC, with a topic that contains neither # nor +",
            key=key, value=text
        )
    return parse_broker(scheme + mark + place, key, login, authority), topic


def make_client(
    broker: Broker, name: str,
    on_connect: Callable[[], None],
    on_message: Callable[[str, bytes, bool], None],
    on_disconnect: Callable[[str], None] = lambda why: None,
    will: tuple[str, str] | None = None,
) -> Client:
    """Return a client that is not connected yet; call ``loop_start`` to start its thread.

    ``connect_async`` has been called, so the thread will connect, and will try again after every
    failure.

    Args:
        broker: the broker to connect to.
        name: beginning of the client ID; the rest is random, because a broker disconnects a client
            when another client connects with the same ID.
        on_connect: callback that is called in the client's thread for every new connection; it
            should subscribe to the topics.
        on_message: callback that is called in the client's thread for every message; its arguments
            are the topic, the payload, and True if the message was retained.
        on_disconnect: callback that is called in the client's thread with the reason why a
            connection ended or failed.
        will: topic and payload of a retained message that the broker publishes if the client is
            lost.

    Raises:
        ConfigurationError: if the MQTT library is missing, or if the login file or the certificate
            file is invalid.
    """
    with require_extra("mqtt"):
        from paho.mqtt.client import Client, MQTTv311
        from paho.mqtt.enums import CallbackAPIVersion
    client = Client(
        CallbackAPIVersion.VERSION2, client_id=f"{name}_{secrets.token_hex(4)}",
        clean_session=True, protocol=MQTTv311,
    )
    if broker.login:
        client.username_pw_set(*_read_login(Path(broker.login)))
    if broker.tls:
        try:
            client.tls_set(str(as_started(Path(broker.authority))) if broker.authority else None)
        except OSError as error:  # or ssl.SSLError
            raise ConfigurationError(
                f"cannot be read as a certificate file: {error.strerror or error}",
                file=broker.authority,
            ) from error
    if will is not None:
        client.will_set(*will, qos=1, retain=True)

    lost = "the connection was lost"
    hint = "" if broker.tls else "; if it expects TLS, use mqtts://"
    unanswered = f"{lost} before the broker responded{hint}"
    why = unanswered

    def connected(client: Client, data: Any, flags: Any, code: Any, properties: Any) -> None:
        nonlocal why
        why = str(code) if code.is_failure else lost
        if not code.is_failure:
            on_connect()

    def disconnected(client: Client, data: Any, flags: Any, code: Any, properties: Any) -> None:
        nonlocal why
        on_disconnect(why if code.value == _UNSPECIFIED else str(code))
        why = unanswered

    client.on_connect = connected
    client.on_disconnect = disconnected
    # Paho calls this while it is handling the error.
    client.on_connect_fail = lambda client, data: on_disconnect(
        _why_not_connected(broker, sys.exc_info()[1])
    )
    client.on_message = lambda client, data, message: on_message(
        message.topic, bytes(message.payload), message.retain
    )
    client.reconnect_delay_set(_FIRST_WAIT_S, _MAX_WAIT_S)
    client.connect_async(broker.host, broker.port, keepalive=_KEEP_ALIVE_S)
    return client


def _why_not_connected(broker: Broker, error: BaseException | None) -> str:
    """Return the reason why there is no connection to a broker."""
    reason = getattr(error, "strerror", None) or error
    return f"no response{' over TLS' if broker.tls else ''} from {broker}: {reason}"


def _read_login(file: Path) -> tuple[str, str]:
    check_private(file)
    login = read_yaml(file)
    for name in ("username", "password"):
        if not isinstance(login.get(name), str):
            raise ConfigurationError("must be text", file=file, key=name)
    return login["username"], login["password"]


_STEP = re.compile(r"\[(\d+)\]|([^.\[\]]+)")


def parse_path(path: str) -> list[str | int]:
    """Return the names and indices in a JSON path such as ``sensors[0].distance``."""
    return [int(index) if index else name for index, name in _STEP.findall(path)]


def value_at(content: Any, path: str) -> Any:
    """Return the value at a path in a JSON value.

    Raises:
        LookupError, TypeError: if there is no value at the path.
    """
    for step in parse_path(path):
        content = content[step]
    return content
