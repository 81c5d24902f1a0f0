"""Simulated relays on a real MQTT broker, with contact, timer, settings and replies.

The replies are based on the manufacturer's documentation. The driver, in contrast, uses the
requests in the relay file, so the simulator and the driver verify each other.
"""

from __future__ import annotations

import asyncio
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar

from greenroof_ros.base.mqtt import Broker, make_client

_STEP_S = 0.01
# A topic and the payload that is published there.
Published = tuple[str, str]


class SimulatedRelay(ABC):
    """Base class for a relay with its contact; it reads the time from a clock.

    Attributes:
        on: whether the output is on, as the relay reports.
        timer_s: setting of the relay's timer (s); None if it is off.
        on_after_power_up: whether the relay is set to be on after power-up.
        auto_on: whether the relay is set to switch itself on again.
        log: function that prints a line about an event.
    """

    TOPICS: ClassVar[tuple[str, ...]]
    """topics that it subscribes to; {} stands for its own topic"""

    def __init__(
        self, device: str, timer_s: float | None, clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Initialize a relay that is off.

        Args:
            device: topic of the relay itself.
            timer_s: setting of the relay's timer (s); None if it is off.
            clock: function that returns the time (s).
        """
        self.on = False
        self.timer_s = timer_s
        self.on_after_power_up = self.auto_on = False
        self.log: Callable[[str], None] = lambda text: None
        self._device, self._clock = device, clock
        self._off_at = math.inf

    @property
    def speed(self) -> float:
        """The speed of the pump that the relay's contact switches (share of the rated speed)."""
        return float(self.on)

    def advance(self) -> None:
        """Simulate the relay until now: switch off if its timer has expired."""
        if self._clock() >= self._off_at:
            self._set(False)
            self.log("the timer has expired: off")

    def switch(self, on: bool, seconds: float | None) -> None:
        """Switch the relay off, or on for a time (s; None for no limit)."""
        self.advance()
        if on != self.on:
            self.log("on" if on else "off")
        self._set(on)
        if on and seconds is not None:
            self._off_at = self._clock() + seconds

    def _set(self, on: bool) -> None:
        self.on, self._off_at = on, math.inf

    @abstractmethod
    def receive(self, topic: str, payload: str) -> Iterator[Published]:
        """Receive a message, and yield the messages that the relay publishes in return."""


class Shelly(SimulatedRelay):
    """Shelly relay of generation 2, with JSON-RPC over MQTT.

    Requests arrive on DEVICE/rpc; replies go to SRC/rpc (``src`` of the request) with the request's
    id.
    """

    TOPICS = ("{}/rpc",)

    def receive(self, topic: str, payload: str) -> Iterator[Published]:
        """Execute a request, and yield the reply."""
        try:
            request = json.loads(payload)
            answer = {"id": request["id"], "src": self._device, "dst": request["src"]}
            method, params = request["method"], request.get("params", {})
        except (ValueError, TypeError, KeyError):
            return
        result = self._execute(method, params)
        answer |= {"error": {"code": 404, "message": f"No handler for {method}"}} \
            if result is None else {"result": result}
        yield f"{request['src']}/rpc", json.dumps(answer)

    def _execute(self, method: str, params: Mapping[str, Any]) -> dict[str, Any] | None:
        if method == "Shelly.GetDeviceInfo":
            return {"name": None, "id": self._device, "gen": 2, "app": "simulator"}
        if params.get("id") != 0:
            return None
        match method:
            case "Switch.Set":
                was_on = self.on
                self.switch(bool(params["on"]), params.get("toggle_after", self.timer_s))
                return {"was_on": was_on}
            case "Switch.GetStatus":
                self.advance()
                return {"id": 0, "source": "MQTT", "output": self.on}
            case "Switch.GetConfig":
                return {
                    "id": 0, "name": None, "in_mode": "detached",
                    "initial_state": "on" if self.on_after_power_up else "off",
                    "auto_on": self.auto_on, "auto_on_delay": 60.0,
                    "auto_off": self.timer_s is not None, "auto_off_delay": self.timer_s or 60.0,
                }
        return None


class Tasmota(SimulatedRelay):
    """Tasmota relay, with commands on cmnd/DEVICE/COMMAND and replies on stat/DEVICE/...

    A command without a payload is a query. A PulseTime of 1 to 111 is a time in 0.1 s, 112 to
    64900 is seconds plus 100, and 0 means off. PowerOnState is 0 (off) or 3 (previous state, the
    factory setting).
    """

    TOPICS = ("cmnd/{}/+",)

    def receive(self, topic: str, payload: str) -> Iterator[Published]:
        """Carry out a command, and yield the replies."""
        command = topic.rpartition("/")[2].lower()
        match command, payload.lower():
            case ("power" | "power1", "on" | "off" as word):
                self.switch(word == "on", self.timer_s)
                yield self._result({"POWER": self._word()})
                yield f"stat/{self._device}/POWER", self._word()
            case ("status", "11"):
                yield f"stat/{self._device}/STATUS11", json.dumps({"StatusSTS": {
                    "Time": time.strftime("%Y-%m-%dT%H:%M:%S"), "POWER": self._word(),
                }})
            case ("status", "2"):
                yield f"stat/{self._device}/STATUS2", json.dumps({"StatusFWR": {
                    "Version": "simulator",
                }})
            case ("pulsetime1", ""):
                remaining = max(0.0, self._off_at - self._clock()) if self.on else 0.0
                yield self._result({"PulseTime1": {
                    "Set": _pulse_time(self.timer_s), "Remaining": _pulse_time(
                        remaining if math.isfinite(remaining) else None),
                }})
            case ("poweronstate", ""):
                yield self._result({"PowerOnState": 3 if self.on_after_power_up else 0})
            case ("setoption0", ""):
                yield self._result({"SetOption0": "ON" if self.on_after_power_up else "OFF"})

    def _word(self) -> str:
        self.advance()
        return "ON" if self.on else "OFF"

    def _result(self, value: Mapping[str, Any]) -> Published:
        return f"stat/{self._device}/RESULT", json.dumps(value)


def _pulse_time(seconds: float | None) -> int:
    if seconds is None:
        return 0
    return round(10 * seconds) if seconds <= 11.1 else round(seconds) + 100


RELAYS: Mapping[str, type[SimulatedRelay]] = {"Shelly": Shelly, "Tasmota": Tasmota}


class RelayOnBroker:
    """A simulated relay that is connected to a broker; it reconnects automatically.

    Attributes:
        relay: the relay.
        client: MQTT client that is connected to the broker.
    """

    def __init__(self, relay: SimulatedRelay, broker: Broker, device: str) -> None:
        """Prepare the client without connecting.

        Args:
            relay: the relay.
            broker: broker to which the relay connects.
            device: the relay's own topic on the broker.

        Raises:
            ConfigurationError: if the MQTT library is not installed, or a login file is invalid.
        """
        self.relay, self._broker, self._device = relay, broker, device
        self._topics = [topic.format(device) for topic in relay.TOPICS]
        self.client = make_client(
            broker, "greenroof_ros-simulated", self._subscribe, self._on_message,
        )

    def __str__(self) -> str:
        """Return the address of the relay."""
        return f"{self._broker}/{self._device}"

    async def run(self, ended: asyncio.Event) -> None:
        """Run the relay until the simulator stops."""
        self._loop = asyncio.get_running_loop()
        self.client.loop_start()
        try:
            while not ended.is_set():
                self.relay.advance()
                await asyncio.sleep(_STEP_S)
        finally:
            self.client.disconnect()
            self.client.loop_stop()

    def _subscribe(self) -> None:
        self.client.subscribe([(topic, 0) for topic in self._topics])

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        """Pass a message from the client's thread to the event loop."""
        self._loop.call_soon_threadsafe(self.receive, topic, payload)

    def receive(self, topic: str, payload: bytes) -> None:
        """Publish the relay's replies to a message."""
        for answer in self.relay.receive(topic, payload.decode(errors="replace")):
            self.client.publish(*answer)
