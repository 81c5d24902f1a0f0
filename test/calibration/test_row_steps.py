"""Which step each row is of, where a logger's clock was set."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from twins import TWIN

from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.row_steps import steps_of_rows
from greenroof_ros.common.errors import ConfigurationError

START = datetime(2021, 4, 1, 0, 3, tzinfo=timezone.utc)


def steps(since: np.ndarray) -> tuple[list[int], float]:
    """Steps of rows at some seconds since the first."""
    times = [START + timedelta(seconds=float(second)) for second in since]
    slots, step_s = steps_of_rows(Path("roof.csv"), "time", times, list(range(2, len(times) + 2)))
    return slots.tolist(), step_s


def test_a_clock_that_is_set_moves_no_row_that_comes_after() -> None:
    """Set on by 2 min before row 200 and before row 400; then it is 4 min late, nearer to the next.

    Before row 1000 it is set right by an hour without rows, less 2 min: 2 min late again.
    """
    since = 300.0 * np.arange(1200)
    for first in (200, 400):
        since[first:] += 120
    since[1000:] += 3600 - 120
    found, step_s = steps(since)
    assert step_s == 300.0
    assert found[:400] == list(range(400))
    assert found[400:1000] == list(range(401, 1001))
    assert found[1000:] == list(range(1012, 1212))


def test_no_row_is_moved_by_more_than_half_a_step() -> None:
    random = np.random.default_rng(4)
    spacing = np.full(20000, 300.0)
    resets = random.integers(0, len(spacing), 100)
    spacing[resets] = random.integers(1, 2000, 100)
    since = np.concatenate(([0.0], np.cumsum(spacing)))
    found, step_s = steps(since)
    assert step_s == 300.0
    assert np.max(np.abs(np.array(found) * 300.0 - since)) <= 150.0


@pytest.mark.parametrize("step_s", [60.0, 600.0, 3600.0, 6 * 3600.0, 86400.0])
def test_any_step_up_to_a_day_is_taken(step_s: float) -> None:
    assert steps(step_s * np.arange(120)) == (list(range(120)), step_s)


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
    with pytest.raises(ConfigurationError) as error:
        steps(since)
    assert message in str(error.value)


def test_two_rows_of_one_step_are_put_together(tmp_path: Path) -> None:
    """Amounts add up, rates and levels are averaged; what one row leaves empty is not known.

    After the row of 2:00 comes one of 2:02, with which the clock was set, and then 2:05.
    """
    lines = ["time,rain [mm],runoff [mm/h],level [m],temperature [degC]"]
    for row in range(400):
        hour, minute = divmod(5 * row, 60)
        lines.append(
            f"2021-06-{1 + hour // 24:02}T{hour % 24:02}:{minute:02},0.1,0.6,0.02,{10 + hour % 24}"
        )
    at = next(number for number, line in enumerate(lines) if "T02:00" in line)
    lines.insert(at + 1, "2021-06-01T02:02,0.3,1.8,0.04,")
    file = tmp_path / "record.csv"
    file.write_text("\n".join(lines) + "\n")
    record = read_csv_record(file, TWIN)
    assert record.steps == 400
    assert record.rain[23:26] == pytest.approx([0.1, 0.4, 0.1])
    assert record.runoff[23:26] == pytest.approx([0.05, 0.1, 0.05])
    assert record.level[23:26] == pytest.approx([0.02, 0.03, 0.02])
    lines[at + 1] = "2021-06-01T02:02,,,,"
    file.write_text("\n".join(lines) + "\n")
    record = read_csv_record(file, TWIN)
    assert np.flatnonzero(np.isnan(record.rain)).tolist() == [24]
    assert record.level[24] == pytest.approx(0.02)
