"""Evapotranspiration of a record: gaps in its own column, and from the temperatures of its days."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal
from twins import TWIN

from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.record import Record

NAME = "reference evapotranspiration [mm/day]"


def read(
    file: Path, minutes: np.ndarray, values: list[str], month: int = 6, column: str = NAME
) -> Record:
    """Return a record of rows at these minutes of a month, with their evapotranspiration."""
    start = datetime(2021, month, 1)  # noqa: DTZ001 - on the clock of the site
    rows = [f"{(start + timedelta(minutes=float(after))).isoformat()},0,0.02,{value}"
            for after, value in zip(minutes, values, strict=True)]
    file.write_text("\n".join([f"time,rain [mm],level [m],{column}", *rows]) + "\n")
    return read_csv_record(file, TWIN)


EMPTY, NO_ROW = "is empty", "there is no row of 2021-06-01T02:30:00"


@pytest.mark.parametrize("what", [EMPTY, NO_ROW])
def test_an_hour_may_be_missing_and_no_more(what: str, tmp_path: Path) -> None:
    """It grows by 0.01 mm/day from row to row, and also through the gap."""
    file = tmp_path / "record.csv"
    row = np.arange(120)
    values = 2 + 0.01 * row

    def without(missing: int) -> Record:
        gone = (row >= 30) & (row < 30 + missing)
        kept = row if what == EMPTY else row[~gone]
        return read(file, 5 * kept, ["" if gone[at] else f"{values[at]:.2f}" for at in kept])

    assert without(12).reference == pytest.approx(values / 288)
    assert refusal(without, 13).startswith(
        f"{file}, line 32: {NAME}: {what}, and none has a value for 65 min: it may be missing "
        "for an hour at most"
    )


def test_at_the_ends_an_hour_may_be_missing_too(tmp_path: Path) -> None:
    """And a column of zeros is not evapotranspiration."""
    cells = [""] * 12 + ["3"] * 96 + [""] * 12
    record = read(tmp_path / "record.csv", 5 * np.arange(120), cells)
    assert record.reference == pytest.approx(np.full(120, 3 / 288))
    for more in (12, 107):
        longer = [*cells[:more], "", *cells[more + 1:]]
        refusal(
            read, tmp_path / "record.csv", 5 * np.arange(120), longer,
            match="is empty, and none has a value for 65 min",
        )
    nothing = ["0"] * 120
    refusal(read, tmp_path / "record.csv", 5 * np.arange(120), nothing, match="is 0 throughout")


def test_a_clock_that_is_set_leaves_no_gap(tmp_path: Path) -> None:
    """Set forward four times, together by more than half a step, so one step has no row."""
    minutes = 360 * np.arange(500)
    for row in range(100, 500, 100):
        minutes[row:] += 55
    record = read(tmp_path / "record.csv", minutes, ["3"] * 500, month=4)
    assert np.flatnonzero(np.isnan(record.level)).tolist() == [400]
    assert record.reference == pytest.approx(np.full(record.steps, 3 * 360 / 1440))


def with_temperatures(file: Path, extremes: dict[int, str]) -> Path:
    """Write two months of hours from 1 April on, with the temperatures of some days."""
    first = datetime(2021, 4, 1)  # noqa: DTZ001 - on the clock of the site
    rows = ["time,rain [mm],level [m],least temperature [degC],greatest temperature [degC]"]
    for day in range(60):
        begin = first + timedelta(days=day)
        rows += [f"{(begin + timedelta(hours=hour)).isoformat()},0,0.02,{extremes.get(day, ',')}"
                 for hour in range(24)]
    file.write_text("\n".join(rows) + "\n")
    return file


def test_temperatures_that_show_no_day_are_refused(tmp_path: Path) -> None:
    """None after ten days; none in early April, as of a logger put away in winter; none at all.

    Six-hourly temperatures show no extremes; and a day's least must not exceed its greatest.
    """
    file = tmp_path / "record.csv"
    for extremes, message in (
        (dict.fromkeys(range(10), "5,15"), "no temperature within 3 days of 2021-04-14"),
        ({}, "no day has its temperatures"),
        (dict.fromkeys(range(60), "5,15") | {0: "40,15"},
         "on 2021-04-01 the least temperature, 40 degC, is above the great"),
        (dict.fromkeys(range(15, 60), "5,15"), "has no temperature within 3 days"),
    ):
        refusal(read_csv_record, with_temperatures(file, extremes), TWIN, match=message)
    assert np.all(read_csv_record(file, TWIN, "5-6").reference >= 0)
    refusal(
        read, file, 360 * np.arange(120), ["12"] * 120, 6, "temperature [degC]",
        match="temperature: its rows are 6 h apart, and show a",
    )


LYON = replace(TWIN, latitude=45 + 43 / 60, longitude=4.85, utc_offset=1.0)
# Least and greatest temperature of 13 to 16 July; the 15th is FAO-56's Example 20.
DAYS = {13: (8.0, 40.0), 14: (4.0, 9.0), 15: (14.8, 26.6), 16: (-2.0, 38.0)}


def times() -> list[datetime]:
    """Rows from 8:23 on, with a clock that is set forward by 2 min at 18:00: one row is at 0:00.

    The step with 0:00 begins at 23:58, because the steps continue from the first row.
    """
    rows = [datetime(1998, 7, 13, 8, 23) + timedelta(minutes=5 * row)  # noqa: DTZ001 - site's clock
            for row in range(12 * 24 * 3)]
    return [time + timedelta(minutes=2 * (time.day > 13 or time.hour >= 18)) for time in rows]


def reference(file: Path, columns: str, cells: dict[datetime, str], empty: str) -> np.ndarray:
    rows = [f"{time.isoformat()},0,0,{cells.get(time, empty)}" for time in times()]
    file.write_text("\n".join([f"time,rain [mm],runoff [mm],{columns}", *rows]) + "\n")
    record = read_csv_record(file, LYON)
    assert str(record.times[187]) == "1998-07-13T23:58:00"
    of_the_15th = record.times.astype("datetime64[D]") == np.datetime64("1998-07-15")
    assert np.sum(record.reference[of_the_15th]) == pytest.approx(5.0, abs=0.05)
    return record.reference


def test_a_row_has_the_temperatures_of_its_own_day(tmp_path: Path) -> None:
    """In the first row of each day, in each row, or as the day's course: the results are equal.

    By Example 20 the 15th has 5.0 mm; the days beside it are much colder and much warmer.
    """
    extremes = "least temperature [degC],greatest temperature [degC]"
    every = {time: "{},{}".format(*DAYS[time.day]) for time in times()}
    first = {min(time for time in every if time.day == day): "{},{}".format(*DAYS[day])
             for day in DAYS}
    assert datetime(1998, 7, 15) in first  # noqa: DTZ001 - on the site's clock
    course = {time: str(DAYS[time.day][time in first]) for time in times()}
    file = tmp_path / "record.csv"
    in_first = reference(file, extremes, first, ",")
    assert reference(file, extremes, every, ",") == pytest.approx(in_first)
    # Three quarters of a day's course are required: the 13th and the 16th have less.
    whole = slice(188, 188 + 2 * 288)
    of_course = reference(file, "temperature [degC]", course, "")
    assert of_course[whole] == pytest.approx(in_first[whole])
    assert of_course[:187].sum() < 0.5 * in_first[:187].sum()  # as cold as the 14th
