"""Files of loggers, services and cities, which are read with a description."""

from __future__ import annotations

import csv
import shutil
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from places import CONFIG, DATA, refusal

from greenroof_ros.base.files import parse_yaml, read_yaml
from greenroof_ros.base.times import parse_time
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.describe import describe
from greenroof_ros.weather.description import make_description
from greenroof_ros.weather.quantities import WEATHER
from greenroof_ros.weather.read import read_file, read_measured, write_plain
from greenroof_ros.weather.table import read_rows

SITE = read_site(CONFIG / "site.yaml")
MAKERS = DATA / "makers"


def test_a_description_takes_two_edits(tmp_path: Path) -> None:
    """The rows end at their times, on the clock of Berlin; the rain is in the row of 01:40."""
    shutil.copy(MAKERS / "german_gauge.csv", tmp_path / "gauge.csv")
    printed = describe(tmp_path / "gauge.csv")
    assert printed.count("'?'") == 2
    description = tmp_path / "gauge.yaml"
    description.write_text(printed, encoding="utf-8")
    assert "time_zone = '?'" in refusal(read_measured, [description], SITE)
    description.write_text(
        printed.replace("time_zone: '?'", "time_zone: Europe/Berlin")
        .replace("rows: '?'", "rows: end"), encoding="utf-8",
    )
    records = read_measured([description], SITE)
    assert records.minutes is not None
    start = datetime.fromisoformat("2024-06-30T23:55+02:00")
    wet = np.flatnonzero(records.minutes.ravel() > 0)
    assert records.first + timedelta(minutes=int(wet[0])) == start + timedelta(minutes=100)
    assert np.nansum(records.minutes) / 60 == pytest.approx(0.4)
    assert records.values["temperature"][-1] == pytest.approx(18.45, abs=0.1)
    (tmp_path / "plain.csv").write_text(write_plain([description], SITE) or "", encoding="utf-8")
    again = read_measured([tmp_path / "plain.csv"], SITE)
    for name, series in records.values.items():
        assert again.values[name].tobytes() == series.tobytes()


@pytest.mark.parametrize("text", [
    "2024-06-15 12:00,1\n2024-06-15 13:00,2\n",  # no header
    "#\n" * 10_500 + "Zeit,Regen\n2024-06-15 12:00,1\n",
    "Dag,Uur,Regen\n2024-06-15,12u00,1\n2024-06-15,13u00,2\n",
    "Code,Year,Month,Day,Rainfall amount (millimetres)\n"
    + "".join(f"IDCJAC0009,2024,01,{day:02},0.4\n" for day in range(1, 32)),
    "Datum;Regen\n" + "".join(f"{day:02}.01.2024;0,4\n" for day in range(1, 32)),
], ids=["no header", "a late header", "no time", "days", "German days"])
def test_what_cannot_be_described(tmp_path: Path, text: str) -> None:
    (tmp_path / "gauge.csv").write_text(text)
    assert "gauge.csv" in refusal(describe, tmp_path / "gauge.csv")


FORMATS = read_yaml(MAKERS / "makers.yaml")


@pytest.mark.parametrize("name", FORMATS)
def test_exports_of_makers_and_services(name: str) -> None:
    """What --describe leaves open is decided as in makers.yaml, which has the expected values."""
    file, about = MAKERS / name, FORMATS[name]
    if "decided" not in about:
        (rows,) = read_file(file, SITE)
    else:
        printed = parse_yaml(describe(file), file)
        assert "\u202e" not in str(printed)
        del printed["file"]
        open_keys = {key for key, value in printed.items() if "?" in (value, *_values(value))}
        chosen = about["decided"].keys() - {"time_zone", "utc_offset", "zero_values"}
        assert open_keys - {"time_zone"} == chosen
        if "utc_offset" in about["decided"]:
            printed.pop("time_zone", None)
        keys = {key: value for key, value in {**printed, **about["decided"]}.items() if value != []}
        rows = read_rows(file, SITE, WEATHER, make_description(keys))
    expected, rain = about["expected"], rows.values["precipitation"] * rows.step_s / 3600
    assert np.nansum(rain) == pytest.approx(expected["rain_mm"], abs=1e-3)
    assert np.count_nonzero(np.isnan(rain)) == expected["missing"]
    assert (rows.step_s, rows.first) == (expected["step_s"], parse_time(expected["first"]))
    if expected["temperature"] is not None:
        assert rows.values["temperature"][0] == pytest.approx(expected["temperature"], abs=1e-3)
    for quantity in expected.keys() & {"wind speed", "solar radiation"}:
        assert rows.values[quantity].tolist() == pytest.approx(expected[quantity])


def _values(value: object) -> list[object]:
    return [*value.values()] if isinstance(value, dict) else []


