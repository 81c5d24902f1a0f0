"""A live site's forecast file: replaced, broken, removed, too old; and what follows from it."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from paper import PAPER_SITE

from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.dressing import Dressing, dressing_text, read_dressing
from greenroof_ros.forecast.live_forecast import (
    ForecastFile,
    LiveDressing,
    LiveForecast,
    NoForecastError,
)
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
    write(file, SIX, [-1.0, -1.0])
    assert not forecasts.look()
    assert f"{file}, line 2" in forecasts.problem and "'-1.0'" in forecasts.problem
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


def dressed(
    directory: Path, all_members: bool = True, days: int = 100
) -> tuple[LiveForecast, LiveDressing]:
    """Write a forecast of 5 mm/h; return forecasts dressed by days when each issue came true."""
    file, record = directory / "forecast.csv", directory / "dressed.csv"
    issued = hours_since_1970(SIX) - 24 * 200 + 24 * np.arange(days)
    fell = np.arange(1.0 * days)[:, None] / 10 * np.ones(3)
    record.write_text(dressing_text(Dressing("given", (0, 3), issued, fell[:, :1] * 3, fell)))
    write(file, SIX, [5.0, 5.0, 5.0])
    dressing = LiveDressing(record, PAPER_SITE.tau)
    forecasts = LiveForecast(ForecastFile(file), PAPER_SITE, 1.0, 7200.0, all_members, dressing)
    return forecasts, dressing


def test_a_dressed_forecast(tmp_path: Path) -> None:
    """Members are what fell after similar issues; temperature and evapotranspiration are kept."""
    forecasts, _ = dressed(tmp_path)
    forecasts.file.look()
    outlook = forecasts.at(SIX + timedelta(minutes=30))
    # The ten nearest, two days apart, each scaled to the same mean rain: 5 mm/h.
    assert np.array(outlook.rain)[:, 0] == pytest.approx([5e-3 / 3600] * 10)
    assert outlook.temperature == 15.0
    assert np.array(outlook.evapotranspiration)[0] == pytest.approx(2.0 / 1000 / 86400 * 68.8)


def test_a_record_stands_for_a_forecast(tmp_path: Path) -> None:
    """Without a usable issue, members are spells of the record, the same all day."""
    forecasts, _ = dressed(tmp_path)
    with pytest.raises(NoForecastError):
        forecasts.at(SIX)
    usual = 3.0 / 1000 / 86400 * 68.8  # 3 mm/day from the bed
    rains = []
    for hours in (0, 5, 24):
        outlook = forecasts.of_record(SIX + timedelta(hours=hours), usual)
        assert outlook is not None
        assert np.array(outlook.evapotranspiration) == pytest.approx(
            np.full(len(outlook.evapotranspiration), usual)
        )
        rains.append(np.array(outlook.rain))
    spells = {round(day / 10, 1) for day in range(100)}
    assert {round(value * 3.6e6, 1) for value in rains[0].ravel()} <= spells
    assert np.array_equal(rains[0], rains[1])
    assert not np.array_equal(rains[0], rains[2])
    assert forecasts.of_record(SIX, None) is None
    # A single member would be a draw of one spell.
    forecasts, _ = dressed(tmp_path, all_members=False)
    assert forecasts.of_record(SIX, usual) is None


def test_a_live_site_learns(tmp_path: Path) -> None:
    """The file has an issue and the hours after it; an hour without a working gauge is unknown."""
    forecasts, dressing = dressed(tmp_path)
    forecasts.file.look()
    forecasts.at(SIX)
    fell = []
    for hour, (rain, gap) in enumerate([(2.0, 0), (4.0, 720), (8.0, 180), (0.0, 0)]):
        for second in range(3600):
            now = SIX + timedelta(hours=hour, seconds=second)
            dressing.measure(now, rain / 3.6e6 if second >= gap else None)
        dressing.close()
        fell.append(read_dressing(tmp_path / "dressed.csv").fell[-1].tolist())
    assert dressing.problem == ""
    # Each hour is known when the next begins.
    assert fell[1] == pytest.approx([2.0, math.nan, math.nan], nan_ok=True)
    assert fell[2] == pytest.approx([2.0, math.nan, math.nan], nan_ok=True)
    # Complete: the gap is bridged.
    assert fell[3] == pytest.approx([2.0, 5.0, 8.0])


def test_too_few_to_dress(tmp_path: Path) -> None:
    """Then an issue is used as issued, it is still learned from, and this is reported."""
    forecasts, dressing = dressed(tmp_path, days=5)
    forecasts.file.look()
    outlook = forecasts.at(SIX)
    assert np.array(outlook.rain).shape[0] == 1
    assert np.array(outlook.rain)[0, 0] == pytest.approx(5e-3 / 3600)
    assert "are needed: add more months" in dressing.few
    dressing.measure(SIX, 0.0)
    dressing.measure(SIX + timedelta(hours=1), 0.0)
    dressing.close()
    assert len(read_dressing(tmp_path / "dressed.csv").issued) == 6


def test_one_site_adds_to_a_file(tmp_path: Path) -> None:
    """Another one reads it, reports this, and writes nothing; no issue, no file."""
    _, dressing = dressed(tmp_path)
    before = (tmp_path / "dressed.csv").read_bytes()
    other = LiveDressing(tmp_path / "dressed.csv", PAPER_SITE.tau)
    assert other.problem.startswith("nothing is added to it: ") and dressing.problem == ""
    for hour in range(2):
        other.measure(SIX + timedelta(hours=hour), 0.0)
    other.close()
    assert (tmp_path / "dressed.csv").read_bytes() == before
    dressing.close()
    LiveDressing(tmp_path / "dressed.csv", PAPER_SITE.tau).close()
