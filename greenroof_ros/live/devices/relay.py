"""Operation of a single MQTT relay according to its relay file.

The relay's own timer switches the relay off after every *on*, and thus serves as its communication
timeout. *On* is published again after at most a third of the timer, but only once the relay has
replied to the previous *on*. At most one *on* can therefore wait in a stalled connection, followed
by the *off* that is published when the connection is closed. Every message is sent with quality of
service 0 and without the retain flag, so the broker stores no messages.
"""

from __future__ import annotations

import json
import queue
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from string import Template
from typing import Any

from greenroof_ros.base.mqtt import Broker, make_client, value_at
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.devices.drive import DriveStatus
from greenroof_ros.live.devices.drive_file import Question, RelayFile, RelayMessage, Timer
from greenroof_ros.live.devices.modbus_line import Address, DriveError

# Time between two questions (s), also while it is expected to switch on; and time after which an
# order to switch off is sent (s), whatever is being waited for.
_PERIOD_S, _POLL_S = 0.5, 0.1
# Longest wait for a reply (s), for the broker (s), and for the relay to switch on (s).
_ANSWER_S, _CONNECT_S, _ON_S = 1.0, 3.0, 2.0
# An *on* is renewed after this share of the timer, which must therefore last for a few periods (s).
_RENEWED = 1 / 3
_MIN_TIMER_S = 2 * _PERIOD_S / _RENEWED