@pytest.mark.parametrize(("text", "wrong"), [
    ("file: no.csv", "no.csv: cannot be read"), ("file: no_*.csv", "a.yaml = "),
    ("rows: end", "a.yaml: file: "), ("file: a.csv\ncolumns: {rain: r}", "columns.time: "),
    ("file: a.csv\ncolumns: {time: t, snow: s}", "line 2: columns.snow: "),
    ("file: a.csv\ncolumns: {time: t, rain: cx}", "a.csv, line 1: 'cx': "),
    ("file: a.csv\ncolumns: {time: t, rain: r}", "a.csv, line 1: 'r': the unit"),
    ("file: a.csv\ncolumns: {time: t, rain: r}\nunits: {temperature: K}", "has no effect"),
    ("file: a.csv\ncolumns: {time: t, rain: r}\nflags: {wind speed: q}", "has no effect"),
    ("file: a.csv\nheader: t", "line 2: header = ('t',): has no effect"),
    ("file: a.csv\ntime_zone: Berlin", "line 2: time_zone = 'Berlin': "),
    ("file: a.csv\ntime_zone: UTC\nutc_offset: 3", "line 3: utc_offset = 3.0: "),
    ("file: a.csv\nencoding: latin9x", "line 2: encoding = 'latin9x': "),
    ("file: a.csv\ntime_format: '%Y-%Y'", "line 2: time_format = '%Y-%Y': "),
    ("file: a.csv\ntime_format: '%d.%m.%y %H:%M %Z'", "%Z"),
    ("file: dwd.txt\nrows: end", "a.yaml: rows: has no effect"),
    ("file: dwd_2.txt", "a.yaml: step: has no effect"),
])
def test_wrong_descriptions(tmp_path: Path, text: str, wrong: str) -> None:
    """Keys that have no effect or are for something else; their types are tested with all files."""
    (tmp_path / "a.csv").write_text("t,r\n2024-06-01T00:00,0\n2024-06-01T01:00,0\n")
    dwd = (MAKERS / "produkt_rr_stunde.txt").read_text()
    (tmp_path / "dwd.txt").write_text(dwd)
    (tmp_path / "dwd_2.txt").write_text(f"# step: 60\n{dwd}")
    (tmp_path / "a.yaml").write_text(text)
    assert wrong in refusal(read_measured, [tmp_path / "a.yaml"], SITE)


# --- services -------------------------------------------------------------------------------------

def test_hours_of_dwd() -> None:
    """R1 of 01 UTC is the rain from midnight on, and TT_TU the temperature at its time."""
    rain, air, wind = (MAKERS / f"produkt_{name}_stunde.txt" for name in ("rr", "tu", "ff"))
    alone = read_measured([rain], SITE)
    assert alone.first.isoformat() == "2024-05-31T23:00:00+00:00"
    both = read_measured([air, rain, wind], SITE)
    assert both.values["wind speed"].tolist() == pytest.approx(
        [np.nan, np.nan, 9.0, 18.0], nan_ok=True
    )
    assert both.first == alone.first
    rain_of_hours, air_of_hours = both.values["precipitation"], both.values["temperature"]
    assert rain_of_hours.tolist() == pytest.approx([0.0, 1.5, np.nan, 0.2], nan_ok=True)
    assert air_of_hours.tolist() == pytest.approx([np.nan, 10.0, 11.0, 12.0], nan_ok=True)
    assert both.values["dew point"][1] == pytest.approx(10.0)


def test_hours_of_environment_canada() -> None:
    """July 2021, as in the service's file: flags and short rows."""
    file = DATA / "en_climate_hourly_07-2021.csv"
    records = read_measured([file], SITE)
    assert records.first.isoformat() == "2021-07-01T00:00:00-05:00" and records.rain_late == 1
    assert [*records.places.values()] == [(43.63, -79.4)]
    with file.open(encoding="utf-8-sig") as stream:
        header, *rows = csv.reader(stream)
    place = header.index("Precip. Amount (mm)")
    total = sum(float(row[place] or 0) for row in rows if len(row) > place)
    assert np.nansum(records.values["precipitation"]) == pytest.approx(total)


def test_a_value_beside_the_flag_of_a_missing_one(tmp_path: Path) -> None:
    """M is missing in the service's legend; often the last observation is repeated beside it."""
    with (DATA / "en_climate_hourly_07-2021.csv").open(encoding="utf-8-sig") as stream:
        header, *rows = [*csv.reader(stream)][:4]
    rows[1][header.index("Precip. Amount Flag")] = "M"
    rows[1][header.index("Precip. Amount (mm)")] = "4.2"
    with (tmp_path / "july.csv").open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream).writerows([header, *rows])
    rain = read_measured([tmp_path / "july.csv"], SITE).values["precipitation"]
    assert np.isnan(rain).tolist() == [False, True, False]


# --- what is shown --------------------------------------------------------------------------------


def test_what_a_draft_does_not_understand_is_open(tmp_path: Path) -> None:
    """Flagged cells can be the heaviest rain, T can be a trace; a code is a number or a word."""
    head = "Datum;Regen [mm]\n13.07.2021 00:00;1,5\n13.07.2021 01:00;"
    for cells, expected in ((["-99", "n/a"], ["-99", "n/a"]), (["24,4*"], "?"), (["T"], "?")):
        (tmp_path / "a.csv").write_text(head + "\n13.07.2021 02:00;".join(cells) + "\n")
        text = describe(tmp_path / "a.csv")
        assert parse_yaml(text, tmp_path)["na_values"] == expected
        assert (f"# not a number: {cells[0]}" in text) == (expected == "?")


def test_stated_rows_come_before_those_of_a_comment(tmp_path: Path) -> None:
    """Also if they are the default."""
    (tmp_path / "a.csv").write_text(
        "# rows: end\ntime,rain [mm]\n2024-07-01T01:00-05:00,1\n2024-07-01T02:00-05:00,0\n"
    )
    (tmp_path / "a.yaml").write_text("file: a.csv\nrows: start\n")
    for file, first in (("a.csv", 0), ("a.yaml", 1)):
        assert read_measured([tmp_path / file], SITE).first.hour == first
