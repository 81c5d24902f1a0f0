"""What a simulated run knows of the hour that has begun: what a site with a rain gauge does."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from forecast_skill.figures import season_weather
from paper import PAPER_SITE

from greenroof_ros.forecast.live_forecast import ForecastFile, LiveForecast
from greenroof_ros.forecast.models import FileModel
from greenroof_ros.forecast.resampling import SteppedForecast
from greenroof_ros.formats.own_csv import write_forecasts
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.formats.records import Issue
from greenroof_ros.model.look_ahead import growing_steps

ISSUED = datetime(2021, 5, 1, 6, tzinfo=timezone.utc)
HOURS, HORIZON = 6, 12.0


def test_a_run_knows_of_the_present_hour_what_a_gauge_reads_now(tmp_path: Path) -> None:
    """At each time the run is given what a live site is, whose gauge reads the present rain.

    Both take that reading for the rest of the hour, and the issue for all hours after it. Records
    are hourly, so that in a run the reading never changes within the hour: the value of that is
    measured by test/real_seasons.
    """
    chance = np.random.default_rng(4)
    rain = chance.gamma(0.2, 3.0, size=(3, 24))
    file = tmp_path / "forecast.csv"
    issue = Issue(ISSUED, file, None, rain, np.full(24, 2.0))
    file.write_text(write_forecasts([issue]))
    fell = chance.gamma(0.2, 3.0, size=24)
    weather = season_weather(2021, fell)
    weather = replace(weather, first=ISSUED)
    site = replace(PAPER_SITE, tau=60.0, M=1)
    run = SteppedForecast(
        FileModel(read_archive(file, site), weather, all_members=True), weather, site, ISSUED,
        growing_steps(HORIZON), 60 * HOURS - 1, all_members=True,
    )
    live = LiveForecast(ForecastFile(file), site, HORIZON, 86_400.0, all_members=True)
    live.file.look()
    for minute in range(0, 60 * HOURS, 7):
        now = ISSUED + timedelta(minutes=minute)
        reading = float(fell[minute // 60]) / 3.6e6
        outlook = live.at(now, observed_rain=reading)
        assert np.array(run.precipitation(minute)) == pytest.approx(np.array(outlook.rain))
        assert np.array(run.precipitation(minute))[:, 0] == pytest.approx(reading)
