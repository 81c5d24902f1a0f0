"""Storms of a record, the steps that are compared, its months and its halves."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from refusals import refusal
from twins import a_record

from greenroof_ros.analysis.calibration.record import (
    find_outages,
    halve_steps,
    select_comparable,
    select_months,
)
from greenroof_ros.analysis.calibration.step_record import StepRecord, find_storms

HOUR = 12
DAY = 24 * HOUR


def of_rain(days: int, rain: dict[int, float]) -> StepRecord:
    """Return a record of five-minute steps with rain in some of them and without runoff."""
    depths = np.zeros(days * DAY)
    depths[list(rain)] = list(rain.values())
    return a_record(depths, runoff=np.zeros(days * DAY))


def test_six_dry_hours_part_two_storms_and_a_day_ends_one() -> None:
    """In daily sums a dry day separates two storms; the record's end ends the last storm."""
    record = of_rain(6, {
        10: 1.0, 10 + 6 * HOUR: 2.0,  # six hours later: the same storm
        20 + 13 * HOUR: 4.0,  # more than six hours later: the next
    })
    assert find_storms(record) == [
        slice(10, 20 + 13 * HOUR), slice(20 + 13 * HOUR, 21 + 13 * HOUR + DAY),
    ]
    days = a_record(np.array([0, 2.0, 3, 0, 4, 0, 0, 1, 0]), step_s=86400.0)
    assert find_storms(days) == [slice(1, 4), slice(4, 6), slice(7, 9)]
    assert find_storms(of_rain(1, {DAY - 5: 3.0})) == [slice(DAY - 5, DAY)]
    assert find_storms(of_rain(1, {})) == []


def test_a_storm_in_which_something_was_not_seen_is_left_out_whole() -> None:
    """On another day only the step and its neighbours are left out."""
    record = of_rain(6, {100: 5.0, 4 * DAY: 5.0})
    for what in ("rain", "pumped", "runoff"):
        series = getattr(record, what).copy()
        series[[120, 3 * DAY]] = np.nan
        steps = select_comparable(replace(record, **{what: series}))
        left_out = [*range(100, 101 + DAY), *range(3 * DAY - 1, 3 * DAY + 2)]
        assert np.flatnonzero(~steps).tolist() == left_out, what


def test_halves_have_the_same_water_and_no_storm_in_common() -> None:
    """Half of the water has come on the second day of the first storm; the next dry day splits."""
    record = of_rain(8, {10: 1.0, DAY: 2.0, DAY + HOUR: 3.0, 5 * DAY: 4.0})
    steps = np.arange(record.steps) != 7
    earlier, later = halve_steps(record, steps).values()
    assert not np.any(earlier & later)
    assert np.array_equal(earlier | later, steps)
    assert int(np.argmax(later)) == 2 * DAY + HOUR
    rainy = of_rain(8, dict.fromkeys(range(0, 8 * DAY, HOUR), 1.0))
    assert not halve_steps(rainy, steps)["validation"].any()


def test_steps_of_months() -> None:
    """Months begin by a clock of UTC+1; an hour before it is July in UTC."""
    start = datetime(2021, 7, 1, tzinfo=timezone(timedelta(hours=1)))
    year = replace(a_record(np.zeros(365 * 24), 3600.0), start=start)
    for text, days, first in (
        ("4-10", 214, "2021-07-01"), ("11-3", 151, "2021-11-01"), ("2-2", 28, "2022-02-01"),
    ):
        steps = select_months(year, text)
        assert steps.sum() == days * 24
        assert str(year.times[steps][0]) == f"{first}T00:00:00"
    for text in ("4", "0-3", "4-13", "april-october"):
        refusal(select_months, year, text, match=f"^--months = '{text}': must be the first and")
    refusal(select_months, of_rain(20, {}), "6-10", match="^roof.csv: has no row in the months 6")


def lost(record: StepRecord, name: str, first: int, end: int) -> StepRecord:
    """Return a record in which a quantity is missing in some steps."""
    series = getattr(record, name).copy()
    series[first:end] = np.nan
    return replace(record, **{name: series})


@pytest.mark.parametrize("name", ["rain", "pumped"])
def test_nothing_counts_after_an_outage_until_the_roof_has_forgotten(name: str) -> None:
    """A week at 3 mm a day is 21 mm; at 1 mm a day it takes twenty days."""
    for daily, days in ((3.0, 7), (1.0, 20)):
        record = replace(of_rain(40, {100: 5.0}), reference=np.full(40 * DAY, daily / DAY))
        record = lost(record, name, 3 * DAY, 5 * DAY)
        (outage,) = find_outages(record)
        assert outage.start == 3 * DAY
        assert outage.stop == pytest.approx((5 + days) * DAY, abs=2)
        counted = np.flatnonzero(select_comparable(record))
        assert not np.isin(np.arange(3 * DAY, outage.stop), counted).any()
        assert counted.max() == 40 * DAY - 1 and 2 * DAY in counted


def test_a_short_outage_counts_only_next_to_rain() -> None:
    record = of_rain(40, {100: 5.0})
    short = lost(record, "rain", 3 * DAY, 3 * DAY + 6)
    assert find_outages(short) == []
    for outside in (3 * DAY - 1, 3 * DAY + 6):
        storm = lost(of_rain(40, {outside: 4.0}), "rain", 3 * DAY, 3 * DAY + 6)
        assert len(find_outages(storm)) == 1


def test_an_outage_at_the_end_or_of_daily_sums() -> None:
    record = lost(of_rain(20, {100: 5.0}), "rain", 19 * DAY, 20 * DAY)
    assert find_outages(record) == [slice(19 * DAY, 20 * DAY)]
    days = a_record(np.array([0, 2.0, *[0.0] * 18]), step_s=86400.0)
    days = lost(replace(days, reference=np.full(20, 4.0)), "rain", 4, 5)
    assert find_outages(days) == [slice(4, 12)]
