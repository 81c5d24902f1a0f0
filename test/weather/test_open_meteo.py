"""Answers of Open-Meteo in JSON, as past weather."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from places import CONFIG, refusal

from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_measured

TORONTO = read_site(CONFIG / "site.yaml")


def answer() -> dict[str, Any]:
    """Return six hours: rain 0.1, 0.2, ... mm and radiation 100, 110, ... W/m2 in the hour before.

    Temperature, 20, 20.5, ... degC, is that at the time.
    """
    hours = range(6)
    return {
        "latitude": 43.62, "longitude": -79.42, "utc_offset_seconds": -18000,
        "hourly_units": {
            "precipitation": "mm", "temperature_2m": "°C", "shortwave_radiation": "W/m²",
            "relative_humidity_2m": "%",
        },
        "hourly": {
            "time": [f"2021-07-07T{10 + hour}:00" for hour in hours],
            "precipitation": [(1 + hour) / 10 for hour in hours],
            "temperature_2m": [20 + hour / 2 for hour in hours],
            "shortwave_radiation": [100 + 10 * hour for hour in hours],
            "relative_humidity_2m": 6 * [100],
        },
    }


def read(directory: Path, content: dict[str, Any]) -> Any:
    file = directory / "answer.json"
    file.write_text(json.dumps(content))
    return read_measured([file], TORONTO)


def test_rain_and_radiation_are_of_the_hour_before(tmp_path: Path) -> None:
    """The value at 11:00 fell from 10:00 to 11:00; temperature is that at its time."""
    records = read(tmp_path, answer())
    assert records.first.isoformat() == "2021-07-07T10:00:00-05:00"
    assert records.values["precipitation"].tolist() == [0.2, 0.3, 0.4, 0.5, 0.6]
    assert records.values["solar radiation"].tolist() == [110, 120, 130, 140, 150]
    assert records.values["temperature"].tolist() == [20, 20.5, 21, 21.5, 22]
    assert records.values["dew point"].tolist() == pytest.approx([20, 20.5, 21, 21.5, 22])
    assert records.rain_kind == "reanalysis" and records.wind_height == 10


@pytest.mark.parametrize(("keys", "value", "reason"), [
    (("latitude",), 44.2, "latitude = 44.2: must be within 0.5 degrees"),
    (("longitude",), 279.0, "longitude = 279.0"),
    (("hourly", "precipitation"), [0.1], "hourly.precipitation"),
    (("hourly", "precipitation"), ["a"] * 6, "row 0: precipitation = 'a'"),
    (("hourly_units", "temperature_2m"), "m", "'temperature_2m': the unit"),
    (("hourly", "time"), ["2021-07-07T10:00"] * 6, "row 1: time = '2021-07-07T10:00'"),
    (("hourly",), {"time": ["2021-07-07T10:00"]}, "hourly: must contain precipitation"),
    (("hourly",), None, "hourly"),
])
def test_refused_answers(tmp_path: Path, keys: tuple[str, ...], value: Any, reason: str) -> None:
    content = answer()
    place = content
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    assert reason in refusal(read, tmp_path, content)
