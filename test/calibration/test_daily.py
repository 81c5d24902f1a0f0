"""Evapotranspiration from the temperatures of days, where a logger's clock was set."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from twins import TWIN

from greenroof_ros.calibration.csv_record import read_csv_record

LYON = replace(TWIN, latitude=45 + 43 / 60, longitude=4.85, utc_offset=1.0)
# Least and greatest temperature of 13 to 16 July; those of the 15th are FAO-56's Example 20.
DAYS = {13: (8.0, 40.0), 14: (4.0, 9.0), 15: (14.8, 26.6), 16: (-2.0, 38.0)}


def times() -> list[datetime]:
    """Rows from 8:23 on, whose clock is set on by 2 min at 18:00: then there is one of 0:00.

    The step that 0:00 lies in begins at 23:58, as the steps go on from the first row.
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
    """In the first row of each day, in each row, in that of noon, or as the day's course: the same.

    By Example 20 the 15th has 5.0 mm; the days beside it are much colder and much warmer.
    """
    extremes = "least temperature [degC],greatest temperature [degC]"
    every = {time: "{},{}".format(*DAYS[time.day]) for time in times()}
    noon = {time: cell for time, cell in every.items() if (time.hour, time.minute // 5) == (12, 0)}
    first = {min(time for time in every if time.day == day): "{},{}".format(*DAYS[day])
             for day in DAYS}
    assert datetime(1998, 7, 15) in first  # noqa: DTZ001 - on the site's clock
    assert len(noon) == 3  # the record ends on the 16th before noon
    course = {time: str(DAYS[time.day][time in first]) for time in times()}
    file = tmp_path / "record.csv"
    in_first = reference(file, extremes, first, ",")
    assert reference(file, extremes, every, ",") == pytest.approx(in_first)
    last = times()[-1]
    with_last = {**noon, last: every[last]}
    assert reference(file, extremes, with_last, ",") == pytest.approx(in_first)
    # Of a day's course three quarters must be there: not so of the 13th and the 16th.
    whole = slice(188, 188 + 2 * 288)
    of_course = reference(file, "temperature [degC]", course, "")
    assert of_course[whole] == pytest.approx(in_first[whole])
