"""Scores of forecasts, from services and from the package, to test the published skill."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import polars as pl
from places import DATA

from greenroof_ros.forecast.choice import Skill
from greenroof_ros.forecast.models import ErrorModel
from greenroof_ros.weather.series import Weather

YEARS = range(2015, 2026)
# Hours from May to October.
SEASON_HOURS = 184 * 24
ZONE = timezone(timedelta(hours=-5))

# Lengths of the sums (h), and for each the minimum sum that is an event (mm).
SUMS = {1: 1.0, 6: 2.0, 12: 3.0, 24: 5.0}
NAMES = ("r", "POD", "FAR", "bias")


def table(name: str) -> pl.DataFrame:
    """Return a table of the test data."""
    return pl.read_csv(DATA / name, comment_prefix="#")


def seasons() -> dict[int, np.ndarray]:
    """Return the rain (mm) of each hour of May to October, local standard time, by year."""
    rain = {year: np.zeros(SEASON_HOURS) for year in YEARS}
    for text, amount in table("toronto_rain.csv").iter_rows():
        time = datetime.fromisoformat(f"{text}:00-05:00")
        rain[time.year][(time - begin(time.year)) // timedelta(hours=1)] = amount
    return rain


def begin(year: int) -> datetime:
    """Return the start of a season."""
    return datetime(year, 5, 1, tzinfo=ZONE)


def season_weather(year: int, rain: np.ndarray) -> Weather:
    """Return a season as weather, with 2 mm/day of evapotranspiration."""
    values = {"precipitation": rain, "evapotranspiration": np.full(len(rain), 2.0)}
    return Weather((Path("season.csv"),), begin(year), values, "drawn")


def services() -> dict[tuple[int, int], np.ndarray]:
    """Return r, POD, FAR and bias of the services by days ahead and hours of the sum.

    Shape (services, 4). GFS's fifth day is left out, because the archive lacks half of its water.
    """
    skill = table("skill.csv").filter(
        ~((pl.col("days_ahead") == 5) & (pl.col("model") == "gfs_seamless"))
    )
    return {
        key: scores.select(name.lower() for name in NAMES).to_numpy()
        for key, scores in skill.group_by("days_ahead", "sum_hours", maintain_order=True)
    }


def figures(forecast: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Return r, POD, FAR and bias of a forecast (mm) of whole days, shape (sums, 4).

    Hours without a forecast are NaN, and their sums are left out.
    """
    scores = []
    for hours, event in SUMS.items():
        sums, observed_sums = (rain.reshape(-1, hours).sum(axis=1) for rain in (forecast, observed))
        complete = ~np.isnan(sums)
        sums, observed_sums = sums[complete], observed_sums[complete]
        hits = ((sums >= event) & (observed_sums >= event)).sum()
        scores.append((
            np.corrcoef(sums, observed_sums)[0, 1], hits / (observed_sums >= event).sum(),
            1 - hits / (sums >= event).sum(), sums.sum() / observed_sums.sum(),
        ))
    return np.array(scores)


def seasons_ahead(
    rain: dict[int, np.ndarray], skill: Skill, seed: int, days: tuple[int, ...], members: int = 1
) -> dict[int, np.ndarray]:
    """Return what :func:`days_ahead` does for seasons, one after the other."""
    ahead = [days_ahead(year, season, skill, seed, days, members) for year, season in rain.items()]
    return {day: np.concatenate([season[day] for season in ahead], axis=1) for day in days}


def days_ahead(
    year: int, rain: np.ndarray, skill: Skill, seed: int, days: tuple[int, ...], members: int = 1
) -> dict[int, np.ndarray]:
    """Return for each hour the forecast (mm) of the newest issue that is at least so many days old.

    Open-Meteo's previous runs are made the same way: for day N, the newest issue that is at least
    N x 24 h old. NaN if there is none.

    Returns:
        Forecasts by day, shape (members, hours).
    """
    weather = season_weather(year, rain)
    model = ErrorModel(weather, seed, skill, members)
    ahead = {day: np.full((members, len(rain)), np.nan) for day in days}
    furthest = 24 * max(days) + 6
    # The first issue is at 01:00 local standard time, 06:00 UTC.
    for issue in range(1, len(rain) - furthest, 6):
        forecast = model.forecast(issue, furthest)[0]
        for day in days:
            lead = 24 * day
            ahead[day][:, issue + lead : issue + lead + 6] = forecast[:, lead : lead + 6]
    return ahead
