"""A site on MQTT: says what the page says, and has the pump stopped; see :class:`Bridge`."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Any

from greenroof_ros.common.mqtt import Broker, make_client
from greenroof_ros.common.processes import Signals
from greenroof_ros.common.standard_error import say
from greenroof_ros.graph.looker import StopFailedError
from greenroof_ros.watch.document import document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.home_assistant import (
    NUMBERS,
    OFF,
    OFFLINE,
    ON,
    ONLINE,
    STOP,
    base_of,
    discovery,
)
from greenroof_ros.watch.store import Store
from greenroof_ros.watch.words import UNKNOWN, display_of

# How often it looks, and how often it says the same again: three times before that expires (s).
_LOOK_S, _AT_LEAST_S = 1.0, 10.0
# Home Assistant takes a state of so many characters, and its records attributes of 16 kB.
_MOST_TEXT, _MOST_ALARMS = 255, 10
# How long the last word may take to be sent (s).
_LAST_WORD_S = 1.0


class Bridge:
    """Says how a site is, and has its pump stopped; nothing else can be asked.

    Under ``greenroof/SITE/`` are ``state``, ``alarms``, ``availability`` and, to be written to,
    ``stop``. A state is not retained: who comes later would take an old value for one of now. It
    comes with each change, and at least every 10 s. A stop counts when it was sent just now: one
    that is retained would stop the pump at each connection, and none is queued for this client.
    """

    def __init__(
        self, store: Store, feed: Feed, broker: Broker, prefix: str = "homeassistant"
    ) -> None:
        """Be connected to nothing yet.

        Args:
            store: what is said.
            feed: stops the pump.
            broker: where the site is said.
            prefix: of Home Assistant's topics.

        Raises:
            ConfigurationError: there is no MQTT library, or a file for the login is wrong.
        """
        site = store.namespace.strip("/").replace("/", "_") or "roof"
        self._store, self._feed, self._broker = store, feed, broker
        self._base, self._status = base_of(site), f"{prefix}/status"
        self._discovery = discovery(site, prefix)
        self._stop, self._again = threading.Event(), threading.Event()
        self._why = ""  # the connection is not there
        self._said: dict[str, str] = {}
        self._said_at = 0.0
        self._client = make_client(
            broker, f"greenroof_{site}", self._on_connect, self._on_message, self._on_disconnect,
            will=(f"{self._base}/availability", OFFLINE),
        )

    def run(self, signals: Signals) -> None:
        """Say how the site is until a signal comes.

        Args:
            signals: that end it.

        Raises:
            InterruptedRun: one came.
        """
        self._client.loop_start()
        try:
            while True:
                signals.check()
                if self._stop.wait(_LOOK_S):
                    self._stop.clear()
                    self._stop_pump()
                self._say_state()
        finally:
            if self._client.is_connected():
                last = self._client.publish(f"{self._base}/availability", OFFLINE, retain=True)
                last.wait_for_publish(_LAST_WORD_S)
            self._client.disconnect()
            self._client.loop_stop()

    def _stop_pump(self) -> None:
        try:
            say(f"stop, over MQTT: {self._feed.ask('stop')}")
        except StopFailedError as failure:
            say(f"stop, over MQTT: {failure}")

    def _say_state(self) -> None:
        shown = document(self._store, time.monotonic())
        with self._store.lock:
            messages = {"state": state_of(self._store, shown), "alarms": alarms_of(shown)}
        now, again = time.monotonic(), self._again.is_set()
        self._again.clear()
        if now - self._said_at >= _AT_LEAST_S or again:
            self._said, self._said_at = {}, now
        for name, content in messages.items():
            text = json.dumps(content, allow_nan=False)
            if self._said.get(name) != text:
                self._said[name] = text
                self._client.publish(f"{self._base}/{name}", text)

    # --- in the client's thread -----------------------------------------------------------------

    def _on_connect(self) -> None:
        self._why = ""
        say(f"connected to {self._broker}; topics: {self._base}/")
        for topic in (f"{self._base}/stop", self._status):
            self._client.subscribe(topic)
        self._introduce()

    def _introduce(self) -> None:
        """Say all again: to a broker that is there again, or a Home Assistant that has started."""
        for topic, text in self._discovery.items():
            self._client.publish(topic, text, retain=True)
        self._client.publish(f"{self._base}/availability", ONLINE, retain=True)
        self._again.set()

    def _on_disconnect(self, why: str) -> None:
        if why != self._why:
            say(f"not connected to {self._broker}: {why}; it goes on trying")
        self._why = why

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if topic == self._status:
            if payload == ONLINE.encode():
                self._introduce()
        elif payload != STOP.encode():
            say(f"{topic}: ignored, since it is not {STOP}")
        elif retained:
            say(f"{topic}: ignored, since the broker has kept it: send it without 'retain'")
        else:
            self._stop.set()


def state_of(store: Store, shown: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state's fields, in the page's units; None is *unknown*.

    Args:
        store: what is known, whose lock the caller has.
        shown: the document of that store.
    """
    tiles, pump = shown["tiles"], shown["tiles"]["pump"]
    here, now, plan = store.mode not in ("none", "ended"), store.now, store.plan
    planned: tuple[float | None, float | None] = None, None
    if here and plan is not None and now is not None and now < plan.ends[-1]:
        planned = plan.pumped(now)
    volume, begin = planned
    numbers = {
        "roof_level": tiles["roof"]["number"], "cistern_level": tiles["cistern"]["number"],
        "rain": tiles["rain"]["number"], "flow": pump["number"],
        "command": store.known("/pump/command"),
    }
    frost, serious = store.known("/weather/frost"), tiles["summary"]["level"] == "error"
    present = [row for row in shown["alarms"] if row["over"] is None]
    return {
        "mode": store.mode,
        **{key: _number(NUMBERS[key][0], one if here else None) for key, one in numbers.items()},
        "pump": pump["value"] if here else UNKNOWN,
        "plan": tiles["controller"]["sentence"][:_MOST_TEXT] if here else UNKNOWN,
        "planned_volume": None if volume is None else round(volume * 1e3),
        "planned_start": None if begin is None or begin == now  # it pumps
        else datetime.fromtimestamp(begin, timezone.utc).isoformat(timespec="seconds"),
        "frost": None if frost is None or not here else ON if frost else OFF,
        "condition": (present[0]["code"] or UNKNOWN) if present else "none" if here else UNKNOWN,
        "problem": ON if serious else OFF if here else None,
        "can_stop": shown["stop"]["possible"],
    }


def _number(topic: str, value: float | None) -> float | None:
    display = display_of(topic)
    return None if value is None else round(value * display.factor, display.decimals or None)


def alarms_of(shown: Mapping[str, Any]) -> dict[str, Any]:
    """Return how things are, what to do, and the alarms of now, as the document has them."""
    summary = shown["tiles"]["summary"]
    return {
        "summary": f"{summary['word']} {summary['sentence']}",
        "advice": shown["advice"],
        "alarms": [
            {key: row[key] for key in ("code", "level", "id", "what", "do", "follows", "since")}
            for row in shown["alarms"] if row["over"] is None
        ][:_MOST_ALARMS],
        "notes": shown["notes"],
    }
