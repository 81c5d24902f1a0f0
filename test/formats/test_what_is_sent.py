"""What services, gauges and loggers really send: one bad value never costs the others."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import archives
import numpy as np
import pytest
from paper import PAPER_SITE
from places import CONFIG, DATA
from refusals import refusal

from greenroof_ros.base.times import parse_time
from greenroof_ros.forecast.archive import read_forecasts
from greenroof_ros.forecast.archive import read_archive, read_records
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.read import read_weather
from greenroof_ros.weather.series import Weather, align_to_hours

TORONTO = read_site(CONFIG / "site.yaml")
JULY = DATA / "en_climate_hourly_07-2021.csv"
HOUR = timedelta(hours=1)

# --- one value of a series ------------------------------------------------------------------------

USUAL = {
    "precipitation": 0.1, "temperature_2m": 20.0, "dew_point_2m": 12.0, "wind_speed_10m": 9.0,
    "surface_pressure": 1001.0, "shortwave_radiation": 100.0,
}


def answer(hours: int = 72, first: str = "2021-07-07T05:00", **columns: Sequence[Any]) -> str:
    """Return a JSON answer about Toronto, with some columns other than usual."""
    series = {name: [value] * hours for name, value in USUAL.items()} | columns
    return json.dumps(archives.answer(first, hours, **series))


def among(value: Any, usual: float, at: int = 30, hours: int = 72) -> list[Any]:
    """Return a series with one other value."""
    return [*[usual] * at, value, *[usual] * (hours - at - 1)]


def weather(directory: Path, site: Site = TORONTO, **columns: Sequence[Any]) -> Weather:
    """Return the weather of an answer."""
    file = directory / "weather.json"
    file.write_text(answer(**columns))
    return read_weather([file], site)


@pytest.mark.parametrize(
    ("name", "quantity", "value", "expected"),
    [
        ("shortwave_radiation", "solar radiation", -0.3, 0.0),
        ("shortwave_radiation", "solar radiation", -13159.9, np.nan),
        ("temperature_2m", "temperature", -999, 20.0),  # bridged
        ("surface_pressure", "station pressure", -32768, 100.1),
    ],
)
def test_one_value(
    tmp_path: Path, name: str, quantity: str, value: Any, expected: float
) -> None:
    """A small negative value is treated as 0, another as missing; the note names value and time."""
    read = weather(tmp_path, **{name: among(value, USUAL[name])})
    at = 30 - (quantity in read.shifted)
    # The records begin with the first whole hour, at the answer's first time.
    assert read.first.isoformat() == "2021-07-07T05:00:00+00:00"
    assert read.values[quantity][at] == pytest.approx(expected, nan_ok=True)
    note = next(note for note in read.notes if f"{name} (" in note)
    assert f"{value} at 2021-07-08T11:00" in note and "weather.json" in note
    others = np.delete(read.values[quantity], at)
    assert not np.isnan(others).any()


@pytest.mark.parametrize(
    ("column", "reason"),
    [
        ([900.0] * 72, r"precipitation\[0\] = '900.0': must be a number from 0 to 500 mm"),
        ([600.0] * 3 + [5.0] * 69, r"precipitation\[0\] = '600.0'"),
        (["NaN", None, *["?"] * 70], r"precipitation\[2\] = '\?': must be a number"),
        ([None] * 72, "has no precipitation: every value is missing"),
    ],
)
def test_too_little_left(tmp_path: Path, column: list[Any], reason: str) -> None:
    """Many implausible values show a wrong unit."""
    refusal(partial(weather, precipitation=column), tmp_path, match=reason)


@pytest.mark.parametrize("code", [-888.8, "#VALUE!"])
def test_an_outage_of_eight_hours(tmp_path: Path, code: Any) -> None:
    """Codes and words cost only their hours, however many they are."""
    read = weather(tmp_path, precipitation=[0.1] * 30 + [code] * 8 + [0.1] * 34)
    assert np.isnan(read.values["precipitation"]).sum() == 8
    assert any("and 5 more is not a plausible value" in note for note in read.notes)


def test_a_loggers_columns(tmp_path: Path) -> None:
    """-999 and words for missing values; humidity above 100 %; dew, negative evapotranspiration."""
    file = tmp_path / "logger.csv"
    header = (
        "time,precipitation [mm/h],temperature [degC],relative humidity [%],wind speed [km/h],"
        "station pressure [kPa]"
    )
    rows = [
        f"2021-07-07T{hour:02}:00-05:00,{rain},20,{humidity},9,100"
        for hour, (rain, humidity) in enumerate(
            [("0.2", "50"), ("-999", "100.4"), ("NAN", "-999"), ("-0.1", "50"), ("1.0", "100")]
            + [("0", "50")] * 19
        )
    ]
    file.write_text("\n".join([header, *rows]))
    read = read_weather([file], TORONTO)
    assert read.precipitation[:5] == pytest.approx([0.2, np.nan, np.nan, 0.0, 1.0], nan_ok=True)
    # FAO-56 Eqs. 11 and 14: at 20 degC and 50 % the dew point is 9.3 degC; at 100 % it is 20.
    assert read.values["dew point"][[0, 1, 4]] == pytest.approx([9.27, 20.0, 20.0], abs=0.02)
    assert [note.split(": ")[1].split(" of ")[0] for note in read.notes] == [
        "precipitation [mm/h]", "precipitation [mm/h]", "relative humidity [%]",
        "relative humidity [%]",
    ]
    file.write_text(
        "time,precipitation [mm/h],own evapotranspiration [mm/day]\n"
        "2021-07-07T00:00Z,0,-0.3\n2021-07-07T01:00Z,0,2.0\n"
    )
    assert read_weather([file], TORONTO).evapotranspiration.tolist() == [0.0, 2.0]


# --- ensembles ------------------------------------------------------------------------------------


def run(directory: Path, name: str = "gem_2021070705.json", **columns: Sequence[Any]) -> Path:
    """Write an answer as a run."""
    file = directory / name
    file.write_text(answer(**columns))
    return file


def test_a_short_control_an_hour_and_an_empty_member(tmp_path: Path) -> None:
    """Cut at what all have, bridge an hour, leave a member out."""
    file = run(
        tmp_path, precipitation=[0.0] * 48 + [None] * 24,
        precipitation_member01=[1.0] * 72, precipitation_member02=among(None, 2.0),
        precipitation_member03=[None] * 72,
    )
    archive = read_archive(file, TORONTO)
    (issue,) = archive.issues
    # The value at the time of the run fell before it.
    assert issue.rain.tolist() == [[0.0] * 47, [1.0] * 47, [2.0] * 47]
    where = "gem_2021070705.json, issue of 2021-07-07T05:00+00:00: "
    assert archive.notes == (
        f"{where}member 3 is left out: it has 0 hours, but the longest member has 71",
        f"{where}is used only for 47 of 71 hours, because later values are missing",
        f"{where}1 missing hours of precipitation were filled with the mean of the adjacent hours",
    )


@pytest.mark.parametrize(
    ("members", "expected"),
    [
        # The first hour has one neighbour; the control without a value is left out.
        ([[None] * 72, [0.0, None, *[3.0] * 70]], [[3.0] * 71]),
        # A member with less than half of the hours costs the others none.
        ([[1.0] * 72, [2.0] * 20 + [None] * 52], [[1.0] * 71]),
        # A longer gap ends the issue.
        ([[1.0] * 50 + [None] * 3 + [1.0] * 19, [2.0] * 72], [[1.0] * 49, [2.0] * 49]),
        ([among(-3276.8, 1.0), [-0.1] * 72], [[1.0] * 71, [0.0] * 71]),
    ],
)
def test_other_ensembles(
    tmp_path: Path, members: list[list[Any]], expected: list[list[float]]
) -> None:
    """More of the kind."""
    file = run(tmp_path, precipitation=members[0], precipitation_member01=members[1])
    assert read_archive(file, TORONTO).issues[0].rain.tolist() == expected


def test_runs_of_an_archive_with_fewer_members(tmp_path: Path) -> None:
    """All have as many as the one with the fewest; one with hardly any is left out."""
    for day, known in ((7, 4), (8, 3), (9, 1)):
        run(
            tmp_path, f"gem_202107{day:02}05.json", first=f"2021-07-{day:02}T05:00", **{
                f"precipitation{suffix}": [float(day)] * 72 if number < known else [None] * 72
                for number, suffix in enumerate(("", "_member01", "_member02", "_member03"))
            },
        )
    archive = read_archive(tmp_path, TORONTO)
    assert [issue.issued.day for issue in archive.issues] == [7, 8]
    assert archive.members == 3
    assert archive.verified is archive.issues
    fewest = "the number of members used from every issue is 3, as in the smallest issue"
    assert fewest in archive.notes


def test_members_that_a_download_lacks(tmp_path: Path) -> None:
    """Members 0, 1 and 3, one without a value; then one unit is null, and another is inch."""
    columns = {f"precipitation_member0{number}": [float(number)] * 72 for number in (1, 3)}
    file = run(tmp_path, precipitation=[-9999] * 72, **columns)
    assert read_archive(file, TORONTO).issues[0].rain.tolist() == [[1.0] * 71, [3.0] * 71]
    content = json.loads(file.read_text())
    content["hourly_units"]["precipitation_member01"] = None
    content["hourly_units"]["precipitation_member03"] = "inch"
    file.write_text(json.dumps(content))
    assert read_archive(file, TORONTO).issues[0].rain[:, 0] == pytest.approx([1.0, 76.2])


def test_downloads_that_failed(tmp_path: Path) -> None:
    """The service's refusal, a file cut short, a run without values, one with a member less."""
    members = {"precipitation": [1.0] * 72, "precipitation_member01": [2.0] * 72}
    for day, columns in ((5, members), (6, members), (7, {"precipitation": [None] * 72}),
                         (8, {"precipitation": [3.0] * 72}), (9, members), (10, members)):
        run(tmp_path, f"gem_202107{day:02}05.json", first=f"2021-07-{day:02}T05:00", **columns)
    (tmp_path / "gem_2021070505.json").write_text('{"error": true, "reason": "limit exceeded"}')
    cut = tmp_path / "gem_2021070605.json"
    cut.write_text(cut.read_text()[:2000])
    archive = read_archive(tmp_path, TORONTO)
    assert [issue.issued.day for issue in archive.issues] == [8, 9, 10]
    assert archive.members == 1
    refused, short, nothing, fewer = archive.notes
    assert "limit exceeded; the file is left out" in refused
    assert "gem_2021070605.json" in short and "is not valid JSON" in short
    assert "gem_2021070705.json: contains no precipitation after the time of its run" in nothing
    assert fewer == "the number of members used from every issue is 1, as in the smallest issue"


