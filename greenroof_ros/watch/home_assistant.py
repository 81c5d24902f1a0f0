"""Discovery messages that let Home Assistant show a site, one message for each entity.

Every entity takes its value from a field of the same message, ``greenroof/SITE/state``. Each entity
has its own discovery message, since Home Assistant releases before 2024.11 do not support device
discovery.
"""

from __future__ import annotations

import json
from typing import Any

from greenroof_ros.interface.states import PUMP_STATES
from greenroof_ros.watch.words import find_display

PREFIX = "homeassistant"
"""Start of the discovery topics, as in Home Assistant's MQTT integration."""

ONLINE, OFFLINE, ON, OFF = "online", "offline", "ON", "OFF"
STOP = "STOP"
"""The whole payload of a message that stops the pump."""

EXPIRES_S = 30
"""Age above which Home Assistant no longer shows a value (s)."""

NUMBERS = {
    "roof_level": ("roof", "/roof/level", {"device_class": "distance"}),
    "cistern_level": ("cistern", "/cistern/level", {"device_class": "distance"}),
    "rain": ("rain", "/weather/precipitation", {"device_class": "precipitation_intensity"}),
    "flow": ("pump", "/pump/flow", {"device_class": "volume_flow_rate"}),
    "command": ("watering", "/pump/command", {}),
}
"""Numeric fields: the tile with the value, and the topic that provides label and unit."""


def make_discovery(site: str) -> dict[str, str]:
    """Return the discovery messages by topic.

    Args:
        site: name of the site in topics and IDs, consisting of letters, digits and _.
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
        "stop": ("button", {
            "name": "Stop the pump", "command_topic": f"{base}/stop", "payload_press": STOP,
        }),
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
            "expire_after": EXPIRES_S,
        }
        messages[f"{PREFIX}/{component}/{node}/{key}/config"] = json.dumps({
            "unique_id": f"{node}_{key}",
            "availability": [{"topic": f"{base}/availability"}],
            "device": {
                "identifiers": [node], "name": f"Green roof {site}",
                "manufacturer": "greenroof_ros",
            },
            **shown, **own,
        })
    return messages
