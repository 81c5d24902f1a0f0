"""Measured records as CSV: columns, steps of rows, evapotranspiration, and what is refused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal
from twins import TWIN

from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.analysis.calibration.step_record import StepRecord
from greenroof_ros.site.site import Site

ROWS = 120


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "record.csv"


def since(first: datetime, minutes: Iterable[float]) -> list[datetime]:
    """Return the times after a first one."""
    return [first + timedelta(minutes=float(after)) for after in minutes]


JUNE = datetime(2021, 6, 1)  # noqa: DTZ001 - on the clock of the site
FIVE_MINUTES = since(JUNE, range(0, 5 * ROWS, 5))


def text_of(
    header: str, cells: str | Sequence[str], times: Sequence[datetime] = FIVE_MINUTES
) -> str:
    """Return a file with the same cells in each row, or with the cells of each row."""
    texts = [cells] * len(times) if isinstance(cells, str) else cells
    rows = (
        f"{time.isoformat(timespec='minutes')},{text}"
        for time, text in zip(times, texts, strict=True)
    )
    return "\n".join([f"time,{header}", *rows, ""])


def read(file: Path, text: str, site: Site = TWIN, months: str | None = None) -> StepRecord:
    """Write a record's file and read it."""
    file.write_text(text)
    return read_csv_record(file, site, months)


def test_units_come_to_mm_of_a_step_and_m(file: Path) -> None:
    """12 mm/h are 1 mm in 5 minutes; on 100 m2, 2 l/s are 6 mm, and 50 l are 0.5 mm."""
    record = read(file, text_of(
        "rain [mm/h],runoff [l/s],pumped [l],level [mm],reference evapotranspiration [mm/day]",
        "12,2,50,25,2.88",
    ))
    assert record.step_s == 300.0
    assert record.start.isoformat() == "2021-06-01T00:00:00+01:00"
    assert record.rain == pytest.approx(np.full(ROWS, 1.0))
    assert record.runoff == pytest.approx(np.full(ROWS, 6.0))
    assert record.pumped == pytest.approx(np.full(ROWS, 0.5))
    assert record.level == pytest.approx(np.full(ROWS, 0.025))
    assert record.reference == pytest.approx(np.full(ROWS, 0.01))


@pytest.mark.parametrize(
    ("runoff", "last_decimal"),
    [("0.04", 0.01), ("3", 1.0), ("0.30000000000000004", 0.1), ("0.00515464", 1e-8)],
)
def test_the_last_decimal_of_runoff(runoff: str, last_decimal: float, file: Path) -> None:
    """On 100 m2, 1 in the last place of litres is a hundredth of that in mm."""
    for unit, factor in (("mm", 1.0), ("l", 0.01)):
        header = f"rain [mm],runoff [{unit}],reference evapotranspiration [mm]"
        record = read(file, text_of(header, f"0,{runoff},0.1"))
        assert record.last_decimal == pytest.approx(factor * last_decimal)


def test_a_record_may_have_a_description(file: Path) -> None:
    """As a weather file may; its runoff is in a column of another name."""
    text = text_of("rain [mm],Abfluss,reference evapotranspiration [mm/day]", "0.1,0.5,2.4")
    file.write_text(text)
    described = file.with_suffix(".yaml")
    described.write_text(
        'file: record.csv\ncolumns: {time: time, rain: "rain [mm]", runoff: Abfluss, '
        'reference evapotranspiration: "reference evapotranspiration [mm/day]"}\n'
        "units: {runoff: mm}\n"
    )
    record = read_csv_record(described, TWIN)
    assert record.runoff is not None
    assert record.runoff[0] == pytest.approx(0.5) and record.rain[0] == pytest.approx(0.1)


def test_a_level_at_the_end_of_its_row(file: Path) -> None:
    """The level at the end of a row is the one at the start of the next; rain stays in its row."""
    header = "rain [mm],level [m],reference evapotranspiration [mm]"
    cells = [f"{n},{n / 1000},0.1" for n in range(ROWS)]
    record = read(file, "# rows: end\n" + text_of(header, cells))
    assert record.rain[:3].tolist() == [0.0, 1.0, 2.0]
    assert record.level[:3] == pytest.approx([np.nan, 0.0, 0.001], nan_ok=True)


