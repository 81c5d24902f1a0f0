"""Hourly bulk files of Environment and Climate Change Canada, as downloaded and with changes."""

from __future__ import annotations

import csv
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from places import DATA
from refusals import refusal

from greenroof_ros.base.files import shared_directory
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_weather
from greenroof_ros.weather.series import Weather, WeatherSeries

TORONTO = read_site(shared_directory() / "config" / "site.yaml")

JULY = DATA / "en_climate_hourly_07-2021.csv"
TEMPERATURE, RAIN = "Temp (°C)", "Precip. Amount (mm)"


def changed(
    directory: Path, hours: int, *cells: tuple[int, str, str], short: tuple[int, ...] = ()
) -> Path:
    """Write the first hours of July 2021 with other cells, each as its hour, column and text.

    The rows of short hours end at the temperature.
    """
    with JULY.open(encoding="utf-8-sig") as stream:
        header, *rows = list(csv.reader(stream))[: hours + 1]
    for hour, column, text in cells:
        rows[hour][header.index(column)] = text
    for hour in short:
        del rows[hour][header.index(TEMPERATURE) :]
    path = directory / "en_climate_hourly.csv"
    with path.open("w", encoding="utf-8-sig", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])
    return path


def run(weather: Weather, start: str, hours: int) -> WeatherSeries:
    """Lay out a file for a run with ticks of ten minutes; seconds are not needed here."""
    site = replace(TORONTO, tau=600.0, M=1)
    return WeatherSeries(weather, site, datetime.fromisoformat(start), 6 * hours)


def test_value_next_to_a_missing_flag_is_none(tmp_path: Path) -> None:
    """The service repeats the last value there, which is no dew point; an estimated one is."""
    stale, flag = ("Dew Point Temp (°C)", "3.0"), "Dew Point Temp Flag"
    path = changed(tmp_path, 24, (6, *stale), (6, flag, "E"), (7, *stale), (7, flag, "M"))
    weather = read_weather([path], TORONTO)
    assert weather.values["dew point"][5:9].tolist() == [16.6, 3.0, (3.0 + 17.2) / 2, 17.2]
    assert weather.filled["dew point"].nonzero()[0].tolist() == [7]


@pytest.mark.parametrize(
    ("column", "quantity", "longest"),
    [
        (RAIN, "precipitation", 0), (TEMPERATURE, "temperature", 6),
        ("Wind Spd (km/h)", "wind speed", 6), ("Dew Point Temp (°C)", "dew point", 24),
        ("Stn Press (kPa)", "station pressure", 24),
    ],
)
def test_gaps_are_filled_up_to_so_many_hours(
    tmp_path: Path, column: str, quantity: str, longest: int
) -> None:
    """Rain is never guessed. A gap at an end, or longer by an hour, is refused if it matters."""
    def two_days(*gaps: range) -> Weather:
        missing = [(hour, column, "") for gap in gaps for hour in gap]
        return read_weather([changed(tmp_path, 48, *missing)], TORONTO)

    bridged = range(6, 6 + longest)
    series = run(two_days(bridged), "2021-07-01T00:00-05:00", 48)
    assert list(series.filled) == [quantity] * (longest > 0)
    for first, last in ((0, 0), (6, 6 + longest), (47, 47)):
        weather = two_days(bridged, range(first, last + 1))
        reason = refusal(run, weather, "2021-07-01T00:00-05:00", 48)
        assert reason.startswith(str(tmp_path / "en_climate_hourly.csv")) and quantity in reason


def test_short_rows_are_missing_hours(tmp_path: Path) -> None:
    """If the service has no observations of an hour, it ends the row before the first."""
    weather = read_weather([changed(tmp_path, 24, short=(9, 10))], TORONTO)
    assert np.isnan(weather.precipitation).nonzero()[0].tolist() == [9, 10]
    # Between 21.4 degC at 8 h and 22.0 at 11 h.
    assert weather.values["temperature"][8:12] == pytest.approx([21.4, 21.6, 21.8, 22.0])
    run(weather, "2021-07-01T11:00-05:00", 12)
    reason = refusal(run, weather, "2021-07-01T08:00-05:00", 4)
    assert "2021-07-01T09:00-05:00 to 2021-07-01T10:00-05:00 (2 hours)" in reason