def test_own_forecasts(tmp_path: Path) -> None:
    """In this project's format, too."""
    header = (
        "issued,time,member,precipitation [mm/h],evapotranspiration [mm/day],temperature [degC]"
    )
    rows = [
        f"2021-07-07T00:00Z,2021-07-07T{hour:02}:00Z,{member},{rain},3.0,18"
        for member, values in enumerate((["1", "", "3"], ["1", "-0.1", "-999"])) for hour, rain in
        enumerate(values)
    ]
    file = tmp_path / "own.csv"
    file.write_text("\n".join([header, *rows]))
    (issue,) = read_forecasts(file)
    assert issue.rain.tolist() == [[1.0, 2.0], [1.0, 0.0]]
    assert len(issue.notes) == 4 and "-999 at 2021-07-07T00:00Z" in issue.notes[1]


# --- models without some quantity -----------------------------------------------------------------


def test_without_radiation(tmp_path: Path) -> None:
    """It is computed from the day's temperatures, FAO-56 Eq. 50, as in files without the column."""
    columns = {"temperature_2m": [15 + 5 * np.sin(hour / 4) for hour in range(72)]}
    read = weather(tmp_path, shortwave_radiation=[None] * 72, **columns)
    file = tmp_path / "weather.json"
    content = json.loads(file.read_text())
    del content["hourly"]["shortwave_radiation"]
    file.write_text(json.dumps(content))
    without = read_weather([file], TORONTO)
    assert read.evapotranspiration.tobytes() == without.evapotranspiration.tobytes()
    assert not np.isnan(read.evapotranspiration[:48]).any()
    assert f"{file} contains no values of solar radiation" in read.notes
    one = weather(tmp_path, shortwave_radiation=among(None, 100.0), **columns)
    assert not np.isnan(one.evapotranspiration[:48]).any()
    assert one.evapotranspiration[29] == without.evapotranspiration[29]
    assert any(note.startswith("solar radiation is missing for 1 hours") for note in one.notes)


