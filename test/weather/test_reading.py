"""Weather files: what people have, several as one, and gaps that are filled on request."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from paper import PAPER_SITE, paper_run
from places import CONFIG, DATA, refusal

from greenroof_ros.base.times import parse_time
from greenroof_ros.simulation.output import write_configuration
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import (
    default_weather,
    fill_long_gaps,
    find_files,
    read_weather,
)
from greenroof_ros.weather.series import WeatherSeries

TORONTO = read_site(CONFIG / "site.yaml")
JULY, MARCH = DATA / "en_climate_hourly_07-2021.csv", DATA / "en_climate_hourly_03-2021.csv"


def test_packaged_weather_is_the_72_hours() -> None:
    """Every hour's observations, and the evapotranspiration of the authors' published code."""
    weather = read_weather([default_weather()], PAPER_SITE)
    with (DATA / "toronto_hours.csv").open() as file:
        source = list(csv.DictReader(file))
    for quantity, column in {
        "precipitation": "rain_mm",
        "evapotranspiration": "published_et_mm_per_day",
        "temperature": "temperature_degC",
        "dew point": "dew_point_degC",
        "wind speed": "wind_km_h",
        "station pressure": "station_pressure_kPa",
    }.items():
        assert weather.values[quantity].tolist() == [float(row[column]) for row in source]
    assert weather.method == "published"
    assert weather.first.isoformat() == "2021-07-07T00:00:00-05:00"
    assert weather.end.isoformat() == "2021-07-10T00:00:00-05:00"


def write(path: Path, header: str, *rows: str) -> Path:
    """Write a weather file with a comment in line 1 and the header in line 2."""
    path.write_text("\n".join(["# Nowhere", header, *rows, ""]))
    return path


def test_rain_alone(tmp_path: Path) -> None:
    """The month's mean of the site file, 3.96 mm/day in June and 4.02 in July; no frost is known.

    An amount of an hour in mm is its rate in mm/h.
    """
    path = write(
        tmp_path / "gauge.csv", "time,rain [mm]", "2021-06-30T22:00-05:00,3.2",
        "2021-06-30T23:00-05:00,0", "2021-07-01T00:00-05:00,0.4",
    )
    weather = read_weather([path], replace(TORONTO, crop_coefficient=0.5))
    assert weather.precipitation.tolist() == [3.2, 0.0, 0.4]
    assert weather.evapotranspiration == pytest.approx([1.98, 1.98, 2.01])
    assert weather.method == "monthly"
    frost, monthly = weather.left_out
    assert "no frost is assumed" in frost and "monthly means" in monthly
    series = WeatherSeries(weather, TORONTO, weather.first, 3600)
    assert (series.frost_hours, series.frost[0]) == (None, 0.0)
    climateless = replace(TORONTO, monthly_evapotranspiration=None)
    refusal(read_weather, [path], climateless, match="has no temperature, .* set monthly_evap")
    refusal(read_weather, [path], TORONTO, "fao56", match="has no column .* lacks temperature")


def test_a_method_can_be_chosen(tmp_path: Path) -> None:
    """Of records with all columns any of them; the most accurate one is the default."""
    means = {
        method: np.nanmean(read_weather([JULY], TORONTO, method).evapotranspiration)
        for method in (None, "fao56", "hargreaves", "monthly")
    }
    assert means[None] == means["fao56"]
    # config/site_neubrandenburg.yaml: they agree within 1 % in Toronto in July 2021.
    assert means["hargreaves"] == pytest.approx(means["fao56"], rel=0.01)
    assert means["monthly"] == pytest.approx(4.02)
    nowhere = replace(TORONTO, latitude=None)
    refusal(read_weather, [JULY], nowhere, "hargreaves", match="hargreaves requires latitude in")
    header = "time,rain [mm],temperature [degC]"
    path = write(tmp_path / "hour.csv", header, "2021-07-07T03:00Z,0.5,20")
    assert read_weather([path], TORONTO).method == "monthly"


def test_rows_of_a_logger_add_up_to_hours(tmp_path: Path) -> None:
    """Rain adds up, temperature is averaged; rain needs three quarters of an hour's rows.

    Twelve rows of 0.1 mm are 1.2 mm. Of nine rows the mean rate counts, of eight none: such hours
    are left out at either end. Temperature may be in every third row.
    """
    first, header = np.datetime64("2021-07-07T14:20"), "time,rain [mm],temperature [degC]"
    rows = {row: f"0.1,{row}" for row in range(8 + 12 + 9)}
    rows |= {row: f"0.2,{'' if row % 3 else 5}" for row in range(8 + 24 + 8) if row >= 8 + 24}
    path = write(tmp_path / "logger.csv", header, *(
        f"{first + np.timedelta64(5 * row, 'm')}-05:00,{cells}" for row, cells in rows.items()
    ))
    weather = read_weather([path], TORONTO)
    assert weather.first.isoformat() == "2021-07-07T15:00:00-05:00"
    assert weather.precipitation.tolist() == [1.2, 1.2]
    # 0.1 mm in each of eight rows before, 0.2 mm after; three missing rows have the mean of nine.
    out, added = weather.left_out[:2]
    assert out.startswith("2.4 mm of rain") and added.startswith("0.3 mm of rain")
    assert weather.values["temperature"].tolist() == [13.5, 24.0]
    begun = (f"2021-07-07T18:0{minute}-05:00,0.2,5" for minute in (0, 5))
    later = write(tmp_path / "later.csv", header, *begun)
    hours = read_weather([path, later], TORONTO).precipitation
    assert hours.tolist() == pytest.approx([1.2, 1.2, np.nan], nan_ok=True)
    assert any("rows of 5 min whose time is their start" in text for text in weather.applied)


# --- several files --------------------------------------------------------------------------------


def piece(path: Path, first: int, last: int) -> Path:
    """Write the records first..last (from 0) of July."""
    header, *records = JULY.read_text(encoding="utf-8-sig").splitlines()
    chosen = records[first : last + 1]
    path.write_text("\n".join([header, *chosen]) + "\n", encoding="utf-8")
    return path


def test_pieces_of_a_month_are_the_month(tmp_path: Path) -> None:
    """In any order: each gap is filled as in the complete file.

    One cut is in a gap of station pressure, 20 July 13:00 to 17:00.
    """
    spans = (481, 600), (0, 480), (601, 743)
    files = [piece(tmp_path / f"{first}.csv", first, last) for first, last in spans]
    joined = read_weather(files, TORONTO)
    month = read_weather([JULY], TORONTO)
    assert joined.first == month.first
    for name, series in month.values.items():
        assert joined.values[name].tobytes() == series.tobytes()
    for name, filled in month.filled.items():
        assert joined.filled[name].tolist() == filled.tolist()
    assert [int(file.stem) for file in joined.files] == sorted(first for first, _ in spans)


def test_months_far_from_each_other() -> None:
    """1 April to 30 June are 91 days without data; 31 + 91 + 31 are 153 days."""
    weather = read_weather([JULY, MARCH], TORONTO)
    assert weather.files == (MARCH, JULY)
    assert len(weather.precipitation) == 153 * 24
    march, july = read_weather([MARCH], TORONTO), read_weather([JULY], TORONTO)
    assert weather.precipitation[:744].tobytes() == march.precipitation.tobytes()
    assert np.isnan(weather.precipitation[744:-744]).all()
    assert weather.evapotranspiration[-744:].tobytes() == july.evapotranspiration.tobytes()
    assert weather.wind_height == july.wind_height == 10.0  # of Environment Canada
    site = replace(TORONTO, tau=600.0, M=1)
    missing = r"missing at 2021-04-01T00:00-05:00 to 2021-04-01T12:00-05:00 \(13 hours\)"
    start = parse_time("2021-03-31T12:00-05:00")
    refusal(WeatherSeries, weather, site, start, 6 * 24, match=missing)


def test_what_cannot_be_joined(tmp_path: Path) -> None:
    """Values for the same hours, even if they are equal; other quantities, another method."""

    def own_csv(first: str, method: str = "published") -> Path:
        """Write two hours of a file in this project's format."""
        hours = np.datetime64(first, "m") + np.arange(2).astype("timedelta64[h]")
        return write(
            tmp_path / f"{first[8:].replace(':', '')}-{method}.csv",
            f"time,precipitation [mm/h],{method} evapotranspiration [mm/day]",
            *(f"{hour}-05:00,0.1,1.0" for hour in hours),
        )

    early = own_csv("2021-07-01T00:00")
    for late, reason in (
        (own_csv("2021-07-01T02:00", "lysimeter"), "must have the same method"),
        (own_csv("2021-07-01T01:00"), "precipitation at 2021-07-01T01:00-05:00"),
        (JULY, "must have the same quantities"),
    ):
        assert refusal(read_weather, [early, late], TORONTO).startswith(f"{late}: {reason}")


