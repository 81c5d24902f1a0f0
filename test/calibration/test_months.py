"""Which months of a record count."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from twins import TWIN, record_rows, write

from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.months import Months
from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.suspicions import refuse_wrong
from greenroof_ros.common.errors import ConfigurationError

YEAR = np.zeros(365 * 24)
# On a clock of UTC+1, on which months begin; an hour before it is July in UTC.
RECORD = Record(
    Path("roof.csv"), datetime(2021, 7, 1, tzinfo=timezone(timedelta(hours=1))), 3600.0, YEAR, YEAR,
    YEAR, YEAR, None,
)


@pytest.mark.parametrize(
    ("text", "days", "first"),
    [("4-10", 214, "2021-07-01"), ("11-3", 151, "2021-11-01"), ("2-2", 28, "2022-02-01"),
     ("1-12", 365, "2021-07-01"), ("12-1", 62, "2021-12-01")],
)
def test_steps_of_months(text: str, days: int, first: str) -> None:
    steps = Months(text).steps(RECORD)
    assert steps.sum() == days * 24
    assert str(RECORD.times[steps][0]) == f"{first}T00:00:00"


@pytest.mark.parametrize("text", ["", "4", "0-3", "4-13", "april-october", "4-10-12", "-4-10"])
def test_what_is_no_span_of_months_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        Months(text)
    assert str(error.value) == (
        f"--months = '{text}': must be the first and the last month that count, such as 4-10, or "
        "11-3 over new year"
    )


def test_a_record_of_other_months_is_refused(tmp_path: Path) -> None:
    file = write(record_rows(TWIN, 20, 1), tmp_path / "april.csv")
    with pytest.raises(ConfigurationError) as error:
        Months("5-10").steps(read_csv_record(file, TWIN))
    assert str(error.value) == (
        f"{file}: has no row in the months 5-10 of --months: it is from 2021-04-01 to 2021-04-20"
    )


def test_what_is_wrong_in_other_months_does_not_count(tmp_path: Path) -> None:
    """A flow meter that is stuck and a level that is nonsense in April; May is right."""
    rows = record_rows(TWIN, 60, 1)
    for row in rows[1:]:
        if row[0].startswith("2021-04"):
            row[2], row[3] = "0.05", "0.3"
    record = read_csv_record(write(rows, tmp_path / "record.csv"), TWIN)
    with pytest.raises(ConfigurationError, match="the sensor is stuck"):
        refuse_wrong(record, TWIN)
    refuse_wrong(record.only(Months("5-6").steps(record)), TWIN)


def test_temperatures_may_be_missing_in_other_months(tmp_path: Path) -> None:
    """None in the first half of April, as of a logger that was out in winter."""
    rows = record_rows(TWIN, 60, 1)
    for row in rows[1:]:
        if row[0] < "2021-04-16":
            row[4] = row[5] = ""
    file = write(rows, tmp_path / "record.csv")
    with pytest.raises(ConfigurationError, match="has no temperature within 3 days"):
        read_csv_record(file, TWIN)
    months = Months("5-6")
    record = read_csv_record(file, TWIN, months)
    refuse_wrong(record.only(months.steps(record)), TWIN)
