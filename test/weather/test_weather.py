"""Hourly weather files and what a run reads from them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from paper import PAPER_SITE
from places import DATA
from refusals import refusal

from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.times import parse_time
from greenroof_ros.forecast.resampling import PerfectForecast
from greenroof_ros.weather.reading import read_weather
from greenroof_ros.weather.series import WeatherSeries

HEADER = "time,precipitation [mm/h],made up evapotranspiration [mm/day]"
# A comment line, the header in line 2, and three hours in lines 3 to 5.
HOURS = [
    "2021-07-07T03:00-05:00,0.2,3.44779366",
    "2021-07-07T04:00-05:00,3.0,1.22675507",
    "2021-07-07T05:00-05:00,0.0,2.4",
]


def write(directory: Path, *lines: str, header: str = HEADER) -> Path:
    """Write a weather file."""
    path = directory / "weather.csv"
    path.write_text("\n".join(["# Nowhere", header, *lines]) + "\n")
    return path


def test_packaged_weather_is_the_72_hours() -> None:
    """Every hour's observations, and the evapotranspiration of the authors' published code."""
    path = shared_directory() / "config" / "weather" / "toronto_2021-07.csv"
    columns = {
        "time": "hour_starting",
        "precipitation [mm/h]": "rain_mm",
        "published evapotranspiration [mm/day]": "published_et_mm_per_day",
        "temperature [degC]": "temperature_degC",
        "dew point [degC]": "dew_point_degC",
        "wind speed [km/h]": "wind_km_h",
        "station pressure [kPa]": "station_pressure_kPa",
    }
    with path.open() as file:
        packaged = list(csv.DictReader(line for line in file if not line.startswith("#")))
    with (DATA / "toronto_hours.csv").open() as file:
        source = list(csv.DictReader(file))
    assert len(packaged) == 72
    assert packaged == [{ours: row[theirs] for ours, theirs in columns.items()} for row in source]

    weather = read_weather([path], PAPER_SITE)
    assert weather.precipitation.tolist() == [float(row["rain_mm"]) for row in source]
    published = [float(row["published_et_mm_per_day"]) for row in source]
    assert weather.evapotranspiration.tolist() == published
    assert weather.method == "published"
    assert weather.first.isoformat() == "2021-07-07T00:00:00-05:00"
    assert weather.end.isoformat() == "2021-07-10T00:00:00-05:00"


@pytest.mark.parametrize(
    ("steps", "repeats"), [(3 * 3600, True), (3 * 3600 - 9, True), (3 * 3600 - 10, False)]
)
def test_last_record_is_repeated_past_the_end(tmp_path: Path, steps: int, repeats: bool) -> None:
    """The window of tick N reaches to tick N + 9; the records end with tick 10,799."""
    hours = [*HOURS[:2], "2021-07-07T05:00-05:00,7.2,2.4"]
    weather = read_weather([write(tmp_path, *hours)], PAPER_SITE)
    run = WeatherSeries(weather, PAPER_SITE, weather.first, steps)
    window = PerfectForecast(run, 10).precipitation(steps)
    assert list(window) == pytest.approx([2e-6] * 10, rel=1e-15)
    end = parse_time("2021-07-07T06:00-05:00")
    assert run.repeats_from == (end if repeats else None)


@pytest.mark.parametrize(
    ("start", "steps"),
    [
        ("2021-07-07T02:59:59-05:00", 10), ("2021-07-07T03:00-04:00", 10),
        ("2021-07-07T03:00-05:00", 10801),
    ],
)
def test_run_outside_the_records(tmp_path: Path, start: str, steps: int) -> None:
    """A second too early, an hour too early by its offset, a second too long."""
    weather = read_weather([write(tmp_path, *HOURS)], PAPER_SITE)
    assert refusal(WeatherSeries, weather, PAPER_SITE, parse_time(start), steps).startswith(
        f"{tmp_path / 'weather.csv'}: has records from 2021-07-07T03:00-05:00 to "
        "2021-07-07T06:00-05:00, but the run starts at "
    )


def test_order_of_columns_and_further_ones(tmp_path: Path) -> None:
    """Columns are found by name; comments and empty lines may be anywhere."""
    header = "time, fao56 evapotranspiration [mm/day],dew point [degC],precipitation [mm/h]"
    path = write(tmp_path, "", "2021-07-07T03:00Z,1.5,-3.5,0.25", "# gauge read", header=header)
    weather = read_weather([path], PAPER_SITE)
    assert (weather.precipitation.tolist(), weather.evapotranspiration.tolist()) == ([0.25], [1.5])
    assert weather.method == "fao56"
    path = write(tmp_path, HOURS[0], header=HEADER.replace("made up ", ""))
    unnamed = read_weather([path], PAPER_SITE)
    assert unnamed.method == "unnamed"


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ("date" + HEADER[4:], "'date': the first column must be 'time'"),
        (HEADER + ",humidity [%]", "'humidity [%]': is not a known column; choose from prec"),
        (HEADER + ",temperature", "'temperature': a column must be named like"),
        (HEADER.replace("mm/h]", "mm]"), "'precipitation [mm]': the unit of precipitation must be"),
        (HEADER + ",b evapotranspiration [mm/day]", "'b evapotranspiration [mm/day]': there is a"),
        ("time,fao56 evapotranspiration [mm/day]", "there must be a column 'precipitation [mm/h]'"),
    ],
)
def test_refused_headers(tmp_path: Path, header: str, reason: str) -> None:
    """The error has file, line and cell, and what would be right."""
    columns = header.count(",") + 1
    hours = [",".join([*hour.split(","), "1"][:columns]) for hour in HOURS]
    path = write(tmp_path, *hours, header=header)
    assert refusal(read_weather, [path], PAPER_SITE).startswith(f"{path}, line 2: {reason}")


def test_a_rain_gauge_alone(tmp_path: Path) -> None:
    """Some need only rain, and an empty cell is a missing hour."""
    path = write(
        tmp_path, "2021-07-07T03:00-05:00,3.0", "2021-07-07T04:00-05:00,",
        "2021-07-07T05:00-05:00,0.2", header="time,precipitation [mm/h]",
    )
    gauge = read_weather([path], PAPER_SITE, rain_only=True)
    assert gauge.precipitation[[0, 2]].tolist() == [3.0, 0.2]
    assert np.isnan(gauge.evapotranspiration).all()
    refusal(read_weather, [path], PAPER_SITE, match="has no column 'evapotranspiration")
