"""Skills that are fitted: errors to scores, and the command that writes a skill."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from forecast_skill.figures import TIP, begin, days_ahead, figures, seasons
from numpy.typing import NDArray
from refusals import refusal

from greenroof_ros.forecast.skill import read_skill
from greenroof_ros.verification.fitting import (
    Sample,
    fit_climate,
    fit_errors,
    fit_skill,
    skill_text,
)
from greenroof_ros.verification.pairs import Class, Sum
from greenroof_ros.verification.scores import Tally

Array = NDArray[np.float64]
HALF_DAY = Sum(12, 3.0)
REAL = read_skill("real")


@pytest.fixture(scope="module")
def rain() -> dict[int, Array]:
    """Toronto's seasons, mm in each hour."""
    return seasons()


def test_a_sample_has_the_scores_of_the_model(rain: dict[int, Array]) -> None:
    """Forecasts of one lead, drawn at once, are as good as those that the model issues.

    r, POD and FAR of half days, by another count, over six seasons; single seasons scatter more.
    """
    six = {year: rain[year] for year in range(2015, 2021)}
    sample = Sample(REAL.climate, list(six.values()), [HALF_DAY])
    observed = np.concatenate(list(six.values()))
    ahead = [days_ahead(year, season, REAL, 0, (1, 2)) for year, season in six.items()]
    for day in (1, 2):
        issued = np.concatenate([season[day][0] for season in ahead])
        (got,) = sample.scores(REAL.errors, 24 * day + 2.5)
        assert got == pytest.approx(figures(issued, observed)[2, :3], abs=0.05)


def test_errors_are_found_again(rain: dict[int, Array]) -> None:
    """Scores of forecasts with another skill lead to errors with these scores."""
    spells = [rain[2019]]
    sample = Sample(fit_climate(spells, TIP), spells, [HALF_DAY])
    worse = replace(REAL.times_lead(3.0).errors, wetness=0.1)
    goals = {lead: sample.scores(worse, lead)[None] for lead in (26.5, 74.5)}
    before = [np.abs(sample.scores(REAL.errors, lead) - goal[0]) for lead, goal in goals.items()]
    assert np.max(before) > 0.1
    fitted = fit_errors(sample, goals, REAL.errors, lambda _: None)
    for lead, (goal,) in goals.items():
        assert sample.scores(fitted, lead) == pytest.approx(goal, abs=0.02)
    assert fitted.persistence == REAL.errors.persistence


def test_lags_without_two_wet_hours() -> None:
    """Three-hour showers every 50 h: no pairs four to 24 hours apart, so a memory of hours.

    Of one hour each 50 h there is no pair at all.
    """
    showers = np.zeros(1000)
    for hour in range(3):
        showers[hour::50] = 1.0 + hour
    fitted = fit_climate([showers], TIP)
    assert fitted.wet_share == pytest.approx(0.06)
    assert 1 < fitted.memory < 12
    single = [np.where(np.arange(1000) % 50 == 0, 1.0, 0.0)]
    refusal(fit_climate, single, TIP, match=r"^--fit: needs records with more rain")


def test_a_spring_gives_a_file_that_is_read(tmp_path: Path, rain: dict[int, Array]) -> None:
    """For 45 days of 2021 the likeliest growth is less than a file may have."""
    climate = fit_climate([rain[2021][:1080]], TIP)
    file = tmp_path / "spring.yaml"
    file.write_text(skill_text(replace(REAL, climate=climate), "a spring"))
    assert read_skill(str(file)).climate.growth == pytest.approx(climate.growth, rel=1e-4)


def test_records_that_say_too_little(rain: dict[int, Array]) -> None:
    """Rain in too many or too few hours for a file; few hours; forecasts of one lead."""
    for wet in (950, 0):
        records = [(np.arange(1000) < wet).astype(float)]
        refusal(fit_climate, records, TIP, match=r"^--fit: needs records with rain in 0.01% to")
    tallies = {Class(0, 24, HALF_DAY): Tally(HALF_DAY.event, 1)}
    for hours, message in (
        (984, "needs at least 1000 h of records, in pieces of 24 h"),
        (1200, "needs at least two classes of leads with"),
    ):
        records = rain[2017][:hours]
        refusal(fit_skill, tallies, 0.0, records, lambda _: None, match=f"^--fit: {message}")


def test_the_command_writes_a_skill(tmp_path: Path, rain: dict[int, Array]) -> None:
    """It can be read, has the records' climate, and is not as good as ``real``."""
    season = rain[2017][:2208]
    hours = enumerate(season.tolist())
    (tmp_path / "records.csv").write_text("time,precipitation [mm/h]\n" + "".join(
        f"{(begin(2017) + timedelta(hours=hour)).isoformat()},{mm}\n" for hour, mm in hours
    ))
    done = run_command(
        "verify", "errors", "--forecast-skill", "much_worse", "--weather", "records.csv",
        "--sums", "12", "--events", "3", "--horizon", "48", "--fit", "mine.yaml",
        cwd=tmp_path, env=dict(os.environ),
    )
    assert done.returncode == 0, done.stderr
    assert "written: mine.yaml" in done.stdout
    skill = read_skill(str(tmp_path / "mine.yaml"))
    assert skill.climate.wet_share == pytest.approx((season > 0).mean(), rel=1e-4)
    assert skill.errors.persistence == REAL.errors.persistence
    sample = Sample(skill.climate, [season], [HALF_DAY])
    got, real = (sample.scores(errors, 36.0)[0] for errors in (skill.errors, REAL.errors))
    assert got[0] < real[0] - 0.05
