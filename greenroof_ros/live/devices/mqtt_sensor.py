"""Receiver for the readings of an MQTT sensor."""

from __future__ import annotations

import json
import logging
import math
import re
import time

from greenroof_ros.base.mqtt import make_client
from greenroof_ros.live.devices.json_path import value_at
from greenroof_ros.live.devices.readings import Reading, SensorReader
from greenroof_ros.live.devices.sensor_file import MqttSensor

# Longest message of a sensor that is accepted (bytes).
_MAX_BYTES = 65_536
# Messages are rejected for this long from the first one after a silence (s), since they may have
# been waiting or retained by another broker.
_IGNORING_S = 1.0
# A number as text, which need not be JSON: "317.3988", 00317.3988, +5.0 or .5.
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?\s*", re.ASCII | re.IGNORECASE)
_WHOLE = re.compile(r"\s*[+-]?\d+\s*", re.ASCII)


def read_number(payload: bytes, sensor: MqttSensor) -> float:
    """Return the number in a message; a whole number of any length remains an integer.

    Args:
        payload: content of the message, which is JSON or a plain number.
        sensor: the sensor's section of the sensor file, which contains the path of the number.

    Raises:
        ValueError: if the message contains no number at the path.
    """
    if len(payload) > _MAX_BYTES:
        raise ValueError(f"a message has {len(payload)} bytes, but the limit is {_MAX_BYTES}")
    value: object = payload.decode(errors="replace")
    if sensor.value or not _NUMBER.fullmatch(str(value)):
        try:
            value = json.loads(payload)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"reports {payload[:40]!r}, which is not JSON") from error
    try:
        value = value_at(value, sensor.value)
    except LookupError as error:
        raise ValueError(
            f"reports {payload[:80]!r}, which does not contain {sensor.value}"
        ) from error
    text = str(value)
    if isinstance(value, bool) or not (isinstance(value, float) or _NUMBER.fullmatch(text)):
        raise ValueError(f"reports {text[:40]!r}, which is not a number")
    number = float(text)
    if math.isinf(number) and not isinstance(value, float):
        raise ValueError("reports a number that is too large")
    return int(text) if _WHOLE.fullmatch(text) else number


class MqttReader(SensorReader):
    """A receiver of a sensor's messages, which reconnects automatically after every failure.

    A message counts as a reading at the time of its arrival. Retained messages, and the first
    messages after a silence or a lost connection, do not count as readings, since they may be of
    any age.
    """

    def __init__(
        self, name: str, sensor: MqttSensor, unit: str, spread_s: float = math.inf
    ) -> None:
        """Prepare the reader without connecting.

        Args:
            name: name of the quantity, for the client id.
            sensor: the sensor whose messages are received.
            unit: unit of the quantity, for messages.
            spread_s: maximum time over which a rise in a total is spread (s).

        Raises:
            ConfigurationError: if the MQTT library is not installed or a login file is invalid.
        """
        broker, self._topic = sensor.broker_and_topic()
        self._sensor = sensor
        first = Reading(problem=f"{sensor.address}: not yet connected", code="broker_lost")
        super().__init__(sensor, unit, spread_s, first)
        # When the last message arrived, and until when messages are rejected (s).
        self._heard_at, self._ignoring_until = -math.inf, -math.inf
        self._client = make_client(
            broker, f"greenroof_{name}", self._on_connect, self._on_message, self._on_disconnect,
        )

    @property
    def snapshot(self) -> Reading:
        """The latest snapshot of the quantity."""
        with self._lock:
            age = time.monotonic() - self._reading.read_at
            if not self._reading.problem and age > self._sensor.max_age:
                self._fail(f"has sent nothing for {self._sensor.max_age:g} s")
            return super().snapshot

    def start(self) -> None:
        """Connect, and start the client's thread."""
        self._client.loop_start()

    def close(self) -> None:
        """Disconnect."""
        self._client.disconnect()

    # --- in the client's thread -------------------------------------------------------------------

    def _on_connect(self) -> None:
        self._heard_at = -math.inf
        self._fail("has sent nothing yet")
        self._client.subscribe(self._topic)

    def _on_disconnect(self, why: str) -> None:
        self._fail(f"no connection to the broker: {why}", "broker_lost")

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        if topic != self._topic:
            return
        with self._lock:
            try:
                self._receive(payload, retained)
            except ValueError as error:
                self._fail(str(error))
            except Exception as error:  # whatever the error, the next message is read
                logging.getLogger(__name__).exception("%s failed", self._sensor.address)
                self._fail(f"reading failed: {error!r}")

    def _receive(self, payload: bytes, retained: bool) -> None:
        now = time.monotonic()
        if retained:
            raise ValueError("has not yet sent a new message; the retained message may be old")
        suspended, before, self._heard_at = (
            self._readings.clear_after_suspend(), self._heard_at, now
        )
        if suspended or now - before > self._sensor.max_age:
            self._ignoring_until = now + _IGNORING_S
            raise ValueError("is sending again, but its first messages may be old")
        if now < self._ignoring_until:
            return
        value = self._readings.add(read_number(payload, self._sensor))
        self._reading = Reading(now, "", value)

    def _fail(self, why: str, code: str = "sensor_lost") -> None:
        self.report_failure(f"{self._sensor.address}: {why}", code)
