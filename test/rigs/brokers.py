"""A real MQTT broker (Mosquitto) on its own port."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from greenroof_ros.base.mqtt import make_client, parse_broker

_FOUND = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
needs_mosquitto = pytest.mark.skipif(_FOUND is None, reason="there is no mosquitto here")


class Mosquitto:
    """A broker that can be killed, stopped, and started again at the same port.

    Attributes:
        port: on loopback.
        address: in the form that an option takes.
    """

    def __init__(self, directory: Path, *lines: str) -> None:
        """Start the broker.

        Args:
            directory: for its configuration and log.
            lines: more lines of its configuration, instead of the line that lets anyone in.
        """
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port: int = free.getsockname()[1]
        self.address = f"mqtt://127.0.0.1:{self.port}"
        self._file, self._log = directory / "mosquitto.conf", directory / "mosquitto.log"
        more = lines or ("allow_anonymous true",)
        self._file.write_text("\n".join([f"listener {self.port} 127.0.0.1", *more, ""]))
        self.start()

    def start(self) -> None:
        """Start the broker, and wait until it listens."""
        with self._log.open("a") as log:
            self.process = subprocess.Popen(
                [str(_FOUND), "-c", str(self._file)], stdout=log, stderr=log
            )
        until = time.monotonic() + 10
        while True:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return
            except OSError:
                if time.monotonic() > until or self.process.poll() is not None:
                    raise OSError(f"no broker: {self._log.read_text()}") from None
                time.sleep(0.05)

    def kill(self) -> None:
        """Kill the broker without a clean shutdown."""
        self.process.send_signal(signal.SIGCONT)
        self.process.kill()
        self.process.wait()

    def end(self) -> None:
        """Shut the broker down cleanly: if persistence is set up, it keeps retained messages."""
        self.process.terminate()
        self.process.wait()

    def pause(self) -> None:
        """Suspend the broker: it answers nothing, but its connections stay open."""
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Resume the broker."""
        self.process.send_signal(signal.SIGCONT)


@contextmanager
def mosquitto(directory: Path, *lines: str) -> Iterator[Mosquitto]:
    """Run a broker; see :class:`Mosquitto`."""
    broker = Mosquitto(directory, *lines)
    try:
        yield broker
    finally:
        broker.kill()


class Talker:
    """A client that publishes, each message confirmed by the broker; ``with`` connects it.

    Attributes:
        received: when (s, `time.monotonic`), topic, payload, whether retained.
    """

    def __init__(self, broker: Mosquitto, topic: str = "#") -> None:
        """Prepare a client that receives a topic; ``#`` stands for all."""
        self.received: list[tuple[float, str, str, bool]] = []
        self._topic, self._connected = topic, threading.Event()
        self._client = make_client(
            parse_broker(broker.address, "broker"), f"talker_{id(self)}", self._subscribe,
            self._receive,
        )

    def _subscribe(self) -> None:
        self._client.subscribe(self._topic, qos=1)
        self._connected.set()

    def _receive(self, topic: str, payload: bytes, retained: bool) -> None:
        self.received.append((time.monotonic(), topic, payload.decode(errors="replace"), retained))

    def __enter__(self) -> Talker:
        self._client.loop_start()
        assert self._connected.wait(20)
        return self

    def __exit__(self, *failure: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def publish(self, topic: str, message: str, *, retain: bool = False) -> None:
        """Publish a message, and wait until the broker has it."""
        self._client.publish(topic, message, qos=1, retain=retain).wait_for_publish(20)

    def of(self, topic: str) -> list[str]:
        """Return the payloads of a topic."""
        return [payload for _, at, payload, _ in self.received if at == topic]

    def last(self, topic: str) -> str:
        """Return the last payload of a topic; empty before the first."""
        return ["", *self.of(topic)][-1]
