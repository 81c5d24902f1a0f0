"""FAO-56 Penman-Monteith, compared with the paper's examples and its equations, written again."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from paper import PAPER_SITE
from refusals import refusal

from greenroof_ros.common.files import shared_directory
from greenroof_ros.formats.records import Records
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.weather.evapotranspiration import fao56, hourly

NDIAYE = replace(
    PAPER_SITE, latitude=16 + 13 / 60, longitude=-(16 + 15 / 60), elevation=8.0, utc_offset=-1.0,
    wind_height=2.0,
)
TORONTO = read_site(shared_directory() / "config" / "site.yaml")


def dew_point(temperature: float, humidity: float) -> float:
    """Return the dew point (degC) of air at a temperature (degC) and a relative humidity (%)."""
    logarithm = math.log(humidity / 100) + 17.27 * temperature / (temperature + 237.3)
    return 237.3 * logarithm / (17.27 - logarithm)


@pytest.mark.parametrize(
    ("hour", "temperature", "humidity", "wind", "radiation", "expected"),
    [(2, 28, 90, 1.9, 0.0, 0.00), (14, 38, 52, 3.3, 2.450, 0.63)],
)
def test_example_19(
    hour: int, temperature: float, humidity: float, wind: float, radiation: float, expected: float
) -> None:
    """N'Diaye, 1 October: 0.00 mm from 2 to 3 h, 0.63 mm from 14 to 15 h.

    Pressure 101.2 kPa follows from 8 m, Eq. 7. The night's Rs/Rso, 0.8 there, changes nothing.
    """
    values = {
        "temperature": np.array([float(temperature)]),
        "dew point": np.array([dew_point(temperature, humidity)]),
        "wind speed": np.array([3.6 * wind]),
        "station pressure": np.array([101.2]),
        "solar radiation": np.array([radiation * 1e6 / 3600]),
    }
    first = datetime.fromisoformat(f"1998-10-01T{hour:02}:00-01:00")
    assert hourly(NDIAYE, first, values)[0] == pytest.approx(expected, abs=0.005)


def test_example_18_hour_by_hour() -> None:
    """Uccle, 6 July: our hours add up to within 0.2 mm of the day's 3.88.

    Temperature varies between the same extremes as a cosine with its maximum at 15 h, vapour
    pressure is the example's 1.409 kPa, the 22.07 MJ/m2 follow the extraterrestrial radiation.
    """
    uccle = replace(
        PAPER_SITE, latitude=50.8, longitude=4.35, elevation=100.0, utc_offset=0.0
    )
    hours = np.arange(24)
    shares = extraterrestrial(uccle, 187, hours)
    ratio = math.log(1.409 / 0.6108)
    values = {
        "temperature": 16.9 + 4.6 * np.cos((hours + 0.5 - 15) * math.pi / 12),
        "dew point": np.full(24, 237.3 * ratio / (17.27 - ratio)),
        "wind speed": np.full(24, 10.0),
        "station pressure": np.full(24, 100.1),
        "solar radiation": 22.07e6 * shares / shares.sum() / 3600,
    }
    day = hourly(uccle, datetime.fromisoformat("2015-07-06T00:00+00:00"), values)
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


def day_of_records(**changes: NDArray[np.float64]) -> Records:
    """Return a summer's day in Toronto, 14 to 30 degC."""
    hours = np.arange(24)
    values = {
        "precipitation": np.zeros(24),
        "temperature": 22 + 8 * np.cos((hours - 15) * math.pi / 12),
        "dew point": np.full(24, 12.0),
        "wind speed": np.full(24, 15.0),
        "station pressure": np.full(24, 100.5),
        **changes,
    }
    return Records((Path("day.csv"),), datetime.fromisoformat("2021-07-15T00:00-05:00"), values)


def test_radiation_of_the_days_temperatures() -> None:
    """Eq. 50 with the day's range of 16 degC, distributed like Ra, equals measured radiation.

    The same hours written in UTC give the same result.
    """
    records = day_of_records()
    estimated = fao56(records, TORONTO)
    utc = replace(records, first=datetime.fromisoformat("2021-07-15T05:00+00:00"))
    assert fao56(utc, TORONTO).tolist() == estimated.tolist()
    radiation = 0.19 * math.sqrt(30 - 14) * extraterrestrial(TORONTO, 196, np.arange(24))
    measured = fao56(day_of_records(**{"solar radiation": radiation * 1e6 / 3600}), TORONTO)
    assert measured == pytest.approx(estimated, abs=1e-4)  # mm/day
    assert estimated.max() > 16


def test_site_matters() -> None:
    """A crop coefficient scales; wind at 2 m is 4.87 / ln(67.8 10 - 5.42) times that at 10 m."""
    standard = fao56(day_of_records(), TORONTO)
    assert fao56(day_of_records(), replace(TORONTO, crop_coefficient=0.5)) == pytest.approx(
        0.5 * standard, rel=1e-15
    )
    factor = 4.87 / math.log(67.8 * 10 - 5.42)
    slower = day_of_records(**{"wind speed": np.full(24, 15.0 * factor)})
    at_2_m = fao56(slower, replace(TORONTO, wind_height=2.0))
    assert at_2_m == pytest.approx(standard, abs=2e-3)  # the factor at 2 m is 1.0002


def test_what_is_missing_is_not_made_up() -> None:
    """Without pressure or wind the library would estimate them; here there is no value.

    A part of a day has no extremes; with measured radiation they are not needed.
    """
    for name in ("temperature", "dew point", "wind speed", "station pressure"):
        series = day_of_records().values[name].copy()
        series[9] = np.nan
        unknown = np.isnan(fao56(day_of_records(**{name: series}), TORONTO))
        assert unknown[9]
        assert unknown.sum() == (24 if name == "temperature" else 1)
    records = day_of_records()
    part = replace(records, values={key: series[1:] for key, series in records.values.items()})
    assert np.isnan(fao56(part, TORONTO)).all()
    measured = {**part.values, "solar radiation": np.full(23, 300.0)}
    assert not np.isnan(fao56(replace(part, values=measured), TORONTO)).any()


@pytest.mark.parametrize("key", ["latitude", "elevation"])
def test_place_is_needed(key: str) -> None:
    """The error names what the site file lacks."""
    nowhere = replace(TORONTO, **{key: None})
    refusal(fao56, day_of_records(), nowhere, match=f"fao56 needs {key} in the site file")
