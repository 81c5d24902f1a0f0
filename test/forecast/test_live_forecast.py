"""A live site's forecast file: replaced, broken, removed, too old; and what follows from it."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from paper import PAPER_SITE

from greenroof_ros.forecast.issue import IssuedForecast, read_forecasts, write_forecasts
from greenroof_ros.forecast.live import ForecastFile, LiveForecast, NoForecastError
from greenroof_ros.site.horizon import look_ahead_ends

SIX = datetime(2026, 7, 1, 6, tzinfo=UTC)


def write(path: Path, issued: datetime, rain: list[float], *lacking: str) -> None:
    """Write a file with an issue of some hours, and rename it into place as one must."""
    hours = np.arange(len(rain))
    day = hours % 24
    values = {
        "precipitation": np.array([rain]), "evapotranspiration": 2.0 + day,
        "temperature": 15.0 - day,
    }
    for name in lacking:
        del values[name]
    draft = path.with_suffix(".new")
    draft.write_text(write_forecasts([IssuedForecast(issued, issued, path, None, values)]))
    draft.replace(path)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The site's file, which does not exist yet."""
    return tmp_path / "forecast.csv"


def live(path: Path, horizon: float = 0.0, limit: float = 7200.0) -> LiveForecast:
    """Return the forecasts of a file that has been read."""
    forecasts, file = LiveForecast(
        PAPER_SITE, look_ahead_ends(PAPER_SITE, horizon), limit, False
    ), ForecastFile(path)
    file.update()
    forecasts.issues = file.issues
    return forecasts


@pytest.mark.parametrize("read", [None, 0.0, 30.0])
def test_the_rest_of_the_hour_is_forecast(file: Path, read: float | None) -> None:
    """At 12:05 and at 12:59:55 a gauge tells what falls now (mm/h), and nothing about later.

    It holds for the first 10 s, or for a tick of a minute. After it comes what is forecast: 0.4 and
    0.8 mm/h in two hours, or ten times as much by a second member. Without a gauge, it comes first.
    """
    site = replace(PAPER_SITE, tau=60.0)
    rain, noon = np.outer((1.0, 10.0), (0.4, 0.8)), SIX.replace(hour=12)
    values = {"precipitation": rain, "evapotranspiration": np.full(2, 4.0)}
    issue = IssuedForecast(noon, noon, file, None, values)
    five = timedelta(minutes=5)
    for at, moment, held, own in (
        (PAPER_SITE, noon + five, 1, [0.4] * 15 + [0.6]),
        (site, noon + five, 6, [0.4] * 10 + [0.6]),
        (PAPER_SITE, noon + timedelta(minutes=59, seconds=55), 1, [0.8] * 16),
    ):
        forecasts = LiveForecast(at, look_ahead_ends(at, 1.0), 7200.0, all_members=True)
        forecasts.issues = [issue]
        outlook = forecasts.at(moment, None if read is None else read / 3.6e6)
        for member, factor in zip(3.6e6 * np.asarray(outlook.rain), (1, 10), strict=True):
            mean = factor * (0.4 if moment == noon + five else 0.6)
            now = [mean if read is None else read] * held
            assert member == pytest.approx([*now, *(factor * rate for rate in own)], abs=1e-9)
        assert outlook.rain_now * 3.6e6 == pytest.approx(0.4 if read is None else read)
        dried = np.array(outlook.evapotranspiration) / 68.8 * 8.64e7
        assert dried == pytest.approx([4.0] * 17)


@pytest.mark.parametrize(("later", "horizon", "words"), [
    (timedelta(hours=2, seconds=1), 0.0, "older than 2 h"),
    (timedelta(hours=5), 3.0, r"issued at .*, ended at 2026-07-01 10:00\S*, after 4 h"),
    (-timedelta(seconds=1), 0.0, "no forecast, only later ones"),
])
def test_no_forecast(file: Path, later: timedelta, horizon: float, words: str) -> None:
    """Too old, at its end, from the future; before that, each is a forecast."""
    write(file, SIX, [0.0] * 4)
    forecast = live(file, horizon, limit=7200.0 if later < timedelta(hours=4) else 86400.0)
    with pytest.raises(NoForecastError, match=words):
        forecast.at(SIX + later)
    forecast.at(SIX + (timedelta(0) if later < timedelta(0) else timedelta(hours=1)))


