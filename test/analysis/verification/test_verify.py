"""The command: scores of archives and models, their table, CSV and page; wrong use."""

from __future__ import annotations

import csv
import math
import os
import subprocess
from collections.abc import Iterable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from numpy.typing import NDArray
from places import DATA
from scipy import stats

from greenroof_ros.analysis.verification import verify
from greenroof_ros.forecast.issue import IssuedForecast, write_forecasts

GEM = DATA / "gem_global_previous_runs_2024-03.csv"
JULY = DATA / "en_climate_hourly_07-2021.csv"
SUMS = ((1, 1.0), (6, 2.0), (12, 3.0), (24, 5.0))
HOUR = timedelta(hours=1)
FIRST = datetime.fromisoformat("2024-03-01T00:00+00:00")


def write_gauge(file: Path, rain: Iterable[object], first: datetime = FIRST) -> None:
    """Write hours of rain as a weather file; an empty cell is a missing hour."""
    file.write_text("\n".join([
        "time,precipitation [mm/h],given evapotranspiration [mm/day]",
        *(f"{(first + hour * HOUR).isoformat()},{mm},2.0" for hour, mm in enumerate(rain)), "",
    ]))


def issue_of(issued: datetime, rain: NDArray[np.float64]) -> IssuedForecast:
    """Return an issue that is known at once."""
    return IssuedForecast(issued, issued, Path(), None, {"precipitation": rain})


