"""Forecasts as good and as bad as real ones: by theory, and by figures of services."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from numpy.typing import NDArray
from places import DATA
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from greenroof_ros.forecast.choice import Skill, read_skill
from greenroof_ros.forecast.models import ErrorModel
from greenroof_ros.weather.series import Weather

Array = NDArray[np.float64]
REAL = read_skill("real")
# No constant error, so what comes is like one more member; the amount makes up for peaks shorter
# than the climate's correlation gives (doc/explanation/forecasts.md).
FAIR = replace(REAL, wetness=0.0, amount=1.3)

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


@pytest.fixture(scope="module")
def rain() -> dict[int, Array]:
    """Toronto's seasons, mm in each hour."""
    return seasons()


# --- the climate -------------------------------------------------------------------------------


def test_the_climate_is_torontos(rain: dict[int, Array]) -> None:
    """The rain of the file's constants agrees with the records.

    Its wet hours, its mean, and what the highest tenth and hundredth of the wet hours exceed; from
    the records themselves, and by integration. And how often two hours some hours apart are wet.
    """
    climate = REAL.climate
    hours = np.concatenate(list(rain.values()))
    assert climate.wet_share == pytest.approx((hours > 0).mean(), rel=0.005)
    wet = hours[hours > 0]

    def amount(normal: float) -> float:
        return float(climate.rain(np.array(normal))) * norm.pdf(normal)

    assert quad(amount, climate.threshold, 8)[0] == pytest.approx(hours.mean(), rel=0.03)
    for share in (0.1, 0.01):
        normal = norm.isf(climate.wet_share * share)
        expected = np.quantile(wet, 1 - share)
        assert climate.rain(np.array(normal)) == pytest.approx(expected, rel=0.06)
    for lag in (1, 2, 3, 6, 12, 24):
        rho = math.exp(-lag / climate.memory)
        pair = multivariate_normal([0, 0], [[1, rho], [rho, 1]])
        both = np.concatenate([(own[lag:] > 0) & (own[:-lag] > 0) for own in rain.values()])
        assert pair.cdf([-climate.threshold] * 2) == pytest.approx(both.mean(), rel=0.1)


# --- forecasts ---------------------------------------------------------------------------------


def test_what_comes_is_like_one_more_member(rain: dict[int, Array]) -> None:
    """Without wetness, nine members a day ahead have rain as often and as much as it fell.

    A few storms make the amount, which scatters by more than 10 %. Among the members what comes is
    equally likely to have any rank, if one of the ten has rain. Equal amounts, such as zeros,
    are ranked by lot. The days' sums are nearly independent: each rank has a tenth of them,
    within four standard errors.
    """
    years = []
    for year in (2015, 2019, 2023):
        members = days_ahead(year, rain[year], FAIR, 7, (1,), members=9)[1]
        all_ten = np.vstack([rain[year], members]).reshape(10, -1, 24)
        years.append(all_ten[:, ~np.isnan(all_ten).any(axis=(0, 2))])
    all_ten = np.concatenate(years, axis=1)
    assert (all_ten[1:] > 0).mean() == pytest.approx((all_ten[0] > 0).mean(), rel=0.1)
    assert all_ten[1:].mean() == pytest.approx(all_ten[0].mean(), rel=0.2)
    sums = all_ten.sum(axis=2)
    sums = sums[:, (sums > 0).any(axis=0)]
    lots = np.random.default_rng(1).random(sums.shape)
    ranks = np.argmax(np.lexsort((lots, sums), axis=0) == 0, axis=0)
    days = sums.shape[1]
    shares = np.bincount(ranks, minlength=10) / days
    assert shares == pytest.approx(np.full(10, 0.1), abs=4 * math.sqrt(0.09 / days))


@pytest.fixture(scope="module")
def ahead(rain: dict[int, Array]) -> dict[int, Array]:
    """What ``real`` forecasts for these hours, by days ahead."""
    return seasons_ahead(rain, REAL, 1, (1, 2, 3, 4, 5))


