"""A simulated relay on a real MQTT broker, and a simulated valve that follows its contact.

The relay has a contact, a timer and settings. It understands the messages in its relay file, and
replies with what the file expects. Every relay file can therefore be tried.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import re
import time
from collections.abc import Callable, Iterator
from typing import Any

from greenroof_ros.base.mqtt import Broker, make_client, parse_path
from greenroof_ros.live.devices.drive_file import RelayFile, RelayMessage


class SimulatedRelay:
    """A relay with its contact, which reconnects to its broker automatically.

    Attributes:
        timer_s: setting of the relay's timer (s).
        settings: values of the settings in its replies, by path.
    """

    def __init__(self, file: RelayFile, broker: Broker, device: str, timer_s: float) -> None:
        """Initialize a relay that is off and not connected.

        Args:
            file: the relay file.
            broker: the broker to which the relay connects.
            device: the relay's own topic.
            timer_s: setting of the relay's timer (s).

        Raises:
            ConfigurationError: if the MQTT library is not installed, or a login file is invalid.
        """
        self._file, self._device = file, device
        self._off_at = -math.inf
        self.settings: dict[str, Any] = {
            setting.path: _value(setting.value) for setting in file.must
        }
        self._questions = (file.state, file.timer, *file.must)
        self.set_timer(timer_s)
        self.client = make_client(
            broker, "greenroof_ros-simulated", self._subscribe, self._on_message,
        )

    @property
    def on(self) -> bool:
        """Whether the output is on, as the relay reports; its timer switches it off."""
        return time.monotonic() < self._off_at

    @property
    def speed(self) -> float:
        """The speed of the pump that the relay's contact switches (share of the rated speed)."""
        return float(self.on)

    def set_timer(self, seconds: float) -> None:
        """Set the timer of the relay (s)."""
        self.timer_s, timer = seconds, self._file.timer
        self.settings[timer.path] = round(seconds / timer.scale, 3)

    def switch(self, on: bool, seconds: float) -> None:
        """Switch the relay off, or on for a time (s)."""
        self._off_at = time.monotonic() + seconds if on else -math.inf

    def receive(self, topic: str, payload: str) -> Iterator[tuple[str, str]]:
        """Receive a message, and yield the topic and the payload of every reply."""
        file = self._file
        for message, on in ((file.switch_on, True), (file.switch_off, False)):
            if (given := self._match(message, topic, payload)) is not None:
                self.switch(on, float(given.get("seconds", self.timer_s)))
                return
        state = file.state.is_on if self.on else file.state.is_off
        values, reply, to = {file.state.path: _value(state), **self.settings}, dict[Any, Any](), ""
        for question in self._questions:
            if (given := self._match(question, topic, payload)) is not None:
                *parents, last = parse_path(question.path)
                part = reply
                for name in parents:
                    part = part.setdefault(name, {})
                part[last] = values[question.path]
                to = self._fill(question.answer, given.get("me", ""))
        if to:
            yield to, json.dumps(reply)

    def _match(self, message: RelayMessage, topic: str, payload: str) -> dict[str, str] | None:
        """Return the values of the placeholders in a message; None if it is another message."""
        text = f"{message.topic}\n{message.payload}".replace("$device", self._device)
        pattern = re.sub(r"\\\$(\w+)", r"(?P<\1>.+?)", re.escape(text))
        found = re.fullmatch(pattern, f"{topic}\n{payload}")
        return None if found is None else found.groupdict()

    def _fill(self, topic: str, me: str) -> str:
        return topic.replace("$device", self._device).replace("$me", me)

    # --- on the broker ----------------------------------------------------------------------------

    async def run(self, ended: asyncio.Event) -> None:
        """Run the relay until the simulator stops."""
        self._loop = asyncio.get_running_loop()
        self.client.loop_start()
        await ended.wait()
        self.client.disconnect()
        self.client.loop_stop()

    def _subscribe(self) -> None:
        messages = (self._file.switch_on, self._file.switch_off, *self._questions)
        topics = {self._fill(message.topic, "+") for message in messages}
        self.client.subscribe([(topic, 0) for topic in sorted(topics)])

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        """Pass a message from the client's thread to the event loop."""
        self._loop.call_soon_threadsafe(self.answer, topic, payload.decode(errors="replace"))

    def answer(self, topic: str, payload: str) -> None:
        """Publish the relay's replies to a message."""
        for reply in self.receive(topic, payload):
            self.client.publish(*reply)


def _value(text: str) -> Any:
    """Return a value that a relay file gives in JSON notation."""
    with contextlib.suppress(ValueError):
        return json.loads(text)
    return text


# --- the valve ------------------------------------------------------------------------------------

FAULTS = "stuck_open", "stuck_closed", "leak", "wrong_switch"
# Flow through a valve that leaks (m3/s).
LEAK = 2.0 / 60_000
# The end switches are on within this share of the ends.
_AT_END = 0.01


class SimulatedValve:
    """A valve that opens while its relay is on, and otherwise closes.

    Attributes:
        position: share to which the valve is open, 0 to 1.
        fault: the fault that it has; empty for none.
    """

    def __init__(self, on: Callable[[], bool], travel_s: float, fault: str = "") -> None:
        """Initialize a closed valve.

        Args:
            on: function that returns whether the relay is on.
            travel_s: time that the valve takes to open or to close (s).
            fault: one of `FAULTS`; empty for none.
        """
        self._on, self._travel_s = on, travel_s
        self.position, self._at = 0.0, time.monotonic()
        self.fault = fault

    def advance(self) -> float:
        """Move the valve up to the present time, and return its position."""
        before, self._at = self._at, time.monotonic()
        opens = self._on()
        if self.fault != ("stuck_closed" if opens else "stuck_open"):
            way = (self._at - before) / self._travel_s
            self.position = min(max(self.position + (way if opens else -way), 0.0), 1.0)
        return self.position

    def switches(self) -> dict[str, float]:
        """Return the states of the end switches, by their sections of the sensor file."""
        is_open = self.position >= 1 - _AT_END or self.fault == "wrong_switch"
        return {"open_switch": is_open, "closed_switch": self.position <= _AT_END}
