"""Open-Meteo's files: past weather, previous runs, single runs and ensembles.

The weather is made up; the previous runs are as they were saved by a program.
"""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import answer
from places import CONFIG, DATA
from refusals import refusal

from greenroof_ros.base.times import parse_time
from greenroof_ros.forecast.archive import read_archive
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_weather

TORONTO = read_site(CONFIG / "site.yaml")
GEM = DATA / "gem_global_previous_runs_2024-03.csv"
KNMI = DATA / "knmi_seamless_previous_runs_2024-02.csv"
HOUR = timedelta(hours=1)

# --- past weather ------------------------------------------------------------------------------

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
        "precipitation and solar radiation in the files are for the hour before the time stamp, "
        "and were moved back by one hour",
    )


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


@pytest.mark.parametrize(
    ("line", "old", "new", "reason"),
    [
        (2, "-79.41748", "79.4", "longitude = '79.4': must be within 0.5 degrees of the site's"),
        (2, ",77.0,", ",900.0,", "elevation = '900.0': must be within 300 m of the site's elevat"),
        (2, "43.620384", "north", "latitude = 'north': must be a number from -90 to 90"),
        (4, "precipitation (mm)", "rain (mm)", "must have a column 'precipitation (mm)', like"),
        # An unknown unit is never guessed.
        (4, "(km/h)", "(Bft)", "'wind_speed_10m (Bft)': must have the unit km/h or m/s"),
        (4, "dew_point_2m (°C)", "temperature_2m (°F)", "'temperature_2m (°F)': must have the"),
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
    refusal(read_weather, [path], anywhere, match="fao56 requires latitude, longitude in t")
    path = write(tmp_path, place=f"location_id,{PLACE}", values=f"1,{VALUES}")
    match = "line 2: location_id = '1': must be for a single location"
    refusal(read_weather, [path], TORONTO, match=match)
    path.write_text(f"{PLACE}\n{VALUES}\n")
    refusal(read_weather, [path], TORONTO, match="must begin with two lines")


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


# --- previous runs -----------------------------------------------------------------------------


def saved(file: Path) -> dict[datetime, list[float]]:
    """Return the rain of the hour that begins at each time, 1 to 5 days before it."""
    with file.open() as stream:
        rows = list(csv.reader(stream))[1:]
    return {
        parse_time(f"{row[0]}+00:00") - HOUR: [float(cell or "nan") for cell in row[1:]]
        for row in rows
    }


@pytest.mark.parametrize("file", [GEM, KNMI])
def test_issues_of_previous_runs(file: Path) -> None:
    """At 00, 06, 12 and 18 UTC each later hour has the newest value that was old enough.

    A value of N days is at least 24 N hours old at the end of its hour. If one is missing, an
    older one was known, too; an issue ends where none was known.
    """
    rows = saved(file)
    archive = read_archive(file, TORONTO)
    assert (archive.kind, archive.delay) == ("Open-Meteo, previous runs", 6.0)
    by_time = {issue.issued: issue for issue in archive.issues}
    for start in rows:
        if start.hour % 6:
            assert start not in by_time
            continue
        expected = []
        for lead in range(120):
            values = rows.get(start + lead * HOUR, [math.nan] * 5)
            known = [
                value for day, value in enumerate(values, start=1)
                if 24 * day >= lead + 1 and not math.isnan(value)
            ]
            if not known:
                break
            expected.append(known[0])
        if expected:
            assert by_time.pop(start).rain.tolist() == [expected]
    assert not by_time


def test_the_same_in_all_forms(tmp_path: Path) -> None:
    """With offset and byte order mark; in two files that have some hours in common.

    No issue ends where a file ends.
    """
    header, *lines = KNMI.read_text().splitlines()
    aware = [f"{datetime.fromisoformat(line[:19]) + HOUR}+01:00{line[19:]}" for line in lines]
    (tmp_path / "aware.csv").write_text("\n".join([f"\ufeff{header}", *aware, ""]))
    (tmp_path / "parts").mkdir()
    for name, low, high in (("b.csv", 0, 300), ("a.csv", 280, 552)):
        (tmp_path / "parts" / name).write_text("\n".join([header, *lines[low:high], ""]))
    whole, *others = (
        [(issue.issued, issue.rain.tolist()) for issue in read_archive(source, TORONTO).issues]
        for source in (KNMI, tmp_path / "aware.csv", tmp_path / "parts")
    )
    assert others == [whole, whole]


# --- runs and ensembles ------------------------------------------------------------------------


def test_runs(tmp_path: Path) -> None:
    """Each begins at the run in its file's name, and ends at the model's horizon.

    The rain at that time fell before it, and is left out; so are earlier hours, which an answer has
    on request. Control and members are in the order of their numbers.
    """
    for name, factor in (("gem_2024060112", 1.0), ("gem-2024-06-01T18", 2.0)):
        (tmp_path / f"{name}.json").write_text(json.dumps(answer(
            "2024-06-01T00:00", 24,
            precipitation_member02=[2 * factor] * 23 + [None],
            precipitation=[0.0] * 22 + [0.5, None], precipitation_member01=[factor] * 23 + [None],
        )))
    archive = read_archive(tmp_path, TORONTO)
    assert (archive.kind, archive.delay, archive.members) == ("Open-Meteo, runs", 6.0, 3)
    first, second = archive.issues
    assert first.issued.isoformat() == "2024-06-01T12:00:00+00:00"
    assert second.issued - first.issued == 6 * HOUR
    assert first.rain.tolist() == [[0.0] * 9 + [0.5], [1.0] * 10, [2.0] * 10]
    assert second.rain.tolist() == [[0.0] * 3 + [0.5], [2.0] * 4, [4.0] * 4]
    file = tmp_path / "without_control_2024060112.json"
    members = {f"precipitation_member0{number}": [number] * 6 for number in (2, 1)}
    file.write_text(json.dumps(answer("2024-06-01T12:00", 6, **members)))
    assert read_archive(file, TORONTO).issues[0].rain[:, 0].tolist() == [1.0, 2.0]


# --- what is refused ---------------------------------------------------------------------------


def run_of(day: int = 1, **columns: list[Any]) -> str:
    """Return the JSON of a run on a day of June."""
    rain = {"precipitation": [0.0] * 6, **columns}
    return json.dumps(answer(f"2024-06-{day:02}T12:00", 6, **rain))


HEAD = KNMI.read_text().splitlines()[0]
ROWS = ["2024-03-01 00:00:00,0.0,0.1,0.2,0.3,0.4", "2024-03-01 01:00:00,0.0,0.1,0.2,0.3,0.4"]
WRONG = {
    "cut.json": ('{"latitude": 42.25,\n"long', ", line 2: is not valid JSON: "),
    "deep.json": ("[" * 200_000, ": is JSON that is nested too deeply to be a response"),
    "refusal.json": (
        '{"error": true, "reason": "Daily API request limit exceeded."}',
        ": is not a forecast but an error message from the service: Daily API request limit",
    ),
    "days.json": ('{"daily": {"time": ["2021-07-07"]}}', ": contains no hourly values, only "),
    "daily.json": ('{"hourly": null}', ": hourly: must be a mapping, as in a response"),
    "temperature.csv": (
        "\n".join([HEAD.replace("precipitation", "temperature_2m"), *ROWS, ""]),
        ", line 1: must contain precipitation, precipitation_member01 or precipitation_previous",
    ),
    "unnamed.json": (run_of(), ": the file name must end with the time of the run"),
    "other_2024060118.json": (run_of(), ": must contain the hour after its run, 2024-06-01T18:00"),
    "history_2024010100.csv": (
        "\n".join(["time,precipitation", *(
            f"{parse_time('2024-01-01T00:00Z') + hour * HOUR},0.0" for hour in range(37 * 24)
        )]),
        ": has 887 hours, but a run covers at most 864 hours. For a longer period",
    ),
    "hours.csv": (
        "\n".join([HEAD, *(f"2024-03-01 {hour:02}:00:00,0,0,0,0,0" for hour in range(2, 7))]),
        ": must contain a value for an hour that starts at 00, 06, 12 or 18 UTC",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files(tmp_path: Path, name: str) -> None:
    """Refused with the file, its line or key, the value and what would be right."""
    text, reason = WRONG[name]
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    assert refusal(read_archive, file, TORONTO).startswith(f"{file}{reason}")


def test_wrong_directories(tmp_path: Path) -> None:
    """An archive has one format, one kind, and each issue once."""
    refusal(read_archive, tmp_path, TORONTO, match="must contain forecast files")
    (tmp_path / "a_2024060112.json").write_text(run_of(1))
    for name, text, wrong in (
        ("README.md", "# Forecasts", r"README.md: must have the suffix .csv or .json, like "),
        (
            "b_2024060112.json", run_of(1, precipitation=[1.0] * 6),
            r"contains the issue of 2024-06-01T12:00.00:00, which is already in a_2024060112.json",
        ),
        ("b.csv", GEM.read_text(), r"a_2024060112.json: must contain previous runs, like b.csv"),
        (
            "b.csv", "issued,time,precipitation [mm/h]\n",
            r"must have the format of a_2024060112.json, like",
        ),
    ):
        (tmp_path / name).write_text(text)
        refusal(read_archive, tmp_path, TORONTO, match=wrong)
        (tmp_path / name).unlink()
    (tmp_path / "b_2024060212.json").write_text(run_of(2))
    assert len(read_archive(tmp_path, TORONTO).issues) == 2
