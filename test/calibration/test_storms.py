"""Storms, and what of a record is compared."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.storms import Storm, comparable, storms

HOUR = 12
DAY = 24 * HOUR


def a_record(days: int, rain: dict[int, float], missing: tuple[int, ...] = ()) -> Record:
    """A record of five-minute steps with rain and without runoff in some of them."""
    depths, runoff = np.zeros(days * DAY), np.zeros(days * DAY)
    for step, depth in rain.items():
        depths[step] = depth
    runoff[list(missing)] = np.nan
    return Record(
        Path("none"), datetime(2021, 5, 1, tzinfo=timezone.utc), 300.0, depths,
        np.zeros(days * DAY), np.zeros(days * DAY), runoff, None,
    )


def test_six_dry_hours_part_two_storms_and_a_day_ends_one() -> None:
    record = a_record(6, {
        10: 1.0, 10 + 6 * HOUR: 2.0,  # six hours later: the same storm
        20 + 13 * HOUR: 4.0,  # more than six hours later: the next
    })
    assert storms(record) == [
        Storm(10, 20 + 13 * HOUR, 3.0), Storm(20 + 13 * HOUR, 21 + 13 * HOUR + DAY, 4.0),
    ]


def test_wet_days_in_a_row_are_one_storm() -> None:
    """Of daily sums: a dry day parts two, and the day after the last rain is a storm's still."""
    record = replace(a_record(1, {}), step_s=86400.0, rain=np.array([0, 2.0, 3, 0, 4, 0, 0, 1, 0]))
    assert storms(record) == [Storm(1, 4, 5.0), Storm(4, 6, 4.0), Storm(7, 9, 1.0)]


def test_without_rain_there_is_none() -> None:
    assert storms(a_record(1, {})) == []


def test_the_last_storm_ends_with_the_record() -> None:
    assert storms(a_record(1, {DAY - 5: 3.0})) == [Storm(DAY - 5, DAY, 3.0)]


def test_a_storm_in_which_the_meter_failed_is_left_out_whole() -> None:
    record = a_record(6, {100: 5.0, 4 * DAY: 5.0}, missing=(120, 3 * DAY))
    steps = comparable(record)
    assert not steps[100:101 + DAY].any()
    assert np.flatnonzero(~steps[101 + DAY:]).tolist() == [
        3 * DAY + near - 101 - DAY for near in (-1, 0, 1)
    ]


@pytest.mark.parametrize("water", ["rain", "pumped"])
def test_a_storm_in_which_water_came_unseen_is_left_out_whole(water: str) -> None:
    record = a_record(6, {100: 5.0, 4 * DAY: 5.0})
    came = getattr(record, water).copy()
    came[[120, 3 * DAY]] = np.nan
    steps = comparable(replace(record, **{water: came}))
    assert not steps[100:101 + DAY].any()
    assert np.flatnonzero(~steps[101 + DAY:]).tolist() == [
        3 * DAY + near - 101 - DAY for near in (-1, 0, 1)
    ]
