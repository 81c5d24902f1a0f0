"""``greenroof weather``: what a file is, and the same weather as one CSV."""

from __future__ import annotations

import json
import os
from datetime import datetime, timedelta
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from archives import answer
from commands import run_command
from paper import site_file
from places import CONFIG, DATA

from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_weather

JULY, DECEMBER = DATA / "en_climate_hourly_07-2021.csv", DATA / "en_climate_hourly_12-2015.csv"
PACKAGED = CONFIG / "weather" / "toronto_2021-07.csv"


def weather(directory: Path, *arguments: str | Path) -> CompletedProcess[str]:
    return run_command(
        "weather_file", *map(str, arguments), cwd=directory, env={**os.environ, "COLUMNS": "500"}
    )


def about(directory: Path, *arguments: str | Path) -> list[tuple[str, ...]]:
    """Return the rows of the table."""
    done = weather(directory, *arguments)
    assert (done.returncode, done.stderr) == (0, "")
    return [
        tuple(cell.strip() for cell in line.split("│")[1:-1])
        for line in done.stdout.splitlines() if line.startswith("│")
    ]


def open_meteo(file: Path, latitude: float = 43.62) -> Path:
    """Write an answer of the archive in Fahrenheit, with gaps and a code."""
    hours = range(96)
    content = answer(
        "2021-07-07T00:00", 96,
        temperature_2m=[60 + hour % 24 for hour in hours],
        relative_humidity_2m=[50.5 + hour % 7 for hour in hours],
        precipitation=[0.1 * (hour % 5) for hour in hours],
        wind_speed_10m=[7.3] * 96, surface_pressure=[1003.7] * 96,
        shortwave_radiation=[max(0, 33.3 * (12 - abs(hour % 24 - 12))) for hour in hours],
    )
    content["hourly"]["temperature_2m"][30] = None
    content["hourly"]["precipitation"][40] = -999
    content["hourly_units"] |= {"temperature_2m": "°F", "wind_speed_10m": "m/s"}
    content |= {"latitude": latitude, "utc_offset_seconds": -18000}
    file.write_text(json.dumps(content))
    return file


def logger(file: Path) -> Path:
    """Write two days of a rain gauge, in rows of five minutes without an offset from UTC."""
    first = datetime(2021, 7, 7, 14, 3)  # noqa: DTZ001 - on the clock of the site
    file.write_text("\n".join(["time,rain [mm]", *(
        f"{first + timedelta(minutes=5 * row)},{row % 3 / 10}" for row in range(576)
    )]))
    return file


@pytest.mark.parametrize("name", ["frost", "open-meteo", "packaged", "logger"])
def test_a_run_has_the_same_numbers_with_the_csv(tmp_path: Path, name: str) -> None:
    """Every hour's values are equal in each bit, and so is what a run makes of them."""
    file = {
        "frost": lambda: DECEMBER, "packaged": lambda: PACKAGED,
        "open-meteo": lambda: open_meteo(tmp_path / "answer.json"),
        "logger": lambda: logger(tmp_path / "logger.csv"),
    }[name]()
    place = site_file(tmp_path, time_zone="America/Toronto", wind_height=2.0)
    done = weather(tmp_path, file, "--output", "own.csv", "--site", place)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("written: own.csv\n")
    site = read_site(place)
    given, own = (read_weather([each], site) for each in (file, tmp_path / "own.csv"))
    for quantity, series in given.values.items():
        assert own.values[quantity].tobytes() == series.tobytes(), quantity
    for each in ("first", "method", "rain_late", "hours"):
        assert getattr(own, each) == getattr(given, each)
    assert [*own.places.values()] == [*given.places.values()]
    assert own.evapotranspiration.tobytes() == given.evapotranspiration.tobytes()
    assert (own.frost is None) == (given.frost is None)
    assert own.frost is None or own.frost.tobytes() == given.frost.tobytes()


