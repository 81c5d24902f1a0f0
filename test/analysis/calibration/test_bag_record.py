"""Bags as measured records: five-minute sums, each value held until the next message."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from places import refusal
from twins import TWIN

from greenroof_ros.analysis.calibration.record import read_bag_record
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.results.bag_write import BagWriter

START_NS = 1625641200 * 10**9  # 2021-07-07T07:00 UTC, by date -d


def write_bag(
    directory: Path, seconds: Iterable[int] = range(0, 1810, 10), drainage: float = 1e-4,
    evapotranspiration: Callable[[int], float] = lambda now: 1e-5,
) -> Path:
    """Write a bag in which it rains 36 mm/h, and in the first minute nothing is pumped."""
    series: dict[str, Callable[[int], float]] = {
        "/roof/level": lambda now: 0.02 + now * 1e-6,
        "/cistern/level": lambda now: 2.0,
        "/pump/command": lambda now: 1.5 if now == 700 else 0.5,
        "/pump/flow": lambda now: 0.0 if now < 60 else 0.002,
        "/weather/precipitation": lambda now: 1e-5,
        "/weather/evapotranspiration": evapotranspiration,
        "/roof/drainage": lambda now: drainage,
    }
    writer = BagWriter(directory, [read_topics()[name] for name in series])
    for now in seconds:
        writer.write_tick(START_NS + now * 10**9, [
            b"\x00\x01\x00\x00" + struct.pack("<d", value(now)) for value in series.values()
        ])
    writer.close()
    return directory


def test_sums_of_five_minutes(tmp_path: Path) -> None:
    """On 100 m2, 1e-5 m/s are 3 mm in 300 s, 2 l/s are 6 mm, and 1e-4 m3/s is 0.3 mm.

    No crop coefficient is applied to the evapotranspiration.
    """
    record = read_bag_record(write_bag(tmp_path / "bag"), TWIN)
    assert record.start.isoformat() == "2021-07-07T08:00:00+01:00"
    assert record.step_s == 300.0
    assert record.rain == pytest.approx(np.full(6, 3.0))
    assert record.pumped == pytest.approx([4.8, *[6.0] * 5])
    assert record.measured["runoff"] == pytest.approx(np.full(6, 0.3))
    assert record.measured["level"] == pytest.approx(0.02 + 300e-6 * np.arange(6))
    assert record.reference == pytest.approx(np.full(6, 0.03))
    short = write_bag(tmp_path / "short", range(0, 300, 10))
    refusal(read_bag_record, short, TWIN, match="must be at least five minutes long")


def test_in_a_gap_the_roof_dries_and_nothing_else_is_known(tmp_path: Path) -> None:
    """It dries as on average: 0.01 mm in 5 min during 1 h, and 0.04 mm during 3 h.

    Without drainage only levels are treated as measured.
    """
    hour, mm = 3600, TWIN.a2 / 1000 / 300
    times = [now for now in range(0, 10 * hour + 1, 300) if not 2 * hour < now < 8 * hour]
    bag = write_bag(
        tmp_path / "bag", times, 0.0, lambda now: mm * (0.01 if now < hour else 0.04)
    )
    record = read_bag_record(bag, TWIN)
    assert list(record.measured) == ["level"] and "6 h in total" in record.notes[-1]
    for series in (record.rain, record.measured["level"], record.pumped):
        assert np.flatnonzero(np.isnan(series)).tolist() == [*range(2 * 12, 8 * 12)]
    assert record.drying[24:96] == pytest.approx((0.01 * 1 + 0.04 * 3) / 4)
    assert record.drying[96:] == pytest.approx(0.04)
