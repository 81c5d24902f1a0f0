"""Measured records: what is read from them, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from twins import TWIN, record_rows, summed, write

from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.suspicions import refuse_wrong
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory

DAY = 288
Rows = list[list[str]]
HOURS = (1, 6, 24)


@cache
def twin(days: int, seed: int) -> Rows:
    """The rows of a twin without gaps, made when the first test needs them."""
    return record_rows(TWIN, days, seed, gaps=False)


def small(header: str, *cells: str, minutes: int = 5, clock: str = "") -> str:
    """A file of 120 rows with the same cells in each."""
    lines = [header]
    for row in range(120):
        hour, minute = divmod(row * minutes, 60)
        lines.append(",".join([f"2021-06-{1 + hour // 24:02}T{hour % 24:02}:{minute:02}{clock}",
                               *cells]))
    return "\n".join(lines) + "\n"


def test_units_come_to_mm_of_a_step_and_m(tmp_path: Path) -> None:
    """12 mm/h are 1 mm in 5 minutes; 2 l/s off 100 m2 6 mm, and 50 l 0.5 mm."""
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
    [("0.04", 0.01), ("1.5", 0.1), ("3", 1.0), ("0", 1.0), ("0.30000000000000004", 0.1),
     ("0.00515464", 1e-8)],
)
def test_the_last_decimal_of_runoff(runoff: str, last_decimal: float, tmp_path: Path) -> None:
    """Of 100 m2: 1 in the last place of litres is a hundredth of that in mm."""
    file = tmp_path / "record.csv"
    for unit, factor in (("mm", 1.0), ("l", 0.01)):
        file.write_text(small(
            f"time,rain [mm],runoff [{unit}],reference evapotranspiration [mm]", "0", runoff, "0.1",
        ))
        assert read_csv_record(file, TWIN).last_decimal == pytest.approx(factor * last_decimal)


def test_a_pump_state_is_a_share_of_the_flow_at_the_cistern_level(tmp_path: Path) -> None:
    """At 3 m the paper's pumps lift sqrt((3 + 55.2 - 16) / 1 / b^-2), Eq. 3e."""
    file = tmp_path / "record.csv"
    file.write_text(small(
        "time,rain [mm],level [m],pump state [%],cistern level [m],temperature [degC]",
        "0", "0.02", "50", "3", "",
    ).replace("T04:00,0,0.02,50,3,", "T04:00,0,0.02,50,3,10").replace(
        "T05:00,0,0.02,50,3,", "T05:00,0,0.02,50,3,20"))
    with pytest.raises(ConfigurationError, match="no day has its temperatures"):
        read_csv_record(file, TWIN)
    file.write_text(small(
        "time,rain [mm],level [m],pump state [%],cistern level [m],"
        "reference evapotranspiration [mm]", "0", "0.02", "50", "3", "0.1",
    ))
    flow = 0.5 * TWIN.b * np.sqrt(3 + TWIN.c_hat - TWIN.d)
    record = read_csv_record(file, TWIN)
    assert record.pumped == pytest.approx(np.full(120, flow * 300 / 100 * 1e3))
    assert record.command == pytest.approx(np.full(120, 0.5))
    assert record.cistern == pytest.approx(np.full(120, 3.0))


def test_a_pump_of_which_too_little_is_known_is_a_gap(tmp_path: Path) -> None:
    """Without the cistern's level a pump that runs lifts nobody knows what, one that stands 0."""
    text = small(
        "time,rain [mm],level [m],pump state [1],cistern level [m],"
        "reference evapotranspiration [mm]", "0", "0.02", "0", "3", "0.1",
    )
    for minute, state, level in (("15", "1", ""), ("25", "0", ""), ("35", "", "3")):
        text = text.replace(f"T00:{minute},0,0.02,0,3,", f"T00:{minute},0,0.02,{state},{level},")
    file = tmp_path / "record.csv"
    file.write_text(text)
    record = read_csv_record(file, TWIN)
    assert np.flatnonzero(np.isnan(record.pumped)).tolist() == [3, 7]
    assert np.nansum(record.pumped) == 0
    assert np.flatnonzero(~record.known).tolist() == [2, 3, 4, 6, 7, 8]