@dataclass(frozen=True)
class RelayEndpoint:
    """A relay of a certain make, with its address.

    Attributes:
        file: the relay file.
        broker: the broker to which the relay is connected.
        device: the relay's own topic on the broker.
    """

    file: RelayFile
    broker: Broker
    device: str

    period = _PERIOD_S

    def __str__(self) -> str:
        return f"{self.broker}/{self.device}"

    @property
    def guard(self) -> Timer:
        """The timer that switches the relay off if no *on* arrives."""
        return self.file.timer

    def lock_name(self) -> str:
        """Return the name of the relay's lock, which is the same for all spellings of the address.

        The call may block while the host name is resolved.

        Raises:
            OSError: if the host is unknown or no name server responds.
        """
        return f"{Address(self.broker.host, self.broker.port).canonical_name()}-{self.device}"

    def connection(self) -> Relay:
        """Return the relay on a new connection that is not yet open and must be opened only once.

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        return Relay(self)


class RelayLine:
    """A single connection to the broker, over which the relay is queried.

    Attributes:
        where: address of the relay, for messages.
        last_message: message to publish before the connection is closed; None for none.
    """

    def __init__(self, relay: RelayEndpoint, while_waiting: Callable[[], None]) -> None:
        """Prepare the connection without opening it.

        Args:
            relay: the relay.
            while_waiting: function that is called again and again while a reply is awaited.

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        self.where = str(relay)
        self.last_message: RelayMessage | None = None
        self._while_waiting = while_waiting
        # All connections use this name, so a broker can restrict who may publish under it.
        self._placeholders = {"device": relay.device, "me": f"greenroof_ros-{relay.device}"}
        questions = (relay.file.state, relay.file.timer, *relay.file.must)
        self._topics = sorted({self._fill(question.answer) for question in questions})
        # How many replies of each kind are on their way.
        self._awaited: Counter[str] = Counter()
        # The messages; one without topic tells that the connection was established or lost.
        self._received: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self._connected, self._closed_by = False, ""
        self._client = make_client(
            relay.broker, "greenroof_ros", self._on_connect, self._on_message, self._on_disconnect,
        )

    @property
    def connected(self) -> bool:
        """Whether the connection to the broker is established."""
        return self._connected and not self._closed_by

    def connect(self) -> None:
        """Connect to the broker.

        Raises:
            DriveError: if the broker does not respond or rejects the connection.
        """
        self._client.loop_start()
        with suppress(queue.Empty):
            self._received.get(timeout=_CONNECT_S)
        if not self.connected:
            why = self._closed_by or f"no reply within {_CONNECT_S:g} s"
            raise self.error("connection", f"cannot connect: {why}")

    def close(self) -> None:
        """Publish the last message, and close the connection."""
        if self.last_message is not None and self.connected:
            with suppress(DriveError):  # the connection was just lost
                self.publish(self.last_message)
        self._closed_by = self._closed_by or "closed here"
        self._client.disconnect()
        self._client.loop_stop()

    def publish(self, message: RelayMessage, **values: str) -> None:
        """Publish a message once.

        Args:
            message: message to the relay.
            values: values of the ``$`` placeholders in the message, in addition to those of the
                connection.

        Raises:
            DriveError: if the connection has been lost.
        """
        topic, payload = self._fill(message.topic), self._fill(message.payload, **values)
        if not self.connected or self._client.publish(topic, payload).rc:
            raise self.error("connection", f"the connection was closed: {self._closed_by}")

    def ask(self, question: Question) -> Any:
        """Ask the relay, and return the value in its reply.

        The replies arrive in the order of the requests, so late ones are counted, and skipped.

        Raises:
            DriveError: if no valid reply arrives in time.
        """
        if not self._awaited.total():
            self._received = queue.SimpleQueue()  # earlier messages answer no question
        self._awaited[question.path] += 1
        self.publish(question)
        topic, until = self._fill(question.answer), time.monotonic() + _ANSWER_S
        while self.connected and time.monotonic() < until:
            self._while_waiting()
            # Nothing yet, or not a reply to this.
            with suppress(queue.Empty, ValueError, LookupError, TypeError, RecursionError):
                received, payload = self._received.get(timeout=_POLL_S)
                value = value_at(json.loads(payload) if received == topic else {}, question.path)
                self._awaited[question.path] -= 1
                if not self._awaited[question.path]:
                    return value
        if not self.connected:
            raise self.error("connection", f"the connection was closed: {self._closed_by}")
        # Not "answer": the reply may still come, so only a new connection counts right again.
        problem = f"no valid reply with {question.path} within {_ANSWER_S:g} s"
        raise self.error("connection", problem)

    def error(self, kind: str, problem: str) -> DriveError:
        """Return an error that names the relay and the problem."""
        return DriveError(kind, f"{self.where}: {problem}")

    def _fill(self, text: str, **values: str) -> str:
        return Template(text).substitute(self._placeholders, **values)

    # --- in the client's thread -------------------------------------------------------------------

    def _on_connect(self) -> None:
        if not self._closed_by:  # after the end the client reconnects automatically
            self._client.subscribe([(topic, 0) for topic in self._topics])
            self._connected = True
            self._received.put(("", b""))

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if not retained:
            self._received.put((topic, payload))

    def _on_disconnect(self, why: str) -> None:
        self._closed_by = self._closed_by or why
        self._received.put(("", b""))


