"""``greenroof weather``: what a file is, and the same weather as one CSV."""

from __future__ import annotations

import os
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
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


@pytest.mark.parametrize("file", [DECEMBER, PACKAGED], ids=["frost", "packaged"])
def test_a_run_has_the_same_numbers_with_the_csv(tmp_path: Path, file: Path) -> None:
    """Every hour's values are equal in each bit, and so is what a run makes of them."""
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
    assert own.frost.tobytes() == given.frost.tobytes()


def test_what_the_file_of_a_service_is(tmp_path: Path) -> None:
    """July 2021 at Toronto City Centre, as the file itself has it."""
    said = {row[0]: row for row in about(tmp_path, JULY)}
    assert said["hours"][1:] == ("744", "2021-07-01 00:00-05:00 to 2021-07-31 23:00-05:00")
    assert (said["rain"][1], said["no temperature"][1]) == ("1 h late", "6 h")
    assert said["evapotranspiration"][1] == "fao56"
    summaries = " ".join(row[2] for row in about(tmp_path, JULY) if row[0] == "summary")
    # The sum of its column of precipitation.
    assert "rain 112.3 mm in 31 days" in summaries and "temperature 6 h" in summaries
    assert "13.6 to 32.7 degC, mean 21.1" in summaries


def test_a_description_is_printed(tmp_path: Path) -> None:
    (tmp_path / "gauge.csv").write_text("Zeit;Regen\n" + "".join(
        f"01.07.2024 {hour:02}:00;0,{hour}\n" for hour in range(10)
    ))
    printed = weather(tmp_path, "gauge.csv", "--describe").stdout
    assert "time_zone: '?'" in printed and "precipitation: '?'" in printed


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
    whole = read_weather([year], read_site(CONFIG / "site.yaml")).evapotranspiration
    in_july = whole[hours.astype("datetime64[M]") == np.datetime64("2024-07")]
    assert means is not None and means[6] == pytest.approx(in_july.mean(), abs=0.005)
    assert not any(row[1] == "monthly" for row in about(tmp_path, JULY))


def test_years_are_summed(tmp_path: Path) -> None:
    """A millimetre an hour for more than two years: 8760 or 8784 mm, on the clock of the file.

    With a site file, the sums are on the site's clock.
    """
    hours = np.arange("2019-01-01", "2021-02-01", dtype="datetime64[h]")
    file = tmp_path / "years.csv"
    file.write_text("\n".join(["time,rain [mm]", *(f"{hour}:00Z,1" for hour in hours)]))
    for options, sums in (
        ((), "(2019 8760, 2020 8784, 2021 744)"),
        (("--site", site_file(tmp_path)), "(2018 5, 2019 8760, 2020 8784, 2021 739)"),
    ):
        summary = next(row[2] for row in about(tmp_path, file, *options) if row[0] == "summary")
        assert sums in summary