def test_without_temperature(tmp_path: Path) -> None:
    """The site's monthly means, in July 4.02 mm/day times the crop coefficient; no known frost."""
    nothing = partial(weather, temperature_2m=[None] * 72)
    read = nothing(tmp_path, replace(TORONTO, crop_coefficient=0.5))
    assert read.evapotranspiration.tolist() == [pytest.approx(2.01)] * 71
    assert (read.method, read.frost) == ("monthly", None)
    note = "evapotranspiration is taken from the site's monthly means, for lack of temperature"
    assert note in read.notes
    without = replace(TORONTO, monthly_evapotranspiration=None)
    refusal(nothing, tmp_path, without, match="set monthly_evapotranspiration in the site file")


@pytest.mark.parametrize(
    ("name", "lacking"), [("dew_point_2m", "dew point"), ("surface_pressure", "station pressure")]
)
def test_with_temperature_but_not_all_that_fao56_needs(
    tmp_path: Path, name: str, lacking: str
) -> None:
    """Hargreaves' equation, with or without monthly means."""
    course = [15 + 5 * np.sin(hour / 4) for hour in range(72)]
    for site in (TORONTO, replace(TORONTO, monthly_evapotranspiration=None)):
        read = weather(tmp_path, site, **{"temperature_2m": course, name: [None] * 72})
        assert read.method == "hargreaves"
        assert any(f"Eq. 52), for lack of {lacking}" in note for note in read.notes)
        assert read.frost is not None


