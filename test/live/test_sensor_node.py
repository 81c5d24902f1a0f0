"""A rain gauge's node between a real broker and ROS: all rain of its total is published."""

from __future__ import annotations

import time
from itertools import pairwise
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
        observer.start(f"live.station --sensors {file}")
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
