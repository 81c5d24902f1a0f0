"""Discovery messages that let Home Assistant show a site, one message for each entity.

Every entity takes its value from a field of the same message, ``greenroof/SITE/state``. Each entity
has its own discovery message, since Home Assistant releases before 2024.11 do not support device
discovery.
"""

from __future__ import annotations

import json
from typing import Any

from greenroof_ros import __version__
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
    "roof_level": ("/roof/level", "distance"),
    "cistern_level": ("/cistern/level", "distance"),
    "rain": ("/weather/precipitation", "precipitation_intensity"),
    "flow": ("/pump/flow", "volume_flow_rate"),
    "command": ("/pump/command", None),
}
"""Numeric fields: the topic that provides label and unit, and Home Assistant's device class."""


def make_prefix(site: str) -> str:
    """Return the prefix of a site's topics."""
    return f"greenroof/{site}"


def make_discovery(site: str) -> dict[str, str]:
    """Return the discovery messages by topic.

    Args:
        site: name of the site in topics and IDs, consisting of letters, digits and _.
    """
    base, node = make_prefix(site), f"greenroof_{site}"
    bridge = {"topic": f"{base}/availability"}
    messages = {}
    for (component, key), own in _list_entities(base).items():
        config = {
            "unique_id": f"{node}_{key}",
            "availability": [bridge],
            "device": {
                "identifiers": [node], "name": f"Green roof {site}",
                "manufacturer": "greenroof_ros", "sw_version": __version__,
            },
            "origin": {"name": "greenroof_ros", "sw_version": __version__},
            **own,
        }
        if component == "button":
            # Without a pump node, the button cannot be pressed.
            template = "{{ 'online' if value_json.can_stop else 'offline' }}"
            config["availability"] = [
                bridge, {"topic": f"{base}/state", "value_template": template}
            ]
            config["availability_mode"] = "all"
        else:
            config |= {
                "state_topic": f"{base}/state", "value_template": f"{{{{ value_json.{key} }}}}",
                "expire_after": EXPIRES_S,
            }
        messages[f"{PREFIX}/{component}/{node}/{key}/config"] = json.dumps(config)
    return messages


def _list_entities(base: str) -> dict[tuple[str, str], dict[str, Any]]:
    """Return the settings that differ between entities, by component and field."""
    entities: dict[tuple[str, str], dict[str, Any]] = {}
    for key, (topic, kind) in NUMBERS.items():
        display = find_display(topic)
        entities["sensor", key] = {
            "name": display.label, "unit_of_measurement": display.unit,
            "state_class": "measurement", **({"device_class": kind} if kind else {}),
        }
    entities |= {
        ("sensor", "pump"): {
            "name": "Pump", "device_class": "enum", "options": list(PUMP_STATES),
        },
        ("sensor", "plan"): {"name": "Watering"},
        ("sensor", "planned_volume"): {
            "name": "Planned volume", "unit_of_measurement": "L", "state_class": "measurement",
        },
        ("sensor", "planned_start"): {"name": "Next planned start", "device_class": "timestamp"},
        ("sensor", "condition"): {"name": "Condition"},
        ("binary_sensor", "frost"): {"name": find_display("/weather/frost").label,
                                     "device_class": "cold"},
        ("binary_sensor", "problem"): {
            "name": "Alarm", "device_class": "problem", "json_attributes_topic": f"{base}/alarms",
        },
        ("button", "stop"): {
            "name": "Stop the pump", "command_topic": f"{base}/stop", "payload_press": STOP,
        },
    }
    return entities