# --- files of the service's page ------------------------------------------------------------------

HOURLY = ["time,temperature_2m (°C),precipitation (mm)"] + [
    f"2021-07-07T{hour:02}:00,20.0,{hour / 10}" for hour in range(24)
]
SECTIONS = {
    "current": ["time,temperature_2m (°C),precipitation (mm)", "2021-07-07T10:15,20.1,9.9"],
    "minutely_15": ["time,precipitation (mm)", "2021-07-07T00:00,8.8", "2021-07-07T00:15,8.8"],
    "daily": ["time,precipitation_sum (mm)", "2021-07-07,7.7", "2021-07-08,7.7"],
}


@pytest.mark.parametrize("form", ["padded", "carriage returns"])
def test_forms_of_the_services_csv(tmp_path: Path, form: str) -> None:
    """As a spreadsheet saves it, between the other sections."""
    lines = [
        "latitude,longitude,elevation,utc_offset_seconds", "43.62,-79.42,77.0,0", "",
        *SECTIONS["current"], "", *SECTIONS["minutely_15"], "", *HOURLY, "", *SECTIONS["daily"],
    ]
    if form == "padded":
        lines = [line + "," * (3 - line.count(",")) for line in lines]
    file = tmp_path / "gem_2021070700.csv"
    file.write_text(("\r\n" if form == "carriage returns" else "\n").join(lines), "utf-8-sig")
    (issue,) = read_archive(file, TORONTO).issues
    assert issue.rain.tolist() == [[hour / 10 for hour in range(1, 24)]]


