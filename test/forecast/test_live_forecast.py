"""A live site's forecast file: replaced, broken, removed, too old; and what follows from it."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from paper import PAPER_SITE

from greenroof_ros.forecast.live_forecast import ForecastFile, LiveForecast, NoForecastError
from greenroof_ros.formats.own_csv import read_forecasts, write_forecasts
from greenroof_ros.formats.records import Issue

SIX = datetime(2026, 7, 1, 6, tzinfo=UTC)


def write(path: Path, issued: datetime, rain: list[float], **left_out: None) -> None:
    """Write a file with an issue of some hours, and rename it into place as one must."""
    hours = np.arange(len(rain))
    issue = Issue(issued, path, None, np.array([rain]), 2.0 + hours, 15.0 - hours)
    draft = path.with_suffix(".new")
    draft.write_text(write_forecasts([replace(issue, **left_out)]))
    draft.replace(path)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The site's file, which does not exist yet."""
    return tmp_path / "forecast.csv"


def live(path: Path, horizon: float = 0.0, limit: float = 7200.0) -> LiveForecast:
    """Return the forecasts of a file that has been read."""
    forecasts = LiveForecast(ForecastFile(path), PAPER_SITE, horizon, limit, all_members=False)
    forecasts.file.look()
    return forecasts


def test_the_present_hour_and_the_look_ahead(file: Path) -> None:
    """At 07:59:57 three of the ten seconds are in the second hour, the rest in the third.

    A gauge's reading stands for the rest of the present hour. 3.6 mm/h are 1e-6 m/s; 3 and 4 mm/day
    from 68.8 m2 are 2.3889e-6 and 3.1852e-6 m3/s.
    """
    write(file, SIX, [0.0, 3.6, 7.2, 0.0])
    now = SIX + timedelta(hours=1, minutes=59, seconds=57)
    for read, rain_now in ((None, 1e-6), (5e-6, 5e-6)):
        outlook = live(file).at(now, observed_rain=read)
        assert outlook.issued == SIX
        assert np.array(outlook.rain) == pytest.approx([rain_now] * 3 + [2e-6] * 7)
        assert np.array(outlook.evapotranspiration) == pytest.approx(
            [2.38889e-6] * 3 + [3.18519e-6] * 7, rel=1e-5
        )
        assert outlook.rain_now == pytest.approx(rain_now)
        assert outlook.evapotranspiration_now == pytest.approx(2.38889e-6, rel=1e-5)
        assert outlook.temperature == 14.0


@pytest.mark.parametrize(
    ("later", "horizon", "words"),
    [
        (timedelta(hours=2, seconds=1), 0.0, "older than 2 h"),
        (timedelta(hours=1, minutes=1), 3.0, "look-ahead does; a horizon of at most 2 h"),
        (-timedelta(seconds=1), 0.0, "in the future"),
    ],
)
def test_no_forecast(file: Path, later: timedelta, horizon: float, words: str) -> None:
    """Too old, too short, from the future; a moment before, each is a forecast."""
    write(file, SIX, [0.0] * 4)
    forecast = live(file, horizon)
    with pytest.raises(NoForecastError, match=words):
        forecast.at(SIX + later)
    forecast.at(SIX + (timedelta(0) if later < timedelta(0) else timedelta(hours=1)))


def test_a_file_is_read_again_when_it_is_replaced(file: Path) -> None:
    """By another file, in place, or within the resolution of its time, and once each.

    A broken or removed file keeps the old one. The error names file and line, and disappears with
    the next good file.
    """
    forecasts, later = ForecastFile(file), SIX + timedelta(hours=1)
    write(file, SIX, [0.0] * 4)
    assert forecasts.look() and not forecasts.look()
    stamp = file.stat().st_mtime_ns
    write(file, later, [0.0] * 4)
    os.utime(file, ns=(stamp, stamp))
    assert forecasts.look() and not forecasts.look()
    file.write_text(file.read_text() + "# a comment\n")
    assert forecasts.look() and not forecasts.look()
    write(file, SIX, [0.0, -1.0])
    assert not forecasts.look()
    assert f"{file}, line 3" in forecasts.problem and "'-1.0'" in forecasts.problem
    file.unlink()
    assert not forecasts.look()
    assert f"{file}: cannot be read: No such file" in forecasts.problem
    assert forecasts.issues[0].issued == later
    write(file, SIX, [0.0])
    assert forecasts.look()
    assert (forecasts.problem, forecasts.issues[0].issued) == ("", SIX)


def test_columns_that_may_be_left_out(file: Path) -> None:
    """Temperature is optional; evapotranspiration is not, as a live site has no record of it."""
    forecasts = ForecastFile(file)
    assert not forecasts.look()
    assert "cannot be read" in forecasts.problem and forecasts.issues == []
    with pytest.raises(NoForecastError, match="there is no forecast"):
        LiveForecast(forecasts, PAPER_SITE, 0.0, 7200.0, all_members=False).at(SIX)
    write(file, SIX, [0.0] * 4, evapotranspiration=None)
    assert not forecasts.look()
    assert "must have a column 'evapotranspiration [mm/day]'" in forecasts.problem
    (issue,) = read_forecasts(file)
    assert issue.evapotranspiration is None
    assert issue.temperature is not None and issue.temperature.tolist() == [15.0, 14.0, 13.0, 12.0]
    write(file, SIX, [0.0], temperature=None)
    assert np.isnan(live(file).at(SIX).temperature)