def run(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command until it ends."""
    return run_command("verify", *arguments, cwd=directory, env=dict(os.environ))


def blocks(series: dict[datetime, float], hours: int) -> dict[datetime, float]:
    """Return the sums over complete blocks of the clock, by their beginning."""
    values: dict[datetime, list[float]] = {}
    for start, value in series.items():
        values.setdefault(start.replace(hour=start.hour // hours * hours), []).append(value)
    return {start: round(sum(rain), 6) for start, rain in values.items() if len(rain) == hours}


def test_previous_runs_by_their_definition(tmp_path: Path) -> None:
    """Sums over whole blocks of the clock, as in ../shared/forecasts, by plain counting.

    The forecast of one day before stands in for the records; some of its hours are missing.
    """
    with GEM.open() as stream:  # the service's hours end at their time
        hours = {
            datetime.fromisoformat(f"{row[0]}+00:00") - HOUR: row[1:]
            for row in list(csv.reader(stream))[1:]
        }
    rain = {start: "" if number in (30, 31, 200) else cells[0]
            for number, (start, cells) in enumerate(hours.items())}
    write_gauge(tmp_path / "own.csv", rain.values(), min(hours))
    rows = verify(GEM, [str(tmp_path / "own.csv")]).rows
    got = {(row["lead_to_h"] // 24, row["sum_hours"]): row for row in rows}
    assert len(got) == 20
    observed = {start: float(value) for start, value in rain.items() if value}
    for day in range(1, 6):
        forecast = {start: float(cells[day - 1]) for start, cells in hours.items()
                    if cells[day - 1]}
        for length, event in SUMS:
            ours, theirs = blocks(forecast, length), blocks(observed, length)
            pairs = [(ours[start], theirs[start]) for start in theirs if start in ours]
            row = got[day, length]
            assert (row["n"], row["event_mm"]) == (len(pairs), event)
            predicted, fell = map(np.array, zip(*pairs, strict=True))
            for name, value in (
                ("bias", predicted.sum() / fell.sum()),
                ("r", stats.pearsonr(predicted, fell).statistic),
                ("pod", (predicted >= event)[fell >= event].mean()),
                ("crps_mm", np.abs(predicted - fell).mean()),
            ):
                assert row[name] == pytest.approx(value, rel=1e-5, abs=1e-9), (day, name)


def test_runs_by_lead(tmp_path: Path) -> None:
    """An ensemble of two runs: each hour's lead counts from its run, with all its members."""
    (tmp_path / "runs.csv").write_text(write_forecasts([
        issue_of(FIRST + hour * HOUR, np.repeat([members], 12, axis=0).T)
        for hour, members in ((0, (0.0, 2.0)), (6, (4.0, 1.0)))
    ]))
    write_gauge(tmp_path / "own.csv", [0.0] * 6 + [1.0] * 6 + [3.0] * 6 + [0.0] * 6)
    made = verify(tmp_path / "runs.csv", [str(tmp_path / "own.csv")], lead=6).rows
    rows = [row for row in made if row["sum_hours"] == 6]
    assert [(row["lead_from_h"], row["lead_to_h"]) for row in rows] == [(0, 6), (6, 12)]
    # Sums of six hours. Near: 0 and 12 against 0, 24 and 6 against 6; far: the same against 6, 18.
    assert [[row[name] for name in ("bias", "n", "pod", "far")] for row in rows] == [
        [4.0, 2, 1, 0], [1.0, 2, 0.5, 0]
    ]
    # Probabilities 0.5 without an event and 1 with one; 0.5 and 1 with events.
    assert [row["brier"] for row in rows] == [0.125, 0.125]
    # Means of |x - y| less half of |x - x'|: 6 - 6 and 9 - 9, in both classes.
    assert [row["crps_mm"] for row in rows] == [0.0, 0.0]


def test_rain_that_is_an_hour_late(tmp_path: Path) -> None:
    """A service's rain is of the hour before its time: its right forecasts score as right."""
    with JULY.open(encoding="utf-8-sig") as stream:  # the first row's hour was before the records
        rain = [float(row["Precip. Amount (mm)"]) for row in csv.DictReader(stream)][1:]
    first = datetime.fromisoformat("2021-07-01T00:00-05:00")
    (tmp_path / "right.csv").write_text(write_forecasts([
        issue_of(first + hour * HOUR, np.array([rain[hour:hour + 24]]))
        for hour in range(0, len(rain), 24)
    ]))
    hourly, *_ = verify(tmp_path / "right.csv", [str(JULY)], horizon=24).rows
    assert hourly["n"] == len(rain)
    got = [hourly[name] for name in ("r", "bias", "pod", "far")]
    assert got == pytest.approx([1.0, 1.0, 1.0, 0.0])


def test_the_command(tmp_path: Path) -> None:
    """Its file has the scores; a note says what was left out."""
    write_gauge(tmp_path / "gauge.csv", [0.1] * 72)
    lines = write_forecasts([
        issue_of(FIRST + day * 24 * HOUR, np.full((3, 24), 0.2)) for day in range(3)
    ]).splitlines()
    lines[-1] = lines[-1].rpartition(",")[0] + ","
    (tmp_path / "archive.csv").write_text("\n".join([*lines, ""]))
    done = run(tmp_path, "archive.csv", "--weather", "gauge.csv", "-o", "scores.csv")
    assert done.returncode == 0, done.stderr
    part = "archive.csv, issue of 2024-03-03T00:00+00:00: is used only for 23 of 24 hours"
    assert part in done.stderr
    with (tmp_path / "scores.csv").open(encoding="utf-8-sig") as stream:
        rows = list(csv.DictReader(stream))
    made = verify(tmp_path / "archive.csv", [str(tmp_path / "gauge.csv")]).table.to_dicts()
    for row, ours in zip(rows, made, strict=True):
        assert {name: float(text or "nan") for name, text in row.items()} == pytest.approx(
            {name: math.nan if value is None else value for name, value in ours.items()},
            nan_ok=True,
        )


def test_wrong_use(tmp_path: Path) -> None:
    """One line that reports what would be right, exit code 2, and nothing written."""
    done = run(tmp_path, str(GEM), "--lead", "6", "--weather", str(JULY))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: --lead = 6: must be a multiple of 24 h")
    assert list(tmp_path.iterdir()) == []
