"""MQTT bridge that publishes the page's values and accepts few requests; see :class:`Bridge`."""

from __future__ import annotations

import json
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from typing import Any

from greenroof_ros.base.mqtt import Broker, make_client
from greenroof_ros.base.processes import Signals
from greenroof_ros.base.standard_error import print_seldom
from greenroof_ros.interface.states import PUMP_STATES, VALVE, VALVE_STATES
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import RequestError
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.tiles import UNKNOWN, find_display

ONLINE, OFFLINE, ON, OFF = "online", "offline", "ON", "OFF"
BUTTONS = {
    "stop": "Stop the pump", "valve_close": "Close and hold the outlet valve",
    "valve_open": "Open the outlet valve for 30 minutes",
}
"""Requests, each with its label in Home Assistant. The whole payload is the name in capitals."""
NUMBERS = {
    "roof_level": ("roof", "/roof/level", {"device_class": "distance"}),
    "cistern_level": ("cistern", "/cistern/level", {"device_class": "distance"}),
    "rain": ("rain", "/weather/precipitation", {"device_class": "precipitation_intensity"}),
    "flow": ("pump", "/pump/flow", {"device_class": "volume_flow_rate"}),
    "command": ("watering", "/pump/command", {}),
}
"""Numeric fields: the tile with the value, and the topic that provides label and unit."""

# Interval at which the state is sent, and age above which Home Assistant shows no value (s).
_POLL_S, _EXPIRES_S = 1.0, 30
# Home Assistant accepts 255 characters as a state, and records 16 kB of attributes.
_MAX_TEXT, _MAX_ALARMS = 255, 10


class Bridge:
    """A bridge that publishes a site over MQTT and accepts requests to stop the pump.

    It also accepts requests to close the outlet valve and, if that was allowed, to open it for 30
    minutes. The bridge publishes ``state``, ``alarms`` and ``availability``, and subscribes to
    ``stop``, ``valve_close`` and ``valve_open``, all under ``greenroof/SITE/``. The state and the
    alarms are sent every second. They are not retained, since a client that connects later would
    mistake an old value for a current one. A stop that the broker has retained is ignored, since it
    would stop the pump again each time the bridge connects. While connected, the bridge obeys every
    stop, and requests it again until the pump node has confirmed or refused it. The same applies to
    the closing of the valve, but the opening is requested once. MQTT 3.1.1 does not tell a
    connected subscriber whether a message was sent as a retained message, and a stop that a person
    has requested must be obeyed. The broker does not queue stop requests while the bridge is
    disconnected.

    When the bridge connects, it replaces what others have left in its retained messages. Home
    Assistant is told of the valve once it is known that the site has one.
    """

    def __init__(self, store: GraphStore, feed: Feed, broker: Broker, allow_open: bool) -> None:
        """Prepare the bridge without connecting to the broker.

        Args:
            store: graph state to publish.
            feed: feed of the store, through which the pump is stopped.
            broker: MQTT broker to publish to.
            allow_open: whether the valve may be opened over MQTT.

        Raises:
            ConfigurationError: if the MQTT library is missing, or the login or certificate file is
                invalid.
        """
        self._site = site = store.namespace.strip("/").replace("/", "_") or "roof"
        self._store, self._feed, self._broker = store, feed, broker
        self._base = f"greenroof/{site}"
        self._buttons = [name for name in BUTTONS if allow_open or name != "valve_open"]
        self._announced: list[str] = []  # the buttons that Home Assistant was told of
        # What was requested, and that something was; set by the client's thread.
        self._requested, self._is_requested = set[str](), threading.Event()
        self._client = make_client(
            broker, f"greenroof_{site}", self._on_connect, self._on_message,
            lambda why: print_seldom(why, f"not connected to {broker}: {why}; trying again"),
            will=(f"{self._base}/availability", OFFLINE),
        )

    def run(self, signals: Signals) -> None:
        """Publish the site until a signal arrives.

        Args:
            signals: signals that stop the bridge.

        Raises:
            InterruptedRun: if a signal arrives.
        """
        unanswered: set[str] = set()
        self._client.loop_start()
        try:
            while True:
                signals.check()
                if self._is_requested.wait(_POLL_S):
                    self._is_requested.clear()
                while self._requested:
                    unanswered.add(self._requested.pop())
                # The stop first, and the valve is closed before a request to open it.
                unanswered = {name for name in sorted(unanswered) if not self._is_answered(name)}
                try:
                    self._publish_state()
                except Exception:  # Home Assistant shows as unavailable what is not renewed
                    print_seldom("state", traceback.format_exc())
        finally:
            self._publish("availability", OFFLINE, retain=True)
            self._client.disconnect()  # after this message
            self._client.loop_stop()

    def _is_answered(self, name: str) -> bool:
        """Request an action; return False if it must be requested again, whatever the reason."""
        kind, is_answered = name, True
        try:
            answer = self._feed.request_action(name, owner="MQTT")
        except Exception as error:
            is_refused = isinstance(error, RequestError) and error.answered
            is_answered = is_refused or name == "valve_open"
            kind, answer = f"no {name} {is_answered}", str(error)
        print_seldom(kind, f"{name} requested over MQTT: {answer}")
        return is_answered

    def _publish(self, name: str, text: str, *, retain: bool = False) -> None:
        self._client.publish(f"{self._base}/{name}", text, retain=retain)

    def _publish_state(self) -> None:
        # Again and again, as another bridge of this site may have ended.
        self._publish("availability", ONLINE, retain=True)
        shown = make_document(self._store, time.monotonic())
        buttons = self._buttons if VALVE in shown["tiles"] else self._buttons[:1]
        if buttons != self._announced:
            self._announced = buttons
            for topic, text in make_discovery(self._site, buttons).items():
                self._client.publish(topic, text, retain=True)
        for name, content in (("state", make_state(shown)), ("alarms", make_alarms(shown))):
            self._publish(name, json.dumps(content, allow_nan=False))

    # --- in the client's thread -----------------------------------------------------------------

    def _on_connect(self) -> None:
        print_seldom("connected", f"connected to {self._broker}; topics: {self._base}/")
        for name in self._buttons:
            self._client.subscribe(f"{self._base}/{name}")
        self._announced = []

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        word = topic.rpartition("/")[2].upper()
        if payload == word.encode() and not retained:
            self._requested.add(word.lower())
            self._is_requested.set()
        else:
            print_seldom("ignored", f"{topic}: message ignored: must be {word}, and not retained")