def test_what_the_file_of_a_service_is(tmp_path: Path) -> None:
    """July 2021 at Toronto City Centre, as the file itself has it."""
    said = about(tmp_path, JULY)
    expected = {
        ("file", "Environment and Climate Change Canada", JULY.name),
        ("place", "43.63 N, 79.40 W", "0 km from the site, 43.63 N, 79.40 W (--site)"),
        ("hours", "744", "2021-07-01 00:00-05:00 to 2021-07-31 23:00-05:00"),
        ("temperature", "degC", "13.6 to 32.7, mean 21.1; 6 missing"),
        # The sum of its column of precipitation.
        ("rain", "112.3 mm", "2021-07, 744 hours"),
        ("rain", "1 h late", "each time is the end of an hour; a run treats it as the start"),
        ("interpolated", "temperature", "2021-07-20T13:00-05:00 to 2021-07-20T17:00-05:00 "
         "(5 hours); 2021-07-21T11:00-05:00"),
    }
    assert expected <= {*said}
    assert said[-1][:2] == ("evapotranspiration", "fao56")
    assert not any(row[0] == "MISSING" for row in said)
    (suspicious,) = (row[2] for row in about(tmp_path, DECEMBER) if row[0] == "SUSPICIOUS")
    assert suspicious.startswith("rain is 79.2 mm at 2015-12-29T02:00-05:00")


def test_what_a_file_of_elsewhere_is(tmp_path: Path) -> None:
    """A run refuses it; here its distance is given: a degree of latitude is 111.2 km."""
    said = about(tmp_path, open_meteo(tmp_path / "answer.json", latitude=44.63))
    assert ("file", "Open-Meteo", "answer.json") in said
    (place,) = (row[2] for row in said if row[0] == "place")
    assert place.startswith("111 km from the site")
    notes = [row[2] for row in said if row[0] == "note"]
    assert any("precipitation (mm) of -999 at 2021-07-08T16:00" in note for note in notes)
    assert ("MISSING", "precipitation", "2021-07-08T15:00-05:00") in said


def test_monthly_means_are_those_of_a_site_file(tmp_path: Path) -> None:
    """Of reference grass, whatever grows on the roof; a shorter record has none."""
    hours = np.arange("2024-01-01", "2025-01-01", dtype="datetime64[h]")
    year = tmp_path / "year.csv"
    year.write_text("\n".join(["time,rain [mm],temperature [degC]", *(
        f"{hour}:00-05:00,0,{10 - 9 * np.cos(at / 1398) - 5 * np.cos(at / 3.82):.1f}"
        for at, hour in enumerate(hours)
    )]))
    site = site_file(tmp_path, crop_coefficient=0.5)
    (said,) = (row[2] for row in about(tmp_path, year, "--site", site) if row[1] == "monthly")
    (tmp_path / "other.yaml").write_text(f"extends: {site.name}\n{said}\n")
    means = read_site(tmp_path / "other.yaml").monthly_evapotranspiration
    whole = read_weather([year], read_site(CONFIG / "site.yaml"))
    in_july = [
        rate for hour, rate in enumerate(whole.evapotranspiration.tolist())
        if (whole.first + timedelta(hours=hour)).month == 7
    ]
    assert means is not None
    assert means[6] == pytest.approx(sum(in_july) / len(in_july), abs=0.005)
    assert not any(row[1] == "monthly" for row in about(tmp_path, JULY))


def test_years_are_summed(tmp_path: Path) -> None:
    """A millimetre an hour for more than two years: 8760 or 8784 mm, and 744 in a month."""
    hours = np.arange("2019-01-01", "2021-02-01", dtype="datetime64[h]")
    file = tmp_path / "years.csv"
    file.write_text("\n".join(["time,rain [mm]", *(f"{hour}:00Z,1" for hour in hours)]))
    assert [row[1:] for row in about(tmp_path, file) if row[0] == "rain"] == [
        ("8760.0 mm", "2019, 8760 hours"), ("8784.0 mm", "2020, 8784 hours"),
        ("744.0 mm", "2021, 744 hours"),
    ]


def test_an_output_that_exists_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rain.csv").write_text("time,rain [mm]\n2021-07-01T00:00Z,1\n")
    done = weather(tmp_path, "rain.csv", "--output", "rain.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: --output = 'rain.csv': exists")
