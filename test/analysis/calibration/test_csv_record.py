"""Measured records as CSV: columns, steps of rows, evapotranspiration, and what is refused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from places import refusal
from twins import TWIN

from greenroof_ros.analysis.calibration.record import StepRecord, read_csv_record, select_comparable
from greenroof_ros.site.site import Site

ROWS = 120
JUNE = datetime(2021, 6, 1)  # noqa: DTZ001 - on the clock of the site


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "record.csv"


def since(first: datetime, minutes: Iterable[float]) -> list[datetime]:
    """Return the times after a first one."""
    return [first + timedelta(minutes=float(after)) for after in minutes]


FIVE_MINUTES = since(JUNE, range(0, 5 * ROWS, 5))


def text_of(
    header: str, cells: str | Sequence[str], times: Sequence[datetime] = FIVE_MINUTES
) -> str:
    """Return a file with the same cells in each row, or with the cells of each row."""
    texts = [cells] * len(times) if isinstance(cells, str) else cells
    rows = (f"{time:%Y-%m-%dT%H:%M},{text}" for time, text in zip(times, texts, strict=True))
    return "\n".join([f"time,{header}", *rows, ""])


def read(file: Path, text: str, site: Site = TWIN) -> StepRecord:
    """Write a record's file and read it."""
    file.write_text(text)
    return read_csv_record(file, site)


def test_units_come_to_mm_of_a_step_and_m(file: Path) -> None:
    """12 mm/h are 1 mm in 5 minutes; on 100 m2, 2 l/s are 6 mm, and 50 l are 0.5 mm.

    With ``rows: end``, a level is that at the start of the next row.
    """
    text = text_of(
        "rain [mm/h],runoff [l/s],pumped [l],level [mm],reference evapotranspiration [mm/day]",
        [f"12,2,50,{row},2.88" for row in range(ROWS)],
    )
    record = read(file, text)
    assert record.step_s == 300.0
    assert record.start.isoformat() == "2021-06-01T00:00:00+01:00"
    assert record.rain == pytest.approx(np.full(ROWS, 1.0))
    assert record.measured["runoff"] == pytest.approx(np.full(ROWS, 6.0))
    assert record.pumped == pytest.approx(np.full(ROWS, 0.5))
    assert record.measured["level"] == pytest.approx(np.arange(ROWS) / 1000)
    assert record.reference == pytest.approx(np.full(ROWS, 0.01))
    late = read(file, "# rows: end\n" + text)
    assert late.start.isoformat() == "2021-05-31T23:55:00+01:00"
    assert late.measured["level"][:3] == pytest.approx([np.nan, 0.0, 0.001], nan_ok=True)


def test_a_record_may_have_a_description(file: Path) -> None:
    """As a weather file may; its runoff is in a column of another name."""
    file.write_text(text_of("rain [mm],Abfluss,reference evapotranspiration [mm]", "0,0.5,0.01"))
    described = file.with_suffix(".yaml")
    described.write_text(
        'file: record.csv\ncolumns: {time: time, rain: "rain [mm]", runoff: Abfluss, '
        'reference evapotranspiration: "reference evapotranspiration [mm]"}\n'
        "units: {runoff: mm}\n"
    )
    assert read_csv_record(described, TWIN).measured["runoff"][0] == pytest.approx(0.5)


RAIN, RUNOFF, LEVEL = "rain [mm]", "runoff [mm]", "level [m]"
MINIMUM, MAXIMUM = "minimum temperature [degC]", "maximum temperature [degC]"
HEADER = ",".join((RAIN, RUNOFF, LEVEL, MINIMUM, MAXIMUM))
TEXT = text_of(HEADER, "0.1,0.2,0.03,5,15")


def test_missing_rows_and_empty_cells_are_gaps(file: Path) -> None:
    """A sensor that failed has often missed a part of the neighbouring steps."""
    lines = TEXT.splitlines()
    lines[21] = lines[21].replace(",0.2,", ",,")
    record = read(file, "\n".join([*lines[:61], *lines[71:], ""]))
    assert np.flatnonzero(np.isnan(record.rain)).tolist() == list(range(60, 70))
    assert np.flatnonzero(np.isnan(record.measured["runoff"])).tolist() == [20, *range(60, 70)]
    assert np.flatnonzero(~record.complete).tolist() == [19, 20, 21, *range(59, 71)]


