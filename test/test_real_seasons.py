"""Parts of the campaign of real seasons: halves that share no storm, and intervals."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from real_seasons.ideal import squared
from real_seasons.inputs import AUTUMN, BLOCK_WEEKS, SEASON, SERVICES, YEAR, Inputs
from real_seasons.least import least_possible
from real_seasons.runs import (
    CROSSED,
    NO_RAIN,
    ONOFF_NAME,
    PERFECT,
    SCALED_BY_ITSELF,
    Case,
    build,
)
from real_seasons.tables import DRIER, OVER_ONOFF, WETTER, Row, interval, rows, write

from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.skill import REAL, read_skill
from greenroof_ros.model.look_ahead import growing_steps

HOUR = timedelta(hours=1)
# Share of the rain that GFS forecasts, in the season's wetter half and otherwise. The others are
# right.
WETTER_SHARE, DRIER_SHARE = 0.4, 0.8


def share_of_gfs(time: datetime) -> float:
    """Return the share of an hour's rain. Heavy months are in every other block of four weeks."""
    return WETTER_SHARE if (time - SEASON.start).days // 28 in (0, 2, 4) else DRIER_SHARE


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
    for source, name in SERVICES.items():
        shares = [  # a service's hours end at their time
            share_of_gfs(begin + (hour - 1) * HOUR) if source == "GFS" else 1.0
            for hour in range(hours)
        ]
        forecast = "\n".join(
            f"{at},{','.join([f'{share * float(mm):g}'] * 5)}"
            for at, mm, share in zip(stamps, rain, shares, strict=True)
        )
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


def test_least_possible(inputs: Inputs, tmp_path: Path) -> None:
    """From 15 m3, the bound, to 18 m3, a plan, of the 60 m3 that are on/off's."""
    onoff = Case("paper", SEASON, ONOFF_NAME)
    file = onoff.file(tmp_path).with_name("least_possible.json")
    file.parent.mkdir()
    file.write_text(json.dumps({"bound_m3": 15, "plan_m3": 18}))
    metrics = {"total_deviation_m3": 60.0, "mean_deviation_mm": 4.0}
    share, mean = least_possible("paper", {onoff: {"metrics": metrics}}, inputs, tmp_path)
    assert share[-4:] == ("over on/off", 0.3, 0.25, 0.3)
    assert mean[-4:] == ("mean deviation (mm)", pytest.approx(1.2), 1.0, pytest.approx(1.2))


def test_what_a_forecast_gains(inputs: Inputs) -> None:
    """Perfect forecasts save 30 of 90 m3 that a forecast of no rain costs; this saves 10 of them.

    The hour as forecast costs a tenth more. All weeks are alike, so that no interval has a width.
    """
    def result(weekly: float) -> dict[str, Any]:
        return {"weeks": [weekly] * AUTUMN.weeks}

    case = Case("paper", AUTUMN, "three")
    made = list(rows({
        Case("paper", AUTUMN, ONOFF_NAME): result(10.0),
        Case("paper", AUTUMN, NO_RAIN): result(9.0),
        Case("paper", AUTUMN, PERFECT): result(6.0),
        case: result(8.0),
        replace(case, hour=False): result(8.8),
    }, inputs, "paper", AUTUMN))
    of_three = {(row.form, row.measure): row[-3:] for row in made if row.forecast == "three"}
    for key, value in (
        (("as issued", "over on/off"), 0.8), (("as issued", "over no rain"), 8 / 9),
        (("as issued", "gained"), 1 / 3), (("the hour as forecast", "over the hour known"), 1.1),
    ):
        assert of_three[key] == pytest.approx((value, value, value))


def test_halves_are_named(inputs: Inputs) -> None:
    """September is wetter than October: half of on/off's deviation in September, 0.9 in October."""
    made = rows({
        Case("paper", AUTUMN, ONOFF_NAME): {"weeks": [10.0] * 9},
        Case("paper", AUTUMN, "three", CROSSED): {"weeks": [5.0] * 4 + [9.0] * 5},
    }, inputs, "paper", AUTUMN)
    ratios = {
        row.weeks: row.value for row in made if (row.form, row.measure) == (CROSSED, OVER_ONOFF)
    }
    assert ratios == {WETTER: pytest.approx(0.5), DRIER: pytest.approx(0.9)}


@pytest.mark.parametrize("own_half", [True, False])
def test_a_scaled_half_has_the_gauges_water(inputs: Inputs, own_half: bool) -> None:
    """Or what the other half's factor makes of it. Before the season the wetter half's factor.

    The sums may differ by an hour at either end, since the service's hours end at their time.
    """
    scaled = inputs.scaled("measured", "GFS", SEASON, own_half)
    for issue, right in zip(scaled.issues, inputs.issued["GEM"].issues, strict=True):
        assert issue.issued == right.issued
        if issue.issued >= SEASON.start + SEASON.hours * HOUR:
            break
        wetter = issue.issued < SEASON.start or (
            (share_of_gfs(issue.issued) == WETTER_SHARE) is own_half
        )
        factor = 1 / (WETTER_SHARE if wetter else DRIER_SHARE)
        shares = [share_of_gfs(issue.issued + hour * HOUR) for hour in range(issue.hours)]
        np.testing.assert_allclose(
            issue.rain, factor * np.array(shares) * right.rain[:, : issue.hours], rtol=3e-3
        )


def test_factors_of_the_halves_are_stored(inputs: Inputs) -> None:
    """The gauge's rain over the forecast's, each beside the name of its half."""
    roof = "measured, target 39 mm"
    case = Case(roof, SEASON, "GFS", SCALED_BY_ITSELF)
    made = rows({case: {"weeks": [1.0] * SEASON.weeks}}, inputs, roof, SEASON)
    assert {row.weeks: row.value for row in made} == {
        DRIER: pytest.approx(1 / DRIER_SHARE, rel=3e-3),
        WETTER: pytest.approx(1 / WETTER_SHARE, rel=3e-3),
    }


def test_a_file_has_all_digits(tmp_path: Path) -> None:
    """A number reads as it was; without an interval the last two cells are empty."""
    write([Row("paper", "May", "all weeks", "GEM", "dressed", "bias", 1 / 3)], tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines()[1] == (
        "paper,May,all weeks,GEM,dressed,bias,0.3333333333333333,,"
    )
