"""The same file is the same rain for a run and for a calibration: one reader, and one clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal
from twins import TWIN

from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.site.site import Site
from greenroof_ros.weather.read import read_weather

HEADER = "time,rain [mm],runoff [mm],temperature [degC],dew point [degC]"
FIRST = datetime(2021, 6, 1, 13)  # noqa: DTZ001 - on the clock of the site
DAYS, AN_HOUR = 2, 12
ROWS = DAYS * 24 * AN_HOUR
Rows = list[list[str]]


def usual_rows() -> Rows:
    """Return rows of five minutes from 13:00 on; in each hour 0.1 mm fall in its third row.

    The dew point is no column of a calibration.
    """
    return [
        [
            f"{FIRST + timedelta(minutes=5 * row)}", "0.1" if row % AN_HOUR == 2 else "0", "0",
            f"{15 + 5 * np.sin(row / 46):.1f}", "9",
        ]
        for row in range(ROWS)
    ]


def read_both(file: Path, rows: Rows, site: Site = TWIN, header: str = HEADER) -> list[np.ndarray]:
    """Return the rain (mm) that fell in each hour from 13:00 UTC+1 on, of a run and a calibration.

    NaN where an hour's rain is unknown: in a run with less than nine of its twelve rows, in a
    calibration with any of them missing.
    """
    file.write_text("\n".join([header, *map(",".join, rows), ""]))
    weather = read_weather([file], site, rain_only=True)
    record = read_csv_record(file, site)
    first = FIRST.replace(tzinfo=timezone(timedelta(hours=1)))
    shown = []
    for start, step_s, rain in (
        (weather.rain_from, 3600.0, weather.precipitation),
        (record.start, record.step_s, record.rain),
    ):
        since = (start - first).total_seconds()
        hour = np.floor((since + step_s * (np.arange(len(rain)) + 0.5)) / 3600).astype(int)
        hours = np.full(DAYS * 24, np.nan)
        for each in range(max(0, hour[0]), min(DAYS * 24, hour[-1] + 1)):
            hours[each] = rain[hour == each].sum()
        shown.append(hours)
    return shown


def set_rain(row: int, text: str) -> Callable[[Rows], None]:
    def change(rows: Rows) -> None:
        rows[row][1] = text

    return change


def shift_clock(rows: Rows) -> None:
    """From the second hour on the logger's clock is two seconds slow."""
    for number, row in enumerate(rows[12:], start=12):
        row[0] = f"{FIRST + timedelta(minutes=5 * number, seconds=-2)}"
    rows[24][1] = "7"  # stamped 14:59:58, of the step from 15:00 on


def set_clock(rows: Rows) -> None:
    """After the row of 15:00 comes one of 15:02, when the clock was set, and then 15:05."""
    rows.insert(25, [f"{FIRST + timedelta(minutes=122)}", "7", "0", "15", "9"])


# What is changed, the hour that differs, and its rain (mm) by hand.
CASES: dict[str, tuple[Callable[[Rows], None], int, float]] = {
    # 45 mm in 5 min are 540 mm/h, more than falls in an hour and less than has fallen in minutes.
    "a cloudburst": (set_rain(24, "45"), 2, 45.1),
    # The step in which a row begins, by its nearest whole step, is the hour's.
    "a slow clock": (shift_clock, 2, 7.1),
    # Two rows of one step: 0.1 mm of the hour, and 7 mm of two minutes.
    "a clock that is set": (set_clock, 2, 7.1),
}


@pytest.mark.parametrize("name", CASES)
def test_a_run_and_a_calibration_read_the_same_rain(tmp_path: Path, name: str) -> None:
    change, hour, due = CASES[name]
    rows = usual_rows()
    change(rows)
    expected = np.full(DAYS * 24, 0.1)
    expected[hour] = due
    for rain in read_both(tmp_path / "logger.csv", rows):
        assert rain == pytest.approx(expected, nan_ok=True)


def test_times_without_an_offset_are_by_the_sites_standard_time(tmp_path: Path) -> None:
    """With a note; with a time zone they are an hour earlier in summer: 13:00 there is 12:00."""
    file = tmp_path / "logger.csv"
    for rain in read_both(file, usual_rows()):
        assert rain == pytest.approx(np.full(DAYS * 24, 0.1))
    note = "logger.csv: times are interpreted as UTC+0100, the utc_offset of the site file; if"
    assert read_weather([file], TWIN, rain_only=True).notes[0].startswith(note)
    assert read_csv_record(file, TWIN).notes[0].startswith(note)
    berlin = replace(TWIN, time_zone="Europe/Berlin")
    run, fit = read_both(file, usual_rows(), berlin)
    assert np.isnan(run[-1]) and np.isnan(fit[-1])
    assert read_weather([file], berlin, rain_only=True).first == read_csv_record(file, berlin).start
    nowhere = replace(TWIN, utc_offset=None)
    for read in (lambda: read_weather([file], nowhere), lambda: read_csv_record(file, nowhere)):
        refusal(read, match="line 2: time = .*: must include a UTC offset, .*set time_zone")


def test_rain_that_is_an_hour_late(tmp_path: Path) -> None:
    """A comment states it: what the file has at 15:00 fell at 14:00, for runs and for fits."""
    rows = usual_rows()
    rows[24][1] = "7"
    for rain in read_both(tmp_path / "logger.csv", rows, header=f"# rain_late: 1\n{HEADER}"):
        assert rain[1] == pytest.approx(7.1) and np.nansum(rain) == pytest.approx(0.1 * 46 + 7.1)


@pytest.mark.parametrize("cell", ['"0,1 mm"', "1'019", '"1,019.5"'])
def test_what_both_refuse(tmp_path: Path, cell: str) -> None:
    """A hundred cells that are no numbers."""
    file, rows = tmp_path / "logger.csv", usual_rows()
    for row in rows[100:200]:
        row[1] = cell
    file.write_text("\n".join([HEADER, *map(",".join, rows), ""]))
    run = refusal(read_weather, [file], TWIN)
    assert run == refusal(read_csv_record, file, TWIN)
    assert "line 102: rain [mm] = " in run
