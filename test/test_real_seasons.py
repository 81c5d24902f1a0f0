"""Parts of the campaign of real seasons: halves that share no storm, and intervals."""

from __future__ import annotations

import json
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from real_seasons.ideal import squared
from real_seasons.inputs import AUTUMN, BLOCK_WEEKS, SEASON, SERVICES, YEAR, Inputs
from real_seasons.runs import NO_RAIN, PERFECT, Case, build
from real_seasons.tables import interval
from real_seasons.worth import SHOWN, rows

from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.skill import REAL, read_skill
from greenroof_ros.model.look_ahead import growing_steps

HOUR = timedelta(hours=1)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """The inputs of made-up rain: a storm every third day, heavy in every other month."""
    directory = tmp_path_factory.mktemp("archives")
    begin = YEAR.start.replace(hour=0)
    hours = round(YEAR.hours) + 24
    rain = [
        f"{(3.0 if time.month % 2 else 1.0) * (hour % 72 < 4):g}"
        for hour in range(hours) for time in [begin + hour * HOUR]
    ]
    stamps = [f"{begin + hour * HOUR:%Y-%m-%d %H:%M:%S}" for hour in range(hours)]
    heads = ",".join(f"precipitation_previous_day{day}" for day in range(1, 6))
    forecast = "\n".join(f"{at},{','.join([mm] * 5)}" for at, mm in zip(stamps, rain, strict=True))
    for name in SERVICES.values():
        (directory / f"{name}_previous_runs.csv").write_text(f"datetime,{heads}\n{forecast}\n")
    observed = "\n".join(f"{at},{mm}" for at, mm in zip(stamps, rain, strict=True))
    (directory / "gauge_2024.csv").write_text(f"datetime,rain_mm\n{observed}\n")
    return Inputs(directory, tmp_path_factory.mktemp("scratch"))


def test_no_storm_is_on_both_sides(inputs: Inputs) -> None:
    """An issue is dressed only with hours of the other half, at least a week away."""
    wet = inputs.wet_weeks(YEAR)
    assert 0.3 < wet.mean() < 0.6
    changes = np.flatnonzero(np.diff(wet.astype(int))) + 1
    assert (changes % BLOCK_WEEKS == 0).all()  # whole blocks of weeks
    by = inputs.by_half("measured", "GEM", YEAR)
    for is_wet, dressing in by.items():
        assert len(dressing.issued) > 100
        for issued in dressing.issued[::7]:
            first = YEAR.start + (int(issued) - hours_since_1970(YEAR.start)) * HOUR
            last = first + (dressing.hours - 1) * HOUR
            assert inputs.is_wet(YEAR, first) is inputs.is_wet(YEAR, last) is is_wet
    for issue in inputs.issued["GEM"].issues[::97]:
        candidates = by[not inputs.is_wet(YEAR, issue.issued)]
        apart = np.abs(candidates.issued[candidates.usable(hours_since_1970(issue.issued))]
                       - hours_since_1970(issue.issued))
        assert apart.min() >= 7 * 24


@pytest.mark.parametrize("hour", [True, False])
def test_what_is_known_of_the_present_hour(inputs: Inputs, hour: bool) -> None:
    """This minute's rain; the rest of the hour has the same, or only the forecast: no rain."""
    run = build(Case("measured", AUTUMN, NO_RAIN, hour=hour), inputs)
    weather = inputs.weather["measured"]
    first = (AUTUMN.start - weather.first) // HOUR
    wet = next(number for number in range(99) if weather.precipitation[first + number])
    rain = np.atleast_2d(run.forecast.precipitation(60 * wet + 10))[0]  # 50 minutes are left
    assert rain[0] == weather.precipitation[first + wet] / 1000 / 3600
    rest = rain[1:][growing_steps(48.0)[2:] <= 50 * 60]
    assert len(rest) > 9
    np.testing.assert_allclose(rest, rain[0] if hour else 0.0, rtol=1e-12)


def test_an_ideal_ensemble_knows_what_a_single_forecast_does() -> None:
    """Given a forecast of coherence s, members have s^2 with what falls and with each other."""
    skill = read_skill(REAL)
    leads, frequencies = np.array([6.0, 24.0, 100.0]), np.array([0.0, 0.01, 0.1])
    np.testing.assert_allclose(
        squared(skill).coherence(leads, frequencies), skill.coherence(leads, frequencies) ** 2
    )


def test_intervals_of_sums_over_weeks() -> None:
    """A constant factor has an interval without width; otherwise the ratio lies within it."""
    weeks = np.random.default_rng(1).gamma(2.0, size=40)
    assert interval(0.9 * weeks, weeks) == pytest.approx((0.9, 0.9, 0.9))
    value, low, high = interval(weeks, np.ones(40))
    assert value == pytest.approx(weeks.mean())
    assert low < value < high


def test_rows_of_the_figure(inputs: Inputs, tmp_path: Path) -> None:
    """A tenth less in each week gives 0.9 without width; the least possible has a range."""
    results = {}
    for number, (source, form) in enumerate(SHOWN.values()):
        share = 1 - number / 10
        results[Case("paper", SEASON, source, form)] = {
            "weeks": [share * 20.0, share * 30.0, share * 10.0],
            "metrics": {"total_deviation_m3": share * 60.0, "mean_deviation_mm": share * 4.0},
        }
    file = Case("paper", SEASON, PERFECT, trusts=False).file(tmp_path)
    file.parent.mkdir()
    file.with_name("least_possible.json").write_text(json.dumps({"bound_m3": 15, "plan_m3": 18}))
    made = list(rows("paper", results, inputs, tmp_path))
    assert [row[2:] for row in made] == [
        ("4.000", "1.000", "1.000", "1.000"), ("3.600", "0.900", "0.900", "0.900"),
        ("3.200", "0.800", "0.800", "0.800"), ("2.800", "0.700", "0.700", "0.700"),
        ("2.400", "0.600", "0.600", "0.600"), ("1.200", "0.300", "0.250", "0.300"),
    ]
