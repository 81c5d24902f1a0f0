"""Storms of a record, the steps that are compared, its months and halves, and scores."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest
from places import refusal
from twins import a_record

from greenroof_ros.analysis.calibration.record import (
    StepRecord,
    efficiency,
    find_outages,
    find_storms,
    halve_steps,
    score,
    select_comparable,
    select_months,
)

HOUR = 12
DAY = 24 * HOUR


def of_rain(days: int, rain: dict[int, float]) -> StepRecord:
    """Return a record of five-minute steps with rain in some of them and without runoff."""
    depths = np.zeros(days * DAY)
    depths[list(rain)] = list(rain.values())
    return a_record(depths, runoff=np.zeros(days * DAY))


def lost(record: StepRecord, name: str, steps: object) -> StepRecord:
    """Return a record in which a quantity is missing in some steps."""
    series = (record.measured["runoff"] if name == "runoff" else getattr(record, name)).copy()
    series[steps] = np.nan
    if name == "runoff":
        return replace(record, measured={"runoff": series})
    return replace(record, **{name: series})


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
        steps = select_comparable(lost(record, what, [120, 3 * DAY]))
        left_out = [*range(100, 101 + DAY), *range(3 * DAY - 1, 3 * DAY + 2)]
        assert np.flatnonzero(~steps).tolist() == left_out, what


@pytest.mark.parametrize("name", ["rain", "pumped"])
def test_nothing_counts_after_an_outage_until_the_roof_has_forgotten(name: str) -> None:
    """A week at 3 mm a day is 21 mm; at 1 mm a day it takes twenty days."""
    for daily, days in ((3.0, 7), (1.0, 20)):
        record = replace(of_rain(40, {100: 5.0}), reference=np.full(40 * DAY, daily / DAY))
        record = lost(record, name, slice(3 * DAY, 5 * DAY))
        (outage,) = find_outages(record)
        assert outage.start == 3 * DAY
        assert outage.stop == pytest.approx((5 + days) * DAY, abs=2)
        counted = np.flatnonzero(select_comparable(record))
        assert not np.isin(np.arange(3 * DAY, outage.stop), counted).any()
        assert counted.max() == 40 * DAY - 1 and 2 * DAY in counted


def test_a_short_outage_counts_only_next_to_rain() -> None:
    """And an outage at the end of a record ends there."""
    short = slice(3 * DAY, 3 * DAY + 6)
    assert find_outages(lost(of_rain(40, {100: 5.0}), "rain", short)) == []
    for outside in (3 * DAY - 1, 3 * DAY + 6):
        assert len(find_outages(lost(of_rain(40, {outside: 4.0}), "rain", short))) == 1
    end = slice(19 * DAY, 20 * DAY)
    assert find_outages(lost(of_rain(20, {100: 5.0}), "rain", end)) == [end]


def test_halves_have_the_same_water_and_no_storm_in_common() -> None:
    """Half of the water has come on the second day of the first storm; the next dry day splits."""
    record = of_rain(8, {10: 1.0, DAY: 2.0, DAY + HOUR: 3.0, 5 * DAY: 4.0})
    steps = np.arange(8 * DAY) != 7
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
        assert year.time(int(np.argmax(steps))) == f"{first} 00:00"
    for text in ("4", "0-3", "4-13", "april-october", "4-5-6"):
        refusal(select_months, year, text, match=f"^months = '{text}': must be the first and")


def test_nash_and_sutcliffe() -> None:
    """The example in the documentation of the package HydroErr, with its result.

    The mean of the measurements is worth 0; constant measurements give no score.
    """
    simulated = np.array([5, 7, 9, 2, 4.5, 6.7])
    measured = np.array([4.7, 6, 10, 2.5, 4, 7])
    assert efficiency(simulated, measured) == pytest.approx(0.922093023255814, rel=1e-12)
    assert efficiency(np.full(6, measured.mean()), measured) == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(efficiency(measured, np.ones(6)))


def test_longer_sums_forgive_a_delay() -> None:
    """A day's runoff an hour late scores below 0 by the hour, and perfectly by the day.

    Of levels, days of 4, 1 and 2 values with 1, 3 and 2 cm have a mean of 2 cm.
    """
    measured = np.zeros(4 * 24)
    measured[[10, 60]] = 5.0, 2.0
    steps = np.full(96, True)
    hourly = a_record(measured, 3600.0, runoff=measured)
    scores = score("runoff", "fit", np.roll(measured, 1), hourly, steps)
    assert scores.nse[3600] < 0
    assert scores.nse[86400] == 1.0
    for step_s, times in ((60, [60, 3600, 86400]), (21600, [21600, 86400])):
        record = replace(hourly, step_s=step_s)
        less = score("runoff", "fit", 0.9 * measured, record, steps)
        assert list(less.nse) == times  # none shorter than a step
        assert less.volume_error == pytest.approx(-0.1)
    known = np.isin(np.arange(72), [0, 1, 2, 3, 29, 48, 57])
    levels = a_record(np.zeros(72), 3600.0, level=np.array([0.01, 0.03, 0.02])[np.arange(72) // 24])
    scores = score("level", "fit", np.full(72, 0.02), levels, known)
    assert scores.nse[86400] == pytest.approx(0.0, abs=1e-12)
