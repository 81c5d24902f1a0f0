"""Bags as measured records: five-minute sums, each value held until the next message."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal
from twins import TWIN

from greenroof_ros.calibration.bag_record import read_bag_record
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.interface import read_topics
from greenroof_ros.model.site import edited
from greenroof_ros.recording.bag_writer import BagWriter

START_NS = 1625641200 * 10**9  # 2021-07-07T07:00 UTC, by date -d
TOPICS = (
    "/roof/level", "/cistern/level", "/pump/command", "/pump/flow", "/weather/precipitation",
    "/weather/evapotranspiration", "/roof/drainage",
)


def write_bag(
    directory: Path, seconds: Iterable[int], drainage: float,
    evapotranspiration: Callable[[int], float] = lambda now: 1e-5,
    command: Callable[[int], float] = lambda now: 0.5,
) -> Path:
    """Write a bag in which it rains 36 mm/h, and in the first minute nothing is pumped."""
    interface = read_topics()
    writer = BagWriter(directory, [interface[name] for name in TOPICS])
    for now in seconds:
        values = (
            0.02 + now * 1e-6, 2.0, command(now), 0.0 if now < 60 else 0.002, 1e-5,
            evapotranspiration(now), drainage,
        )
        writer.write_tick(
            START_NS + now * 10**9,
            [b"\x00\x01\x00\x00" + struct.pack("<d", value) for value in values],
        )
    writer.close()
    return directory


def test_sums_of_five_minutes(tmp_path: Path) -> None:
    """On 100 m2, 1e-5 m/s are 3 mm in 300 s, 2 l/s are 6 mm, and 1e-4 m3/s is 0.3 mm."""
    bag = write_bag(tmp_path / "bag", range(0, 1810, 10), 1e-4)
    record = read_bag_record(bag, TWIN)
    assert record.start.isoformat() == "2021-07-07T08:00:00+01:00"
    assert record.step_s == 300.0
    assert record.rain == pytest.approx(np.full(6, 3.0))
    assert record.pumped == pytest.approx([4.8, *[6.0] * 5])
    assert record.runoff == pytest.approx(np.full(6, 0.3))
    assert record.level == pytest.approx(0.02 + 300e-6 * np.arange(6))
    # Nothing says that it was computed, so the site's crop coefficient is not applied.
    assert record.reference == pytest.approx(np.full(6, 0.03))
    assert record.cistern == pytest.approx(np.full(6, 2.0))
    # While nothing is delivered, the command does not count.
    assert record.command == pytest.approx([0.4, *[0.5] * 5])


def test_a_command_that_no_pump_follows_is_not_known(tmp_path: Path) -> None:
    """Without drainage only levels count as measured."""
    bag = write_bag(
        tmp_path / "bag", range(0, 1810, 10), 0.0, command=lambda now: 1.5 if now == 700 else 1.0
    )
    record = read_bag_record(bag, TWIN)
    assert record.command == pytest.approx([0.8, 1.0, np.nan, 1.0, 1.0, 1.0], nan_ok=True)
    assert list(record.measured) == ["level"]


@pytest.mark.parametrize(
    ("method", "reference"), [("fao56", 0.03 / 0.5), ("Penman-Monteith", 0.03)]
)
def test_a_crop_coefficient_counts_where_evapotranspiration_was_computed(
    method: str, reference: float, tmp_path: Path
) -> None:
    """The run's own site counts with 0.5, not the site that is fitted with 0.85."""
    bag = write_bag(tmp_path / "bag", range(0, 1810, 10), 1e-4)
    (tmp_path / "summary.json").write_text(
        json.dumps({"controller": "onoff", "evapotranspiration_method": method})
    )
    (tmp_path / "configuration").mkdir()
    (tmp_path / "configuration" / "site.yaml").write_text(
        edited(shared_directory() / "config" / "site.yaml", {"crop_coefficient": 0.5})
    )
    assert TWIN.crop_coefficient == 0.85
    assert read_bag_record(bag, TWIN).reference == pytest.approx(np.full(6, reference))


def test_in_a_gap_the_roof_dries_and_nothing_else_is_known(tmp_path: Path) -> None:
    """During the first day it dries as before the gap; later as it did a day before.

    Evapotranspiration is 0.01 mm in 5 min at first, and ten times that from 6 to 12 h of each day.
    """
    hour, gaps = 3600, ((2, 8), (27, 33))
    times = [now for now in range(0, 36 * hour, 300)
             if not any(low * hour < now < high * hour for low, high in gaps)]
    mm = TWIN.a2 / 1000 / 300
    bag = write_bag(
        tmp_path / "bag", times, 0.0,
        lambda now: mm * (0.1 if 6 <= now / hour % 24 < 12 else 0.01),
    )
    record = read_bag_record(bag, TWIN)
    for series in (record.rain, record.level, record.pumped):
        gap = np.flatnonzero(np.isnan(series))
        assert gap.tolist() == [*range(2 * 12, 8 * 12), *range(27 * 12, 33 * 12)]
    reference = record.reference
    assert reference[2 * 12 + 1:8 * 12] == pytest.approx(0.01)
    assert reference[8 * 12 + 1:12 * 12] == pytest.approx(0.1)
    # As a day before, when the value was held.
    assert reference[27 * 12 + 1:32 * 12] == pytest.approx(0.01)
    assert reference[32 * 12 + 1:33 * 12] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("end", "evapotranspiration", "message"),
    [
        (910, 0.0, "/weather/evapotranspiration: is not in the bag"),
        (500, 1e-5, "is 490 s long; it must have two steps of 300 s"),
    ],
)
def test_a_bag_that_tells_nothing_is_refused(
    tmp_path: Path, end: int, evapotranspiration: float, message: str
) -> None:
    bag = write_bag(tmp_path / "bag", range(0, end, 10), 0.0, lambda now: evapotranspiration)
    refusal(read_bag_record, bag, TWIN, match=message)
