"""Rules of plausibility: right records break none, and each finds what is wrong with others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from places import CONFIG, DATA
from twins import DAY, TWIN, a_record, record_of, record_rows

from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.analysis.calibration.record import select_months
from greenroof_ros.analysis.calibration.simulation import simulate
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.formats.rules import check_hours, check_steps, find_outlying_rain
from greenroof_ros.analysis.calibration.step_record import StepRecord
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_weather
from greenroof_ros.weather.series import FILL, WeatherSeries

TORONTO = read_site(CONFIG / "site.yaml")
LST = timezone(timedelta(hours=-5))
Change = Callable[[np.ndarray, int], np.ndarray]
"""changes a column, given the number of its steps in a day"""


@cache
def twin(days: int, hours: int = 0, *, gaps: bool = False) -> StepRecord:
    """Return the record of a twin; with hours, its sums over this many hours."""
    return record_of(record_rows(TWIN, days, 1, gaps=gaps), hours)


def scaled(factor: float) -> Change:
    return lambda values, day: factor * values


def shifted(hours: float) -> Change:
    return lambda values, day: np.roll(values, round(hours * day / 24))


def fixed(value: float, first: float, end: float = np.inf) -> Change:
    """Return a change to a constant value from a day on."""
    def changed(values: np.ndarray, day: int) -> np.ndarray:
        at = np.arange(len(values)) / day
        return np.where((at >= first) & (at < end), value, values)
    return changed


def changed(record: StepRecord, column: str, change: Change) -> StepRecord:
    day = round(86400 / record.step_s)
    return replace(record, **{column: change(getattr(record, column), day)})


UNIT, UNITS, BALANCE, LATE, EARLY, STUCK, BLOCKED = (
    "is the unit", "are the units of this column", "are the units", "after the rain falls",
    "before the rain falls", "stuck or defective", "gauge blocked",
)


def failed(record: StepRecord, column: str, words: str) -> bool:
    """Whether there is a warning or a refusal about a column, with these words."""
    try:
        texts = check_steps(record, TWIN)
    except ConfigurationError as error:
        texts = [error.wrong]
    return any(text.startswith(column) and words in text.lower() for text in texts)


# --- records --------------------------------------------------------------------------------------

# For five-minute steps of a month, and for longer sums of a season: the columns present, the one
# that is changed and how, and the check that fails with its column.
BOTH, LEVEL = ("runoff", "level"), ("level",)
OF_A_MONTH: dict[str, tuple[tuple[str, ...], str, Change, tuple[str, str]]] = {
    "rain of a day": (BOTH, "rain", scaled(24), ("rain", UNIT)),
    "rain of the hour": (BOTH, "rain", scaled(12), ("rain", BALANCE)),
    "level in cm": (BOTH, "level", scaled(100), ("level", UNITS)),
    "runoff in m": (BOTH, "runoff", scaled(1e-4), ("runoff", UNIT)),
    "stuck": (BOTH, "runoff", fixed(0.05, 5), ("runoff", STUCK)),
    "early": (BOTH, "runoff", shifted(-1), ("runoff", EARLY)),
    "late": (BOTH, "runoff", shifted(8), ("runoff", LATE)),
    "early level": (LEVEL, "level", shifted(-1), ("level", EARLY)),
    "late level": (LEVEL, "level", shifted(24), ("level", LATE)),
}
OF_A_SEASON: dict[str, tuple[tuple[str, ...], str, Change, tuple[str, str]]] = {
    "dead": (BOTH, "runoff", scaled(0.0), ("runoff", STUCK)),
    "runoff too large": (BOTH, "runoff", scaled(10), ("runoff", BALANCE)),
    "level too small": (LEVEL, "level", scaled(0.01), ("level", UNITS)),
    "level too large": (BOTH, "level", scaled(10), ("level", UNITS)),
    "stuck level": (BOTH, "level", fixed(0.03, 20), ("level", STUCK)),
    "stuck rain": (BOTH, "rain", fixed(0.3, 12, 20), ("rain", STUCK)),
    "blocked": (BOTH, "rain", fixed(0.0, 30), ("rain", BLOCKED)),
    "early": (BOTH, "runoff", shifted(-24), ("runoff", EARLY)),
    "early level": (LEVEL, "level", shifted(-24), ("level", EARLY)),
}


@pytest.mark.parametrize("hours", [0, 1, 24])
def test_right_records_have_nothing_wrong_and_wrong_ones_have(hours: int) -> None:
    record = twin(100, hours) if hours else twin(60, gaps=True)
    for right in (record, replace(record, runoff=None)):
        assert check_steps(right, TWIN) == []
    seen = record if hours else twin(30)
    for name, (there, *change, expected) in (OF_A_SEASON if hours else OF_A_MONTH).items():
        alone = seen if "runoff" in there else replace(seen, runoff=None)
        assert failed(changed(alone, *change), *expected), name


def test_what_is_wrong_in_other_months_does_not_count() -> None:
    """A flow meter that is stuck in April; May to July are good."""
    record = changed(twin(100, 1), "runoff", fixed(0.05, 0, 30))
    assert failed(record, "runoff", STUCK)
    assert check_steps(record.select(select_months(record, "5-7")), TWIN) == []


def test_a_day_with_too_much_evapotranspiration_is_found() -> None:
    """48 mm a day, as of 4 mm that are read as 12 times as much; the column is the user's."""
    steps = 12 * DAY
    record = a_record(
        np.tile([2.0] + [0.0] * (DAY - 1), 12), level=np.linspace(0, 0.01, steps),
        reference=np.full(steps, 48 / DAY),
    )
    assert check_steps(record, TWIN) == []
    assert failed(replace(record, reference_column="ET"), "ET", UNITS)