def test_names_before_2023(tmp_path: Path) -> None:
    """Dew point, humidity and wind without the underscore."""
    new = weather(tmp_path)
    file = tmp_path / "weather.json"
    text = file.read_text().replace("dew_point_2m", "dewpoint_2m")
    file.write_text(text.replace("wind_speed_10m", "windspeed_10m"))
    old = read_weather([file], TORONTO)
    assert old.evapotranspiration.tobytes() == new.evapotranspiration.tobytes()
    file.write_text(
        text.replace("dewpoint_2m", "relativehumidity_2m")
        .replace('"relativehumidity_2m": "\\u00b0C"', '"relativehumidity_2m": "%"')
    )
    assert read_weather([file], TORONTO).values["dew point"][0] < 0  # 12 %


@pytest.mark.parametrize("name", ["gem_2021070705 (1).json", "gem-2021-07-07T0500(2).json"])
def test_second_downloads(tmp_path: Path, name: str) -> None:
    """A browser numbers them; an equal run is left out, another is refused."""
    assert len(read_archive(run(tmp_path, name), TORONTO).issues) == 1
    run(tmp_path, "gem_2021070705.json")
    archive = read_archive(tmp_path, TORONTO)
    assert len(archive.issues) == 1
    assert "is left out because it has the same content as" in archive.notes[0]
    run(tmp_path, "gem_2021070705.json", precipitation=[1.0] * 72)
    refusal(read_archive, tmp_path, TORONTO, match="contains the issue of 2021-07-07T05:00.00:00")


# --- offsets of half an hour ----------------------------------------------------------------------


@pytest.mark.parametrize(("offset", "late"), [("-03:30", 0.5), ("+05:30", 0.5), ("+05:45", 0.25)])
def test_archives_in_gmt_for_local_records(tmp_path: Path, offset: str, late: float) -> None:
    """An hour that begins between two of the archive has its share of both.

    Hour n of the run has n mm. An hour that begins half an hour later has n / 2 + (n + 1) / 2.
    """
    file = tmp_path / "gauge.csv"
    rows = [f"{datetime(2021, 7, 7) + hour * HOUR}{offset},0" for hour in range(48)]  # noqa: DTZ001
    file.write_text("\n".join(["time,precipitation [mm/h]", *rows]))
    records = read_weather([file], PAPER_SITE, rain_only=True)
    archive = read_archive(run(tmp_path, precipitation=[0, *range(71)]), TORONTO)
    (issue,) = align_to_hours(archive.issues, records)
    assert issue.issued - archive.issues[0].issued == late * HOUR
    assert (issue.issued - records.first) % HOUR == timedelta(0)
    assert issue.rain[0] == pytest.approx(np.arange(70) + late)
    whole = read_weather([JULY], TORONTO)
    assert align_to_hours(archive.issues, whole)[0] is archive.issues[0]


def test_local_times_of_half_an_hour(tmp_path: Path) -> None:
    """The service's data are for whole hours of UTC, which its labels then are not."""
    file = run(tmp_path)
    file.write_text(file.read_text().replace('seconds": 0', 'seconds": -12600'))
    refusal(read_records, file, TORONTO, match="download the data again in GMT")


# --- Environment Canada ---------------------------------------------------------------------------

FRENCH = {
    "Date/Time (LST)": "Date/Heure (HNL)", "Temp Flag": "Temp Indicateur",
    "Dew Point Temp (°C)": "Point de rosée (°C)",
    "Dew Point Temp Flag": "Point de rosée Indicateur",
    "Precip. Amount (mm)": "Hauteur de précip. (mm)",
    "Precip. Amount Flag": "Hauteur de précip. Indicateur",
    "Wind Spd (km/h)": "Vit. du vent (km/h)", "Wind Spd Flag": "Vit. du vent Indicateur",
    "Stn Press (kPa)": "Pression à la station (kPa)",
    "Stn Press Flag": "Pression à la station Indicateur",
}