def test_a_pump_state_is_a_share_of_the_flow_at_the_cistern_level(file: Path) -> None:
    """At 3 m the paper's pumps deliver sqrt((3 + 55.2 - 16) / 1 / b^-2), Eq. 3e.

    Without the cistern's level the flow of a running pump is unknown; a stopped pump delivers 0.
    """
    cells = ["0,0.02,50,3,0.1"] * ROWS
    cells[3], cells[5], cells[7] = "0,0.02,1,,0.1", "0,0.02,0,,0.1", "0,0.02,,3,0.1"
    record = read(file, text_of(
        "rain [mm],level [m],pump state [%],cistern level [m],reference evapotranspiration [mm]",
        cells,
    ))
    flow = 0.5 * TWIN.b * np.sqrt(3 + TWIN.c_hat - TWIN.d)
    assert record.pumped[8:] == pytest.approx(np.full(112, flow * 300 / 100 * 1e3))
    assert np.flatnonzero(np.isnan(record.pumped)).tolist() == [3, 7]
    assert record.pumped[5] == 0
    assert np.flatnonzero(~record.complete).tolist() == [2, 3, 4, 6, 7, 8]


RAIN, RUNOFF, LEVEL = "rain [mm]", "runoff [mm]", "level [m]"
MINIMUM, MAXIMUM = "minimum temperature [degC]", "maximum temperature [degC]"
HEADER = ",".join((RAIN, RUNOFF, LEVEL, MINIMUM, MAXIMUM))
TEXT = text_of(HEADER, "0.1,0.2,0.03,5,15")


def test_missing_rows_and_empty_cells_are_gaps(file: Path) -> None:
    """The clock and evapotranspiration from temperatures need the place in the site file."""
    lines = TEXT.splitlines()
    lines[21] = lines[21].replace(",0.2,", ",,")
    text = "\n".join([*lines[:61], *lines[71:], ""])
    record = read(file, text)
    for lacks, needed in (
        ("latitude", "hargreaves requires latitude in the site file"),
        ("utc_offset", "must include a UTC offset"),
    ):
        refusal(read, file, text, replace(TWIN, **{lacks: None}), match=needed)
    assert record.steps == ROWS
    assert np.flatnonzero(np.isnan(record.rain)).tolist() == list(range(60, 70))
    assert np.flatnonzero(np.isnan(record.runoff)).tolist() == [20, *range(60, 70)]
    # A sensor that failed has often missed a part of the neighbouring steps.
    assert np.flatnonzero(~record.complete).tolist() == [19, 20, 21, *range(59, 71)]


