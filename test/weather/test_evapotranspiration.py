"""Evapotranspiration and the sun, compared with FAO-56's examples and equations."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from paper import PAPER_SITE, weather_of
from places import CONFIG

from greenroof_ros.analysis.calibration.record import read_csv_record
from greenroof_ros.base.times import parse_time
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.evapotranspiration import (
    compute_fao56,
    compute_hargreaves,
    compute_hourly,
    hargreaves,
    spread_over_day,
    sun_height,
)
from greenroof_ros.weather.read import read_weather
from greenroof_ros.weather.series import Weather

NDIAYE = replace(
    PAPER_SITE, latitude=16 + 13 / 60, longitude=-(16 + 15 / 60), elevation=8.0, utc_offset=-1.0,
    wind_height=2.0,
)
TORONTO = read_site(CONFIG / "site.yaml")


def dew_point(temperature: float, humidity: float) -> float:
    """Return the dew point (degC) of air at a temperature (degC) and a relative humidity (%)."""
    logarithm = math.log(humidity / 100) + 17.27 * temperature / (temperature + 237.3)
    return 237.3 * logarithm / (17.27 - logarithm)


def test_example_19() -> None:
    """N'Diaye, 1 October: 0.00 mm from 2 to 3 h, 0.63 mm from 14 to 15 h.

    Pressure 101.2 kPa follows from 8 m, Eq. 7. The night's Rs/Rso, 0.8 there, changes nothing.
    """
    for hour, temperature, humidity, wind, radiation, expected in (
        (2, 28, 90, 1.9, 0.0, 0.00), (14, 38, 52, 3.3, 2.450, 0.63),
    ):
        values = {
            "temperature": np.array([float(temperature)]),
            "dew point": np.array([dew_point(temperature, humidity)]),
            "wind speed": np.array([3.6 * wind]),
            "station pressure": np.array([101.2]),
            "solar radiation": np.array([radiation * 1e6 / 3600]),
        }
        first = parse_time(f"1998-10-01T{hour:02}:00-01:00")
        assert compute_hourly(NDIAYE, first, values)[0] == pytest.approx(expected, abs=0.005)


def test_example_18_hour_by_hour() -> None:
    """Uccle, 6 July: our hours add up to within 0.2 mm of the day's 3.88.

    Temperature is a cosine with its maximum at 15 h between the same extremes, and the 22.07 MJ/m2
    follow the extraterrestrial radiation.
    """
    uccle = replace(PAPER_SITE, latitude=50.8, longitude=4.35, elevation=100.0, utc_offset=0.0)
    hours, ratio = np.arange(24), math.log(1.409 / 0.6108)  # of vapour pressures, kPa
    shares = extraterrestrial(uccle, 187, hours)
    day = compute_hourly(uccle, parse_time("2015-07-06T00:00+00:00"), {
        "temperature": 16.9 + 4.6 * np.cos((hours + 0.5 - 15) * math.pi / 12),
        "dew point": np.full(24, 237.3 * ratio / (17.27 - ratio)),
        "wind speed": np.full(24, 10.0),
        "station pressure": np.full(24, 100.1),
        "solar radiation": 22.07e6 * shares / shares.sum() / 3600,
    })
    assert day.sum() == pytest.approx(3.88, abs=0.2)


def extraterrestrial(
    site: Site, day_of_year: int, hours: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return Ra (MJ/m2 in an hour), Eqs. 28-33: the sun's height integrated in steps of 3.6 s."""
    assert site.latitude is not None
    assert site.longitude is not None
    assert site.utc_offset is not None
    phi = math.radians(site.latitude)
    delta = 0.409 * math.sin(2 * math.pi * day_of_year / 365 - 1.39)
    distance = 1 + 0.033 * math.cos(2 * math.pi * day_of_year / 365)
    b = 2 * math.pi * (day_of_year - 81) / 364
    correction = 0.1645 * math.sin(2 * b) - 0.1255 * math.cos(b) - 0.025 * math.sin(b)
    within = (np.arange(1000) + 0.5) / 1000
    time = hours[:, None] + within + (site.longitude - 15 * site.utc_offset) / 15 + correction
    omega = math.pi / 12 * (time - 12)
    height = math.sin(phi) * math.sin(delta) + math.cos(phi) * math.cos(delta) * np.cos(omega)
    return np.asarray(60 * 0.0820 * distance * np.maximum(height, 0).mean(axis=1))


def day_of_records(**changes: NDArray[np.float64]) -> Weather:
    """Return a summer's day in Toronto, 14 to 30 degC."""
    values = {
        "temperature": 22 + 8 * np.cos((np.arange(24) - 15) * math.pi / 12),
        "dew point": np.full(24, 12.0),
        "wind speed": np.full(24, 15.0),
        "station pressure": np.full(24, 100.5),
        **changes,
    }
    return weather_of(np.zeros(24), first=parse_time("2021-07-15T00:00-05:00"), **values)


