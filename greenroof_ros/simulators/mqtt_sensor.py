"""A sensor that says on MQTT what it measures, as its section of the sensor file describes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
from collections.abc import Callable
from typing import Any

from greenroof_ros.common.mqtt import make_client
from greenroof_ros.drives.sensor_file import MqttSensor

# How many messages fit into the time for which it may say nothing.
_MESSAGES = 5


def payload(raw: float, sensor: MqttSensor) -> str:
    """Return a message with a number where a sensor has it."""
    content: Any = raw
    for step in reversed(sensor.steps):
        content = {step: content} if isinstance(step, str) else [None] * step + [content]
    return json.dumps(content)


class SimulatedMqttSensor:
    """Publishes again and again; where it has an availability topic, also that it is there."""

    def __init__(self, name: str, sensor: MqttSensor, read: Callable[[], float | None]) -> None:
        """Connect to nothing yet.

        Args:
            name: of the sensor.
            sensor: where it is to publish what.
            read: returns its raw value; None where it says nothing.
        """
        self._sensor, self._read = sensor, read
        broker, self._topic = sensor.broker_and_topic()
        self._will = (sensor.available, "offline") if sensor.available else None
        self._client = make_client(
            broker, f"simulated_{name}_{secrets.token_hex(6)}", self._announce,
            lambda topic, payload, retained: None, will=self._will,
        )

    def _announce(self) -> None:
        if self._will is not None:
            self._client.publish(self._sensor.available, self._sensor.online, qos=1, retain=True)

    async def run(self, ended: asyncio.Event) -> None:
        """Publish until the end."""
        self._client.loop_start()
        while not ended.is_set():
            raw = self._read()
            if raw is not None:
                self._client.publish(self._topic, payload(raw, self._sensor))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(ended.wait(), self._sensor.max_age / _MESSAGES)
        if self._will is not None:
            self._client.publish(*self._will, qos=1, retain=True)
        self._client.disconnect()
