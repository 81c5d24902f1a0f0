"""Archives of forecasts: own form, and previous runs and runs of Open-Meteo."""

from __future__ import annotations

import csv
import json
import math
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from archives import answer
from places import CONFIG, DATA
from refusals import refusal

from greenroof_ros.base.times import parse_time
from greenroof_ros.forecast.archive import read_archive, read_forecasts, write_forecasts
from greenroof_ros.site.file import read_site

TORONTO = read_site(CONFIG / "site.yaml")
GEM = DATA / "gem_global_previous_runs_2024-03.csv"
KNMI = DATA / "knmi_seamless_previous_runs_2024-02.csv"
HOUR = timedelta(hours=1)


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
        [(issue.issued, issue.rain.tolist()) for issue in read_archive(source, TORONTO).issues]
        for source in (
            KNMI, tmp_path / "aware.csv", tmp_path / "parts", tmp_path / "answer.json",
        )
    )
    assert others == [whole, whole, whole]


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
    file = tmp_path / "own.csv"
    file.write_text("\n".join([header, *rows]))
    issues = read_forecasts(file)
    assert issues[0].rain.tolist() == [[1.0, 2.0, 3.0], [1.0, 0.0, 0.0]]
    assert "1 missing hours of precipitation" in issues[0].notes[0]
    (tmp_path / "again.csv").write_text(write_forecasts(issues))
    again = read_forecasts(tmp_path / "again.csv")
    assert [issue.rain.tolist() for issue in again] == [issue.rain.tolist() for issue in issues]
    newest = read_forecasts(file, parse_time("2021-07-07T07:00Z"))
    assert [issue.issued.hour for issue in newest] == [6]


# --- what is refused ------------------------------------------------------------------------------


def run_of(day: int = 1, **columns: list[Any]) -> str:
    """Return the JSON of a run on a day of June."""
    rain = {"precipitation": [0.0] * 6, **columns}
    return json.dumps(answer(f"2024-06-{day:02}T12:00", 6, **rain))


HEAD = KNMI.read_text().splitlines()[0]
ROWS = ["2024-03-01 00:00:00,0.0,0.1,0.2,0.3,0.4", "2024-03-01 01:00:00,0.0,0.1,0.2,0.3,0.4"]
OWN = "issued,time,precipitation [mm/h]\n2024-06-01T00:00Z,2024-06-01T00:00Z,0\n"
WRONG = {
    "cut.json": ('{"latitude": 42.25,\n"long', ": is not valid JSON, or is nested too deeply: "),
    "deep.json": ("[" * 200_000, ": is not valid JSON, or is nested too deeply: "),
    "refusal.json": (
        '{"error": true, "reason": "Daily API request limit exceeded."}',
        ": is an error message from the service: Daily API request limit",
    ),
    "days.json": ('{"daily": {"time": ["2021-07-07"]}}', ": must be an answer of Open-Meteo"),
    "temperature.csv": (
        "\n".join([HEAD.replace("precipitation", "temperature_2m"), *ROWS, ""]),
        ", line 1: 'datetime': must begin with 'issued'",
    ),
    "half.csv": (
        "\n".join([HEAD, *ROWS, "2024-03-01 01:30:00,0,0,0,0,0"]), ", line 4: datetime = ",
    ),
    "word.csv": ("\n".join([HEAD, ROWS[0].replace("0.1", "rain")]),
                 ", line 2: precipitation_previous_day2 = 'rain'"),
    "unnamed.json": (run_of(), ": the file name must end with the time of the run"),
    "other_2024060118.json": (run_of(), ": must contain the hour after its run, 2024-06-01T18:00"),
    "hours.csv": (
        "\n".join([HEAD, *(f"2024-03-01 {hour:02}:00:00,0,0,0,0,0" for hour in range(2, 7))]),
        ": must contain a value for an hour that starts at 00, 06, 12 or 18 UTC",
    ),
    "gap.csv": (OWN + "2024-06-01T00:00Z,2024-06-01T02:00Z,0\n", ", line 3: time = "),
    "early.csv": (OWN + "2024-05-31T00:00Z,2024-05-31T00:00Z,0\n", ", line 3: issued = "),
    "negative.csv": (OWN.replace(",0\n", ",-1\n"), ", line 2: precipitation [mm/h] = '-1'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files(tmp_path: Path, name: str) -> None:
    """Refused with the file, its line or key, the value and what would be right."""
    text, reason = WRONG[name]
    file = tmp_path / name
    file.write_text(text, encoding="utf-8")
    assert refusal(read_archive, file, TORONTO).startswith(f"{file}{reason}")


def test_wrong_directories(tmp_path: Path) -> None:
    """An archive has one form, one kind, and each issue once."""
    refusal(read_archive, tmp_path, TORONTO, match="must contain forecast files")
    (tmp_path / "a_2024060112.json").write_text(run_of(1))
    for name, text, wrong in (
        ("README.md", "# Forecasts", r"README.md: must have the suffix .csv or .json, like "),
        (
            "b_2024060112.json", run_of(1, precipitation=[1.0] * 6),
            r"contains the issue of 2024-06-01T12:00.00:00, which is already in a_2024060112.json",
        ),
        ("b.csv", GEM.read_text(), r"a_2024060112.json: must contain previous runs, like b.csv"),
        ("b.csv", OWN, r"b.csv: must have the form of a_2024060112.json, like"),
    ):
        (tmp_path / name).write_text(text)
        refusal(read_archive, tmp_path, TORONTO, match=wrong)
        (tmp_path / name).unlink()
    (tmp_path / "b_2024060212.json").write_text(run_of(2))
    assert len(read_archive(tmp_path, TORONTO).issues) == 2