@pytest.mark.parametrize(("hours", "age", "horizon", "needed"), [
    (24, 0.5, 120.0, 122), (2, 1.0, 6.0, 8),  # for two hours more than the look-ahead
])
def test_a_short_forecast_is_used_as_far_as_it_reaches(
    file: Path, hours: int, age: float, horizon: float, needed: int
) -> None:
    """After its end it is dry, and evapotranspiration repeats: its last day, or its last hour.

    Rain is 1 mm/h, so the depth over the look-ahead is the number of hours left. The temperature of
    the present hour is known.
    """
    write(file, SIX, [1.0] * hours)
    forecasts, now = live(file, horizon), SIX + timedelta(hours=age)
    assert f"must be {needed} h long, not {hours} h" in forecasts.shortage(now)
    outlook = forecasts.at(now)
    steps = np.diff(look_ahead_ends(PAPER_SITE, horizon))
    depth = 1000 * float((np.array(outlook.rain) * steps).sum())
    assert depth == pytest.approx(hours - age, rel=1e-9)
    if hours < 24:  # mm/day: written as 2, 3, 4, ...
        expected = (1 + hours) / 1000 / 86400 * PAPER_SITE.a2
        assert outlook.evapotranspiration[-1] == pytest.approx(expected)
    assert outlook.temperature == 15.0 - int(age)


def test_a_forecast_that_is_long_enough_lacks_nothing(file: Path) -> None:
    """To the second: two of 122 hours have passed."""
    write(file, SIX, [0.0] * 122)
    assert live(file, 120.0).shortage(SIX + timedelta(hours=2)) == ""


def test_a_file_is_read_again_when_it_is_replaced(file: Path) -> None:
    """By another file, in place, or within the resolution of its time, and once each.

    A broken or removed file keeps the old one. The error names file and line, and disappears with
    the next good file.
    """
    forecasts, later = ForecastFile(file), SIX + timedelta(hours=1)

    def is_new() -> bool:
        before = forecasts.issues
        forecasts.update()
        return forecasts.issues is not before

    write(file, SIX, [0.0] * 4)
    assert is_new() and not is_new()
    stamp = file.stat().st_mtime_ns
    write(file, later, [0.0] * 4)
    os.utime(file, ns=(stamp, stamp))
    assert is_new() and not is_new()
    file.write_text(file.read_text() + "# a comment\n")
    assert is_new() and not is_new()
    write(file, SIX, [-1.0, -1.0])
    assert not is_new()
    assert f"{file}, line 2" in forecasts.problem and "'-1.0'" in forecasts.problem
    file.unlink()
    assert not is_new()
    assert f"{file} cannot be read: No such file" in forecasts.problem
    assert forecasts.issues[0].issued == later
    write(file, SIX, [0.0])
    assert is_new()
    assert (forecasts.problem, forecasts.issues[0].issued) == ("", SIX)


def test_an_issue_that_is_too_long(file: Path) -> None:
    """A line too many is found where it is; what is longer would fill the memory."""
    write(file, SIX, [0.5] * 865)
    forecasts = ForecastFile(file)
    forecasts.update()
    assert f"{file}, line 866: time = " in forecasts.problem
    assert "up to 864 consecutive hours" in forecasts.problem


def test_columns_that_may_be_left_out(file: Path) -> None:
    """Temperature is optional; evapotranspiration is not, as a live site has no record of it."""
    forecasts = ForecastFile(file)
    forecasts.update()
    assert "cannot be read" in forecasts.problem and forecasts.issues == []
    with pytest.raises(NoForecastError, match="there is no forecast"):
        live(file).at(SIX)
    write(file, SIX, [0.0] * 4, "evapotranspiration")
    forecasts.update()
    assert "must have a column 'evapotranspiration [mm/day]'" in forecasts.problem
    (issue,) = read_forecasts(file)
    assert "evapotranspiration" not in issue.values
    assert issue.values["temperature"].tolist() == [15.0, 14.0, 13.0, 12.0]
    write(file, SIX, [0.0], "temperature")
    assert np.isnan(live(file).at(SIX).temperature)
