"""Skills that are fitted: errors to scores, and the command that writes one."""

from __future__ import annotations

import csv
import os
import subprocess
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from forecast_skill.figures import TIP, begin, days_ahead, figures, seasons
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.forecast.skill import read_skill
from greenroof_ros.verification.fitting import Sample, fit_climate, fit_errors, skill_text
from greenroof_ros.verification.pairs import Sum

Array = NDArray[np.float64]
HALF_DAY = Sum(12, 3.0)
REAL = read_skill("real")


@pytest.fixture(scope="module")
def rain() -> dict[int, Array]:
    """Toronto's seasons, mm in each hour."""
    return seasons()


def test_scores_of_a_sample_are_those_of_the_model(rain: dict[int, Array]) -> None:
    """Forecasts of one lead at a stroke are as good as those that the model issues.

    r, POD and FAR of half days, by another count, over eleven seasons and two seeds, of each of
    which they scatter by some 0.03.
    """
    sample = Sample(REAL.climate, list(rain.values()), [HALF_DAY])
    observed = np.concatenate(list(rain.values()))
    found: dict[int, list[Array]] = {1: [], 2: []}
    for seed in range(2):
        ahead = [days_ahead(year, season, REAL, seed, (1, 2)) for year, season in rain.items()]
        for day, of_day in found.items():
            issued = np.concatenate([season[day][0] for season in ahead])
            of_day.append(figures(issued, observed)[2, :3])
    for day, of_day in found.items():
        (got,) = sample.scores(REAL.errors, 24 * day + 2.5)
        assert got == pytest.approx(np.mean(of_day, axis=0), abs=0.05)


def test_errors_are_found_again(rain: dict[int, Array]) -> None:
    """Scores of forecasts of another skill lead to errors with these scores."""
    spells = [rain[year] for year in (2015, 2017, 2019)]
    sample = Sample(fit_climate(spells, TIP), spells, [HALF_DAY])
    worse = replace(REAL.times_lead(3.0).errors, wetness=0.1)
    goals = {lead: sample.scores(worse, lead)[None] for lead in (26.5, 74.5)}
    before = [np.abs(sample.scores(REAL.errors, lead) - goal[0]) for lead, goal in goals.items()]
    assert np.max(before) > 0.1
    found = fit_errors(sample, goals, REAL.errors, lambda _: None)
    for lead, (goal,) in goals.items():
        assert sample.scores(found, lead) == pytest.approx(goal, abs=0.02)
    assert found.persistence == REAL.errors.persistence


def test_lags_without_two_wet_hours(rain: dict[int, Array]) -> None:
    """Of a short and dry record some lags say nothing; the others still give its climate.

    A shower of three hours each 50, from four to 24 hours apart are none: a memory of few hours.
    """
    showers = np.zeros(1000)
    for hour in range(3):
        showers[hour::50] = 1.0 + hour
    fitted = fit_climate([showers], TIP)
    assert fitted.wet_share == pytest.approx(0.06)
    assert 1 < fitted.memory < 12
    # A shower of one hour each 50 has no such pair at all.
    with pytest.raises(ConfigurationError, match=r"^--fit: needs records with more rain"):
        fit_climate([np.where(np.arange(1000) % 50 == 0, 1.0, 0.0)], TIP)
    windows = [season[begin : begin + 1080] for season in rain.values() for begin in (0, 1800)]
    lonely = [
        window for window in windows
        if any(not ((window > 0)[:-lag] & (window > 0)[lag:]).any() for lag in (12, 18, 24))
    ]
    assert lonely
    for window in lonely[:3]:
        assert fit_climate([window], TIP).wet_share == pytest.approx((window > 0).mean())


def test_a_spring_gives_a_file_that_is_read(tmp_path: Path, rain: dict[int, Array]) -> None:
    """Of 45 days of 2021 the likeliest growth is less than a file may have."""
    climate = fit_climate([rain[2021][:1080]], TIP)
    file = tmp_path / "spring.yaml"
    file.write_text(skill_text(replace(REAL, climate=climate), "a spring"))
    assert read_skill(str(file)).climate.growth == pytest.approx(climate.growth, rel=1e-4)


@pytest.mark.parametrize("dry_hours", [50, 0, 1000])
def test_rain_in_more_or_fewer_hours_than_a_file_may_have(dry_hours: int) -> None:
    """In 95 %, in all and in none of the hours: refused, as the file would be."""
    hours = np.arange(1000)
    rain = np.where(hours % (1000 // dry_hours) == 0, 0.0, 1.0) if dry_hours else np.ones(1000)
    with pytest.raises(ConfigurationError, match=r"^--fit: needs records with rain in 0.01% to"):
        fit_climate([rain], TIP)


def write_records(directory: Path, rain: dict[int, Array], hours: int) -> Path:
    """Write the beginning of a season as a weather file."""
    path = directory / "records.csv"
    with path.open("w", newline="") as stream:
        rows = csv.writer(stream, lineterminator="\n")
        rows.writerow(["time", "precipitation [mm/h]", "given evapotranspiration [mm/day]"])
        for hour, depth in enumerate(rain[2017][:hours]):
            rows.writerow([(begin(2017) + hour * timedelta(hours=1)).isoformat(), depth, 2.0])
    return path


def verify(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
    return run_command("verify", *arguments, cwd=directory, env=dict(os.environ))


def test_the_command_writes_a_skill(tmp_path: Path, rain: dict[int, Array]) -> None:
    """One that is read as any other, of the records' climate and not so good as ``real``."""
    write_records(tmp_path, rain, 4416)
    done = verify(
        tmp_path, "errors", "--forecast-skill", "much_worse", "--weather", "records.csv",
        "--sums", "12", "--events", "3", "--horizon", "72", "--fit", "mine.yaml",
    )
    assert done.returncode == 0, done.stderr
    assert "written: mine.yaml" in done.stdout
    skill = read_skill(str(tmp_path / "mine.yaml"))
    season = rain[2017]
    assert skill.climate.wet_share == pytest.approx((season > 0).mean(), rel=1e-4)
    assert skill.errors.persistence == REAL.errors.persistence
    sample = Sample(skill.climate, [season], [HALF_DAY])
    got, real = (sample.scores(errors, 60.0)[0] for errors in (skill.errors, REAL.errors))
    assert got[0] < real[0] - 0.05


def test_one_class_of_leads_says_nothing_of_errors(tmp_path: Path, rain: dict[int, Array]) -> None:
    """One line that says what would be right, exit code 2, and nothing written."""
    write_records(tmp_path, rain, 1200)
    done = verify(
        tmp_path, "errors", "--weather", "records.csv", "--fit", "mine.yaml", "--horizon", "24",
        "--sums", "1", "--events", "1",
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: --fit: needs forecasts of two classes of leads or more")
    assert not (tmp_path / "mine.yaml").exists()