@pytest.mark.parametrize("form", ["decimal commas", "semicolons", "before 2021"])
def test_french_and_older_names(tmp_path: Path, form: str) -> None:
    """The same values as in the English file."""
    with JULY.open(encoding="utf-8-sig") as stream:
        header, *rows = list(csv.reader(stream))
    names = [FRENCH.get(name, name) for name in header]
    if form == "before 2021":
        names = [name.replace(" (LST)", "") for name in header]
    else:
        rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    file = tmp_path / "fr_climat_horaires.csv"
    with file.open("w", encoding="utf-8-sig", newline="") as stream:
        csv.writer(stream, delimiter=";" if form == "semicolons" else ",").writerows([names, *rows])
    read, english = read_weather([file], TORONTO), read_weather([JULY], TORONTO)
    assert read.rain_late == 1
    for quantity, series in english.values.items():
        assert read.values[quantity].tobytes() == series.tobytes()


@pytest.mark.parametrize(
    ("header", "row", "what"),
    [
        ('"Date/Time","Year","Month","Day","Time","Temp (°C)","Temp Flag"',
         '"2019-07-01 00:00","2019","07","01","00:00","20.1",""', "values without precipitation"),
        ('"Longitude (x)","Latitude (y)","Station Name","Climate ID","Date/Time","Year","Month",'
         '"Day","Data Quality","Max Temp (°C)","Total Precip (mm)"',
         '"-79.4","43.6","X","1","2021-07-01","2021","07","01","","25.0","1.0"',
         "contains daily or monthly values instead of hourly values"),
    ],
)
def test_files_that_do_not_suffice(tmp_path: Path, header: str, row: str, what: str) -> None:
    """The message states what the file is and what to download."""
    file = tmp_path / "climate.csv"
    file.write_text(f"{header}\n{row}\n", encoding="utf-8-sig")
    reason = refusal(read_weather, [file], TORONTO)
    assert reason.startswith(f"{file}, line 1: is a file from Environment Canada that {what}") or (
        what in reason
    )
    assert "download hourly data of the station with precipitation" in reason


# --- loggers --------------------------------------------------------------------------------------


def test_semicolons_decimal_commas_and_rows_left_out(tmp_path: Path) -> None:
    """An hour without a row is missing."""
    file = tmp_path / "logger.csv"
    file.write_text(
        "time;precipitation [mm/h];own evapotranspiration [mm/day]\n"
        "2021-07-07T00:00-05:00;0,5;3,25\n2021-07-07T01:00-05:00;1;3\n"
        "2021-07-07T04:00-05:00;,5;2\n"
    )
    read = read_weather([file], TORONTO)
    assert read.precipitation == pytest.approx([0.5, 1, np.nan, np.nan, 0.5], nan_ok=True)
    assert read_weather([file], TORONTO, gaps="fill").precipitation.tolist() == [0.5, 1, 0, 0, 0.5]
    assert read.evapotranspiration.tolist() == pytest.approx([3.25, 3, 8 / 3, 7 / 3, 2])
    file.write_text(file.read_text().replace("-05:00;1;3", "-05:00"))  # its time alone
    assert read_weather([file], TORONTO).precipitation == pytest.approx(
        [0.5, np.nan, np.nan, np.nan, 0.5], nan_ok=True
    )
    file.write_text(file.read_text().replace("T04", "T01"))
    refusal(read_weather, [file], TORONTO, match="must be later than the time of the previous row")


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("time,precipitation [mm/h],", ["{0},0.5,", "{1},1,"]),
        ("time,precipitation [mm/h]", ["{0},0.5,", "{1},1,", "\x1a"]),
        ("sep=;\ntime;precipitation [mm/h]", ["{0};0,5", "{1};1,0"]),
        ('"# a logger, in a garden"\ntime\tprecipitation [mm/h]', ["{0}\t0,5", "{1}\t1", "\t"]),
        ("time,precipitation [mm/h]", ['{0},"0,5"', '{1},"1,0"', " , "]),
    ],
)
def test_what_spreadsheets_add(tmp_path: Path, header: str, rows: list[str]) -> None:
    """Separators at the end, a line that names the separator, comments in quotes."""
    file = tmp_path / "logger.csv"
    text = "\n".join([header, *rows]).format("2021-07-07T00:00Z", "2021-07-07T01:00Z")
    file.write_text(text)
    assert read_weather([file], TORONTO, rain_only=True).precipitation.tolist() == [0.5, 1.0]


