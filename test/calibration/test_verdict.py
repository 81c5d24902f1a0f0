"""A fit that is worse than the mean of the record is refused, or said to be."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.scores import ScoreRow, score
from greenroof_ros.calibration.verdict import refuse_hopeless, warning
from greenroof_ros.common.errors import ConfigurationError

HOURS = 240
SECONDS = 3600 * np.arange(HOURS)
MEASURED = np.where(np.arange(HOURS) % 60 < 6, 1.0, 0.0)
MEAN = np.full(HOURS, MEASURED.mean())
RECORD = Record(
    Path("roof.csv"), datetime(2021, 4, 1, tzinfo=timezone.utc), 3600.0,
    np.zeros(HOURS), np.zeros(HOURS), np.zeros(HOURS), MEASURED, None,
)


def row(part: str, simulated: np.ndarray, quantity: str = "runoff") -> ScoreRow:
    return ScoreRow(quantity, part, score(quantity, simulated, MEASURED, SECONDS, 3600.0))


GOOD, OPPOSITE, HALF_MORE = 0.9 * MEASURED, 2 * MEAN - MEASURED, 1.6 * MEASURED


def test_worse_than_the_mean_everywhere_is_refused() -> None:
    """What falls where it rises has the mean's volume and 1 - 4 = -3 of hours and days."""
    rows = [row("fit", OPPOSITE), row("validation", OPPOSITE)]
    with pytest.raises(ConfigurationError) as error:
        refuse_hopeless(RECORD, rows)
    assert str(error.value).startswith(
        "roof.csv: no roof fits this record, so nothing is written: NSE of runoff, fit: "
        "-3.00 (1 h) and -3.00 (1 day); runoff, validation: -3.00"
    )


def test_a_part_that_fits_is_not_refused_but_named() -> None:
    rows = [row("fit", GOOD), row("validation", OPPOSITE)]
    refuse_hopeless(RECORD, rows)
    assert warning(rows).startswith(
        "This fit is worse than the mean of what was measured in the half that it has not seen "
        "(NSE of runoff -3.00 (1 day)): do not use it. Look at units,"
    )
    levels = [row("fit", GOOD, "level"), row("validation", GOOD, "level")]
    refuse_hopeless(RECORD, [row("fit", OPPOSITE), *rows[1:], *levels])


def test_a_volume_that_is_wrong_by_more_than_half_is_named() -> None:
    rows = [row("fit", GOOD), row("validation", HALF_MORE)]
    assert "wrong by much" in warning(rows)
    assert "(volume of runoff +60 %)" in warning(rows)


def test_of_daily_sums_days_judge() -> None:
    """One of all days falls where it rises: NSE -3, as above."""
    def daily(part: str, simulated: np.ndarray) -> ScoreRow:
        days = 86400 * np.arange(HOURS)
        return ScoreRow("runoff", part, score("runoff", simulated, MEASURED, days, 86400.0))

    refuse_hopeless(RECORD, [daily("fit", GOOD), daily("validation", OPPOSITE)])
    assert "NSE of runoff -3.00 (1 day)" in warning([daily("validation", OPPOSITE)])
    with pytest.raises(ConfigurationError, match=r"NSE of runoff, fit: -3\.00 \(1 day\), and the"):
        refuse_hopeless(RECORD, [daily("fit", OPPOSITE)])


def test_nothing_is_said_of_a_good_fit() -> None:
    rows = [row("fit", OPPOSITE), row("validation", GOOD)]
    refuse_hopeless(RECORD, rows)
    assert warning(rows) == ""