# A text of the file, its replacement, and the message.
WRONG = {
    "no rain column": (RAIN, "pumped [mm]", "line 1: there must be a column 'rain [mm]'"),
    "nothing for evapotranspiration": (
        MAXIMUM, "pumped [mm]", "there must be a column 'reference evapo"),
    "a pump state alone": (RUNOFF, "pump state [1]", "'cistern level [m]', on which"),
    "too short": (
        "\n".join(TEXT.splitlines()[40:]), "", "has 39 rows; a record must have at least 100"),
    "rain in micrometres": (
        "T00:30,0.1,0.2,0.03,5,15\n2021-06-01T00:35,0.1",
        "T00:30,169,0.2,0.03,5,15\n2021-06-01T00:35,169",
        "line 8: rain [mm] = '169': must be a number from 0 to 166.7 mm; is the unit of the column",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_refused(name: str, file: Path) -> None:
    was, now, message = WRONG[name]
    assert was in TEXT
    reason = refusal(read, file, TEXT.replace(was, now, 1))
    assert reason.startswith(str(file)) and message in reason


# --- rows and steps -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("minutes", "message"),
    [
        (2 * 1440 * np.arange(120),
         "line 1: the rows are 2 days apart; they must be no more than a day apart"),
        (np.cumsum(np.resize([5, 5, 7], 200)),
         "line 4: time = '2021-06-01T00:17': this row is 7 min after the previous row, but rows "
         "must be 5 min or a multiple apart"),
    ],
)
def test_rows_that_are_on_no_clock_are_refused(
    minutes: np.ndarray, message: str, file: Path
) -> None:
    """Rows a day apart are on one."""
    days = read(file, text_of(HEADER, "0,0,0,5,15", since(JUNE, 1440 * np.arange(120))))
    assert (days.steps, days.step_s) == (120, 86400.0)
    text = text_of(HEADER, "0,0,0,5,15", since(JUNE, minutes))
    assert message in refusal(read, file, text)


# --- evapotranspiration ---------------------------------------------------------------------------

REFERENCE = "reference evapotranspiration [mm/day]"
OF_REFERENCE = f"{RAIN},{LEVEL},{REFERENCE}"


def of_reference(values: Iterable[object]) -> list[str]:
    """Return the cells of dry rows with these values of evapotranspiration."""
    return [f"0,0.02,{value}" for value in values]


EMPTY, NO_ROW = "empty cells", "no rows"


@pytest.mark.parametrize("what", [EMPTY, NO_ROW])
def test_an_hour_may_be_missing_and_no_more(what: str, file: Path) -> None:
    """It grows by 0.01 mm/day from row to row, and also through the gap."""
    values = 2 + 0.01 * np.arange(ROWS)

    def without(missing: int) -> StepRecord:
        cells = of_reference(f"{value:.2f}" for value in values)
        cells[30:30 + missing] = of_reference([""] * missing)
        kept = [row for row in range(ROWS) if what == EMPTY or not 30 <= row < 30 + missing]
        return read(file, text_of(
            OF_REFERENCE, [cells[row] for row in kept], [FIVE_MINUTES[row] for row in kept]
        ))

    assert without(12).reference == pytest.approx(values / 288)
    assert refusal(without, 13).startswith(
        f"{file}: {REFERENCE}: has no value from 2021-06-01 02:30:00 for 65 min: at most "
        "an hour may be missing"
    )


def test_at_the_ends_an_hour_may_be_missing_too(file: Path) -> None:
    """And a column of zeros is not evapotranspiration."""
    cells = [""] * 12 + ["3"] * 96 + [""] * 12
    record = read(file, text_of(OF_REFERENCE, of_reference(cells)))
    assert record.reference == pytest.approx(np.full(ROWS, 3 / 288))
    for more in (12, 107):
        longer = text_of(OF_REFERENCE, of_reference([*cells[:more], "", *cells[more + 1:]]))
        refusal(read, file, longer, match="has no value from .* for 65 min")
    nothing = text_of(OF_REFERENCE, of_reference(["0"] * ROWS))
    refusal(read, file, nothing, match="is always 0")


def test_temperatures_that_show_no_day_are_refused(file: Path) -> None:
    """None after ten days; none in early April, as of a logger put away in winter; none at all.

    Six-hourly temperatures show no extremes; and a day's minimum must not exceed its maximum.
    """
    hours = since(datetime(2021, 4, 1), range(0, 60 * 1440, 60))  # noqa: DTZ001 - site's clock

    def of_days(extremes: dict[int, str]) -> str:
        cells = [f"0,0.02,{extremes.get(hour // 24, ',')}" for hour in range(60 * 24)]
        return text_of(f"{RAIN},{LEVEL},{MINIMUM},{MAXIMUM}", cells, hours)

    winter = of_days(dict.fromkeys(range(15, 60), "5,15"))
    six_hourly = text_of(f"{RAIN},{LEVEL},temperature [degC]", "0,0.02,12", hours[::6])
    for text, message in (
        (of_days(dict.fromkeys(range(10), "5,15")), "no temperature within 3 days of 2021-04-14"),
        (of_days({}), "no day has a complete set of temperatures"),
        (of_days(dict.fromkeys(range(60), "5,15") | {0: "40,15"}),
         "on 2021-04-01 the minimum temperature, 40 degC, is above the max"),
        (winter, "has no temperature within 3 days"),
        (six_hourly, "temperature: has rows that are 6 h apart, but only rows up to three hours"),
    ):
        refusal(read, file, text, match=message)
    assert np.all(read(file, winter, months="5-6").reference >= 0)


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
        of_the_15th = record.times.astype("datetime64[D]") == np.datetime64("1998-07-15")
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
