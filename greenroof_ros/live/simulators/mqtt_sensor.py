"""A simulated sensor on MQTT, which publishes as its section of the sensor file describes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
from collections.abc import Callable
from typing import Any

from greenroof_ros.common.mqtt import make_client
from greenroof_ros.live.drives.sensor_file import MqttSensor

# Number of messages within the longest silence that the sensor file allows.
_MESSAGES = 5


def payload(raw: float, sensor: MqttSensor) -> str:
    """Return a message that has a number at the sensor's path."""
    content: Any = raw
    for step in reversed(sensor.steps):
        content = {step: content} if isinstance(step, str) else [None] * step + [content]
    return json.dumps(content)


class SimulatedMqttSensor:
    """Publishes readings regularly, and its availability if the sensor has a topic for that."""

    def __init__(self, name: str, sensor: MqttSensor, read: Callable[[], float | None]) -> None:
        """Prepare the sensor without connecting.

        Args:
            name: of the sensor.
            sensor: where and how it publishes.
            read: returns its raw value; None if it must not publish.
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
        """Publish until the simulator ends."""
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
