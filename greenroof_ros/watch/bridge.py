"""MQTT bridge that publishes the page's values and accepts stop requests; see :class:`Bridge`."""

from __future__ import annotations

import json
import math
import threading
import time
import traceback
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timezone
from typing import Any

from greenroof_ros.base.mqtt import Broker, make_client
from greenroof_ros.base.processes import Signals
from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.watch.document import join_summary, make_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import PumpRequestError
from greenroof_ros.watch.home_assistant import (
    NUMBERS,
    OFF,
    OFFLINE,
    ON,
    ONLINE,
    PREFIX,
    STOP,
    make_discovery,
    make_prefix,
)
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.words import UNKNOWN, find_display

# Interval at which the state is checked, and at which it is sent even if unchanged (s): three times
# before it expires in Home Assistant.
_POLL_S, _RENEW_S = 1.0, 10.0
# Home Assistant accepts 255 characters as a state, and records 16 kB of attributes.
_MAX_TEXT, _MAX_ALARMS = 255, 10
# Longest time that the last message may take (s).
_LAST_S = 1.0
# For how long a stop is tried again (s): a pump node that has died is back by then.
_STOP_S = 60.0


class Bridge:
    """A bridge that publishes a site over MQTT and accepts a single request: to stop the pump.

    The bridge publishes ``state``, ``alarms`` and ``availability``, and subscribes to ``stop``, all
    under ``greenroof/SITE/``. The state and the alarms are sent whenever they change, and at least
    every 10 s. The state and the alarms are not retained, since a client that connects later would
    mistake an old value for a current one. A stop that the broker has retained is ignored, since it
    would stop the pump again each time the bridge connects. While connected, the bridge obeys every
    stop. MQTT 3.1.1 does not tell a connected subscriber whether a message was sent as a retained
    message, and a stop that a person has requested must be obeyed. The broker does not queue stop
    requests while the bridge is disconnected.

    When the bridge connects, it replaces what others have left in its retained messages.
    """

    def __init__(self, store: GraphStore, feed: Feed, broker: Broker) -> None:
        """Prepare the bridge without connecting to the broker.

        Args:
            store: graph state to publish.
            feed: feed of the store, through which the pump is stopped.
            broker: MQTT broker to publish to.

        Raises:
            ConfigurationError: if the MQTT library is missing, or the login or certificate file is
                invalid.
        """
        site = store.namespace.strip("/").replace("/", "_") or "roof"
        self._store, self._feed, self._broker = store, feed, broker
        self._base, self._status = make_prefix(site), f"{PREFIX}/status"
        self._stops_on = f"{self._base}/stop"
        self._kept = make_discovery(site)  # messages that the broker keeps, by topic
        self._kept[f"{self._base}/availability"] = ONLINE
        self._stop, self._again = threading.Event(), threading.Event()
        self._why, self._ending = "", False  # why there is no connection
        self._availability = threading.Lock()  # keeps messages about it in order
        self._sent: dict[str, str] = {}
        self._sent_at = 0.0
        self._stop_until = -math.inf  # time until which a stop is tried (steady clock, s)
        self._client = make_client(
            broker, f"greenroof_{site}", self._on_connect, self._on_message, self._on_disconnect,
            will=(f"{self._base}/availability", OFFLINE),
        )

    def run(self, signals: Signals) -> None:
        """Publish the site until a signal arrives.

        Args:
            signals: signals that stop the bridge.

        Raises:
            InterruptedRun: if a signal arrives.
        """
        self._client.loop_start()
        try:
            while True:
                signals.check()
                if self._stop.wait(_POLL_S):
                    self._stop.clear()
                    self._stop_until = time.monotonic() + _STOP_S
                if time.monotonic() < self._stop_until:
                    self._stop_pump()
                try:
                    self._publish_state()
                except Exception:  # Home Assistant shows as unavailable what is not renewed
                    print_seldom("state", traceback.format_exc())
        finally:
            self._ending = True
            last = self._publish_availability()
            with suppress(RuntimeError):  # there is no broker
                last.wait_for_publish(_LAST_S)
            self._client.disconnect()
            self._client.loop_stop()

    def _stop_pump(self) -> None:
        try:
            answer = self._feed.request_action("stop", owner="MQTT")
            print_seldom("stop", f"stop requested over MQTT: {answer}")
            self._stop_until = -math.inf
        except PumpRequestError as failure:
            print_seldom("no stop", f"stop requested over MQTT: {failure}")
            if failure.answered:
                self._stop_until = -math.inf
        except Exception as error:  # tried again: no other error ends a stop
            what = type(error).__name__
            print_seldom(what, f"stop requested over MQTT: {what}: {error}; trying again")

    def _publish_state(self) -> None:
        now = time.monotonic()
        shown = make_document(self._store, now)
        with self._store.lock:
            messages = {"state": make_state(self._store, shown), "alarms": make_alarms(shown)}
        if self._again.is_set() or now - self._sent_at >= _RENEW_S:
            self._again.clear()
            self._sent, self._sent_at = {}, now
            self._publish_availability()  # another bridge of this site may have ended
        for name, content in messages.items():
            text = json.dumps(content, allow_nan=False)
            if self._sent.get(name) != text:
                self._sent[name] = text
                self._client.publish(f"{self._base}/{name}", text)

    # --- in the client's thread -----------------------------------------------------------------

    def _on_connect(self) -> None:
        self._why = ""
        print_seldom("connected", f"connected to {self._broker}; topics: {self._base}/")
        self._client.subscribe([(topic, 0) for topic in (self._stops_on, self._status)])
        self._publish_all()

    def _publish_all(self) -> None:
        """Publish all messages, after connecting to the broker or after Home Assistant starts."""
        for topic, text in self._kept.items():
            self._client.publish(topic, text, retain=True)
        self._publish_availability()
        self._again.set()

    def _publish_availability(self) -> Any:
        """Publish the bridge's availability, and return the message so that a caller can await it.

        A bridge that connects while it is shutting down publishes ``offline`` itself. Since the
        bridge then disconnects normally, the broker does not publish the bridge's will.
        """
        with self._availability:
            word = OFFLINE if self._ending else ONLINE
            return self._client.publish(f"{self._base}/availability", word, retain=True)

    def _on_disconnect(self, why: str) -> None:
        if why != self._why and not self._ending:
            print_seldom(why, f"not connected to {self._broker}: {why}; trying again")
        self._why = why

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if topic == self._status:
            if payload == ONLINE.encode():
                self._publish_all()
        elif payload != STOP.encode():
            print_seldom("other", f"{topic}: message ignored, since its payload is not {STOP}")
        elif retained:
            print_seldom(
                "kept",
                f"{topic}: message ignored, since a stop must not be retained; clear the retained "
                "message",
            )
        else:
            self._stop.set()


