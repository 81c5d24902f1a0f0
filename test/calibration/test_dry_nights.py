"""A level sensor's noise and drift, from nights in which nothing moves."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from greenroof_ros.calibration.dry_nights import dry_nights
from greenroof_ros.calibration.record import Record

DAY = 288


def a_record(days: int, drift_mm_a_month: float, rain: float = 0.0) -> tuple[Record, np.ndarray]:
    """A record of a level with a noise of 2 mm and a drift, and the true level."""
    random = np.random.default_rng(5)
    steps = np.arange(days * DAY)
    sun = (steps % DAY >= 72) & (steps % DAY < 216)
    true = 0.03 - 1e-6 * np.cumsum(sun)
    measured = true + random.normal(0, 0.002, len(steps))
    measured += drift_mm_a_month / 1000 / 30 * steps / DAY
    depths = np.where(steps % 100 == 0, rain, 0.0)
    return Record(
        Path("none"), datetime(2021, 5, 1, tzinfo=timezone.utc), 300.0, depths,
        np.where(sun, 0.01, 0.0), np.zeros(len(steps)), None, measured,
    ), true


@pytest.mark.parametrize("drift", [0.0, 6.0, -3.0])
def test_noise_and_drift_are_found(drift: float) -> None:
    record, true = a_record(60, drift)
    sensor = dry_nights(record, true)
    assert sensor is not None
    assert sensor.nights == 61
    assert sensor.noise == pytest.approx(0.002, rel=0.03)
    assert abs(30000 * sensor.drift - drift) <= 30000 * sensor.half
    assert 30000 * sensor.half < 0.5


def test_wet_nights_say_nothing() -> None:
    record, true = a_record(60, 6.0, rain=0.1)
    assert dry_nights(record, true) is None
