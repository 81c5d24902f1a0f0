"""Operation of a single MQTT relay according to its relay file.

The relay's own timer switches the relay off after every *on*, and thus serves as its communication
timeout. *On* is published again after at most a third of the timer, but only once the relay has
replied to the previous *on*. At most one *on* can therefore wait in a stalled connection, followed
by the *off* that is published when the connection is closed. Every message is sent with quality of
service 0 and without the retain flag, so the broker stores no messages.
"""

from __future__ import annotations

import itertools
import json
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from string import Template
from typing import Any

from greenroof_ros.base.mqtt import Broker, make_client
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.devices.drive import DriveStatus
from greenroof_ros.live.devices.drive_file import LIMIT_S, RelayFile, RelayMessage, Timer, Value
from greenroof_ros.live.devices.json_path import value_at
from greenroof_ros.live.devices.modbus_line import Address, DriveError

# Longest wait for the broker (s).
_CONNECT_S = 3.0
# How long the relay may take to switch on after *on*, and the interval between questions (s).
_ON_S, _POLL_S = 2.0, 0.1
# An *on* is renewed after this share of the timer.
_RENEWED = 1 / 3
# Number of characters of an invalid answer that are shown, and of messages that may wait.
_SHOWN, _MAX_WAITING = 120, 1000


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

    def __str__(self) -> str:
        return f"{self.broker}/{self.device}"

    @property
    def period(self) -> float:
        """Minimum polling interval (s)."""
        return self.file.period

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
        return f"{Address(self.broker.host).canonical_name(self.broker.port)}-{self.device}"

    def connection(self, timeout_s: float = 0.5) -> Relay:
        """Return the relay on a new connection that is not yet open and must be opened only once.

        Args:
            timeout_s: maximum time to wait for a reply (s), unless the relay file sets a longer
                time.

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        return Relay(self, max(timeout_s, self.file.answer_within))


class RelayLine:
    """A single connection to the broker, over which the relay is queried.

    Attributes:
        where: address of the relay, for messages.
        last_message: message to publish before the connection is closed; None for none.
    """

    def __init__(self, relay: RelayEndpoint, timeout_s: float) -> None:
        """Prepare the connection without opening it.

        Args:
            relay: the relay.
            timeout_s: maximum time to wait for a reply (s).

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        self.where = str(relay)
        self.last_message: RelayMessage | None = None
        self._file, self._timeout_s = relay.file, timeout_s
        # All connections use this name, so a broker can restrict who may publish under it. If
        # answers are numbered, an answer to another connection does not count.
        self._placeholders = {"device": relay.device, "me": f"greenroof_ros-{relay.device}"}
        self._numbers = itertools.count(secrets.randbelow(10**9))
        self._awaited: Counter[str] = Counter()
        self._received: deque[tuple[str, bytes]] = deque(maxlen=_MAX_WAITING)
        self._changed = threading.Condition()
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
        with self._changed:
            self._changed.wait_for(lambda: self._connected or self._closed_by, _CONNECT_S)
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

    def publish(self, message: RelayMessage, **values: str) -> str:
        """Publish a message once, and return its number.

        Args:
            message: message to the relay.
            values: values of the ``$`` placeholders in the message, in addition to those of the
                connection.

        Raises:
            DriveError: if the connection has been lost.
        """
        number = str(next(self._numbers))
        topic, payload = self._fill(message.topic), self._fill(message.payload, id=number, **values)
        if not self.connected or self._client.publish(topic, payload).rc:
            raise self.error("connection", f"the connection was closed: {self._closed_by}")
        return number

    def request(self, name: str) -> Any:
        """Send a request to the relay, and return its reply, parsed from JSON.

        Raises:
            DriveError: if no valid response arrives in time.
        """
        question = self._file.questions[name]
        if not self._awaited.total():
            self._received.clear()  # earlier messages answer no question
        self._awaited[name] += 1
        number = self.publish(question)
        topic, until = self._fill(question.answer), time.monotonic() + self._timeout_s
        payload = b""
        while (message := self._receive(until)) is not None:
            if message[0] != topic:
                continue
            payload = message[1]
            try:
                answer = json.loads(payload)
                value_at(answer, question.known_by)
                if self._file.number and str(value_at(answer, self._file.number)) != number:
                    continue
            except (ValueError, LookupError, RecursionError):
                continue
            self._awaited[name] -= 1
            if self._file.number or self._awaited[name] <= 0:
                self._awaited[name] = 0
                return answer
        if payload and self.connected:
            raise self.error("answer", (
                f"no valid reply to the request {name!r} within {self._timeout_s:g} s; received "
                f"{payload[:_SHOWN]!r}"
            ))
        raise self.error("connection", (
            f"no reply to the request {name!r} within {self._timeout_s:g} s"
            if self.connected else f"the connection was closed: {self._closed_by}"
        ))

    def error(self, kind: str, problem: str) -> DriveError:
        """Return an error that names the relay and the problem."""
        return DriveError(kind, f"{self.where}: {problem}")

    def _receive(self, until: float) -> tuple[str, bytes] | None:
        """Return the next message; None if none arrives in time or the connection ends."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._received or self._closed_by, max(0.0, until - time.monotonic())
            )
            return self._received.popleft() if self._received else None

    def _fill(self, text: str, **values: str) -> str:
        return Template(text).substitute(self._placeholders, **values)

    # --- in the client's thread -------------------------------------------------------------------

    def _on_connect(self) -> None:
        if not self._closed_by:  # after the end the client reconnects automatically
            topics = {self._fill(question.answer) for question in self._file.questions.values()}
            self._client.subscribe([(topic, 0) for topic in sorted(topics)])
            with self._changed:
                self._connected = True
                self._changed.notify()

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if not retained:
            with self._changed:
                self._received.append((topic, payload))
                self._changed.notify()

    def _on_disconnect(self, why: str) -> None:
        with self._changed:
            self._closed_by = self._closed_by or why
            self._changed.notify()


class Relay:
    """A relay on a single connection, which the caller opens and closes.

    Attributes:
        file: the relay file.
        line: the connection.
        stopped: whether the last `stop` on this connection was published; None before any `stop`.
    """

    def __init__(self, endpoint: RelayEndpoint, timeout_s: float) -> None:
        """Prepare the relay without opening a connection.

        Args:
            endpoint: the relay and its address.
            timeout_s: maximum time to wait for a reply (s).

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        self.file, self.line = endpoint.file, RelayLine(endpoint, timeout_s)
        self.stopped: bool | None = None
        # The state that was last ordered, None if unknown; and the state that it has reported since
        # *on* was last published, None if it has not answered.
        self._ordered: bool | None = None
        self._is_on: bool | None = None
        # Its timer as last read (s), None if it is not effective; and when *on* was published (s).
        self._timer_s: float | None = None
        self._on_at = 0.0

    def identify(self) -> str:
        """Return the relay's make, model and own name as text.

        Raises:
            DriveError: if the name cannot be read.
        """
        return f"{self.file.make} {self.file.model} ({_text(self._value(self.file.name))})"

    def timeout(self) -> tuple[float | None, str]:
        """Return the relay's timer (s), or None and the reason if the timer is not effective.

        The timer is not effective if it is off or too short to be renewed in time, or if another
        setting could switch the relay on unintentionally.

        Raises:
            DriveError: if the timer or another required setting cannot be read.
        """
        answers = {
            setting.question: self.line.request(setting.question)
            for setting in (self.file.timer, *self.file.must)
        }
        self._timer_s = None  # the earlier value was valid only until now
        for setting in self.file.must:
            if (value := _text(self._value(setting, answers))) != setting.value:
                return None, (
                    f"{setting.meaning}: {setting.path} is {value}, but must be {setting.value}"
                )
        timer = self.file.timer
        raw = self._value(timer, answers)
        if isinstance(raw, bool) or not isinstance(raw, int | float):
            raise self.line.error("answer", f"the timer {timer.path} is {raw!r}, not a number")
        try:
            seconds = timer.seconds(raw)
        except OverflowError:
            raise self.line.error("answer", f"the timer {timer.path} is too large") from None
        if seconds is None:
            return None, f"{timer.path} is {raw:g}, which means off"
        if seconds < self.file.min_timer:
            return None, (
                f"{timer.path} is {raw:g}, which is {seconds:g} s; a timer shorter than "
                f"{self.file.min_timer:g} s cannot be renewed in time"
            )
        self._timer_s = seconds
        return seconds, ""

    def read(self) -> DriveStatus:
        """Return the status that the relay reports.

        Raises:
            DriveError: if the state cannot be read or is an impossible value.
        """
        on = self._read()
        return DriveStatus(
            ready=True, running=on, fault="", warning="", speed=float(on), flow=None, remote=True
        )

    def local(self) -> bool:
        """Return False, since the local control of a relay cannot be detected."""
        return False

    def run(self, speed: float, may_continue: Callable[[], bool] = lambda: True) -> None:
        """Switch the relay on, or keep it on.

        The caller repeats the call while the relay must be on. *On* is published again only after
        the relay has replied to the last *on*. *On* is not published if the relay is off although
        it was switched on: see `second_master`.

        Args:
            speed: speed above 0 (share of the rated speed); a pump switched by a relay always runs
                at 1.
            may_continue: function that is called before switching on and while waiting; if it
                returns False, the call returns early.

        Raises:
            DriveError: if no valid response arrives, the relay's timer is not effective, or the
                relay does not switch on.
            ValueError: if the speed is out of range.
        """
        if not 0 < speed <= 1:
            raise ValueError(
                f"{speed} is not a valid speed for a relay that is on (above 0, at most 1)")
        timer_s = self._timer_s
        if timer_s is None:
            raise self.line.error(
                "drive", "the relay is not switched on: its own timer is not effective"
            )
        is_on = self._read() if self._is_on is None else self._is_on
        if self._ordered:
            # Renew it one period early, since the next round might be too late.
            due = self._on_at + _RENEWED * timer_s - self.file.period
            if is_on and time.monotonic() >= due:
                self._switch_on(timer_s)
        elif may_continue():
            self._switch_on(timer_s)
            self._wait_until_on(may_continue)

    def stop(self) -> None:
        """Switch the relay off; the caller repeats the call while the relay must be off.

        Raises:
            DriveError: if the connection has been lost.
        """
        self.stopped = False
        self.line.publish(self.file.switch_off)
        self._ordered, self.line.last_message = False, None
        self.stopped = True

    def reset(self) -> None:
        """Switch the relay off; a relay has no faults that could be acknowledged.

        Raises:
            DriveError: if the connection has been lost.
        """
        self.stop()

    def second_master(self) -> Diagnosis | None:
        """Return a diagnosis if the relay is known not to be in the state last commanded.

        Its own timer, a power failure, a person or another program may have switched the relay.

        Raises:
            DriveError: if no valid response arrives.
        """
        is_on = self._read()
        if self._ordered is None or is_on == self._ordered:
            return None
        return Diagnosis.of(
            "second_master", "on" if is_on else "off", "pause", where=self.line.where, pause=LIMIT_S
        )

    def _read(self) -> bool:
        """Return whether the relay reports that it is on."""
        self._is_on, state = None, self.file.state
        answer = _text(self._value(state))
        if answer not in (state.is_on, state.is_off):
            raise self.line.error(
                "answer",
                f"the state {state.path} is {answer}, neither {state.is_on} nor {state.is_off}",
            )
        self._is_on = answer == state.is_on
        return self._is_on

    def _switch_on(self, timer_s: float) -> None:
        self.line.last_message = self.file.switch_off
        self._on_at, self._is_on = time.monotonic(), None
        self.line.publish(self.file.switch_on, seconds=f"{timer_s:g}")

    def _wait_until_on(self, may_continue: Callable[[], bool]) -> None:
        self._ordered = None  # unknown until it has answered
        while not self._read():
            if not may_continue():
                return
            if time.monotonic() > self._on_at + _ON_S:
                raise self.line.error(
                    "drive", f"the relay was switched on, but is still off after {_ON_S:g} s"
                )
            time.sleep(_POLL_S)
        self._ordered = True

    def _value(self, value: Value, answers: Mapping[str, Any] | None = None) -> Any:
        """Return a value from the replies; if there are none, send the value's request first."""
        answer = self.line.request(value.question) if answers is None else answers[value.question]
        try:
            return value_at(answer, value.path)
        except LookupError:
            raise self.line.error(
                "answer", f"the reply does not contain {value.path}: {answer}"
            ) from None


def _text(value: Any) -> str:
    """Return a value as JSON text, or a string without its quotes."""
    return value if isinstance(value, str) else json.dumps(value)