def test_files_whose_hours_begin_at_different_minutes(tmp_path: Path) -> None:
    """Hours of the first file, with the means of the second's.

    Rain of 1 to 4 mm, in hours that begin 20 min later: each hour of the clock has the rest of one
    and the start of the next.
    """
    first = np.datetime64("2021-07-01T00:00")
    header = "time,precipitation [mm/h],published evapotranspiration [mm/day]"
    early = write(tmp_path / "gmt.csv", header, *(
        f"{first + np.timedelta64(hour, 'h')}+00:00,0.5,1.0" for hour in range(4)
    ))
    late = write(tmp_path / "local.csv", header, *(
        f"{first + np.timedelta64(60 * (4 + hour) + 20, 'm')}+00:00,{hour + 1}.0,2.0"
        for hour in range(4)
    ))
    read = read_weather([late, early], TORONTO)
    assert read.first.isoformat() == "2021-07-01T00:00:00+00:00"
    assert read.files == (early, late)
    # Of the fifth hour, two thirds are known.
    assert read.values["precipitation"].tolist() == pytest.approx(
        [0.5] * 4 + [np.nan, 5 / 3, 8 / 3, 11 / 3], nan_ok=True
    )
    assert read.values["evapotranspiration"][:4].tolist() == [1.0] * 4
    assert read.values["evapotranspiration"][5:].tolist() == pytest.approx([2.0] * 3)


