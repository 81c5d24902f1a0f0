"""Several weather files as one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from paper import paper_run
from places import CONFIG, DATA
from refusals import refusal

from greenroof_ros.common.times import parse_time
from greenroof_ros.experiment.run_directory import write_configuration
from greenroof_ros.model.site import read_site
from greenroof_ros.weather.reading import find_files, read_weather
from greenroof_ros.weather.series import Weather, WeatherSeries

TORONTO = read_site(CONFIG / "site.yaml")
JULY, MARCH = DATA / "en_climate_hourly_07-2021.csv", DATA / "en_climate_hourly_03-2021.csv"


def piece(path: Path, first: int, last: int, *, rain: bool = True) -> Path:
    """Write the records first..last (from 0) of July; the first one with or without its rain."""
    header, *records = JULY.read_text(encoding="utf-8-sig").splitlines()
    chosen = records[first : last + 1]
    if not rain:
        cells = chosen[0].split(",")
        cells[header.replace('"', "").split(",").index("Precip. Amount (mm)")] = " "
        chosen[0] = ",".join(cells)
    path.write_text("\n".join([header, *chosen]) + "\n", encoding="utf-8")
    return path


def same(weather: Weather, expected: Weather) -> None:
    """Check that two weathers are equal bit for bit, except for their files."""
    assert (weather.first, weather.method) == (expected.first, expected.method)
    for own, due in ((weather.values, expected.values), (weather.filled, expected.filled)):
        assert {name: series.tobytes() for name, series in own.items()} == {
            name: series.tobytes() for name, series in due.items()
        }


@pytest.mark.parametrize(
    "spans",
    [
        [(481, 743), (0, 480)],  # in a gap of station pressure, 20 July 13:00 to 17:00
        [(0, 400), (200, 600), (100, 150), (550, 743)],
    ],
)
def test_pieces_of_a_month_are_the_month(tmp_path: Path, spans: list[tuple[int, int]]) -> None:
    """In any order, with equal overlaps: each gap is filled as in the complete file."""
    files = [piece(tmp_path / f"{first}.csv", first, last) for first, last in spans]
    joined = read_weather(files, TORONTO)
    same(joined, read_weather([JULY], TORONTO))
    assert [int(file.stem) for file in joined.files] == sorted(first for first, _ in spans)


def test_months_far_from_each_other() -> None:
    """March and July: 1,488 hours with records, 2,928 without in between.

    1 April to 30 June are 91 days without data; 31 + 91 + 31 are 153 days.
    """
    weather = read_weather([JULY, MARCH], TORONTO)
    assert weather.files == (MARCH, JULY)
    assert len(weather.precipitation) == 153 * 24
    march, july = read_weather([MARCH], TORONTO), read_weather([JULY], TORONTO)
    assert weather.precipitation[:744].tobytes() == march.precipitation.tobytes()
    assert np.isnan(weather.precipitation[744:-744]).all()
    assert weather.evapotranspiration[-744:].tobytes() == july.evapotranspiration.tobytes()
    site = replace(TORONTO, tau=600.0, M=1)
    said = refusal(WeatherSeries, weather, site, parse_time("2021-03-31T12:00-05:00"), 6 * 24)
    assert said.startswith(
        f"{DATA / '2 files'}, {MARCH.name} to {JULY.name}: precipitation is missing at "
        "2021-04-01T00:00-05:00 to 2021-04-01T12:00-05:00 (13 hours)"
    )


def test_value_that_one_file_lacks(tmp_path: Path) -> None:
    """The other file's value is used, whichever comes first."""
    lacking = piece(tmp_path / "a.csv", 0, 30, rain=False)
    whole = piece(tmp_path / "b.csv", 0, 743)
    expected = read_weather([JULY], TORONTO)
    for files in ([lacking, whole], [whole, lacking]):
        same(read_weather(files, TORONTO), expected)


COLUMN = "published evapotranspiration [mm/day]"


def own(directory: Path, first: str, column: str = COLUMN, rain: float = 0.1) -> Path:
    """Write two hours of a file in this project's format."""
    begin = np.datetime64(first, "m")
    path = directory / f"{first[8:].replace(':', '')}-{column[:4]}-{rain}.csv"
    path.write_text("\n".join([
        f"time,precipitation [mm/h],{column}",
        *(f"{begin + np.timedelta64(hour, 'h')}-05:00,{rain},1.0" for hour in range(2)), "",
    ]))
    return path


def test_what_cannot_be_joined(tmp_path: Path) -> None:
    """Other values or quantities, another method, hours that begin at another minute."""
    early = own(tmp_path, "2021-07-01T00:00")
    for late, reason in (
        (own(tmp_path, "2021-07-01T02:00", "lysimeter evapotranspiration [mm/day]"),
         f"must have the same method of evapotranspiration as {early}, published; it has lysimet"),
        (own(tmp_path, "2021-07-01T02:30"),
         "its hours begin at 2021-07-01T02:30-05:00, which must be a whole number of hours from "
         f"2021-07-01T00:00-05:00, as in {early}"),
        (own(tmp_path, "2021-07-01T01:00", rain=9.9),
         f"precipitation at 2021-07-01T01:00-05:00 = 9.9: must be 0.1, as in {early}, or the files "
         "must not overlap"),
        (JULY, f"must have the same quantities as {early}, evapotranspiration, precipitation; it "
         "has dew point, precipitation, station pressure, temperature, wind speed"),
    ):
        assert refusal(read_weather, [early, late], TORONTO).startswith(f"{late}: {reason}")


def test_names_and_patterns(tmp_path: Path) -> None:
    """A name as it is, a pattern sorted, each file once; the name of a file is not a pattern."""
    for name in ("b-1.csv", "b-2.csv", "a.csv", "c[1].csv"):
        (tmp_path / name).write_text("")
    def files(*names: str) -> list[str]:
        return [path.name for path in find_files(names, "--weather", tmp_path)]

    assert files("b-*.csv") == ["b-1.csv", "b-2.csv"]
    assert files("b-2.csv", "b-?.csv", "a.csv") == ["b-2.csv", "b-1.csv", "a.csv"]
    assert files("c[1].csv") == ["c[1].csv"]
    assert files("absent.csv") == ["absent.csv"]  # reading it is an error
    assert find_files([str(tmp_path / "b-[1].csv")], "--weather") == [tmp_path / "b-1.csv"]
    refusal(files, "a.csv", "d-*.csv", match=r"--weather = 'd-\*\.csv': matches no file")


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
    same(read_weather(sorted(kept.glob("*")), TORONTO), run.weather)