@pytest.mark.parametrize(("hours", "stuck"), [(12, False), (24, True)])
def test_a_stuck_gauge_is_found_by_a_run_and_a_calibration(
    tmp_path: Path, hours: int, stuck: bool
) -> None:
    """The same sentence; but models interpolate, and have the same 0.9 mm in twelve hours."""
    file = tmp_path / "roof.csv"
    file.write_text("time,rain [mm],level [m],reference evapotranspiration [mm]\n" + "".join(
        f"{datetime(2021, 6, 1, tzinfo=LST) + timedelta(hours=hour)},"
        f"{0.9 if 200 <= hour < 200 + hours else hour % 50 // 48},{0.02 + hour / 1e5:.5f},0.1\n"
        for hour in range(480)
    ))
    weather = read_weather([file], TORONTO)
    run = WeatherSeries(weather, replace(TORONTO, tau=600.0), weather.first, 450 * 6)
    record = read_csv_record(file, TORONTO)
    for sentences in (run.suspicious, check_steps(record, TORONTO)):
        found = [sentence for sentence in sentences if "stuck or defective" in sentence]
        assert [sentence[:41] for sentence in found] == (
            ["rain is 0.9 mm for 24 h from 2021-06-09 0"] if stuck else []
        )
    unit = replace(record, rain=100 * record.rain)
    sentences = check_steps(unit, TORONTO)
    assert any(each.startswith("rain is ") and UNIT in each.lower() for each in sentences)


# --- roofs off which nothing runs -----------------------------------------------------------------


def test_a_field_capacity_soil_in_dry_weeks_is_right() -> None:
    """The roof at Neubrandenburg, 45 days with 39 mm of rain and no runoff.

    With three times the rain, 116 mm, the soil of 108 mm could not hold it.
    """
    site = read_site(CONFIG / "site_neubrandenburg.yaml")
    file = DATA / "neubrandenburg_dry.csv"
    record = read_csv_record(file, replace(site, utc_offset=1.0))
    assert np.nansum(record.rain) == pytest.approx(38.61)
    assert np.nansum(record.runoff) == 0
    assert check_steps(record, site) == []
    (dead,) = check_steps(replace(record, rain=3 * record.rain), site)
    assert dead.startswith("runoff is 0 mm") and STUCK in dead


def test_gaps_do_not_hide_a_dead_flow_meter() -> None:
    """113 mm in all steps with readings, at most 63 mm without a gap; the soil is 100 mm deep."""
    record = changed(twin(60, gaps=True), "runoff", scaled(0.0))
    assert failed(record, "runoff", STUCK)
    assert 100 < record.rain[~np.isnan(record.runoff)].sum() < 120
    without = np.where(np.cumsum(np.where(np.isnan(record.runoff), 0.0, record.rain)) > 99.0,
                       np.nan, record.runoff)
    assert check_steps(replace(record, runoff=without), TWIN) == []