def test_names_and_patterns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name as it is, a pattern sorted, each file once; the name of a file is not a pattern."""
    monkeypatch.chdir(tmp_path)
    for name in ("b-1.csv", "b-2.csv", "a.csv", "c[1].csv"):
        (tmp_path / name).write_text("")
    for names, expected in (
        (["b-2.csv", "b-?.csv", "a.csv"], ["b-2.csv", "b-1.csv", "a.csv"]),
        (["c[1].csv"], ["c[1].csv"]),
        (["absent.csv"], ["absent.csv"]),  # reading it is an error
        ([str(tmp_path / "b-[1].csv")], ["b-1.csv"]),
        ([str(tmp_path)], ["a.csv", "b-1.csv", "b-2.csv", "c[1].csv"]),  # a directory
    ):
        assert [path.name for path in find_files(names, "--weather")] == expected
    refusal(find_files, ["a.csv", "d-*.csv"], "--weather", match="--weather = .*matches no file")
    (tmp_path / "empty").mkdir()
    refusal(find_files, ["empty"], "--weather", match="--weather = 'empty': matches no file .of a")


def test_run_directory_keeps_all_files(tmp_path: Path) -> None:
    """With unique names; the node's parameter has them in the order of time."""
    parts: list[Path] = []
    for name, first, last in (("late", 200, 400), ("early", 0, 199)):
        (tmp_path / name).mkdir()
        parts.append(piece(tmp_path / name / "july.csv", first, last))
    run = paper_run(
        "--weather", *map(str, parts), "--controller", "onoff", "--start", "2021-07-07T02:00",
        "--hours", "1",
    )
    assert run.weather.source == str(tmp_path / "early" / "2 files, july.csv to july.csv")
    (tmp_path / "run" / "configuration").mkdir(parents=True)
    file = write_configuration(tmp_path / "run", run, {})
    kept = tmp_path / "run" / "configuration" / "weather"
    assert (kept / "july.csv").read_bytes() == parts[1].read_bytes()
    assert (kept / "july-2.csv").read_bytes() == parts[0].read_bytes()
    parameters = yaml.safe_load(file.read_text())["/**/weather"]["ros__parameters"]
    assert parameters["weather_files"] == [str(kept / "july.csv"), str(kept / "july-2.csv")]


# --- long gaps ------------------------------------------------------------------------------------


def test_long_gaps_have_the_mean_of_the_days_about_them() -> None:
    """At the same time of day, of three days before and three after; the rest stays missing."""
    day, hour = np.divmod(np.arange(20 * 24), 24)
    series = day**2 + hour / 100
    series[5 * 24 : 13 * 24] = np.nan
    filled = fill_long_gaps({"temperature": series})["temperature"]
    assert np.flatnonzero(np.isnan(filled)).tolist() == list(range(8 * 24, 10 * 24))
    assert filled[5 * 24 + 7] == pytest.approx((4 + 9 + 16) / 3 + 0.07)
    assert filled[12 * 24] == pytest.approx((13**2 + 14**2 + 15**2) / 3)
    assert filled[[4 * 24, 13 * 24]].tolist() == [16.0, 169.0]
