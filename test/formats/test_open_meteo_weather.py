"""Open-Meteo's hourly archive CSV; every figure of these files is made up."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from graphs import environment
from places import CONFIG
from refusals import refusal

from greenroof_ros.common.times import parse_time
from greenroof_ros.model.site import read_site
from greenroof_ros.weather.reading import read_weather
from greenroof_ros.weather.series import WeatherSeries

TORONTO = read_site(CONFIG / "site.yaml")
PLACE = "latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation"
VALUES = "43.620384,-79.41748,77.0,-18000,America/Toronto,GMT-5"
HEADER = (
    "time,temperature_2m (°C),precipitation (mm),dew_point_2m (°C),wind_speed_10m (km/h),"
    "surface_pressure (hPa),shortwave_radiation (W/m²)"
)
# Six hours from 10:00 on: rain 0.1, 0.2, ... mm and radiation 100, 110, ... W/m2 in the hour before
# each time; 20, 20.5, ... degC at the time.
HOURS = [
    f"2021-07-07T{10 + i}:00,{20 + i / 2:.1f},{(i + 1) / 10:.2f},{12 + i / 10:.1f},{9 + i}.0,"
    f"100{i}.5,{100 + 10 * i}.0"
    for i in range(6)
]


def write(
    directory: Path, hours: list[str] = HOURS, header: str = HEADER, values: str = VALUES,
    place: str = PLACE, name: str = "open-meteo.csv",
) -> Path:
    """Write a file as the service does."""
    path = directory / name
    path.write_text("\n".join([place, values, "", header, *hours]) + "\n", encoding="utf-8")
    return path


def test_rain_and_radiation_are_of_the_hour_before(tmp_path: Path) -> None:
    """The value at 11:00 fell from 10:00 to 11:00; temperature is that at its time.

    So only the five hours 10:00 to 15:00 are complete: 9:00 has no temperature, and 15:00
    no rain. The file's offset holds although Toronto has daylight saving time in July.
    """
    weather = read_weather([write(tmp_path)], TORONTO)
    assert weather.first.isoformat() == "2021-07-07T10:00:00-05:00"
    assert weather.end.isoformat() == "2021-07-07T15:00:00-05:00"
    assert weather.precipitation.tolist() == [0.2, 0.3, 0.4, 0.5, 0.6]
    values = weather.values
    assert values["solar radiation"].tolist() == [110, 120, 130, 140, 150]
    assert values["temperature"].tolist() == [20, 20.5, 21, 21.5, 22]
    assert values["dew point"].tolist() == [12, 12.1, 12.2, 12.3, 12.4]
    assert values["wind speed"].tolist() == [9, 10, 11, 12, 13]
    # 1000.5 hPa are 100.05 kPa.
    assert values["station pressure"] == pytest.approx([100.05, 100.15, 100.25, 100.35, 100.45])
    assert weather.method == "fao56"
    assert not np.isnan(weather.evapotranspiration).any()
    assert weather.notes == (
        "precipitation and solar radiation in the files are for the hour before their time, and "
        "were moved back an hour",
    )


def test_order_of_columns_and_further_variables(tmp_path: Path) -> None:
    """Columns are found by name; unneeded ones are not read; radiation may be absent."""
    def cells(line: str) -> str:
        parts = line.split(",")[:-1]
        return ",".join([parts[0], *reversed(parts[1:]), "no number"])

    header = cells(HEADER).replace("no number", "weather_code (wmo code)")
    weather = read_weather([write(tmp_path, [cells(hour) for hour in HOURS], header)], TORONTO)
    assert weather.precipitation.tolist() == [0.2, 0.3, 0.4, 0.5, 0.6]
    assert weather.values["temperature"].tolist() == [20, 20.5, 21, 21.5, 22]
    assert weather.shifted == ("precipitation",)
    assert np.isnan(weather.evapotranspiration).all()  # needs whole days without radiation


# 20 degF are 12 below the freezing point, and 1.8 degF are 1 degC; 1 inch is 25.4 mm; 1 m/s are
# 3.6 km/h, 1 mph 1.609344 km/h, 1 kn 1.852 km/h.
@pytest.mark.parametrize(
    ("unit", "theirs", "quantity", "expected"),
    [
        ("ture_2m (°C)", "ture_2m (°F)", "temperature", -12 / 1.8),
        ("tion (mm)", "tion (inch)", "precipitation", 0.2 * 25.4),
        ("(km/h)", "(m/s)", "wind speed", 9 * 3.6),
        ("(km/h)", "(mp/h)", "wind speed", 9 * 1.609344),
        ("(km/h)", "(kn)", "wind speed", 9 * 1.852),
    ],
)
def test_units(tmp_path: Path, unit: str, theirs: str, quantity: str, expected: float) -> None:
    """All units of the service are converted."""
    path = write(tmp_path, header=HEADER.replace(unit, theirs))
    values = read_weather([path], TORONTO).values
    assert values[quantity][0] == pytest.approx(expected, rel=1e-12)


def test_missing_radiation(tmp_path: Path) -> None:
    """It is never filled; a run that needs it names the missing hour."""
    hours = [hour.replace(",120.0", ",") for hour in HOURS]
    weather = read_weather([write(tmp_path, hours)], TORONTO)
    site = replace(TORONTO, tau=600.0, M=1)
    WeatherSeries(weather, site, parse_time("2021-07-07T12:00-05:00"), 12)
    needed = r"the file lacks solar radiation at 2021-07-07T11:"
    refusal(WeatherSeries, weather, site, weather.first, 12, match=needed)


@pytest.mark.parametrize(
    ("line", "old", "new", "reason"),
    [
        (2, "-18000", "-99999", "utc_offset_seconds = '-99999': must be a number from -43200 to"),
        (2, "-79.41748", "79.4", "longitude = '79.4': must be within 0.5 degrees of the site's"),
        (2, ",77.0,", ",900.0,", "elevation = '900.0': must be within 300 m of the site's elevat"),
        (2, "43.620384", "north", "latitude = 'north': must be a number from -90 to 90"),
        (4, "\ntime,", "\ndate,", "must have a column 'time', as Open-Meteo's hourly files have"),
        (4, "precipitation (mm)", "rain (mm)", "must have a column 'precipitation (mm)', as Open"),
        # An unknown unit is never guessed.
        (4, "(km/h)", "(Bft)", "'wind_speed_10m (Bft)': must be in km/h or m/s or mp/h or kn, a"),
        (4, "dew_point_2m (°C)", "temperature_2m (°F)", "'temperature_2m (°F)': must be in °C"),
    ],
)
def test_refused_files(tmp_path: Path, line: int, old: str, new: str, reason: str) -> None:
    """The error has file, line, key and value."""
    path = write(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert refusal(read_weather, [path], TORONTO).startswith(f"{path}, line {line}: {reason}")


def test_places(tmp_path: Path) -> None:
    """An unknown elevation of the service is NaN; a site without a place is near any place.

    179.9 degrees east and west are 0.2 degrees apart. A file must have one place.
    """
    path = write(tmp_path, values=VALUES.replace("77.0", "NaN"))
    assert read_weather([path], TORONTO).method == "fao56"
    path = write(tmp_path, values=VALUES.replace("-79.41748", "-179.9"))
    east = replace(TORONTO, longitude=179.9, utc_offset=12.0)
    assert len(read_weather([path], east).precipitation) == 5
    path = write(tmp_path, values="-33.9,151.2,9000.0,36000,Australia/Sydney,GMT+10")
    anywhere = replace(TORONTO, latitude=None, longitude=None, elevation=None)
    refusal(read_weather, [path], anywhere, match="fao56 needs latitude, longitude, elevation in t")
    path = write(tmp_path, place=f"location_id,{PLACE}", values=f"1,{VALUES}")
    refusal(read_weather, [path], TORONTO, match="line 2: location_id = '1': must be for one place")
    path.write_text(f"{PLACE}\n{VALUES}\n")
    refusal(read_weather, [path], TORONTO, match="must have two lines about the place, then")


def test_shifted_files_join_without_a_gap(tmp_path: Path) -> None:
    """The rain of one file's last hour is at the next file's first time."""
    both = [
        write(tmp_path, HOURS[3:], name="later.csv"), write(tmp_path, HOURS[:3], name="early.csv")
    ]
    whole, joined = read_weather([write(tmp_path)], TORONTO), read_weather(both, TORONTO)
    assert joined.first == whole.first
    assert sorted(joined.values) == sorted(whole.values)
    for quantity, series in whole.values.items():
        assert joined.values[quantity].tolist() == series.tolist()
    assert joined.evapotranspiration.tobytes() == whole.evapotranspiration.tobytes()


def test_run_says_what_was_moved(tmp_path: Path) -> None:
    """In the summary of a run."""
    write(tmp_path)
    done = run_command(
        "simulate", "--controller", "onoff", "--weather", "open-meteo.csv",
        "--start", "2021-07-07T10:30", "--hours", "1", "--json", cwd=tmp_path, env=environment(0),
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    (note,) = summary["weather_notes"]
    assert note.startswith("precipitation and solar radiation in the files are for the hour before")
    # Half an hour of 0.2 mm and half an hour of 0.3 mm on roof (68.8 m2) and inlet (0.2922467 m2).
    assert summary["rain_m3"] == pytest.approx(0.25e-3 * (68.8 + 0.2922466566), rel=1e-9)
