"""A record's own column of evapotranspiration: gaps that are filled, units that are refused."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from twins import TWIN

from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.record import Record
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.site import Site

NAME = "reference evapotranspiration [mm/day]"


def read(
    file: Path, minutes: np.ndarray, values: list[str], site: Site = TWIN, month: int = 6
) -> Record:
    """A record of rows so long after the month's beginning, and their evapotranspiration."""
    start = datetime(2021, month, 1)  # noqa: DTZ001 - on the clock of the site
    rows = [f"{(start + timedelta(minutes=float(after))).isoformat()},0,0.02,{value}"
            for after, value in zip(minutes, values, strict=True)]
    file.write_text("\n".join([f"time,rain [mm],level [m],{NAME}", *rows]) + "\n")
    return read_csv_record(file, site)


EMPTY, NO_ROW = "is empty", "there is no row of 2021-06-01T02:30:00"


@pytest.mark.parametrize("what", [EMPTY, NO_ROW])
def test_an_hour_may_be_missing_and_no_more(what: str, tmp_path: Path) -> None:
    """It grows by 0.01 mm/day from row to row, and so it does through the gap."""
    file = tmp_path / "record.csv"
    row = np.arange(120)
    values = 2 + 0.01 * row
    for missing in (1, 12, 13):
        gone = (row >= 30) & (row < 30 + missing)
        cells = ["" if lost else f"{value:.2f}" for lost, value in zip(gone, values, strict=True)]
        kept = row if what == EMPTY else row[~gone]
        if missing <= 12:
            record = read(file, 5 * kept, [cells[one] for one in kept])
            assert record.reference == pytest.approx(values / 288)
            continue
        with pytest.raises(ConfigurationError) as error:
            read(file, 5 * kept, [cells[one] for one in kept])
        assert str(error.value).startswith(
            f"{file}, line 32: {NAME}: {what}, and none has a value for 65 min: it may be missing "
            "for an hour at most"
        )


@pytest.mark.parametrize("rows", [slice(0, 12), slice(108, 120)])
def test_at_the_ends_an_hour_may_be_missing_too(rows: slice, tmp_path: Path) -> None:
    cells = ["3"] * 120
    cells[rows] = [""] * 12
    record = read(tmp_path / "record.csv", 5 * np.arange(120), cells)
    assert record.reference == pytest.approx(np.full(120, 3 / 288))
    cells[rows.start - 1 if rows.start else rows.stop] = ""
    with pytest.raises(ConfigurationError, match="is empty, and none has a value for 65 min"):
        read(tmp_path / "record.csv", 5 * np.arange(120), cells)


@pytest.mark.parametrize(
    ("step", "rows", "set_on", "missing"),
    [(5, 600, 1, [300]), (6 * 60, 500, 55, [400])],
)
def test_a_clock_that_is_set_leaves_no_gap(
    step: int, rows: int, set_on: int, missing: list[int], tmp_path: Path
) -> None:
    """Set on four times, together by more than half a step: one step has no row then."""
    minutes = step * np.arange(rows)
    for row in range(100, 500, 100):
        minutes[row:] += set_on
    record = read(tmp_path / "record.csv", minutes, ["3"] * rows, month=4)
    assert np.flatnonzero(np.isnan(record.level)).tolist() == missing
    assert record.reference == pytest.approx(np.full(record.steps, 3 * step / 1440))


def test_a_day_with_too_much_is_refused(tmp_path: Path) -> None:
    """4 mm a day, taken for 12 times as much: 1/12 of each in a row of 2 h, by the hour."""
    file = tmp_path / "record.csv"
    rows = 12 * np.arange(120)
    assert read(file, 10 * rows, ["4"] * 120).reference == pytest.approx(np.full(120, 1 / 3))
    with pytest.raises(ConfigurationError) as error:
        read(file, 10 * rows, ["48"] * 120)
    assert str(error.value) == (
        f"{file}: {NAME}: is 48 mm on 2021-06-01; no day has more than 20 mm, and few have 10: is "
        "the unit of the column right?"
    )


# Mean reference evapotranspiration of warm and of cool humid regions (FAO-56, Table 2: 4 to 7 and 1
# to 2 mm a day); a December of central Europe.
@pytest.mark.parametrize(("month", "mm_a_day"), [(6, 7.0), (6, 4.0), (9, 2.0), (12, 0.3)])
def test_a_twelfth_of_a_month_is_refused(month: int, mm_a_day: float, tmp_path: Path) -> None:
    """What each day has may be so little; not where the place is unknown, nor in 29 days."""
    file = tmp_path / "record.csv"
    for days, site, refused in (
        (30, TWIN, True), (29, TWIN, False), (30, replace(TWIN, latitude=None), False),
    ):
        hours = 60 * np.arange(24 * days)
        read(file, hours, [f"{mm_a_day}"] * len(hours), site, month)
        few = [f"{mm_a_day / 12}"] * len(hours)
        if not refused:
            read(file, hours, few, site, month)
            continue
        with pytest.raises(ConfigurationError) as error:
            read(file, hours, few, site, month)
        assert f"{file}: {NAME}: is {mm_a_day / 12:.2g} mm at most in a day, on" in str(error.value)
        assert "is the unit of the column right?" in str(error.value)


def test_evapotranspiration_of_0_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "record.csv"
    with pytest.raises(ConfigurationError) as error:
        read(file, 5 * np.arange(120), ["0"] * 120)
    assert str(error.value).startswith(f"{file}: {NAME}: is 0 throughout")