def watered_roof(days: int, mm_a_day: float = 4.25) -> StepRecord:
    """A roof in a dry July, watered each morning with its evapotranspiration, 0.85 of 5 mm.

    Two showers of 4 and 6 mm; the meter shows no flow below 0.06 mm in 5 min.
    """
    step = np.arange(days * DAY)
    rain = np.zeros(len(step))
    for day, depth in ((8, 4.0), (19, 6.0)):
        rain[day * DAY + 200:day * DAY + 212] = depth / 12
    record = a_record(
        rain, month=7, runoff=rain,
        pumped=np.where((step % DAY >= 60) & (step % DAY < 64), mm_a_day / 4, 0.0),
        reference=np.where((step % DAY >= 72) & (step % DAY < 240), 5.0 / 168, 0.0),
    )
    simulated = simulate(TWIN, record, 0.35, minimum=0.06)
    noise = np.random.default_rng(1).normal(0, 0.002, len(step))
    return replace(record, runoff=simulated.runoff, level=simulated.level + noise)


def test_a_well_kept_roof_off_which_nothing_runs_is_right() -> None:
    """27 days, 125 mm on 100 mm of soil, and no runoff: a good controller does this.

    15 mm a day exceed what a watered roof evaporates, 1.3 x 5 mm, by 230 mm in 27 days.
    """
    record = watered_roof(27)
    assert record.water.sum() == pytest.approx(124.75)
    assert not record.runoff.any()
    assert check_steps(record, TWIN) == []
    # After one watering it rains enough: 121 mm in 60 days, in which 240 mm could evaporate.
    rain = np.tile([2 / DAY] * DAY, 60)
    rainy = a_record(
        rain, month=7, runoff=np.zeros(60 * DAY), reference=2 * rain,
        pumped=np.where(np.arange(60 * DAY) == 72, 1.0, 0.0),
    )
    assert not failed(rainy, "runoff", STUCK)
    flooded = watered_roof(27, 15.0)
    (dead,) = check_steps(
        replace(flooded, runoff=np.zeros(flooded.steps), level=None), TWIN
    )
    assert dead == (
        "runoff is 0 mm for 648 h from 2021-07-01 00:00:00, although 415 mm of water arrived: is "
        "the sensor stuck or defective? Leave these cells empty"
    )
    # 720 mm in a month on 100 mm of soil: four dry months after it excuse nothing.
    wet = np.repeat([24 / DAY, 0.0, 0.0, 0.0, 0.0], 30 * DAY)
    dry = np.repeat([0.0, *[6 / DAY] * 4], 30 * DAY)
    months = a_record(
        wet, month=4, runoff=0 * wet, reference=dry, pumped=np.where(wet > 0, 0.0, 1 / DAY)
    )
    assert failed(months, "runoff", STUCK)


# --- outlying rain -----------------------------------------------------------------------------


def test_hours_that_are_hard_to_believe() -> None:
    """79.2 mm in an hour of December; not July's storms, nor March's sleet."""
    weather = read_weather([DATA / "en_climate_hourly_12-2015.csv"], TORONTO, gaps=FILL)
    (only,) = WeatherSeries(weather, TORONTO, weather.first, 29 * 86_400).suspicious
    assert only.startswith("rain is 79.2 mm at 2015-12-29T02:00-05:00")
    assert weather.precipitation.max() == 79.2
    assert WeatherSeries(weather, TORONTO, weather.first, 3 * 86_400).suspicious == []
    for month in ("07-2021", "03-2021"):
        weather = read_weather([DATA / f"en_climate_hourly_{month}.csv"], TORONTO)
        assert check_hours(weather, TORONTO, range(weather.hours)) == []


def test_factors_of_the_check() -> None:
    """Durre et al. (2010): 9 times the 95th percentile, 5 times below 0 degC; 20 wet hours.

    Usual amounts of the last days of December also count for the first of January.
    """

    def suspicious(most: float, temperature: float, wet: int = 100, last: int = 99) -> list[str]:
        # From 22 December 1 mm in each wet hour, so the percentile is 1 mm; and one other hour.
        rain = np.where(np.arange(480) < wet, 1.0, 0.0)
        rain[last] = most
        first = datetime(2021, 12, 22, tzinfo=LST)
        record = replace(a_record(rain, 3600.0), start=first)
        return [*find_outlying_rain(
            replace(record, temperature=np.full(480, temperature)), TORONTO
        )]

    assert suspicious(8.9, 0.0) == []
    assert len(suspicious(9.0, 0.0)) == 1
    assert suspicious(4.9, -0.1) == []
    assert len(suspicious(5.0, -0.1)) == 1
    assert suspicious(500.0, 5.0, wet=18) == []
    (only,) = suspicious(9.0, 0.0, last=11 * 24)
    assert only.startswith("rain is 9 mm at 2022-01-02T00:00-05:00, 9.0 times")