def test_radiation_of_the_days_temperatures() -> None:
    """Eq. 50 with the day's range of 16 degC, distributed like Ra, equals measured radiation."""
    estimated = compute_fao56(day_of_records(), TORONTO)
    radiation = 0.19 * math.sqrt(30 - 14) * extraterrestrial(TORONTO, 196, np.arange(24))
    measured = compute_fao56(day_of_records(**{"solar radiation": radiation * 1e6 / 3600}), TORONTO)
    assert measured == pytest.approx(estimated, abs=1e-4)  # mm/day
    assert estimated.max() > 16


def test_site_matters() -> None:
    """A crop coefficient scales; wind at 2 m is 4.87 / ln(67.8 10 - 5.42) times that at 10 m.

    The height of the wind is the records' if it is known, and else the site file's.
    """
    standard = compute_fao56(day_of_records(), TORONTO)
    assert compute_fao56(day_of_records(), replace(TORONTO, crop_coefficient=0.5)) == pytest.approx(
        0.5 * standard, rel=1e-15
    )
    factor = 4.87 / math.log(67.8 * 10 - 5.42)
    slower = day_of_records(**{"wind speed": np.full(24, 15.0 * factor)})
    at_2_m = compute_fao56(slower, replace(TORONTO, wind_height=2.0))
    assert at_2_m == pytest.approx(standard, abs=2e-3)  # the factor at 2 m is 1.0002
    of_2_m = replace(slower, wind_height=2.0)
    assert compute_fao56(of_2_m, TORONTO).tolist() == at_2_m.tolist()


def test_a_place_without_its_elevation_and_clock() -> None:
    """Example 2: 81.8 kPa is the pressure at 1800 m. 79.4 W is closest to UTC-5, in UTC, too."""
    records = day_of_records(**{"station pressure": np.full(24, 81.8)})
    known = replace(TORONTO, elevation=1800.0)
    computed = compute_fao56(records, replace(known, elevation=None, utc_offset=None))
    assert computed == pytest.approx(compute_fao56(records, known), abs=1e-3)
    assert computed.sum() != pytest.approx(compute_fao56(records, TORONTO).sum(), rel=2e-3)
    utc = replace(records, first=parse_time("2021-07-15T05:00+00:00"))
    for compute in (compute_fao56, compute_hargreaves):
        for site in (known, replace(known, utc_offset=None)):
            assert compute(utc, site).tolist() == compute(records, known).tolist()


def test_what_is_missing_is_not_made_up() -> None:
    """Without pressure or wind the library would estimate them; here there is no value.

    A part of a day has no extremes; with measured radiation they are not needed.
    """
    for name in ("temperature", "dew point", "wind speed", "station pressure"):
        series = day_of_records().values[name].copy()
        series[9] = np.nan
        unknown = np.isnan(compute_fao56(day_of_records(**{name: series}), TORONTO))
        assert unknown[9]
        assert unknown.sum() == (24 if name == "temperature" else 1)
    records = day_of_records()
    part = replace(records, values={key: series[1:] for key, series in records.values.items()})
    assert np.isnan(compute_fao56(part, TORONTO)).all()
    measured = {**part.values, "solar radiation": np.full(23, 300.0)}
    assert not np.isnan(compute_fao56(replace(part, values=measured), TORONTO)).any()


# --- Hargreaves' equation and the sun ------------------------------------------------------------


def days(*texts: str) -> np.ndarray:
    return np.array(texts, dtype="datetime64[D]")


def test_worked_examples() -> None:
    """Example 8: Ra on 3 September at 20 degrees south, 32.2 MJ/m2 and day, evaporates 13.1 mm;
    from 10 to 14.4 degC (mean 12.2), Eq. 52 has 0.0023 x 30 x 4.4^0.5 of it.

    Example 9: the sun is up for 11.7 h then. Example 20: Lyon in July, 14.8 to 26.6 degC, has
    5.0 mm/day by Eq. 52. Hard frost has none.
    """
    evaporated = hargreaves(-20.0, days("1998-09-03"), np.array([10.0]), np.array([14.4]))
    radiation = evaporated / (0.0023 * 30 * math.sqrt(4.4)) / 0.408
    assert radiation == pytest.approx([32.2], abs=0.05)
    seconds = (np.datetime64("1998-09-03", "s") + 60 * np.arange(1440)).astype(np.int64)
    assert (sun_height(-20.0, seconds, 0.0) > 0).sum() / 60 == pytest.approx(11.7, abs=0.05)
    lyon, july = 45 + 43 / 60, days("1998-07-15")
    assert hargreaves(lyon, july, np.array([14.8]), np.array([26.6])) == pytest.approx(
        [5.0], abs=0.05
    )
    assert hargreaves(52.5, days("2019-01-20"), np.array([-30.0]), np.array([-20.0])) == [0.0]