def test_frost(tmp_path: Path) -> None:
    """0.0 degC is frost, 0.1 is not; precipitation in frost is summed up."""
    path = changed(
        tmp_path, 24, *((hour, TEMPERATURE, "-3.0") for hour in range(5)),
        (5, TEMPERATURE, "0.0"), (5, RAIN, "1.5"), (6, TEMPERATURE, "0.1"), (6, RAIN, "4.0"),
    )
    series = run(read_weather([path], TORONTO), "2021-07-01T03:30-05:00", 5)
    assert series.frost_hours == 2.5
    assert series.precipitation_in_frost == pytest.approx(1.5, rel=1e-12)
    assert list(series.frost) == [1.0] * 15 + [0.0] * 16


def test_refused(tmp_path: Path) -> None:
    """The error has the line, the service's column and the value, or what the site lacks."""
    for cell, reason in (
        ((3, "Date/Time (LST)", "2021-07-01 3:00Z"), "line 5: Date/Time (LST) = '2021-07-01"),
        ((0, "Longitude (x)", "-123.1"), "line 2: Longitude (x) = '-123.1': does not match the"),
    ):
        path = changed(tmp_path, 24, cell)
        assert refusal(read_weather, [path], TORONTO).startswith(f"{path}, {reason}")
    nowhere = replace(TORONTO, utc_offset=None)
    refusal(read_weather, [JULY], nowhere, match="the site file must state the UTC offset")
    wrong = "evapotranspiration = 'published': must be one of fao56"
    # 'published' is a method of the authors' 72 hours.
    refusal(read_weather, [JULY], TORONTO, "published", match=wrong)


def test_july_2021() -> None:
    """744 hours; values flagged as missing by the service are filled and named, hour by hour."""
    weather = read_weather([JULY], TORONTO)
    assert len(weather.precipitation) == 744
    assert weather.first.isoformat() == "2021-07-01T00:00:00-05:00"
    assert weather.end.isoformat() == "2021-08-01T00:00:00-05:00"
    filled = {name: int(marks.sum()) for name, marks in weather.filled.items() if marks.any()}
    # Counted in the file by eye and by grep: rows with flag M.
    assert filled == {
        "temperature": 6, "dew point": 32, "wind speed": 1, "station pressure": 6
    }
    series = run(weather, "2021-07-01T00:00-05:00", 744)
    assert series.frost_hours == 0
    # Rows with an M at any of the quantities used, by grep: 25 from the 20th to the 21st, 6 on the
    # 30th, 2 on the 31st.
    assert series.filled_hours == 33
    assert series.filled["station pressure"] == [
        "2021-07-20T13:00-05:00 to 2021-07-20T17:00-05:00 (5 hours)", "2021-07-21T11:00-05:00"
    ]
    assert series.repeats_from == weather.end  # tick N is the first after the last hour
    # The hours of the paper's window, compared with its own 72 hours.
    packaged = read_weather(
        [shared_directory() / "config" / "weather" / "toronto_2021-07.csv"], TORONTO, "fao56"
    )
    assert weather.precipitation[144:216].tolist() == packaged.precipitation.tolist()
    # The first night has the clouds of the evening before, which the 72 hours do not have.
    assert weather.evapotranspiration[149:216] == pytest.approx(
        packaged.evapotranspiration[5:], rel=1e-12
    )
    # Toronto's July has about 4 to 5 mm of reference evapotranspiration a day.
    assert 3.5 < weather.evapotranspiration.mean() < 5.5


def test_march_2021() -> None:
    """The form of another year, quoted and padded; 203 hours of frost."""
    weather = read_weather([DATA / "en_climate_hourly_03-2021.csv"], TORONTO)
    assert len(weather.precipitation) == 744
    assert weather.frost is not None
    assert weather.frost.sum() == 203
    series = run(weather, "2021-03-01T00:00-05:00", 744)
    assert series.frost_hours == 203
    assert series.filled == {}
    assert series.precipitation_in_frost == 0.0  # eight hours of snow, none of it measurable