class Relay:
    """A relay on a single connection, which the caller opens and closes.

    Attributes:
        line: the connection.
        may_run: function that returns whether the relay may be on. If it returns False, the relay
            is switched off at once, even while a reply is awaited.
    """

    def __init__(self, endpoint: RelayEndpoint) -> None:
        """Prepare the relay without opening a connection.

        Args:
            endpoint: the relay and its address.

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        self._file, self.line = endpoint.file, RelayLine(endpoint, self._hurry)
        self.may_run: Callable[[], bool] = lambda: True
        # The state that was last ordered, None if a reply may still be of an earlier one.
        self._ordered: bool | None = None
        # Its timer as last read (s), None if it is not effective; and when *on* was published (s).
        self._timer_s: float | None = None
        self._on_at = 0.0

    def timeout(self) -> tuple[float | None, str]:
        """Return the relay's timer (s), or None and the reason if the timer is not effective.

        The timer is not effective if it is off or too short to be renewed in time, or if another
        setting could switch the relay on unintentionally.

        Raises:
            DriveError: if the timer or another required setting cannot be read.
        """
        self._timer_s = None  # the earlier value was valid only until now
        for setting in self._file.must:
            if (value := _text(self.line.ask(setting))) != setting.value:
                return None, f"{setting.path} is {value}, but must be {setting.value}"
        timer, raw = self._file.timer, self.line.ask(self._file.timer)
        low, high = _MIN_TIMER_S / timer.scale, timer.high
        if isinstance(raw, bool) or not isinstance(raw, int | float) or not low <= raw <= high:
            return None, f"{timer.path} is {raw}, but must be {low:g} to {high:g}"
        self._timer_s = timer.scale * raw
        return self._timer_s, ""

    def read(self) -> DriveStatus:
        """Return the status that the relay reports.

        Raises:
            DriveError: if the state cannot be read or is an impossible value.
        """
        on = self._read()
        return DriveStatus(ready=True, running=on, fault="", speed=float(on))

    def run(self, speed: float) -> None:
        """Switch the relay on, or keep it on.

        The caller repeats the call while the relay must be on, each time after `second_master`.
        *On* is thus published again only after the relay has replied to the last *on*, and only if
        it is still on.

        Args:
            speed: speed above 0 (share of the rated speed); a pump switched by a relay always runs
                at 1.

        Raises:
            DriveError: if no valid response arrives, the relay's timer is not effective, or the
                relay does not switch on.
        """
        if (timer_s := self._timer_s) is None:
            raise self.line.error(
                "drive", "the relay is not switched on: its own timer is not effective")
        if self._ordered:
            # Renew it one period early, since the next round might be too late.
            if time.monotonic() >= self._on_at + _RENEWED * timer_s - _PERIOD_S:
                self._switch_on(timer_s)
        elif self.may_run():
            self._switch_on(timer_s)
            self._ordered = None
            while not self._read():
                if not self.may_run():
                    return
                if time.monotonic() > self._on_at + _ON_S:
                    raise self.line.error(
                        "drive", f"the relay was switched on, but is still off after {_ON_S:g} s")
                time.sleep(_POLL_S)
            if self.line.last_message is not None:  # not switched off meanwhile
                self._ordered = True

    def stop(self) -> None:
        """Switch the relay off; the caller repeats the call while the relay must be off.

        Raises:
            DriveError: if the connection has been lost.
        """
        self.line.publish(self._file.switch_off)
        self._ordered, self.line.last_message = False, None

    # A relay has no faults that could be acknowledged.
    reset = stop

    def second_master(self) -> Diagnosis | None:
        """Return a diagnosis if the relay is known not to be in the state last commanded.

        Its own timer, a power failure, a person or another program may have switched the relay.

        Raises:
            DriveError: if no valid response arrives.
        """
        is_on = self._read()
        if self._ordered is None or is_on == self._ordered:
            return None
        return Diagnosis.of("second_master", "on" if is_on else "off", where=self.line.where)

    def _read(self) -> bool:
        """Return whether the relay reports that it is on."""
        state = self._file.state
        answer = _text(self.line.ask(state))
        if answer not in (state.is_on, state.is_off):
            raise self.line.error(
                "answer",
                f"the state {state.path} is {answer}, neither {state.is_on} nor {state.is_off}",
            )
        return answer == state.is_on

    def _switch_on(self, timer_s: float) -> None:
        self.line.last_message, self._on_at = self._file.switch_off, time.monotonic()
        self.line.publish(self._file.switch_on, seconds=f"{timer_s:g}")

    def _hurry(self) -> None:
        """Switch the relay off if it may no longer be on."""
        if self.line.last_message is not None and not self.may_run():
            self.stop()
            self._ordered = None


def _text(value: Any) -> str:
    """Return a value as JSON text, or a string without its quotes."""
    return value if isinstance(value, str) else json.dumps(value)
