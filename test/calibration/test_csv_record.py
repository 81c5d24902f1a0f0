"""Measured records as CSV: what is read, which step a row belongs to, what is refused."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from refusals import refusal
from twins import TWIN

from greenroof_ros.calibration.csv_record import read_csv_record, steps_of_rows
from greenroof_ros.formats.records import Table


def small(header: str, *cells: str, rows: int = 120) -> str:
    """Return a file of rows five minutes apart with the same cells in each."""
    times = (f"2021-06-{1 + row // 288:02}T{row % 288 // 12:02}:{row % 12 * 5:02}"
             for row in range(rows))
    return "\n".join([header, *(",".join([time, *cells]) for time in times), ""])


def test_units_come_to_mm_of_a_step_and_m(tmp_path: Path) -> None:
    """12 mm/h are 1 mm in 5 minutes; on 100 m2, 2 l/s are 6 mm, and 50 l are 0.5 mm."""
    file = tmp_path / "record.csv"
    file.write_text(small(
        "time,rain [mm/h],runoff [l/s],pumped [l],level [mm],reference evapotranspiration [mm/day]",
        "12", "2", "50", "25", "2.88",
    ))
    record = read_csv_record(file, TWIN)
    assert record.step_s == 300.0
    assert record.start.isoformat() == "2021-06-01T00:00:00+01:00"
    assert record.rain == pytest.approx(np.full(120, 1.0))
    assert record.runoff == pytest.approx(np.full(120, 6.0))
    assert record.pumped == pytest.approx(np.full(120, 0.5))
    assert record.level == pytest.approx(np.full(120, 0.025))
    assert record.reference == pytest.approx(np.full(120, 0.01))


@pytest.mark.parametrize(
    ("runoff", "last_decimal"),
    [("0.04", 0.01), ("3", 1.0), ("0.30000000000000004", 0.1), ("0.00515464", 1e-8)],
)
def test_the_last_decimal_of_runoff(runoff: str, last_decimal: float, tmp_path: Path) -> None:
    """On 100 m2, 1 in the last place of litres is a hundredth of that in mm."""
    file = tmp_path / "record.csv"
    for unit, factor in (("mm", 1.0), ("l", 0.01)):
        file.write_text(small(
            f"time,rain [mm],runoff [{unit}],reference evapotranspiration [mm]", "0", runoff, "0.1",
        ))
        assert read_csv_record(file, TWIN).last_decimal == pytest.approx(factor * last_decimal)


def test_a_pump_state_is_a_share_of_the_flow_at_the_cistern_level(tmp_path: Path) -> None:
    """At 3 m the paper's pumps deliver sqrt((3 + 55.2 - 16) / 1 / b^-2), Eq. 3e.

    Without the cistern's level the flow of a running pump is unknown; a pump at rest delivers 0.
    """
    text = small(
        "time,rain [mm],level [m],pump state [%],cistern level [m],"
        "reference evapotranspiration [mm]", "0", "0.02", "50", "3", "0.1",
    )
    for minute, state, level in (("15", "1", ""), ("25", "0", ""), ("35", "", "3")):
        text = text.replace(f"T00:{minute},0,0.02,50,3,", f"T00:{minute},0,0.02,{state},{level},")
    file = tmp_path / "record.csv"
    file.write_text(text)
    record = read_csv_record(file, TWIN)
    flow = 0.5 * TWIN.b * np.sqrt(3 + TWIN.c_hat - TWIN.d)
    assert record.pumped[8:] == pytest.approx(np.full(112, flow * 300 / 100 * 1e3))
    assert record.command[8:] == pytest.approx(np.full(112, 0.5))
    assert record.cistern[8:] == pytest.approx(np.full(112, 3.0))
    assert np.flatnonzero(np.isnan(record.pumped)).tolist() == [3, 7]
    assert record.pumped[5] == 0
    assert np.flatnonzero(~record.known).tolist() == [2, 3, 4, 6, 7, 8]


TEXT = small(
    "time,rain [mm],runoff [mm],level [m],least temperature [degC],greatest temperature [degC]",
    "0.1", "0.2", "0.03", "5", "15",
)
LINES = TEXT.splitlines()


def test_missing_rows_and_empty_cells_are_gaps(tmp_path: Path) -> None:
    """The clock and evapotranspiration from temperatures need the place in the site file."""
    file = tmp_path / "record.csv"
    lines = [*LINES[:61], *LINES[71:]]
    lines[21] = lines[21].replace(",0.2,", ",,")
    file.write_text("\n".join(lines) + "\n")
    record = read_csv_record(file, TWIN)
    for lacks, needed in (
        ("latitude", "needs latitude and longitude"),
        ("utc_offset", "or the site file must give utc_offset"),
    ):
        refusal(read_csv_record, file, replace(TWIN, **{lacks: None}), match=needed)
    assert record.steps == 120
    assert np.flatnonzero(np.isnan(record.rain)).tolist() == list(range(60, 70))
    assert np.flatnonzero(np.isnan(record.runoff)).tolist() == [20, *range(60, 70)]
    # A sensor that failed has often missed a part of the neighbouring steps.
    assert np.flatnonzero(~record.known).tolist() == [19, 20, 21, *range(59, 71)]


RAIN, RUNOFF, LEVEL, LEAST, GREATEST = LINES[0].split(",")[1:]
# A text of the file, its replacement, and the message.
WRONG = {
    "no rain column": (RAIN, "pumped [mm]", "line 1: there must be a column 'rain [mm]'"),
    "nothing measured": (
        f"{RUNOFF},{LEVEL}", "pumped [mm],cistern level [m]",
        "there must be a column 'runoff [mm]' or 'level [m]'",
    ),
    "nothing for evapotranspiration": (
        f"{LEAST},{GREATEST}", f"{LEAST},pumped [mm]", "there must be a column 'reference evapo"),
    "no unit": (RAIN, "rain", "line 1: 'rain': a column must be named like 'rain [mm]'"),
    "unknown unit": (RAIN, "rain [inch]", "'rain [inch]': the unit of rain must be one like"),
    "rain in litres": (RAIN, "rain [l]", "the unit of rain must be one like [mm]"),
    "unknown quantity": (RUNOFF, "flow [mm]", "'flow [mm]': is not a known column"),
    "a quantity twice": (RUNOFF, "rain [mm/h]", "there is a column of rain before this one"),
    "a pump state alone": (RUNOFF, "pump state [1]", "'cistern level [m]', on which"),
    "no time": ("2021-06-01T00:40", "noon", "line 10: time = 'noon': must be a time such as"),
    "too short": (
        "\n".join(LINES[40:]), "", "has 39 rows; a record must have 100 at least"),
    "rain in micrometres": (
        "T00:30,0.1", "T00:30,159", "line 8: rain [mm] = '159': must be a number from 0 to "
        "158.333 mm, or empty; is the unit of the column right?",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_refused(name: str, tmp_path: Path) -> None:
    was, now, message = WRONG[name]
    assert was in TEXT
    file = tmp_path / "wrong.csv"
    file.write_text(TEXT.replace(was, now, 1))
    said = refusal(read_csv_record, file, TWIN)
    assert said.startswith(str(file)) and message in said


START = datetime(2021, 4, 1, 0, 3, tzinfo=timezone.utc)


def steps(since: np.ndarray) -> tuple[list[int], float]:
    """Return the steps of rows at these times (s) since the first."""
    times = [START + timedelta(seconds=float(second)) for second in since]
    texts = [time.isoformat() for time in times]
    table = Table(Path("roof.csv"), ["time"], {"time": texts}, 1, range(2, len(times) + 2))
    slots, step_s = steps_of_rows(table, times)
    return slots.tolist(), step_s


@pytest.mark.parametrize(
    ("since", "message"),
    [
        (2 * 86400.0 * np.arange(120),
         "line 3: time = '2021-04-03T00:03:00+00:00': the rows are 2 days apart; they must be a "
         "day apart at most"),
        (300.0 * np.concatenate((np.arange(60), np.arange(48, 120))),
         "line 62: time = '2021-04-01T04:03:00+00:00': must be later than the time of the row "
         "before"),
        (np.cumsum(np.resize([300.0, 300.0, 420.0], 200)),
         "line 4: time = '2021-04-01T00:20:00+00:00': must be 300 s after the row before, or a "
         "whole number of such steps, not 420 s; so are 66 of 200 rows"),
    ],
)
def test_rows_that_are_on_no_clock_are_refused(since: np.ndarray, message: str) -> None:
    assert steps(86400.0 * np.arange(120)) == (list(range(120)), 86400.0)
    assert message in refusal(steps, since)


def test_two_rows_of_one_step_are_put_together(tmp_path: Path) -> None:
    """Amounts add up, rates and levels are averaged; a cell that is empty in one row is unknown.

    After the row of 2:00 comes one of 2:02, when the clock was set, and then 2:05.
    """
    lines = small(
        "time,rain [mm],runoff [mm/h],level [m],least temperature [degC],"
        "greatest temperature [degC]", "0.1", "0.6", "0.02", "5", "15", rows=250,
    ).splitlines()
    lines.insert(26, "2021-06-01T02:02,0.3,1.8,0.04,,")
    file = tmp_path / "record.csv"
    file.write_text("\n".join(lines) + "\n")
    record = read_csv_record(file, TWIN)
    assert record.steps == 250
    assert record.rain[23:26] == pytest.approx([0.1, 0.4, 0.1])
    assert record.runoff[23:26] == pytest.approx([0.05, 0.1, 0.05])
    assert record.level[23:26] == pytest.approx([0.02, 0.03, 0.02])
    lines[26] = "2021-06-01T02:02,,,,,"
    file.write_text("\n".join(lines) + "\n")
    record = read_csv_record(file, TWIN)
    assert np.flatnonzero(np.isnan(record.rain)).tolist() == [24]
    assert record.level[24] == pytest.approx(0.02)
