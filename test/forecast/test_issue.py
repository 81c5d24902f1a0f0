"""Issued forecasts and their files: own form, and previous runs of Open-Meteo."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import CONFIG, DATA, refusal

from greenroof_ros.base.times import parse_time
from greenroof_ros.forecast.issue import read_archive, read_forecasts, write_forecasts
from greenroof_ros.site.file import read_site

TORONTO = read_site(CONFIG / "site.yaml")
GEM = DATA / "gem_global_previous_runs_2024-03.csv"
KNMI = DATA / "knmi_seamless_previous_runs_2024-02.csv"
HOUR = timedelta(hours=1)
UNITS = {
    "temperature_2m": "°C", "dew_point_2m": "°C", "relative_humidity_2m": "%",
    "wind_speed_10m": "km/h", "surface_pressure": "hPa", "shortwave_radiation": "W/m²",
}


def answer(first: str, hours: int, **columns: Sequence[Any]) -> dict[str, Any]:
    """Return an answer of Open-Meteo about Toronto, in GMT; without a value a unit is undefined."""
    start = datetime.fromisoformat(first)
    return {
        "latitude": 43.62, "longitude": -79.42, "elevation": 77.0, "utc_offset_seconds": 0,
        "hourly_units": {"time": "iso8601", **{
            name: "undefined" if set(values) == {None} else UNITS.get(name, "mm")
            for name, values in columns.items()
        }},
        "hourly": {
            "time": [f"{start + timedelta(hours=hour):%Y-%m-%dT%H:%M}" for hour in range(hours)],
            **columns,
        },
    }


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
    issues = read_archive(file, TORONTO)
    assert {issue.available - issue.issued for issue in issues} == {6 * HOUR}
    by_time = {issue.issued: issue for issue in issues}
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
    """With offset and byte order mark, as JSON, in two files: no issue ends where a file ends."""
    header, *lines = KNMI.read_text().splitlines()
    aware = [f"{datetime.fromisoformat(line[:19]) + HOUR}+01:00{line[19:]}" for line in lines]
    (tmp_path / "aware.csv").write_text("\n".join([f"\ufeff{header}", *aware, ""]))
    (tmp_path / "parts").mkdir()
    for name, low, high in (("b.csv", 0, 300), ("a.csv", 300, 552)):
        (tmp_path / "parts" / name).write_text("\n".join([header, *lines[low:high], ""]))
    columns = [*zip(*(line.split(",") for line in lines), strict=True)]
    (tmp_path / "answer.json").write_text(json.dumps(answer(
        columns[0][0].replace(" ", "T")[:16], len(lines), **{
            name: [float(cell) if cell else None for cell in cells]
            for name, cells in zip(header.split(",")[1:], columns[1:], strict=True)
        },
    )))
    whole, *others = (
        [(issue.issued, issue.rain.tolist()) for issue in read_archive(source, TORONTO)]
        for source in (
            KNMI, tmp_path / "aware.csv", tmp_path / "parts", tmp_path / "answer.json",
        )
    )
    assert others == [whole, whole, whole]


def test_own_forecasts(tmp_path: Path) -> None:
    """Missing hours are filled by their neighbours; the text that is written is read back."""
    header = (
        "issued,time,member,precipitation [mm/h],evapotranspiration [mm/day],temperature [degC]"
    )
    rows = [
        f"2021-07-07T{issued:02}:00Z,2021-07-07T{issued + hour:02}:00Z,{member},{rain},3.0,18"
        for issued in (0, 6) for member, values in enumerate((["1", "", "3"], ["1", "0", "0"]))
        for hour, rain in enumerate(values)
    ]
    rows[6:] = sorted(rows[6:])  # hour by hour; those of the first issue are one after the other
    file = tmp_path / "own.csv"
    text = "\n".join([header, *rows])
    file.write_text(text.replace("2021-07-07T01:00Z", "2021-07-06T20:00-05:00"))
    issues = read_forecasts(file)
    assert [issue.rain.tolist() for issue in issues] == 2 * [[[1.0, 2.0, 3.0], [1.0, 0.0, 0.0]]]
    assert "1 missing hours of precipitation" in issues[0].notes[0]
    (tmp_path / "again.csv").write_text(write_forecasts(issues))
    again = read_forecasts(tmp_path / "again.csv")
    assert [issue.rain.tolist() for issue in again] == [issue.rain.tolist() for issue in issues]


def test_steps_of_ten_minutes_are_averaged_to_hours(tmp_path: Path) -> None:
    """An hour is the mean of its six steps, whichever minute the issue begins at."""
    file, issued = tmp_path / "own.csv", parse_time("2024-06-01T12:10Z")
    times = [f"{issued + step * timedelta(minutes=10):%Y-%m-%dT%H:%MZ}" for step in range(15)]
    file.write_text("\n".join([OWN.splitlines()[0], *(
        f"{times[0]},{time},{rain}" for rain, time in enumerate(times)
    )]))
    (issue,) = read_forecasts(file)
    assert issue.rain.tolist() == [[2.5, 8.5]]
    assert issue.end == parse_time("2024-06-01T14:10Z")


# --- what is refused ------------------------------------------------------------------------------


HEAD = KNMI.read_text().splitlines()[0]
ROWS = ["2024-03-01 00:00:00,0.0,0.1,0.2,0.3,0.4", "2024-03-01 01:00:00,0.0,0.1,0.2,0.3,0.4"]
OWN = "issued,time,precipitation [mm/h]\n2024-06-01T00:00Z,2024-06-01T00:00Z,0\n"
WRONG = {
    "deep.json": ("[" * 200_000, ": is not valid JSON, or is nested too deeply: "),
    "refusal.json": (
        '{"error": true, "reason": "Daily API request limit exceeded."}',
        ": is an error message from the service: Daily API request limit",
    ),
    "days.json": ('{"daily": {"time": ["2021-07-07"]}}', ": must be an answer of Open-Meteo"),
    "temperature.csv": (
        "\n".join([HEAD.replace("precipitation", "temperature_2m"), *ROWS]),
        ", line 1: 'datetime'",
    ),
    "half.csv": ("\n".join([HEAD, *ROWS, "2024-03-01 01:30:00,0,0,0,0,0"]), ", line 4: datetime"),
    "word.csv": (
        "\n".join([HEAD, ROWS[0].replace("0.1", "rain")]),
        ", line 2: precipitation_previous_day2 = 'rain'",
    ),
    "hours.csv": (
        "\n".join([HEAD, *(f"2024-03-01 {hour:02}:00:00,0,0,0,0,0" for hour in range(2, 7))]),
        ": must contain a value for an hour that starts at 00, 06, 12 or 18 UTC",
    ),
    "gap.csv": (OWN + "2024-06-01T00:00Z,2024-06-01T02:00Z,0\n", ", line 3: time = "),
    "member.csv": (
        OWN.replace("time,", "time,member,").replace("Z,0", "Z,1,0"), ", line 2: member = '1'",
    ),
    "empty.csv": (OWN.replace(",0\n", ",\n"), ", line 2: lacks a value for the hour"),
    "early.csv": (
        OWN.replace("issued,", "issued,available,").replace("Z,2024", "Z,2024-05-31T23:00Z,2024"),
        ", line 2: available = '2024-05-31T23:00Z': must not be before the time of issue",
    ),
    "negative.csv": (OWN.replace(",0\n", ",-1\n"), ", line 2: precipitation [mm/h] = '-1'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files(tmp_path: Path, name: str) -> None:
    """Refused with the file, its line or key, and the value."""
    text, place = WRONG[name]
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    assert refusal(read_archive, file, TORONTO).startswith(f"{file}{place}")


def test_wrong_directories(tmp_path: Path) -> None:
    """An archive has one form and one kind, and no issue occurs twice."""
    refusal(read_archive, tmp_path, TORONTO, match="must contain forecast files")
    (tmp_path / "a.csv").write_text(OWN)
    for name in ("b.csv", "a.csv"):
        (tmp_path / "b.csv").write_text(OWN)
        (tmp_path / name).write_text(GEM.read_text())
        refusal(read_archive, tmp_path, TORONTO, match="b.csv, line 1: ")
    (tmp_path / "a.csv").write_text(OWN.replace(",0\n", ",1\n"))
    (tmp_path / "b.csv").write_text(OWN)
    (tmp_path / "README.md").write_text("# Forecasts")
    refusal(read_archive, tmp_path, TORONTO, match="which is already in a.csv")


def test_issues_with_fewer_members(tmp_path: Path) -> None:
    """A member with less than half of the hours is left out, and so is it in all other issues."""
    file, hours = tmp_path / "a.csv", ("2024-06-01T00:00Z", "2024-06-01T01:00Z")
    file.write_text(
        "issued,time,member,precipitation [mm/h],temperature [degC]\n" + "".join(
            f"{hours[0]},{time},{member},{'' if member == 2 else member},\n"
            for member in range(3) for time in hours
        ) + "".join(f"{hours[1]},{hours[1]},{member},{member},\n" for member in range(3))
    )
    first, second = read_archive(file, TORONTO, 2.0)
    assert first.rain.tolist() == [[0.0] * 2, [1.0] * 2] and second.rain.tolist() == [[0.0], [1.0]]
    assert "member 2 is left out: it has 0 hours, but the longest" in first.notes[0]
    assert "2 members are used from every issue" in second.notes[0]
    assert np.isnan(first.values["temperature"]).all()
    assert first.available - first.issued == second.available - second.issued == 2 * HOUR
    (tmp_path / "again.csv").write_text(write_forecasts([first]))
    (again,) = read_forecasts(tmp_path / "again.csv")
    assert again.available == first.available and again.repeats(first)