def make_state(shown: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of the ``state`` message in the page's units; None means *unknown*."""
    tiles, rows = shown["tiles"], shown["alarms"]
    pump, watering, frost = tiles["pump"], tiles["watering"], shown["frost"]
    fields: dict[str, Any] = {
        "pump": UNKNOWN if pump["state"] == "alarm" else pump["state"],
        "plan": f"{watering['value']}; {watering['sentence']}"[:_MAX_TEXT],
        "frost": None if frost is None else ON if frost else OFF,
        "condition": rows[0]["code"] if rows else "none" if shown["known"] else UNKNOWN,
        "problem": ON if tiles["summary"]["level"] == "error" else OFF,
    }
    if (valve := tiles.get(VALVE)) is not None:
        fields[VALVE] = UNKNOWN if valve["state"] == "alarm" else valve["state"]
    for key, (tile, topic, _) in NUMBERS.items():
        display, number = find_display(topic), tiles[tile]["number"]
        fields[key] = None if number is None else round(number * display.factor, display.decimals)
    # Of a site that is gone, the problem is known.
    here = shown["mode"] != "ended" and (shown["mode"] != "none" or fields["problem"] == ON)
    return {"mode": shown["mode"], **(fields if here else dict.fromkeys(fields))}


def make_alarms(shown: Mapping[str, Any]) -> dict[str, Any]:
    """Return the summary, the advice and the current alarms, as in the document."""
    return {
        "summary": shown["tiles"]["summary"]["text"],
        "advice": shown["advice"],
        "alarms": shown["alarms"][:_MAX_ALARMS],
        "notes": shown["notes"],
    }


def make_discovery(site: str, buttons: Sequence[str] = ("stop",)) -> dict[str, str]:
    """Return the messages that let Home Assistant discover a site, one for each entity, by topic.

    Every entity takes its value from a field of the same message, ``greenroof/SITE/state``. Each
    entity has its own message, since Home Assistant releases before 2024.11 do not support device
    discovery.

    Args:
        site: name of the site in topics and IDs, consisting of letters, digits and _.
        buttons: names of the requests that are possible; those on the valve if there is one.
    """
    base, node = f"greenroof/{site}", f"greenroof_{site}"
    entities: dict[str, tuple[str, dict[str, Any]]] = {
        "pump": ("sensor", {"name": "Pump", "device_class": "enum", "options": [*PUMP_STATES]}),
        "plan": ("sensor", {"name": "Watering"}),
        "condition": ("sensor", {"name": "Condition"}),
        "frost": ("binary_sensor", {"name": "Frost", "device_class": "cold"}),
        "problem": ("binary_sensor", {
            "name": "Alarm", "device_class": "problem", "json_attributes_topic": f"{base}/alarms",
        }),
    }
    if "valve_close" in buttons:
        options = {"device_class": "enum", "options": [*VALVE_STATES]}
        entities[VALVE] = "sensor", {"name": "Outlet valve", **options}
    for key in buttons:
        entities[key] = "button", {
            "name": BUTTONS[key], "command_topic": f"{base}/{key}", "payload_press": key.upper(),
        }
    for key, (_, topic, kind) in NUMBERS.items():
        display = find_display(topic)
        entities[key] = "sensor", {
            "name": display.label, "unit_of_measurement": display.unit,
            "state_class": "measurement", **kind,
        }
    messages = {}
    for key, (component, own) in entities.items():
        shown = {} if component == "button" else {
            "state_topic": f"{base}/state", "value_template": f"{{{{ value_json.{key} }}}}",
            "expire_after": _EXPIRES_S,
        }
        messages[f"homeassistant/{component}/{node}/{key}/config"] = json.dumps({
            "unique_id": f"{node}_{key}",
            "availability": [{"topic": f"{base}/availability"}],
            "device": {
                "identifiers": [node], "name": f"Green roof {site}",
                "manufacturer": "greenroof_ros",
            },
            **shown, **own,
        })
    return messages
