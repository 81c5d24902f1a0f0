"""A rain gauge's node between a real broker and ROS: all rain of its total is published."""

from __future__ import annotations

import re
import time
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import pytest
from brokers import Talker, mosquitto, needs_mosquitto
from places import CONFIG

pytestmark = needs_mosquitto


def test_the_published_rain_adds_up_to_the_rise_of_the_total(
    observer: Any, tmp_path: Path
) -> None:
    """2.2 mm at up to 0.4 mm/s: copies, two tips at once; then the broker is lost in the rain."""
    with mosquitto(tmp_path) as broker:
        text, file = (CONFIG / "sensors_mqtt.yaml").read_text(), tmp_path / "sensors.yaml"
        text = text.replace("mqtt://127.0.0.1:1883", broker.address)
        file.write_text(text.replace("high: 0.0001 ", "high: 0.0004 "))
        times, rates = (
            collect("/gauge/precipitation") for collect in (observer.times, observer.collect)
        )
        observer.start(f"live.sensors --sensors {file}")
        with Talker(broker) as talker:

            def first() -> bool:
                talker.publish("roof/rain", "17.0")
                return bool(rates)

            observer.until(first, 60, "a second total")
            for total in ("17.4", "17.6", "18.0", "18.0", "19.2"):
                pause = time.monotonic() + (0.1 if total == "17.4" else 1.5)
                for _ in range(3):
                    talker.publish("roof/rain", total)
                observer.until(lambda pause=pause: time.monotonic() > pause, 60, "a pause")
        broker.kill()
        observer.until(lambda: rates[-1] == 0.0, 60, "the end of what is due")
    sum_mm = 1000 * sum(
        rate * (later - sent)
        for rate, (sent, later) in zip(rates, pairwise(times), strict=False)
    )
    assert max(rates) <= 0.0004
    assert sum_mm == pytest.approx(2.2, abs=0.05)


@pytest.mark.parametrize("garbage", ["nan?", "-40.0", '{"level": []}'])
def test_garbage_between_true_values_is_an_alarm(
    observer: Any, tmp_path: Path, garbage: str
) -> None:
    """No message lasts long enough for one, 20 to 1; the true values still count."""
    with mosquitto(tmp_path) as broker, Talker(broker) as talker:
        text, file = (CONFIG / "sensors_mqtt.yaml").read_text(), tmp_path / "sensors.yaml"
        file.write_text(text.replace("mqtt://127.0.0.1:1883", broker.address))
        levels, messages = observer.collect("/cistern/level"), cycle([*20 * [garbage], "0.9"])
        observer.start(f"live.sensors --sensors {file}")

        def is_reported(message: str) -> bool:
            talker.publish("cistern/sensor/level/state", message)
            time.sleep(0.02 if message == garbage else 0.2)
            code = observer.values("/cistern_sensor: sensor").get("code")
            return bool(levels and code == "readings_refused")

        observer.until(lambda: is_reported(next(messages)), 60, "an alarm")
        message = observer.diagnoses["/cistern_sensor: sensor"].message
        assert re.match(
            r"\d+ of \d+ readings within a minute were rejected; the last one: ", message
        )


def test_sensor_that_falls_silent_after_rejected_readings_is_lost(
    observer: Any, tmp_path: Path
) -> None:
    """The page must not say that valid values of a silent sensor are used."""
    with mosquitto(tmp_path) as broker, Talker(broker) as talker:
        text, file = (CONFIG / "sensors_mqtt.yaml").read_text(), tmp_path / "sensors.yaml"
        file.write_text(text.replace("mqtt://127.0.0.1:1883", broker.address))
        messages = cycle([*20 * ["nan?"], "0.9"])
        observer.start(f"live.sensors --sensors {file}")

        def code() -> str | None:
            values: dict[str, str] = observer.values("/cistern_sensor: sensor")
            return values.get("code")

        def is_reported(message: str) -> bool:
            talker.publish("cistern/sensor/level/state", message)
            time.sleep(0.02 if message == "nan?" else 0.2)
            return code() == "readings_refused"

        observer.until(lambda: is_reported(next(messages)), 60, "an alarm")
        observer.until(lambda: code() == "sensor_lost", 60, "the silence")