@pytest.mark.parametrize("rest", ["2", "2021-07-07T0", "2021-07-07T02:00Z", "2021-07-07T02:00Z,"])
def test_a_last_line_that_is_cut_off_is_left_out(tmp_path: Path, rest: str) -> None:
    """As where a logger lost power. With a line end, a wrong row is refused like any other."""
    file = tmp_path / "logger.csv"
    rows = ["2021-07-07T00:00Z,0.5,20", "2021-07-07T01:00Z,1.0,21", rest]
    text = "\n".join(["time,precipitation [mm/h],temperature [degC]", *rows])
    file.write_text(text)
    read = read_weather([file], TORONTO, rain_only=True)
    assert read.precipitation.tolist() == [0.5, 1.0]
    assert "logger.csv: line 4 is incomplete and was ignored" in read.notes
    if rest == "2":
        file.write_text(f"{text}\n")
        assert "line 4: time = '2'" in refusal(read_weather, [file], TORONTO)


@pytest.mark.parametrize(
    ("time", "what"),
    [
        ("44384.0416667", "a spreadsheet counts days: format its cells as yyyy-mm-dd hh:mm"),
        ("13/07/2021 00:00", "year, month and day, in this order"),
        ("2021-07-07 00:00 EST", "write the offset from UTC as a number"),
    ],
)
def test_other_forms_of_times(tmp_path: Path, time: str, what: str) -> None:
    """The message states what is wrong with them."""
    refusal(read_weather, [local(tmp_path, [time])], EASTERN, match=what)


def test_a_decimal_comma_between_commas(tmp_path: Path) -> None:
    """It looks like one cell more."""
    file = local(tmp_path, ["2021-07-07 00:00"])
    file.write_text(file.read_text() + ",5")
    refusal(read_weather, [file], EASTERN, match="quote numbers with decimal commas, or separate")


EASTERN = replace(TORONTO, time_zone="America/Toronto")


def local(directory: Path, times: Sequence[str]) -> Path:
    """Write an hourly file with times without an offset."""
    file = directory / "local.csv"
    file.write_text("\n".join(
        ["time,precipitation [mm/h]", *(f"{time},{row}" for row, time in enumerate(times))]
    ))
    return file


def test_a_clock_with_daylight_saving(tmp_path: Path) -> None:
    """By the site's time_zone: 1 o'clock comes twice in autumn, and 2 o'clock never in spring."""
    autumn = [f"2021-11-07 {hour:02}:00" for hour in (0, 1, 1, 2)]
    read = read_weather([local(tmp_path, autumn)], EASTERN, rain_only=True)
    assert read.first.isoformat() == "2021-11-07T00:00:00-04:00"
    assert read.precipitation.tolist() == [0, 1, 2, 3]
    spring = [f"2021-03-14 {hour:02}:00" for hour in (0, 1, 3, 4)]
    read = read_weather([local(tmp_path, spring)], EASTERN, rain_only=True)
    assert read.precipitation.tolist() == [0, 1, 2, 3]
    # A clock on standard time has the hour that clocks in Toronto skip.
    file = local(tmp_path, ["2021-03-14 01:00", "2021-03-14 02:00"])
    refusal(read_weather, [file], EASTERN, match="in an hour that clocks in America/Toronto skip")
    assert "set time_zone in the site file" in read_weather([file], TORONTO).notes[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2021-07-07T02:00+0000", "2021-07-07T02:00:00+00:00"),
        ("2021-07-07T0200Z", "2021-07-07T02:00:00+00:00"),
        ("2021-07-07 02:00:00.123456789-05:00", "2021-07-07T02:00:00.123456-05:00"),
        ("20210707T020000z", "2021-07-07T02:00:00+00:00"),
        ("2021-07-07t02-05", "2021-07-07T02:00:00-05:00"),
        ("2021-07-07T02:00:00,5Z", "2021-07-07T02:00:00.500000+00:00"),
        ("2021-07-07T24:00-03:30", "2021-07-08T00:00:00-03:30"),
        ("2021-07-07", "2021-07-07T00:00:00"),
        ("2021-07-07 02:00 +05:45", "2021-07-07T02:00:00+05:45"),
    ],
)
def test_times(text: str, expected: str) -> None:
    """The same on each version of Python."""
    assert parse_time(text).isoformat() == expected