def test_the_sun_stands_highest_at_noon_of_its_own_meridian() -> None:
    """7.5 degrees west of the clock's meridian this is half an hour later.

    On 15 April and 1 September the equation of time is 0 within a minute (Eq. 32).
    """
    seconds = (np.datetime64("1998-04-15", "s") + 60 * np.arange(1440)).astype(np.int64)
    highest = int(np.argmax(sun_height(45.0, seconds, -7.5)))
    assert highest == pytest.approx(12 * 60 + 30, abs=2)


@pytest.mark.parametrize("step_s", [60, 300, 6 * 3600])
def test_steps_of_any_length_keep_the_sums_of_whole_days(step_s: int) -> None:
    """From noon on it is half of a day's; none falls at night; quarters of days are alike."""
    first = np.datetime64("2015-06-01T12:00", "s").astype(np.int64)
    greenwich = replace(TORONTO, latitude=52.5, longitude=0.0, utc_offset=0.0)

    def over(step_s: int) -> tuple[np.ndarray, np.ndarray]:
        seconds = first + step_s * np.arange(int(2.5 * 86400) // step_s)
        day = seconds // 86400 - first // 86400
        daily = np.array([4.0, 5.0, 6.0])
        return day, spread_over_day(daily, greenwich, seconds, float(step_s))

    day, steps = over(step_s)
    sums = np.bincount(day, steps)
    assert sums[1:] == pytest.approx([5.0, 6.0], rel=1e-3)
    assert sums[0] == pytest.approx(2.0, abs=0.1)
    quarters = over(300)[1].reshape(-1, 72).sum(axis=1)
    tolerance = 1e-3 if step_s < 300 else 1e-6
    assert steps.reshape(10, -1).sum(axis=1) == pytest.approx(quarters, rel=tolerance)
    assert over(300)[1][12 * 12:15 * 12].tolist() == [0.0] * 36


# --- hours of temperature -------------------------------------------------------------------------

LYON = replace(TORONTO, latitude=45 + 43 / 60, longitude=4.85, utc_offset=1.0)
# From 14.8 to 26.6 degC each day, FAO-56's Example 20.
COURSE = np.tile(20.7 + 5.9 * np.cos(np.pi * (np.arange(24) - 15) / 12), 4)


def hours_of(temperature: NDArray[np.float64], first: str) -> Weather:
    return weather_of(np.zeros(len(temperature)), first=parse_time(first), temperature=temperature)


def test_hargreaves_hour_by_hour() -> None:
    """Example 20: 5.0 mm on 15 July, in each hour as its share of the day's Ra (Eqs. 28-33)."""
    records = hours_of(COURSE, "1998-07-13T00:00+01:00")
    evaporated = compute_hargreaves(records, replace(LYON, crop_coefficient=0.5))
    of_the_15th = evaporated[48:72] / 24
    assert of_the_15th.sum() == pytest.approx(0.5 * 5.0, abs=0.025)
    shares = extraterrestrial(LYON, 196, np.arange(24))
    assert of_the_15th / of_the_15th.sum() == pytest.approx(shares / shares.sum(), abs=2e-4)


def test_days_with_too_few_temperatures() -> None:
    """Less than 18 hours show no extremes: a day nearby stands in, for at most three days."""
    records = hours_of(COURSE[:90], "1998-07-13T00:00+01:00")
    whole = compute_hargreaves(hours_of(COURSE, "1998-07-13T00:00+01:00"), LYON)
    assert compute_hargreaves(records, LYON).tolist() == whole[:90].tolist()
    short = hours_of(COURSE[8:32], "1998-07-13T08:00+01:00")
    assert np.isnan(compute_hargreaves(short, LYON)).all()
    temperature = np.tile(COURSE, 3)
    temperature[24 : 24 * 9] = np.nan
    far = np.isnan(compute_hargreaves(hours_of(temperature, "1998-07-01T00:00+01:00"), LYON))
    assert np.flatnonzero(far).tolist() == list(range(24 * 4, 24 * 6))


def test_simulations_and_fits_use_the_same_evapotranspiration(tmp_path: Path) -> None:
    """A year's hours of temperature as weather, and as a measured record: equal in every bit."""
    random = np.random.default_rng(4)
    times = np.datetime64("2021-01-01T00:00") + np.arange(365 * 24).astype("timedelta64[h]")
    temperature = random.normal(12, 6, len(times)).round(1)
    file = tmp_path / "record.csv"
    file.write_text("\n".join(["time,rain [mm],temperature [degC],level [m]", *(
        f"{time},0,{degrees},0.02" for time, degrees in zip(times, temperature, strict=True)
    )]))
    site = replace(TORONTO, time_zone="Etc/GMT+5", crop_coefficient=0.5)
    weather = read_weather([file], site)
    assert weather.method == "hargreaves"
    reference = read_csv_record(file, site).reference
    assert (reference * 24 * 0.5).tolist() == weather.evapotranspiration.tolist()
