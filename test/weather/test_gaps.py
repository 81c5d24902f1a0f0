"""Gaps that are filled on request, and implausible hours of rain, in real months."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from graphs import environment
from paper import weather_of
from places import DATA

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.formats.records import Records
from greenroof_ros.model.site import read_site
from greenroof_ros.weather.reading import fill_long_gaps, read_weather
from greenroof_ros.weather.series import FILL, REFUSE, Weather, WeatherSeries, suspicious_rain

TORONTO = read_site(shared_directory() / "config" / "site.yaml")
JULY = DATA / "en_climate_hourly_07-2022.csv"
DECEMBER = DATA / "en_climate_hourly_12-2015.csv"
LST = timezone(timedelta(hours=-5))


def test_missing_rain_counts_as_none_and_every_hour_is_named() -> None:
    plain, weather = (read_weather([JULY], TORONTO, gaps=gaps) for gaps in (REFUSE, FILL))
    missing = np.flatnonzero(np.isnan(plain.precipitation)).tolist()
    assert weather.precipitation.tolist() == np.nan_to_num(plain.precipitation).tolist()
    named = WeatherSeries(weather, TORONTO, weather.first, 31 * 86_400).filled["precipitation"]
    assert "2022-07-21T11:00-05:00" in named
    assert named == [
        (weather.first + timedelta(hours=hour)).isoformat(timespec="minutes") for hour in missing
    ]
    assert not np.isnan(weather.evapotranspiration).any()
    # Julys of five years have a mean of 4 to 5 mm a day; far more would be another climate.
    assert 3.5 < weather.evapotranspiration.mean() < 6


def test_long_gaps_have_the_mean_of_the_days_about_them() -> None:
    """At the same time of day, of three days before and three after; the rest stays missing."""
    day, hour = np.divmod(np.arange(20 * 24), 24)
    series = day**2 + hour / 100
    series[5 * 24 : 13 * 24] = np.nan
    filled = fill_long_gaps({"temperature": series})["temperature"]
    assert np.flatnonzero(np.isnan(filled)).tolist() == list(range(8 * 24, 10 * 24))
    assert filled[5 * 24 + 7] == pytest.approx((4 + 9 + 16) / 3 + 0.07)
    assert filled[12 * 24] == pytest.approx((13**2 + 14**2 + 15**2) / 3)
    assert filled[[4 * 24, 13 * 24]].tolist() == [16.0, 169.0]
    weather = weather_of(np.zeros(20 * 24), temperature=filled)
    with pytest.raises(ConfigurationError) as caught:
        WeatherSeries(replace(weather, gaps=FILL), TORONTO, weather.first + timedelta(days=8), 3600)
    assert "temperature is missing at" in str(caught.value)
    assert "--gaps" not in str(caught.value)


def test_command_line(tmp_path: Path) -> None:
    """Refused by default; with the option the summary names the filled hours; the node has it.

    The run's own records also state what they were made from.
    """
    options = [
        "--controller", "onoff", "--weather", str(JULY), "--start", "2022-07-21T10:30",
        "--hours", "1", "--output", "run",
    ]
    refused = run_command("simulate", *options, cwd=tmp_path, env=environment(0))
    assert refused.returncode == 2
    assert "precipitation is missing at 2022-07-21T11:00-05:00; choose another" in refused.stderr
    assert "fill the gaps (--gaps fill; in a grid, gaps: fill)" in refused.stderr
    done = run_command("simulate", *options, "--gaps", "fill", cwd=tmp_path, env=environment(0))
    assert done.returncode == 0, done.stderr
    assert "FILLED" in done.stdout
    assert "2022-07-21T11:00-05:00" in done.stdout
    assert "gaps: fill" in (tmp_path / "run" / "configuration" / "parameters.yaml").read_text()


def test_hours_that_are_hard_to_believe() -> None:
    """79.2 mm in an hour of December; not July's storms, nor March's sleet."""
    weather = read_weather([DECEMBER], TORONTO, gaps=FILL)
    (only,) = WeatherSeries(weather, TORONTO, weather.first, 29 * 86_400).suspicious
    assert only.startswith("79.2 mm at 2015-12-29T02:00-05:00")
    assert weather.precipitation.max() == 79.2
    assert WeatherSeries(weather, TORONTO, weather.first, 3 * 86_400).suspicious == []
    for month in ("07-2021", "03-2021"):
        weather = read_weather([DATA / f"en_climate_hourly_{month}.csv"], TORONTO)
        assert suspicious_rain(weather, range(weather.hours)) == []


def test_factors_of_the_check() -> None:
    """Durre et al. (2010): 9 times the 95th percentile, 5 times below 0 degC; 20 wet hours."""
    first = datetime(2021, 1, 20, tzinfo=LST)

    def suspicious(most: float, temperature: float, wet: int = 100) -> list[str]:
        # 1 mm each except one hour, so the percentile is 1 mm.
        rain = np.zeros(240)
        rain[:wet] = 1.0
        rain[wet - 1] = most
        values = {"precipitation": rain, "temperature": np.full(240, temperature)}
        return suspicious_rain(Records((JULY,), first, values), range(240))

    assert suspicious(8.9, 0.0) == []
    assert len(suspicious(9.0, 0.0)) == 1
    assert suspicious(4.9, -0.1) == []
    assert len(suspicious(5.0, -0.1)) == 1
    assert suspicious(500.0, 5.0, wet=19) == []


def test_the_year_has_no_end() -> None:
    """Usual amounts of the last days of December also count for the first of January."""
    rain = np.zeros(20 * 24)
    rain[:200] = 1.0  # from 22 to 30 December
    rain[11 * 24] = 9.0  # 2 January
    records = Records((JULY,), datetime(2021, 12, 22, tzinfo=LST), {"precipitation": rain})
    (only,) = suspicious_rain(records, range(records.hours))
    assert only.startswith("9 mm at 2022-01-02T00:00-05:00, 9.0 times")


# --- runs of years ------------------------------------------------------------------------------


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
    start = weather.first + timedelta(minutes=83)
    steps = min(int(40 * 3600 / tau), 20_000)
    series = WeatherSeries(weather, site, start, steps)
    assert len(series.precipitation) == steps + 10
    assert weather.frost is not None
    frozen = 0
    until = 0
    for tick in range(steps + 10):
        hour = (timedelta(minutes=83) + tick * timedelta(seconds=tau)) // timedelta(hours=1)
        frozen += int(weather.frost[hour]) * (tick < steps)
        if tick % 4:
            continue
        now = series.at(tick)
        assert now[:3] == (
            weather.precipitation[hour] / 1000 / 3600,
            weather.evapotranspiration[hour] / 1000 / 86400 * site.a2, weather.frost[hour],
        )
        assert now[:3] == (
            series.precipitation[tick], series.evapotranspiration[tick], series.frost[tick]
        )
        if tick >= until:
            until = now.until
        assert now.until == until
    assert series.frost_hours == pytest.approx(frozen * tau / 3600, rel=1e-12)
    assert series.precipitation[5:25:3].tolist() == [
        series.precipitation[tick] for tick in range(5, 25, 3)
    ]
    assert series.precipitation.largest == max(series.precipitation)
    with pytest.raises(IndexError):
        series.precipitation[steps + 10]


def test_years_take_no_more_memory_than_hours() -> None:
    """Three years of seconds: a few numbers per hour, and nothing per tick."""
    weather = years(26_304)
    site = replace(TORONTO, tau=1.0, M=10)
    tracemalloc.start()
    series = WeatherSeries(weather, site, weather.first, 26_000 * 3600)
    series.at(26_000 * 3600)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # A byte a tick would be 94 MB.
    assert peak < 14e6
