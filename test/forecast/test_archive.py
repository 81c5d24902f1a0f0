"""Archives of forecasts: when an issue becomes known."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from archives import write_runs
from paper import PAPER_SITE, weather_of
from refusals import refusal

from greenroof_ros.forecast.models import FileModel
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.formats.records import HOUR
from greenroof_ros.weather.series import Weather


def weather_from(first: datetime, hours: int = 48) -> Weather:
    """Return dry records."""
    return weather_of(np.zeros(hours), first=first)


@pytest.mark.parametrize(
    ("delay", "late", "rain_late"), [(None, 6, 0), (0.0, 0, 0), (4.25, 5, 0), (2.0, 3, 1)]
)
def test_an_issue_is_known_when_it_is_available(
    tmp_path: Path, delay: float | None, late: int, rain_late: int
) -> None:
    """It is known hours after its nominal time, and used from the next full hour on.

    Its leads still count from the nominal time: when it is known late, its first hours are past.
    With records whose rain is an hour late, an issue's rain is, too; evapotranspiration is not.
    Run n has n.LL mm/h of rain and 10 + n.LL mm/day of evapotranspiration at its lead LL.
    """
    first = datetime.fromisoformat("2021-07-07T06:00+00:00")
    runs = read_archive(write_runs(tmp_path / "runs"), PAPER_SITE, delay)
    archive = replace(
        runs, issues=tuple(replace(run, evapotranspiration=10 + run.rain[0]) for run in runs.issues)
    )
    weather = replace(weather_from(first, 100), rain_late=rain_late)
    model = FileModel(archive, weather, False)
    for hour in range(24):
        since = hour + 12 - late  # the first run is at 18:00 the day before
        number, lead = since // 6, since % 6 + late
        rain, evapotranspiration = model.known(hour, 3)
        expected = np.array([number + (lead + ahead) / 100 for ahead in range(3)])
        assert rain[0] == pytest.approx(expected - rain_late / 100, abs=1e-12)
        assert evapotranspiration == pytest.approx(expected + 10, abs=1e-12)
    # The last run is of 12:00 on the 8th, 30 h after the first hour, and has 48 h; the rain of the
    # last one can be late.
    end = datetime.fromisoformat("2021-07-10T12:00+00:00") + rain_late * HOUR
    without = FileModel(runs, weather, False)
    assert without.repeats_from(36, 42 + rain_late) is None
    assert without.repeats_from(36, 43 + rain_late) == end


def test_hours_of_records_and_issues(tmp_path: Path) -> None:
    """They start together, in any time zone; before the first issue is known there is none."""
    archive = read_archive(write_runs(tmp_path / "runs"), PAPER_SITE, 0.0)
    first = datetime.fromisoformat("2021-07-07T11:30+05:30")
    model = FileModel(archive, weather_from(first), False)
    assert model.known(0, 2)[0][0].tolist() == [2.0, 2.01]  # 06:00 UTC
    between = weather_from(first.replace(minute=0))
    refusal(FileModel, archive, between, False, match="must be a whole number of hours from 2021")
    late = read_archive(tmp_path / "runs", PAPER_SITE)
    model = FileModel(late, weather_from(datetime.fromisoformat("2021-07-06T00:00+00:00")), False)
    needed = "available from 2021-07-07T00:00.00:00 on, but the run needs one at 2021-07-06T23:00"
    refusal(model.known, 23, 1, match=needed)
    assert model.known(24, 1)[0].shape == (1, 1)


def test_evapotranspiration_in_a_part(tmp_path: Path) -> None:
    """The error names a file of an archive that differs from the others in this column."""
    for day, column in ((7, ""), (8, ",evapotranspiration [mm/day]")):
        (tmp_path / f"{day}.csv").write_text(
            f"issued,time,precipitation [mm/h]{column}\n"
            f"2021-07-0{day}T00:00Z,2021-07-0{day}T00:00Z,0.0{',2.5' if column else ''}\n"
        )
    wrong = r"8.csv, line 2: must have a column of evapotranspiration, or none, like 7.csv"
    refusal(read_archive, tmp_path, PAPER_SITE, match=wrong)
