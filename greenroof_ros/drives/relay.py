"""One relay on MQTT, switched as its file says; its own timer is its communication timeout.

Each *on* lasts no longer than that timer, and is published again after at most a third of it, each
time only after the relay has answered: an *on* that waits on a stalled connection is the only such,
and is followed there by the *off* with which the connection is given up. All is of quality of
service 0 and not retained, so that nobody keeps it for later.
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

from greenroof_ros.common.mqtt import Broker, make_client
from greenroof_ros.drives.drive import DriveStatus
from greenroof_ros.drives.modbus_line import SIMULATOR, Address, DriveError
from greenroof_ros.drives.relay_file import Message, RelayFile, Timer, Value

# How long the broker is waited for (s).
_CONNECT_S = 3.0
# How long the relay may take to be on after *on*, and how often it is asked meanwhile (s).
_ON_S, _LOOK_S = 2.0, 0.1
# An *on* is renewed after this share of the timer.
_RENEWED = 1 / 3
# So much of an answer that is none is shown (characters), and so many messages wait at most.
_SHOWN, _KEPT = 120, 1000


@dataclass(frozen=True)
class PlacedRelay:
    """A make of relay at an address.

    Attributes:
        file: what the relay is like.
        broker: that it is connected to.
        device: its own topic there.
    """

    file: RelayFile
    broker: Broker
    device: str

    def __str__(self) -> str:
        return f"{self.broker}/{self.device}"

    @property
    def period(self) -> float:
        """Least time between two rounds of questions (s)."""
        return self.file.period

    @property
    def guard(self) -> Timer:
        """What switches it off when nobody is heard."""
        return self.file.timer

    @property
    def is_here(self) -> bool:
        """Whether its broker is at loopback; may wait for a host to be looked up."""
        return Address(self.broker.host).is_here

    def place(self) -> str:
        """Return where it is, by the same name for each way to write the address.

        May wait for the name of a host to be looked up.

        Raises:
            OSError: there is no such host, or nobody who knows it answers.
        """
        return f"{Address(self.broker.host).place(self.broker.port)}-{self.device}"

    def place_of_lock(self) -> str:
        """Return what one driver alone may have: the relay.

        Raises:
            OSError: likewise.
        """
        return self.place()

    def connection(self, timeout_s: float = 0.5) -> Relay:
        """Return it, to be connected once; nothing is opened yet.

        Args:
            timeout_s: longest wait for an answer (s), where its file does not ask for more.

        Raises:
            ConfigurationError: there is no MQTT library, or a file for the login is wrong.
        """
        return Relay(self, max(timeout_s, self.file.answer_within))


class RelayLine:
    """One connection to the broker, and questions to the relay over it.

    Attributes:
        where: the relay is, for messages.
        parting: published before the connection is closed; None for nothing.
    """

    def __init__(self, relay: PlacedRelay, timeout_s: float) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            relay: that is asked.
            timeout_s: longest wait for an answer (s).

        Raises:
            ConfigurationError: there is no MQTT library, or a file for the login is wrong.
        """
        self.where = str(relay)
        self.parting: Message | None = None
        self._file, self._timeout_s = relay.file, timeout_s
        # One name for all connections, so that a broker can limit who may publish on it; where
        # answers have numbers, an answer to another connection does not count.
        self._known = {"device": relay.device, "me": f"greenroof_ros-{relay.device}"}
        self._numbers = itertools.count(secrets.randbelow(10**9))
        self._awaited: Counter[str] = Counter()
        self._heard: deque[tuple[str, bytes]] = deque(maxlen=_KEPT)
        self._changed = threading.Condition()
        self._connected, self._closed_by = False, ""
        self._client = make_client(
            relay.broker, f"greenroof_ros-{secrets.token_hex(6)}", self._on_connect,
            self._on_message, self._on_disconnect,
        )

    @property
    def connected(self) -> bool:
        """Whether the broker has let it in, and the connection has not ended since."""
        return self._connected and not self._closed_by

    def connect(self) -> None:
        """Connect to the broker.

        Raises:
            DriveError: nobody answers there, or does not let this in.
        """
        self._client.loop_start()
        with self._changed:
            self._changed.wait_for(lambda: self._connected or self._closed_by, _CONNECT_S)
        if not self.connected:
            why = self._closed_by or f"no answer within {_CONNECT_S:g} s"
            raise self.error("connection", f"cannot connect: {why}")

    def close(self) -> None:
        """Part from the relay, and close the connection."""
        if self.parting is not None and self.connected:
            with suppress(DriveError):  # it has just been lost
                self.publish(self.parting)
        self._closed_by = self._closed_by or "closed here"
        self._client.disconnect()
        self._client.loop_stop()

    def publish(self, message: Message, **values: str) -> None:
        """Publish a message once, if there is a connection.

        Args:
            message: to the relay.
            values: of names with a $ in it, besides the connection's own.

        Raises:
            DriveError: there is no connection any more.
        """
        self._publish(message.topic, message.payload, str(next(self._numbers)), values)

    def ask(self, name: str) -> Any:
        """Return the relay's answer to a question, as JSON has it.

        Raises:
            DriveError: no answer in time, or none that can be understood.
        """
        question, number = self._file.questions[name], str(next(self._numbers))
        if not self._awaited.total():
            self._heard.clear()  # what came unasked answers nothing
        self._awaited[name] += 1
        self._publish(question.topic, question.payload, number, {})
        topic, until = self._filled(question.answer), time.monotonic() + self._timeout_s
        payload = b""
        while (message := self._next(until)) is not None:
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
                f"no answer to the question {name!r} that can be understood within "
                f"{self._timeout_s:g} s, but {payload[:_SHOWN]!r}"
            ))
        raise self.error("connection", (
            f"no answer to the question {name!r} within {self._timeout_s:g} s"
            if self.connected else f"the connection was closed: {self._closed_by}"
        ))

    def error(self, kind: str, problem: str) -> DriveError:
        """Return what went wrong, with where."""
        return DriveError(kind, f"{self.where}: {problem}")

    def _next(self, until: float) -> tuple[str, bytes] | None:
        """Return the next message; None where none comes until a time, or the connection ends."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._heard or self._closed_by, max(0.0, until - time.monotonic())
            )
            return self._heard.popleft() if self._heard else None

    def _filled(self, text: str, **values: str) -> str:
        return Template(text).substitute(self._known, **values)

    def _publish(self, topic: str, payload: str, number: str, values: dict[str, str]) -> None:
        filled = self._filled(payload, id=number, **values)
        if not self.connected or self._client.publish(self._filled(topic), filled).rc:
            raise self.error("connection", f"the connection was closed: {self._closed_by}")

    # --- in the client's thread -------------------------------------------------------------------

    def _on_connect(self) -> None:
        if not self._closed_by:  # the client connects again by itself
            topics = {self._filled(question.answer) for question in self._file.questions.values()}
            self._client.subscribe([(topic, 0) for topic in sorted(topics)])
            with self._changed:
                self._connected = True
                self._changed.notify()

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if not retained:
            with self._changed:
                self._heard.append((topic, payload))
                self._changed.notify()

    def _on_disconnect(self, why: str) -> None:
        with self._changed:
            self._closed_by = self._closed_by or why
            self._changed.notify()


class Relay:
    """One relay; one connection, which who uses it opens and closes.

    Attributes:
        file: what the relay is like.
        line: the connection.
        stopped: whether the last `stop` on this connection was written; None where there was none.
    """

    def __init__(self, placed: PlacedRelay, timeout_s: float) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            placed: what it is like, and where.
            timeout_s: longest wait for an answer (s).

        Raises:
            ConfigurationError: there is no MQTT library, or a file for the login is wrong.
        """
        self.file, self.line = placed.file, RelayLine(placed, timeout_s)
        self.stopped: bool | None = None
        self._placed = placed
        # What it was switched to last, None where that is not known; and what it has said since
        # *on* was published last, None for nothing.
        self._ordered: bool | None = None
        self._is_on: bool | None = None
        # Its timer as read last, None where that does not guard; and when *on* was published (s).
        self._timer_s: float | None = None
        self._on_at = 0.0

    def identify(self) -> str:
        """Return what it says that it is, for people.

        Raises:
            DriveError: it cannot be read.
        """
        return f"{self.file.make} {self.file.model} ({_text(self._value(self.file.name))})"

    def timeout(self) -> tuple[float | None, str]:
        """Return its timer (s); where it does not guard None, and why.

        It does not where it is off or too short to be renewed in time, or where another setting
        would have the relay on by itself.

        Raises:
            DriveError: it cannot be read.
        """
        answers = {
            setting.question: self.line.ask(setting.question)
            for setting in (self.file.timer, *self.file.must)
        }
        self._timer_s = None  # what was read before holds until there are answers
        for setting in self.file.must:
            if (value := _text(self._value(setting, answers))) != setting.value:
                return None, (
                    f"{setting.meaning}: {setting.path} is {value}, and must be {setting.value}"
                )
        timer = self.file.timer
        raw = self._value(timer, answers)
        if isinstance(raw, bool) or not isinstance(raw, int | float):
            raise self.line.error("answer", f"its timer, {timer.path}, is {raw!r}: no number")
        try:
            seconds = timer.seconds(raw)
        except OverflowError:
            raise self.line.error("answer", f"its timer, {timer.path}, is too large") from None
        if seconds is None:
            return None, f"{timer.path} is {raw:g}: off"
        if seconds < self.file.least_timer:
            return None, (
                f"{timer.path} is {raw:g}, which is {seconds:g} s: less than "
                f"{self.file.least_timer:g} s cannot be renewed in time"
            )
        self._timer_s = seconds
        return seconds, ""

    def read(self) -> DriveStatus:
        """Return what it says of itself.

        Raises:
            DriveError: it cannot be read, or says what cannot be.
        """
        on = self._read()
        return DriveStatus(
            ready=True, running=on, fault="", warning="", speed=float(on), flow=None, remote=True
        )

    def local(self) -> bool:
        """Return that nobody can be seen to have it in local control."""
        return False

    def run(self, speed: float, go_on: Callable[[], bool] = lambda: True) -> None:
        """Switch it on, or keep it on; to be called again and again while it is to be on.

        Nothing is published where the relay has not answered since the last *on*, and where it is
        off although it was switched on: see `intruder`.

        Args:
            speed: share of rated speed; a relay has no other than 1.
            go_on: asked while it is waited for; where it says no, the wait ends there.

        Raises:
            DriveError: no or a wrong answer; its timer does not guard; it does not switch on.
            ValueError: the speed is out of range.
        """
        if not 0 < speed <= 1:
            raise ValueError(f"{speed} is no speed at which a relay is on")
        timer_s = self._timer_s
        if timer_s is None:
            raise self.line.error("drive", "it is not switched on: its own timer does not guard")
        is_on = self._read() if self._is_on is None else self._is_on
        if self._ordered:
            # The next round might be too late.
            due = self._on_at + _RENEWED * timer_s - self.file.period
            if is_on and time.monotonic() >= due:
                self._switch_on(timer_s)
        elif go_on():
            self._switch_on(timer_s)
            self._until_on(go_on)

    def stop(self) -> None:
        """Switch it off; to be called again and again while it is to be off.

        Raises:
            DriveError: there is no connection any more.
        """
        self.stopped = False
        self.line.publish(self.file.switch_off)
        self._ordered, self.line.parting = False, None
        self.stopped = True

    def reset(self) -> None:
        """Stop: a relay has no fault of its own.

        Raises:
            DriveError: there is no connection any more.
        """
        self.stop()

    def intruder(self) -> str:
        """Return that it is not as it was switched last; empty where it is, or that is unknown.

        Its own timer, a loss of power, and a person or a program may have switched it.

        Raises:
            DriveError: no or a wrong answer.
        """
        is_on = self._read()
        if self._ordered is None or is_on == self._ordered:
            return ""
        if is_on:
            return f"{self.line.where}: somebody else has switched the relay on"
        return (
            f"{self.line.where}: the relay is off although it was switched on: somebody else has "
            "switched it off, it was without power, or its timer has passed"
        )

    def why_no_simulator(self) -> str:
        """Return why it is not, for certain, the relay simulator; empty where it is.

        Nothing is published to switch it, and nothing at all where the broker is not at loopback.

        Raises:
            DriveError: nobody answers there, of the kind ``connection``.
        """
        if not self._placed.is_here:
            return f"the broker of {self.line.where} is not at loopback"
        try:
            named = _text(self._value(self.file.name))
        except DriveError as error:
            if error.kind == "connection":
                raise
            return f"what is there does not identify itself as that ({error})"
        return "" if named == " ".join(SIMULATOR) else (
            f"what is at {self.line.where} identifies itself as {named!r}"
        )

    def _read(self) -> bool:
        """Return whether it is on, as it says."""
        self._is_on, state = None, self.file.state
        answer = _text(self._value(state))
        if answer not in (state.is_on, state.is_off):
            raise self.line.error(
                "answer",
                f"its state, {state.path}, is {answer}, neither {state.is_on} nor {state.is_off}",
            )
        self._is_on = answer == state.is_on
        return self._is_on

    def _switch_on(self, timer_s: float) -> None:
        self.line.parting = self.file.switch_off
        self._on_at, self._is_on = time.monotonic(), None
        self.line.publish(self.file.switch_on, seconds=f"{timer_s:g}")

    def _until_on(self, go_on: Callable[[], bool]) -> None:
        self._ordered = None  # what comes of it is not known
        while not self._read():
            if not go_on():
                return
            if time.monotonic() > self._on_at + _ON_S:
                raise self.line.error(
                    "drive", f"it was switched on, and is still off after {_ON_S:g} s"
                )
            time.sleep(_LOOK_S)
        self._ordered = True

    def _value(self, value: Value, answers: Mapping[str, Any] | None = None) -> Any:
        """Return a value of an answer; the relay is asked where there are no answers yet."""
        answer = self.line.ask(value.question) if answers is None else answers[value.question]
        try:
            return value_at(answer, value.path)
        except LookupError:
            raise self.line.error("answer", f"its answer has no {value.path}: {answer}") from None


def value_at(answer: Any, path: str) -> Any:
    """Return what an answer has at a path such as ``result.output``.

    Raises:
        LookupError: nothing.
    """
    for name in path.split("."):
        if not isinstance(answer, dict):
            raise LookupError(path)
        answer = answer[name]
    return answer


def _text(value: Any) -> str:
    """Return a value as JSON writes it, a text without its quotes."""
    return value if isinstance(value, str) else json.dumps(value)