def make_state(store: GraphStore, shown: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of the ``state`` message in the page's units; None means *unknown*.

    Args:
        store: state of the graph; the caller must hold its lock.
        shown: document made from the store.
    """
    tiles, pump = shown["tiles"], shown["tiles"]["pump"]
    here, now = store.mode not in ("none", "ended"), store.now
    plan = None if store.present_value("/pump/command") is None else store.plan
    volume: float | None = None
    begin: float | None = None
    if here and plan is not None and now is not None and now < plan.ends[-1]:
        planned = plan.pumped(now)
        volume = 0.0 if planned is None else planned.volume
        begin = None if planned is None else planned.begin
    numbers = {
        "roof_level": tiles["roof"]["number"], "cistern_level": tiles["cistern"]["number"],
        "rain": tiles["rain"]["number"], "flow": pump["number"],
        "command": store.present_value("/pump/command"),
    }
    frost, serious = store.present_value("/weather/frost"), tiles["summary"]["level"] == "error"
    present = shown["alarms"]
    return {
        "mode": store.mode,
        **{key: _round_number(topic, numbers[key] if here else None)
           for key, (topic, _) in NUMBERS.items()},
        "pump": pump["state"] if here and not pump["alarm"] else UNKNOWN,
        "plan": _write_plan(tiles["watering"]) if here else UNKNOWN,
        "planned_volume": None if volume is None else round(volume * 1e3),
        "planned_start": None if begin is None or begin == now  # it is pumping now
        else datetime.fromtimestamp(begin, timezone.utc).isoformat(timespec="seconds"),
        "frost": None if frost is None or not here else ON if frost else OFF,
        "condition": (present[0]["code"] or UNKNOWN) if present else "none" if here else UNKNOWN,
        "problem": ON if serious else OFF if here else None,
        "can_stop": shown["stop"]["possible"],
        "hold": shown["stop"]["hold"] if shown["stop"]["possible"] else None,
    }


def _write_plan(tile: Mapping[str, Any]) -> str:
    """Write when it is watered next, in as many characters as Home Assistant accepts."""
    return "; ".join(filter(None, (tile["value"], tile["sentence"])))[:_MAX_TEXT]


def _round_number(topic: str, value: float | None) -> float | None:
    display = find_display(topic)
    return None if value is None else round(value * display.factor, display.decimals or None)


def make_alarms(shown: Mapping[str, Any]) -> dict[str, Any]:
    """Return the summary, the advice and the current alarms, as in the document."""
    keys = "code", "level", "id", "what", "do", "since"
    return {
        "summary": join_summary(shown),
        "advice": shown["advice"],
        "alarms": [{key: row[key] for key in keys} for row in shown["alarms"][:_MAX_ALARMS]],
        "notes": shown["notes"],
    }