def test_missing_rows_and_empty_cells_are_gaps(tmp_path: Path) -> None:
    rows = twin(30, 1)[:500] + twin(30, 1)[600:1000]
    rows = [list(row) for row in rows]
    rows[200][2] = ""
    record = read_csv_record(write(rows, tmp_path / "record.csv"), TWIN)
    assert record.steps == 999
    assert np.flatnonzero(np.isnan(record.rain)).tolist() == list(range(499, 599))
    assert np.flatnonzero(np.isnan(record.runoff)).tolist() == [199, *range(499, 599)]
    # A sensor that failed has often seen a part of the steps beside only.
    assert np.flatnonzero(~record.known).tolist() == [198, 199, 200, *range(498, 600)]


def test_a_right_record_is_not_refused(tmp_path: Path) -> None:
    for seed in range(3):
        rows = record_rows(TWIN, 60, seed)
        refuse_wrong(read_csv_record(write(rows, tmp_path / "record.csv"), TWIN), TWIN)


def change(column: int, how: Callable[[int, str], str]) -> Callable[[Rows], Rows]:
    """Change a column of the record, by its row's number from 0 and its text."""
    def changed(rows: Rows) -> Rows:
        result = [list(row) for row in rows]
        for number, row in enumerate(result[1:]):
            if row[column]:
                row[column] = how(number, row[column])
        return result
    return changed


def scaled(column: int, factor: float) -> Callable[[Rows], Rows]:
    return change(column, lambda _, text: repr(float(text) * factor))


def shifted(column: int, steps: int) -> Callable[[Rows], Rows]:
    """Shift a column in time, round its ends."""
    def changed(rows: Rows) -> Rows:
        cells = [row[column] for row in rows[1:]]
        cells = cells[-steps:] + cells[:-steps]
        result = [list(row) for row in rows]
        for row, cell in zip(result[1:], cells, strict=True):
            row[column] = cell
        return result
    return changed


def without(*columns: int) -> Callable[[Rows], Rows]:
    return lambda rows: [[cell for place, cell in enumerate(row) if place not in columns]
                         for row in rows]


def header(column: int, name: str) -> Callable[[Rows], Rows]:
    return lambda rows: [[*rows[0][:column], name, *rows[0][column + 1:]], *rows[1:]]


def cell(row: int, column: int, text: str) -> Callable[[Rows], Rows]:
    def changed(rows: Rows) -> Rows:
        result = [list(one) for one in rows]
        result[row][column] = text
        return result
    return changed


def both(*changes: Callable[[Rows], Rows]) -> Callable[[Rows], Rows]:
    def changed(rows: Rows) -> Rows:
        for one in changes:
            rows = one(rows)
        return rows
    return changed


