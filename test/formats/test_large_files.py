"""Large files: an error is reported when its line is reached, and no file exhausts the memory."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from places import CONFIG, DATA
from refusals import refusal
from twins import TWIN

from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.forecast.archive import read_archive, read_records
from greenroof_ros.site.file import read_site

TORONTO = read_site(CONFIG / "site.yaml")
OWN = "time,precipitation [mm/h],temperature [degC]\n2021-07-07T03:00-05:00,0.1,20\n"
ISSUES = (
    "issued,time,member,precipitation [mm/h]\n"
    "2021-07-07T00:00Z,2021-07-07T00:00Z,0,0.1\n"
)
PLACE = (
    "latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation\n"
    "43.62,-79.42,77.0,0,GMT,GMT\n"
)
SERVICE = (
    f"{PLACE}time,precipitation (mm),temperature_2m (°C),dew_point_2m (°C),wind_speed_10m (km/h),"
    "surface_pressure (hPa)\n2021-07-07T05:00,0.1,20,12,9,1001\n"
)
PREVIOUS = "time,precipitation_previous_day1\n2024-03-01T01:00,0.1\n"
ECCC = "".join((DATA / "en_climate_hourly_07-2021.csv").read_text("utf-8").splitlines(True)[:2])
MEASURED = (
    "time,rain [mm],runoff [mm],temperature [degC]\n2021-06-01T00:00,0,0,20\n"
    "2021-06-01T00:05,0,0,20\n"
)


def weather(file: Path) -> object:
    return read_records(file, TORONTO)


def archive(file: Path) -> object:
    return read_archive(file, TORONTO)


def measured(file: Path) -> object:
    return read_csv_record(file, TWIN)


READERS: list[tuple[str, str, Callable[[Path], object], str]] = [
    # The start of a file, the line behind it, how it is read, and why that line is refused.
    (OWN, "2021-07-07T03:00-05:00,0.1,20", weather, "line 3: time = .* must be later than"),
    (ISSUES, "2021-07-07T00:00Z,2021-07-07T02:00Z,0,0.1", archive, "line 3: time = .* consecutive"),
    (SERVICE, "2021-07-07T05:00,0.1,20,12,9,1001", weather, "line 5: time = .*of hours later"),
    (PREVIOUS, "2024-03-01T01:30,0.1", archive, "line 3: time = '2024-03-01T01:30'"),
    (ECCC, ECCC.splitlines()[1], weather, "line 3: .*a whole number of hours later"),
    (MEASURED, "2021-06-01T00:00,0,0,20", measured, "line 4: time = .* must be later"),
]


@pytest.mark.parametrize(("top", "line", "read", "reason"), READERS)
def test_an_error_is_reported_when_its_line_is_reached(
    tmp_path: Path, top: str, line: str, read: Callable[[Path], object], reason: str
) -> None:
    """Of 95 MB: the rest was not read, as it is not even text."""
    file = tmp_path / "large.csv"
    file.write_text(f"{top}{line}\n", encoding="utf-8")
    with file.open("ab") as stream:
        stream.write(b"\xff\n")
        stream.truncate(95_000_000)
    tracemalloc.start()
    began = time.process_time()
    try:
        with pytest.raises(ConfigurationError, match=reason) as caught:
            read(file)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()
    assert time.process_time() - began < 1
    assert "UTF-8" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "read"),
    [("weather.csv", weather), ("weather.json", weather), ("forecasts.csv", archive),
     ("previous.json", archive), ("measured.csv", measured),
     ("site.yaml", read_site)],
)
def test_a_file_of_any_kind_that_is_too_large(
    tmp_path: Path, name: str, read: Callable[[Path], object]
) -> None:
    """One limit for all, and what to do."""
    file = tmp_path / name
    with file.open("w") as stream:
        stream.truncate(150_000_000)
    assert refusal(read, file) == (
        f"{file}: is 150 MB in size, but the limit is 100 MB: delete the data that no run needs, "
        "or split the file (weather can be given as several files, and forecasts as a directory of "
        "files)"
    )


def test_memory_of_a_valid_file(tmp_path: Path) -> None:
    """380 kB of weather take less than 5 MB."""
    file = tmp_path / "weather.csv"
    hours = np.datetime64("1981-01-01T00:00") + np.arange(12_000).astype("timedelta64[h]")
    file.write_text(OWN.splitlines()[0] + "\n" + "".join(
        f"{hour}-05:00,{hour.astype(int) % 9 / 10},{hour.astype(int) % 300 / 10}\n"
        for hour in hours
    ))
    read_records(file, TORONTO)  # imports what it needs
    tracemalloc.start()
    hours_read = read_records(file, TORONTO).hours
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert hours_read == 12_000
    assert peak < 5e6