def test_wrong_files_are_refused(file: Path) -> None:
    """Columns that are lacking, too much rain, rows that are uneven, and no clock."""
    days = text_of(HEADER, "0,0,0,5,15", since(JUNE, 1440 * np.arange(120)))
    assert read(file, days).step_s == 86400.0
    for text, message in (
        (TEXT.replace(RAIN, "pumped [mm]"), r"csv, line 1: must have the columns 'rain \[mm"),
        (TEXT.replace("T00:30,0.1", "T00:30,169"), r"line 8: rain \[mm\] = '169': must be"),
        (text_of(HEADER, "0,0,0,5,15", since(JUNE, np.cumsum(np.resize([5, 5, 7], 120)))),
         "line 4: time = '2021-06-01T00:17': this row is 7 min after"),
    ):
        refusal(read, file, text, match=message)
    refusal(read, file, TEXT, replace(TWIN, utc_offset=None), match="must include a UTC offset")


def test_a_gap_in_evapotranspiration_hides_the_time_after_it(file: Path) -> None:
    """It grows by 0.01 mm/day from row to row, also through a gap of an hour.

    In a longer gap, the roof dries as on average, and nothing is compared in the week after it.
    """
    values = 2 + 0.01 * np.arange(ROWS)

    def without(missing: int) -> StepRecord:
        cells = [f"0,0.02,{value:.2f}" for value in values]
        cells[30:30 + missing] = ["0,0.02,"] * missing
        header = f"{RAIN},{LEVEL},reference evapotranspiration [mm/day]"
        return read(file, text_of(header, cells))

    assert without(12).reference == pytest.approx(values / 288)
    assert select_comparable(without(12)).all()
    longer = without(13)
    assert np.flatnonzero(np.isnan(longer.reference)).tolist() == [*range(30, 43)]
    assert longer.drying[30] == pytest.approx(np.delete(values, range(30, 43)).mean() / 288)
    assert np.flatnonzero(select_comparable(longer)).tolist() == [*range(30)]


def test_temperatures_that_show_no_day(file: Path) -> None:
    """None from 13 days on; none in early April, as of a logger put away in winter; none at all.

    Six-hourly temperatures show no extremes, and nor does a minimum above the maximum.
    """
    hours = since(datetime(2021, 4, 1), range(0, 60 * 1440, 60))  # noqa: DTZ001 - site's clock

    def of_days(days: Iterable[int], extremes: str = "5,15") -> str:
        cells = [
            f"0,0.02,{extremes if hour // 24 in days else ','}" for hour in range(60 * 24)
        ]
        return text_of(f"{RAIN},{LEVEL},{MINIMUM},{MAXIMUM}", cells, hours)

    for days, known in ((range(10), range(13)), (range(15, 60), range(12, 60))):
        reference = read(file, of_days(days)).reference.reshape(60, 24)
        assert np.flatnonzero(~np.isnan(reference).any(axis=1)).tolist() == [*known]
    six_hourly = text_of(f"{RAIN},{LEVEL},temperature [degC]", "0,0.02,12", hours[::6])
    for text in (of_days(()), of_days(range(60), "15,5"), six_hourly):
        refusal(read, file, text, match="has no evapotranspiration; if it is computed, each day")


LYON = replace(TWIN, latitude=45 + 43 / 60, longitude=4.85, utc_offset=1.0)
# Minimum and maximum temperature of 13 to 16 July; the 15th is FAO-56's Example 20.
DAYS = {13: (8.0, 40.0), 14: (4.0, 9.0), 15: (14.8, 26.6), 16: (-2.0, 38.0)}


def test_a_row_has_the_temperatures_of_its_own_day(file: Path) -> None:
    """In the first row of each day, in each row, or as the day's course: the results are equal.

    By Example 20 the 15th has 5.0 mm; the days next to it are much colder and much warmer.
    """
    times = since(datetime(1998, 7, 13, 8, 25), range(0, 3 * 1440, 5))  # noqa: DTZ001 - site's
    first = {min(time for time in times if time.day == day) for day in DAYS}

    def reference(columns: str, cells: list[str]) -> np.ndarray:
        record = read(
            file, text_of(f"{RAIN},{RUNOFF},{columns}", [f"0,0,{cell}" for cell in cells], times),
            LYON,
        )
        of_the_15th = [time.day == 15 for time in times]
        assert np.sum(record.reference[of_the_15th]) == pytest.approx(5.0, abs=0.05)
        return record.reference

    both = f"{MINIMUM},{MAXIMUM}"
    every = ["{},{}".format(*DAYS[time.day]) for time in times]
    in_first = reference(both, [
        cell if time in first else "," for time, cell in zip(times, every, strict=True)
    ])
    assert reference(both, every) == pytest.approx(in_first)
    # Three quarters of a day's course are required: the 13th and the 16th have less.
    whole = slice(187, 187 + 2 * 288)
    of_course = reference(
        "temperature [degC]", [str(DAYS[time.day][time in first]) for time in times]
    )
    assert of_course[whole] == pytest.approx(in_first[whole])
    assert of_course[:187].sum() < 0.5 * in_first[:187].sum()  # as cold as the 14th