# Columns: time, rain, runoff, level, least and greatest temperature.
WRONG = {
    "no rain column": (without(1), "line 1: there must be a column 'rain [mm]'"),
    "nothing measured": (without(2, 3), "there must be a column 'runoff [mm]' or 'level [m]'"),
    "nothing for evapotranspiration": (without(4), "there must be a column 'reference evapo"),
    "no unit": (header(1, "rain"), "line 1: 'rain': a column must be named like 'rain [mm]'"),
    "unknown unit": (header(1, "rain [inch]"), "'rain [inch]': the unit of rain must be one like"),
    "rain in litres": (header(1, "rain [l]"), "the unit of rain must be one like [mm]"),
    "unknown quantity": (header(2, "flow [mm]"), "'flow [mm]': is not a known column"),
    "a quantity twice": (header(2, "rain [mm/h]"), "there is a column of rain before this one"),
    "time not first": (header(0, "date"), "'date': the first column must be 'time'"),
    "a pump state alone": (header(2, "pump state [1]"), "'cistern level [m]', on which"),
    "not a number": (cell(7, 1, "wet"), "line 8: rain [mm] = 'wet': must be a number, or empty"),
    "infinite": (cell(7, 3, "inf"), "line 8: level [m] = 'inf': must be a number"),
    "no time": (cell(9, 0, "noon"), "line 10: time = 'noon': must be a time such as"),
    "a time twice": (cell(9, 0, "2021-04-01T00:35:00"), "line 10: time = '2021-04-01T00:35:00"),
    "irregular steps": (
        change(0, lambda row, text: text[:-2] + "59" if row % 20 == 7 else text),
        "line 9: time = '2021-04-01T00:35:59+01:00': must be 300 s after the row before, or a "
        "whole number of such steps, not 359 s; so are 864 of 8640 rows"),
    "a row cut off": (lambda rows: [*rows[:50], rows[50][:3], *rows[51:]], "must have 6 cells"),
    "too short": (lambda rows: rows[:40], "has 39 rows; a record must have 100 at least"),
    "negative rain": (cell(7, 1, "-1"), "line 8: rain [mm] = -1.0: must be from 0 to 1900 mm/h"),
    "rain in micrometres": (scaled(1, 1000), "is the unit of the column right?"),
    "rain in metres": (scaled(1, 0.001), "nothing can be fitted: is the unit right"),
    "rain of a day in an hour": (scaled(1, 24), "more than anywhere on earth: is the unit right?"),
    "level in mm called m": (scaled(3, 1000), "m, more than twice the soil's depth of 0.1 m"),
    "level in cm called m": (scaled(3, 100), "more than twice the soil's depth of 0.1 m"),
    "level in m called mm": (header(3, "level [mm]"), "included: is the unit right?"),
    "runoff of a larger roof": (scaled(2, 10), "where"),
    "runoff in m called mm": (scaled(2, 1e-4), "is its unit right, or the sensor dead?"),
    "an empty column": (change(3, lambda *_: ""), "level: has 0 values; it must have 100 at least"),
    "a dead runoff sensor": (scaled(2, 0.0), "or the sensor dead?"),
    "least above greatest": (
        cell(1, 4, "40"), "on 2021-04-01 the least temperature, 40 degC, is above the greatest"),
    "temperatures end": (
        change(4, lambda row, text: text if row < 10 * DAY else ""),
        "has no temperature within 3 days of 2021-04-14"),
    "a stuck level": (
        change(3, lambda row, text: text if row < 5 * DAY else "0.0300"), "the sensor is stuck"),
    "a stuck runoff": (
        change(2, lambda row, text: text if row < 5 * DAY else "0.0500"), "the sensor is stuck"),
    "a stuck rain gauge": (
        change(1, lambda row, text: text if not 5 * DAY <= row < 6 * DAY else "0.1000"),
        "the sensor is stuck"),
    "a blocked rain gauge": (
        change(1, lambda row, text: text if row < 8 * DAY else "0"), "is the gauge blocked"),
    "a blocked rain gauge beside a level": (
        both(without(2), change(1, lambda row, text: text if row < 8 * DAY else "0")),
        "is 0 for 1 day and more when at"),
    "rain of the hour in 5 minutes": (
        both(scaled(1, 12), without(3)), "are the units of rain and runoff right?"),
    "runoff of a smaller roof": (
        both(scaled(2, 4), without(3)), "is more than what came, storm by storm"),
    "level in cm called mm": (scaled(3, 0.1), "included: is the unit right? It should be"),
    "a level of every third row": (
        change(3, lambda row, text: text if row % 3 == 0 else ""),
        "level: has a value every 15 min, and there is a row every 5 min: every row must have one"),
    "a clock two hours early": (shifted(2, -24), "before it falls"),
    "half an hour early": (both(without(2), shifted(2, -12)), "before it falls"),
    "runoff an hour early": (shifted(2, -12), "before it falls"),
    "runoff of another time zone": (shifted(2, 96), "after it falls"),
    "level a day late": (both(without(2), shifted(2, 288)), "is a clock shifted"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_records_are_refused(name: str, tmp_path: Path) -> None:
    changed, message = WRONG[name]
    file = write(changed(twin(30, 1)), tmp_path / "wrong.csv")
    with pytest.raises(ConfigurationError) as error:
        refuse_wrong(read_csv_record(file, TWIN), TWIN)
    assert str(error.value).startswith(str(file))
    assert message in str(error.value)


def test_a_right_season_is_not_refused(tmp_path: Path) -> None:
    refuse_wrong(read_csv_record(write(twin(100, 1), tmp_path / "season.csv"), TWIN), TWIN)


@pytest.mark.parametrize(
    ("column", "factor"), [(1, 12), (1, 10), (1, 1 / 12), (1, 0.1), (2, 10), (2, 12), (2, 0.1),
                           (2, 1 / 12), (3, 10), (3, 0.1)],
)
def test_of_a_season_a_unit_that_is_wrong_is_refused(
    column: int, factor: float, tmp_path: Path
) -> None:
    file = tmp_path / "season.csv"
    with pytest.raises(ConfigurationError, match="unit"):
        refuse_wrong(read_csv_record(write(scaled(column, factor)(twin(100, 1)), file), TWIN), TWIN)


@pytest.mark.parametrize("hours", HOURS)
def test_sums_of_longer_steps_are_not_refused(hours: int, tmp_path: Path) -> None:
    """With runoff, with the level alone, and of other weather."""
    for seed, rows in ((seed, summed(twin(100, seed), hours)) for seed in (1, 2)):
        for number, changed in enumerate((lambda rows: rows, without(2), without(3))):
            file = write(changed(rows), tmp_path / f"{seed}-{number}.csv")
            record = read_csv_record(file, TWIN)
            assert record.step_s == 3600.0 * hours
            refuse_wrong(record, TWIN)


def from_day(day: int, column: int, text: str, hours: int) -> Callable[[Rows], Rows]:
    return change(column, lambda row, was: was if row * hours < 24 * day else text)


WRONG_SUMS = {
    "runoff of a larger roof": (lambda hours: scaled(2, 10), "and the soil holds 100 mm at most"),
    "a level in m called cm": (
        lambda hours: both(without(2), header(2, "level [cm]")), "included: is the unit right?"
    ),
    "a stuck level": (lambda hours: from_day(20, 3, "0.03", hours), "the sensor is stuck"),
    "a stuck rain gauge": (
        lambda hours: change(1, lambda row, text: "0.3" if 12 <= row < 20 else text),
        "the sensor is stuck",
    ),
    "a blocked rain gauge": (lambda hours: from_day(30, 1, "0", hours), "is the gauge blocked"),
    "runoff a day early": (lambda hours: shifted(2, -24 // hours), "before it falls"),
    "a level a day early": (
        lambda hours: both(without(2), shifted(2, -24 // hours)), "before it falls"),
}


@pytest.mark.parametrize("hours", HOURS)
@pytest.mark.parametrize("name", WRONG_SUMS)
def test_wrong_sums_of_longer_steps_are_refused(name: str, hours: int, tmp_path: Path) -> None:
    changed, message = WRONG_SUMS[name]
    file = write(changed(hours)(summed(twin(100, 1), hours)), tmp_path / "wrong.csv")
    with pytest.raises(ConfigurationError) as error:
        refuse_wrong(read_csv_record(file, TWIN), TWIN)
    assert message in str(error.value)


def test_temperatures_of_every_sixth_hour_do_not_show_a_day(tmp_path: Path) -> None:
    rows = [[*row[:4], "12"] for row in summed(twin(100, 1), 6)]
    rows[0][4] = "temperature [degC]"
    with pytest.raises(ConfigurationError) as error:
        read_csv_record(write(rows, tmp_path / "record.csv"), TWIN)
    assert "temperature: its rows are 6 h apart, and show a day's extremes where they" in str(
        error.value
    )


def test_a_dead_flow_meter_is_refused(tmp_path: Path) -> None:
    """More than 100 mm fall, and the soil is 100 mm deep."""
    rows = change(2, lambda row, text: text if row < 30 * DAY else "0")(twin(100, 1))
    file = write(rows, tmp_path / "dead.csv")
    with pytest.raises(ConfigurationError, match=r"runoff: is 0 for \d\d days from .* mm came"):
        refuse_wrong(read_csv_record(file, TWIN), TWIN)


@pytest.mark.parametrize(
    "name",
    ["no rain column", "unknown unit", "not a number", "a time twice", "irregular steps",
     "too short", "rain in metres", "level in m called mm", "a stuck level", "a stuck rain gauge",
     "a blocked rain gauge", "temperatures end", "runoff an hour early"],
)
def test_the_command_ends_with_2_and_one_line(name: str, tmp_path: Path) -> None:
    file = write(WRONG[name][0](twin(30, 1)), tmp_path / "wrong.csv")
    site = shared_directory() / "config" / "site.yaml"
    ended = run_command(
        "calibrate", str(file), "--site", str(site), "-o", "fitted.yaml", cwd=tmp_path, env={},
    )
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"error: {file}")
    assert ended.stderr.count("\n") == 1
    assert not (tmp_path / "fitted.yaml").exists()


def test_a_place_is_needed_for_temperatures(tmp_path: Path) -> None:
    file = write(twin(30, 1), tmp_path / "record.csv")
    with pytest.raises(ConfigurationError, match="needs latitude and longitude"):
        read_csv_record(file, replace(TWIN, latitude=None))
    with pytest.raises(ConfigurationError, match="must say its offset from UTC"):
        read_csv_record(file, replace(TWIN, utc_offset=None))
