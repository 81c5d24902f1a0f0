"""The weather of a run: each tick's hour, and gaps that were filled."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from graphs import environment
from paper import PAPER_SITE, weather_of
from places import CONFIG, DATA, refusal

from greenroof_ros.base.times import parse_time
from greenroof_ros.forecast.steps import PerfectForecast
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_weather
from greenroof_ros.weather.series import FILL, REFUSE, Weather, WeatherSeries

TORONTO = read_site(CONFIG / "site.yaml")
JULY = DATA / "en_climate_hourly_07-2022.csv"
LST = timezone(timedelta(hours=-5))
THREE_HOURS = weather_of([0.2, 3.0, 7.2], first=parse_time("2021-07-07T03:00-05:00"))


@pytest.mark.parametrize(
    ("steps", "repeats"), [(3 * 3600, True), (3 * 3600 - 9, True), (3 * 3600 - 10, False)]
)
def test_last_record_is_repeated_past_the_end(steps: int, repeats: bool) -> None:
    """The window of tick N reaches to tick N + 9; the records end with tick 10,799."""
    run = WeatherSeries(THREE_HOURS, PAPER_SITE, THREE_HOURS.first, steps)
    window = PerfectForecast(run, 10).at(steps).rain
    assert list(window) == pytest.approx([2e-6] * 10, rel=1e-15)
    end = parse_time("2021-07-07T06:00-05:00")
    assert run.repeats_from == (end if repeats else None)


def test_run_outside_the_records() -> None:
    """A second too early, and a second too long."""
    for start, steps in (("2021-07-07T02:59:59-05:00", 10), ("2021-07-07T03:00-05:00", 10801)):
        reason = refusal(WeatherSeries, THREE_HOURS, PAPER_SITE, parse_time(start), steps)
        assert reason.startswith(
            "drawn.csv: contains records from 2021-07-07T03:00-05:00 to 2021-07-07T06:00-05:00, "
            "but the run starts at "
        )


def years(hours: int) -> Weather:
    """Return made-up records of this many hours."""
    chance = np.random.default_rng(5)
    rain, evaporated = chance.gamma(0.1, size=hours), chance.gamma(2.0, size=hours)
    first = datetime(2014, 6, 1, tzinfo=LST)
    return weather_of(rain, evaporated, first, temperature=chance.normal(5, 10, size=hours))


@pytest.mark.parametrize("tau", [7.0, 0.3, 1234.5])
def test_each_tick_has_its_hour(tau: float) -> None:
    """By the clock: the hour in which a tick begins, even if the start is within an hour."""
    site = replace(TORONTO, tau=tau, M=10)
    weather = years(70)
    late = timedelta(minutes=83)
    steps = min(int(40 * 3600 / tau), 8000)
    series = WeatherSeries(weather, site, weather.first + late, steps)
    hours = [
        (late + tick * timedelta(seconds=tau)) // timedelta(hours=1) for tick in range(steps + 10)
    ]
    rain = weather.precipitation[hours] / 1000 / 3600
    dry = weather.evapotranspiration[hours] / 1000 / 86400 * site.a2
    frost = weather.frost[hours]
    for values, due in (
        (series.precipitation, rain), (series.evapotranspiration, dry), (series.frost, frost)
    ):
        assert list(values) == due.tolist()
    for tick in range(0, steps + 10, 16):
        now, until = series.at(tick), np.searchsorted(hours, hours[tick], "right")
        assert now[:3] == (rain[tick], dry[tick], frost[tick])
        assert min(now.until, steps + 10) == until
    assert series.frost_hours == pytest.approx(frost[:steps].sum() * tau / 3600, rel=1e-12)
    assert series.precipitation[5:25:3].tolist() == rain[5:25:3].tolist()
    assert series.precipitation.maximum == rain.max()
    with pytest.raises(IndexError):
        series.precipitation[steps + 10]


# --- gaps that were filled ------------------------------------------------------------------------


def test_missing_rain_is_treated_as_none_and_every_hour_is_named() -> None:
    plain, weather = (read_weather([JULY], TORONTO, gaps=gaps) for gaps in (REFUSE, FILL))
    missing = np.flatnonzero(np.isnan(plain.precipitation)).tolist()
    assert weather.precipitation.tolist() == np.nan_to_num(plain.precipitation).tolist()
    notes = WeatherSeries(weather, TORONTO, weather.first, 31 * 86_400).notes
    (named,) = re.findall("^precipitation is missing at (.*) and was filled", "\n".join(notes))
    assert "2022-07-21T11:00-05:00" in named
    assert named.split(", ") == [
        (weather.first + timedelta(hours=hour)).isoformat(timespec="minutes") for hour in missing
    ]
    assert not np.isnan(weather.evapotranspiration).any()
    # Julys of five years have a mean of 4 to 5 mm a day; far more would be another climate.
    assert 3.5 < weather.evapotranspiration.mean() < 6


def test_a_command_fills_gaps(tmp_path: Path) -> None:
    """The summary names the filled hours; the node and the run's own records have the option."""
    done = run_command(
        "simulate", "--controller", "onoff", "--weather", str(JULY), "--start", "2022-07-21T10:30",
        "--hours", "1", "--output", "run", "--gaps", "fill", cwd=tmp_path, env=environment(0),
    )
    assert done.returncode == 0, done.stderr
    printed = " ".join(done.stdout.replace("│", " ").split())
    assert "precipitation is missing at 2022-07-21T11:00-05:00" in printed
    assert "gaps: fill" in (tmp_path / "run" / "configuration" / "parameters.yaml").read_text()