@pytest.mark.parametrize(
    "text",
    ["2021-W27-3", "2021-0707", "2021-07-07T2:00", "2021-07-07T24:01Z", "2021-07-07T02:00+25:00",
     "2021-07-07T02:00:00.Z", "2021-13-01", "07/07/2021", "٢٠٢١-07-07", ""],
)
def test_no_times(text: str) -> None:
    """Other forms, which only some versions of Python read."""
    with pytest.raises(ValueError):  # noqa: PT011 - any
        parse_time(text)


# --- places beyond a polar circle -----------------------------------------------------------------


@pytest.mark.parametrize("latitude", [69.65, 78.2, -75.1])
def test_far_north(tmp_path: Path, latitude: float) -> None:
    """Nothing but FAO-56 needs a sunrise each day; the site's monthly means stand in for it."""
    text = (CONFIG / "site.yaml").read_text().replace("latitude: 43.63", f"latitude: {latitude}")
    (tmp_path / "site.yaml").write_text(text)
    site = read_site(tmp_path / "site.yaml")
    assert site.latitude == latitude
    read = read_weather([JULY], site)
    assert read.evapotranspiration == pytest.approx(4.02)
    assert "monthly means, for lack of sunrise each day" in read.notes[-1]
    alone = replace(site, monthly_evapotranspiration=None)
    refusal(read_weather, [JULY], alone, match=r"latitude = .*: must be a number from -66 to 66")


# --- times as seconds since 1970 ------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0, -18000, 3600])
def test_an_answer_with_unixtime(tmp_path: Path, offset: int) -> None:
    """``timeformat=unixtime`` is in UTC, regardless of the zone of the answer: the same weather.

    date -u -d 2021-07-07T05:00 +%s: 1625634000.
    """
    text = answer().replace("iso8601", "unixtime").replace(
        '"utc_offset_seconds": 0', f'"utc_offset_seconds": {offset}'
    )
    content = json.loads(text)
    content["hourly"]["time"] = [1625634000 + 3600 * hour for hour in range(72)]
    (unix := tmp_path / "unix.json").write_text(json.dumps(content))
    (iso := tmp_path / "iso.json").write_text(answer())
    read, same = (read_records(file, TORONTO) for file in (unix, iso))
    assert read.first == same.first
    assert read.first.utcoffset() == timedelta(seconds=offset)
    for quantity, series in same.values.items():
        np.testing.assert_array_equal(read.values[quantity], series)


def test_saved_previous_runs_with_unixtime(tmp_path: Path) -> None:
    """As a program saves them, without the place; a table of numbers writes whole ones with .0.

    date -u -d 2024-03-01T00:00 +%s: 1709251200.
    """
    file = tmp_path / "previous.csv"
    file.write_text("time,precipitation_previous_day1\n" + "".join(
        f"{1709251200 + 3600 * hour}.0,{hour}\n" for hour in range(1, 25)
    ))
    archive = read_archive(file, TORONTO)
    assert archive.issues[0].issued == parse_time("2024-03-01T00:00Z")
    assert archive.issues[0].rain[0, :3].tolist() == [1.0, 2.0, 3.0]
