"""What a record contains is shown, so that a person sees a wrong unit or a wrong clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from places import CONFIG

from greenroof_ros.site.file import read_site
from greenroof_ros.weather.evapotranspiration import sun_height
from greenroof_ros.weather.read import read_measured
from greenroof_ros.weather.records import Records, add_dew_point
from greenroof_ros.weather.summary import summarize

SITE = read_site(CONFIG / "site.yaml")
SEASON = CONFIG / "weather" / "toronto_2021.csv"


def season() -> Records:
    """May to October 2021 at Toronto, with a made-up radiation."""
    records = read_measured([SEASON], SITE)
    seconds = round(records.first.timestamp()) + 3600 * np.arange(records.hours) + 1800
    sun = 1000 * sun_height(43.63, seconds, -79.4) * (0.5 + 0.5 * np.sin(seconds / 90_000))
    return replace(records, values={**records.values, "solar radiation": np.maximum(sun, 0)})


def test_a_right_record_has_no_note() -> None:
    """The figures are those of Environment Canada's file: 402.3 mm, 15.4 mm in the wettest hour."""
    records = season()
    summary = summarize(records, SITE)
    assert summary["notes"] == []
    rain = np.nan_to_num(records.values["precipitation"])
    assert summary["rain"]["total"] == pytest.approx(rain.sum())
    assert summary["rain"]["wettest_hour"] == 15.4


def test_known_hours_by_hand() -> None:
    """Two days of rain, of which one hour is missing and another was filled."""
    rain = np.zeros(48)
    rain[[3, 4, 30]] = 2.0, 3.0, 4.0
    rain[7] = np.nan
    records = Records(
        (Path("gauge.csv"),), datetime(2024, 6, 1, tzinfo=timezone(timedelta(hours=-5))),
        {"precipitation": rain, "temperature": np.full(48, 20.0)},
        filled={"temperature": np.arange(48) == 0},
    )
    summary = summarize(records, SITE)
    assert summary["rain"] | {"longest_dry_days": 0} == {
        "total": 9.0, "wet_hours": 3, "wettest_hour": 4.0,
        "wettest_hour_at": "2024-06-02 06:00-05:00", "wettest_day": 5.0,
        "wettest_day_at": "2024-06-01", "longest_dry_days": 0,
        "months": {"2024-06": 9.0}, "years": {"2024": 9.0},
    }
    missing = {name: about["missing"] for name, about in summary["quantities"].items()}
    assert missing == {"precipitation": 1, "temperature": 1}


Values = dict[str, np.ndarray]


def scaled(quantity: str, by: float, add: float = 0.0) -> Callable[[Values], Values]:
    return lambda values: {quantity: values[quantity] * by + add}


# What is wrong with a record, and the statistic whose note names it. The dew point of a fraction
# for per cent is that of 1 % of the humidity.
MISTAKES = {
    "mm in 5 min as mm/h": (scaled("precipitation", 1 / 12), "mean of wet hours"),
    "inches as mm": (scaled("precipitation", 1 / 25.4), "mean of wet hours"),
    "mm/h as mm in 5 min": (scaled("precipitation", 12), "mean of wet hours"),
    "a running total": (
        lambda values: {"precipitation": np.nancumsum(values["precipitation"])}, "wet hours",
    ),
    "kW/m2": (scaled("solar radiation", 1e-3), "clearest hour"),
    "MJ/m2": (scaled("solar radiation", 3.6e-3), "clearest hour"),
    "daily means": (lambda values: {"solar radiation": np.repeat(
        values["solar radiation"].reshape(-1, 24).mean(axis=1), 24)}, "radiation at night"),
    "degF": (scaled("temperature", 1.8, 32), "mean temperature"),
    "m/s as km/h": (scaled("wind speed", 1 / 8), "mean wind"),
    "km/h as m/s": (scaled("wind speed", 3.6), "mean wind"),
    "a fraction for per cent": (lambda values: add_dew_point({
        "temperature": values["temperature"],
        "relative humidity": np.full(len(values["temperature"]), 0.6),
    }), "highest relative humidity: 1 %"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_noted(name: str) -> None:
    change, statistic = MISTAKES[name]
    records = season()
    values = {**records.values, **change(records.values)}
    notes = summarize(replace(records, values=values), SITE)["notes"]
    assert any(note.startswith(statistic) for note in notes)


@pytest.mark.parametrize(("hours", "statistic"), [
    (-5, "middle of the sun"), (1, "middle of the sun"), (7, "warmest hour"),
])
def test_wrong_clocks_are_noted(hours: int, statistic: str) -> None:
    """UTC for local time, local time for UTC, daylight saving time, the end for the start."""
    records = season()
    wrong = replace(records, first=records.first + timedelta(hours=hours))
    notes = summarize(wrong, SITE)["notes"]
    assert any(note.startswith(f"{statistic}: ") for note in notes)


def test_heavy_rain_in_minutes_is_noted() -> None:
    """45 mm in five minutes are 540 mm/h; 41 mm are 492 mm/h."""
    records = season()
    for amount, is_noted in ((45.0, True), (41.0, False)):
        minutes = np.zeros((records.hours, 60))
        minutes[7, :5] = 12 * amount
        notes = summarize(replace(records, minutes=minutes), SITE)["notes"]
        assert is_noted == any(note.startswith("heaviest rain: 540 mm/h") for note in notes)


def test_missing_days_are_not_dry() -> None:
    """A record of 80 days, of which 75 are missing."""
    rain = np.zeros(80 * 24)
    rain[48:77 * 24] = np.nan
    records = Records((Path("gauge.csv"),), season().first, {"precipitation": rain})
    assert summarize(records, SITE)["rain"]["longest_dry_days"] == 3