def test_as_good_as_services(rain: dict[int, Array], ahead: dict[int, Array]) -> None:
    """r, POD and FAR of sums over 1, 6, 12 and 24 h, one to five days ahead: skill ``real``.

    Within the spread of the services, or as far from it as doc/explanation/forecasts.md states.
    """
    spread, observed = services(), np.concatenate(list(rain.values()))
    for day in (1, 2, 3, 5):
        scores = figures(ahead[day][0], observed)[:, :3]
        for row, hours in zip(scores, SUMS, strict=True):
            low, high = (how(spread[day, hours][:, :3], axis=0) for how in (np.min, np.max))
            assert (row > low - 0.1).all() and (row < high + 0.12).all(), (day, hours, row)
        middle = np.mean([spread[day, hours][:, :3].mean(axis=0) for hours in SUMS], axis=0)
        assert scores.mean(axis=0) == pytest.approx(middle, abs=0.09)


def test_none_is_as_wet_as_the_climate_and_as_services(rain: dict[int, Array]) -> None:
    """A day ahead it rains as often as in the climate, and no less than services forecast."""
    years, none = {year: rain[year] for year in (2017, 2021)}, read_skill("none")
    observed = np.concatenate(list(years.values()))
    members = seasons_ahead(years, none, 1, (1,), 2)[1]
    there = members[~np.isnan(members)]
    assert (there > 0).mean() == pytest.approx(none.climate.wet_share, rel=0.1)
    biases = np.concatenate([scores[:, 3] for scores in services().values()])
    assert biases.min() < there.mean() / observed.mean() < biases.max() + 0.1


def test_issues_agree_as_real_ones_do(ahead: dict[int, Array]) -> None:
    """r between forecasts of different days ahead: within 0.1 of the services' spread.

    Sums over 12 h, from test/data/previous_runs_agreement.csv.
    """
    real: dict[tuple[int, int], list[float]] = {}
    agreements = table("previous_runs_agreement.csv").filter(pl.col("sum_hours") == 12)
    for day, other_day, r in agreements.select("day", "other_day", "r").iter_rows():
        real.setdefault((day, other_day), []).append(r)
    sums = {day: members[0].reshape(-1, 12).sum(axis=1) for day, members in ahead.items()}
    for (day, other), services_r in real.items():
        both = ~np.isnan(sums[day]) & ~np.isnan(sums[other])
        agreement = np.corrcoef(sums[day][both], sums[other][both])[0, 1]
        assert min(services_r) - 0.1 < agreement < max(services_r) + 0.1, (day, other)


def test_the_same_in_any_order(rain: dict[int, Array]) -> None:
    """In any order of calls, with a long or a short horizon, alone or as member 0.

    Only the seed matters.
    """
    weather = season_weather(2020, rain[2020])
    skill = replace(FAIR, wetness=0.2)
    long, short = ErrorModel(weather, 9, skill, 4), ErrorModel(weather, 9, skill)
    asked = (661, 2233, 1909, 1843)  # it rains, and each is a time of issue
    backwards = {hour: short.forecast(hour, 13) for hour in asked[::-1]}
    for hour in asked:
        members, evapotranspiration, _ = long.forecast(hour, 241)
        near = backwards[hour]
        assert members[:1, :13].tobytes() == near[0].tobytes()
        assert evapotranspiration[:13].tobytes() == near[1].tobytes()
        assert len({member.tobytes() for member in members}) == 4
    another = ErrorModel(weather, 8, skill).forecast(661, 13)[1]
    assert not np.isclose(another, backwards[661][1])[1:].any()


def test_evapotranspiration(rain: dict[int, Array]) -> None:
    """Right on average; the error grows with the lead, from nearly 0 up to the skill's share.

    If the logarithm of a factor is normal, and its mean is 1, the logarithm's is -variance / 2.
    """
    large = replace(REAL, evapotranspiration=1.0)
    factors = np.array([
        ErrorModel(season_weather(2016, rain[2016][:700]), seed, large).forecast(301, 241)[1] / 2
        for seed in range(150)
    ])
    mean, spread = np.log(factors).mean(axis=0), np.log(factors).std(axis=0)
    for lead in (120, 240):
        assert mean[lead] == pytest.approx(-spread[lead] ** 2 / 2, abs=3 * spread[lead] / 12)
    assert 0 < spread[0] < spread[6] < spread[48] < spread[240] < 1.1


def test_believable(rain: dict[int, Array]) -> None:
    """At most 500 mm/h and 50 mm/day, which are within the topics' ranges."""
    weather = season_weather(2016, np.full(300, 400.0))
    weather.values["evapotranspiration"] = np.full(300, 49.0)
    known = [ErrorModel(weather, seed, REAL).forecast(61, 200)[:2] for seed in range(20)]
    assert [max(float(series.max()) for series in both) for both in zip(*known, strict=True)] == [
        500.0, 50.0
    ]
