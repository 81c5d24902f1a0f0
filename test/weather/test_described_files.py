"""Files of loggers, services and cities, which are read with a description."""

from __future__ import annotations

import csv
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from places import CONFIG, DATA
from refusals import refusal

from greenroof_ros.base.files import parse_yaml, read_yaml
from greenroof_ros.base.times import parse_time
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.describe import describe
from greenroof_ros.weather.description import make_description, service_descriptions
from greenroof_ros.weather.quantities import WEATHER
from greenroof_ros.weather.read import read_measured, write_plain
from greenroof_ros.weather.table import read_rows

SITE = read_site(CONFIG / "site.yaml")
TIMES = [datetime(2024, 7, 1) + timedelta(minutes=5 * n) for n in range(36)]  # noqa: DTZ001

GERMAN = (
    "Station: Klärwerk Süd\nMessgröße: Niederschlag\nZeitbezug: MEZ/MESZ\n\n"
    "Datum;Uhrzeit;Niederschlag [mm];Lufttemperatur [°C];Qualität\n"
) + "".join(
    f"{time:%d.%m.%Y;%H:%M};{'0,4' if n == 20 else '0,0'};18,{n % 10};gut\n"
    for n, time in enumerate(TIMES)
)
FRENCH = "Nom de la station;Lyon\nDate;Pluie (mm);Température (°C);Humidité (%)\n" + "".join(
    f"{time:15/%m/%Y %H:%M};{'1,2' if n == 20 else '0,0'};18,{n % 10};60\n"
    for n, time in enumerate(TIMES)
)
LOGGER = '"TOA5","CR1000X","1","2"\n"TIMESTAMP","Rain_Tot","AirTC_Avg","RH"\n' + (
    '"TS","mm","Deg C","%"\n"","Tot","Avg","Smp"\n'
) + "".join(
    f'"{time}",{0.2 if n == 20 else 0},18.{n % 10},"NAN"\n' for n, time in enumerate(TIMES)
)
KNX = '"Zeitstempel";"Regenmenge (mm)";"Lufttemperatur (°C)";"\u202eextra"\n' + "".join(
    f'"{time:15.%m.%Y %H:%M:%S}";"{"0,3" if n == 20 else "0"}";"18,{n % 10}";"1"\n'
    for n, time in enumerate(TIMES)
) + "Summe;0,3;;\nMaximum;0,3;18,9;\n"


@pytest.mark.parametrize(
    ("text", "encoding", "rain", "first"),
    [
        (KNX, "utf-8", 0.3, "2024-07-14T23:55:00+02:00"),
        (GERMAN, "cp1252", 0.4, "2024-06-30T23:55:00+02:00"),
        (FRENCH, "utf-8", 1.2, "2024-07-14T23:55:00+02:00"),
        (LOGGER, "utf-8", 0.2, "2024-06-30T23:55:00+02:00"),
    ],
)
def test_a_description_takes_two_edits(
    tmp_path: Path, text: str, encoding: str, rain: float, first: str
) -> None:
    """The rows end at their times, on the clock of Berlin; the rain is in the row of 01:40."""
    (tmp_path / "gauge.csv").write_bytes(text.encode(encoding))
    printed = describe(tmp_path / "gauge.csv")
    assert printed.count("'?'") == 2 and "\u202e" not in printed
    description = tmp_path / "gauge.yaml"
    description.write_text(printed, encoding="utf-8")
    assert refusal(read_measured, [description], SITE).endswith(
        "time_zone = '?': must be decided, because the file does not say it"
    )
    description.write_text(
        printed.replace("time_zone: '?'", "time_zone: Europe/Berlin")
        .replace("rows: '?'", "rows: end"), encoding="utf-8",
    )
    records = read_measured([description], SITE)
    assert records.minutes is not None
    start = datetime.fromisoformat(first)
    wet = np.flatnonzero(records.minutes.ravel() > 0)
    assert records.first + timedelta(minutes=int(wet[0])) == start + timedelta(minutes=100)
    assert np.nansum(records.minutes) / 60 == pytest.approx(rain)
    assert records.values["temperature"][-1] == pytest.approx(18.45, abs=0.1)
    (tmp_path / "plain.csv").write_text(write_plain([description], SITE) or "", encoding="utf-8")
    again = read_measured([tmp_path / "plain.csv"], SITE)
    for name, series in records.values.items():
        assert again.values[name].tobytes() == series.tobytes()


@pytest.mark.parametrize(
    ("header", "rows", "expected"),
    [
        ("Date;Heure;Pluie (mm)", "15/06/2024;23h00;1\n15/06/2024;24h00;2", {
            "columns": {"time": ["Date", "Heure"], "precipitation": "Pluie (mm)"},
            "time_format": "%d/%m/%Y %Hh%M", "units": {"precipitation": "mm"}, "sep": ";",
        }),
        ("Zeit,Regen in mm", "15.06.2024 12.00,1\n15.06.2024 13.00,2", {
            "columns": {"time": "Zeit", "precipitation": "Regen in mm"},
            "time_format": "%d.%m.%Y %H.%M", "units": {"precipitation": "?"},  # in or mm
        }),
        ("date time rain_mm", "2024-06-15 12:00   1\n2024-06-15 13:00  12", {
            "columns": {"time": ["date", "time"], "precipitation": "rain_mm"},
            "units": {"precipitation": "mm"}, "sep": "space",
        }),
        ("Zeit,N [mm]", "2024-06-15 12:00,1\n2024-06-15 13:00,2",
         {"columns": {"time": "Zeit", "precipitation": "?"}}),
        ("Zeit UTC+05:30,rain A (mm),rain B (mm)", "2024-06-15 12:00,1,1\n2024-06-15 13:00,2,1", {
            "columns": {"time": "Zeit UTC+05:30", "precipitation": "?"}, "utc_offset": 5.5,
            "units": {"precipitation": "mm"},
        }),
    ],
)
def test_a_description_leaves_open_what_a_file_does_not_say(
    tmp_path: Path, header: str, rows: str, expected: dict[str, object]
) -> None:
    file = tmp_path / "gauge.csv"
    file.write_text(f"{header}\n{rows}\n")
    stated = dict(parse_yaml(describe(file), file))
    zone = {} if "utc_offset" in expected else {"time_zone": "?"}
    assert stated == {"file": "gauge.csv", "rows": "?", **zone, **expected}
    (tmp_path / "gauge.yaml").write_text(
        "".join(f"{key}: {value!r}\n" for key, value in {
            **expected, "file": "gauge.csv", "units": {"precipitation": "mm"}, "utc_offset": 0,
        }.items()).replace("'?'", f"{header.split(',')[-1]!r}")
    )
    assert np.nansum(read_measured([tmp_path / "gauge.yaml"], SITE).values["precipitation"]) > 0


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("2024-06-15 12:00,1\n2024-06-15 13:00,2\n", "line 1: is a row, but must be a header"),
        ("#\n" * 10_500 + "Zeit,Regen\n2024-06-15 12:00,1\n", "in its first 10000 lines: write"),
        ("Dag,Uur,Regen\n2024-06-15,12u00,1\n2024-06-15,13u00,2\n", "no rows with a time in a"),
    ],
)
def test_what_cannot_be_described(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "gauge.csv").write_text(text)
    assert reason in refusal(describe, tmp_path / "gauge.csv")


MAKERS = read_yaml(DATA / "makers" / "makers.yaml")


@pytest.mark.parametrize("name", MAKERS)
def test_exports_of_makers_and_services(name: str) -> None:
    """What --describe leaves open is decided as in makers.yaml, which has the expected values."""
    file, about = DATA / "makers" / name, MAKERS[name]
    printed = parse_yaml(describe(file), file)
    del printed["file"]
    open_keys = {key for key, value in printed.items() if "?" in (value, *_values(value))}
    assert open_keys <= about["decided"].keys() | {"time_zone"}
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


def _values(value: object) -> list[object]:
    return [*value.values()] if isinstance(value, dict) else []


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("file: no.csv", "no.csv: cannot be read: No such file"),
        ("file: no_*.csv", "a.yaml = "), ("rows: end", "a.yaml: file: must name a weather file"),
        ("file: a.csv\ncolumns: {time: t, snow: s}", "line 2: columns.snow: must be one of time"),
        ("file: a.csv\ncolumns: {rain: r}", "columns.time: must name the column of the times"),
        ("file: a.csv\nrows: middle", "line 2: rows = 'middle': must be one of start, end"),
        ("file: a.csv\ntime_zone: Berlin", "line 2: time_zone = 'Berlin': must be the name of a"),
        ("file: a.csv\nencoding: latin9x", "line 2: encoding = 'latin9x': must be the name of an"),
        ("file: a.csv\ntime_format: '%Y-%Y'", "line 2: time_format = '%Y-%Y': must be the form of"),
        ("file: a.csv\ntime_format: '%Q'", "line 2: time_format = '%Q': must be the form of"),
        ("file: a.csv\nencoding: punycode", "a.csv, line 1: is not text in PUNYCODE"),
        ("file: a.csv\nskip: 3", "line 2: skip = 3: is not a valid key"),
        ("file: a.csv\ncolumns: {time: t, rain: rain}\nunits: {rain: mm}",
         "line 1: 'rain': must be the name of one column of the file"),
        ("file: a.csv\ncolumns: {time: t, rain: r}", "line 1: 'r': the unit of precipitation must"),
        ("file: a.csv\ncolumns: {time: t, rain: cx}", "line 1: 'cx': must be the name of one"),
        ("file: a.csv\ntime_zone: UTC\nutc_offset: 3", "line 3: utc_offset = 3.0: must not be sta"),
        ("file: a.csv\nskiprows: 1", "a.csv, line 2: '2024-06-01T00:00': must be 'time', or the"),
        ("file: a.csv\nskiprows: -1", "line 2: skiprows = -1: must be a list"),
        ("file: a.csv\ncolumns: {time: t, rain: r}\nunits: {temperature: K}", "has no effect"),
        ("file: a.csv\nheader: t", "line 2: header = ('t',): has no effect: only the descriptions"),
        ("file: dwd.txt\nrows: end", "a.yaml: rows: has no effect, because the form of "),
        ("file: dwd_2.txt", "a.yaml: step: has no effect, because the form of "),
        ("file: a.csv\ntime_format: '%d.%m.%y %H:%M %Z'", "must not contain %Z"),
        ("file: a.json\nencoding: cp1252\nstep: 60", "a.yaml: step: has no effect, because "),
        ("file: a.csv\ncolumns: {time: t, rain: r}\nflags: {wind speed: q}", "has no effect"),
        ("file: a.csv\ncolumns: {time: t, rain: r, precipitation: r}", "must name a quantity only"),
    ],
)
def test_wrong_descriptions(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "a.csv").write_text("t,r\n2024-06-01T00:00,0\n2024-06-01T01:00,0\n")
    (tmp_path / "dwd.txt").write_text(DWD_RAIN)
    (tmp_path / "dwd_2.txt").write_text(f"# step: 60\n{DWD_RAIN}")
    (tmp_path / "a.json").write_text("{}")
    (tmp_path / "a.yaml").write_text(text)
    assert reason in refusal(read_measured, [tmp_path / "a.yaml"], SITE)


# --- services -------------------------------------------------------------------------------------

# The first lines of files as the services write them, and the rain, temperature and start by hand.
DWD_RAIN = (
    "STATIONS_ID;MESS_DATUM;QN_8;  R1;RS_IND;WRTR;eor\n"
    "       1219;2024060100;    3;   0.0;   0;-999;eor\n"
    "       1219;2024060101;    3;   1.5;   1;   6;eor\n"
    "       1219;2024060102;    3;  -999;-999;-999;eor\n"
    "       1219;2024060103;    3;   0.2;   1;   6;eor\n"
)
DWD_AIR = (
    "STATIONS_ID;MESS_DATUM;QN_9;TT_TU;RF_TU;eor\n"
    "       1219;2024060100;    3;  10.0; 100.0;eor\n"
    "       1219;2024060101;    3;  11.0;  90.0;eor\n"
    "       1219;2024060102;    3;  12.0;  80.0;eor\n"
)
DWD_WIND = (
    "STATIONS_ID;MESS_DATUM;QN_3;   F;   D;eor\n"
    "       1219;2024060101;    3;   2.5; 230;eor\n"
    "       1219;2024060102;    3;   5.0; 240;eor\n"
)
KNMI = (
    "# BRON: KONINKLIJK NEDERLANDS METEOROLOGISCH INSTITUUT (KNMI)\n"
    "# Opmerking: door stationsverplaatsingen en veranderingen in waarneemmethodieken\n#\n"
    "# STN,YYYYMMDD,   HH,   FH,    T,   TD,    Q,   RH,    P,    U\n\n"
    "  260,20240601,   23,   30,  151,  120,    0,   -1,10151,   82\n"
    "  260,20240601,   24,   20,  149,  118,    0,   12,10152,   83\n"
    "  260,20240602,    1,   20,  148,  118,   36,    0,10152,   84\n"
)
SWISS = (
    "station_abbr;reference_timestamp;tre200h0;ure200h0;tde200h0;prestah0;gre000h0;fkl010h0;"
    "rre150h0\n"
    "SMA;01.06.2024 01:00;15.1;82;12.0;951.5;0;3.0;0.1\n"
    "SMA;01.06.2024 02:00;14.9;83;11.8;951.6;5;2.0;1.2\n"
)


FRENCH_NAMES = {
    "Station Name": "Nom de la Station", "Climate ID": "ID climatologique",
    "Date/Time (LST)": "Date/Heure (HNL)", "Temp Flag": "Temp Indicateur",
    "Dew Point Temp (°C)": "Point de rosée (°C)",
    "Dew Point Temp Flag": "Point de rosée Indicateur",
    "Precip. Amount (mm)": "Hauteur de précip. (mm)",
    "Precip. Amount Flag": "Hauteur de précip. Indicateur",
    "Wind Spd (km/h)": "Vit. du vent (km/h)", "Wind Spd Flag": "Vit. du vent Indicateur",
    "Stn Press (kPa)": "Pression à la station (kPa)",
    "Stn Press Flag": "Pression à la station Indicateur",
}


@pytest.mark.parametrize(
    ("text", "first", "rain", "temperature"),
    [
        (KNMI, "2024-06-01T22:00:00+00:00", [0, 1.2, 0], [15.1, 14.9, 14.8]),
        (SWISS, "2024-06-01T00:00:00+00:00", [0.1, 1.2], [15.1, 14.9]),
    ],
)
def test_hours_of_services(
    tmp_path: Path, text: str, first: str, rain: list[float], temperature: list[float]
) -> None:
    """KNMI writes tenths, -1 for a trace, and 24 for midnight."""
    (tmp_path / "hours.txt").write_text(text)
    records = read_measured([tmp_path / "hours.txt"], SITE)
    assert records.first.isoformat() == first
    assert records.values["precipitation"].tolist() == pytest.approx(rain)
    assert records.values["temperature"].tolist() == pytest.approx(temperature)
    assert records.values["wind speed"][0] == pytest.approx(10.8)
    assert records.values["solar radiation"][-1] == pytest.approx(100 if text == KNMI else 5)


def test_hours_of_dwd(tmp_path: Path) -> None:
    """R1 of 01 UTC is the rain from midnight on, and TT_TU the temperature at its time."""
    rain, air, wind = (tmp_path / f"produkt_{name}_stunde_1.txt" for name in ("rr", "tu", "ff"))
    rain.write_text(DWD_RAIN)
    air.write_text(DWD_AIR)
    wind.write_text(DWD_WIND)
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


def test_hours_of_environment_canada(tmp_path: Path) -> None:
    """July 2021, as in the service's file: flags, short rows, and the same in French."""
    file = DATA / "en_climate_hourly_07-2021.csv"
    records = read_measured([file], SITE)
    assert records.first.isoformat() == "2021-07-01T00:00:00-05:00" and records.rain_late == 1
    assert [*records.places.values()] == [(43.63, -79.4)]
    with file.open(encoding="utf-8-sig") as stream:
        header, *rows = csv.reader(stream)
    place = header.index("Precip. Amount (mm)")
    total = sum(float(row[place] or 0) for row in rows if len(row) > place)
    assert np.nansum(records.values["precipitation"]) == pytest.approx(total)
    french = tmp_path / "fr.csv"
    with french.open("w", encoding="utf-8-sig", newline="") as stream:
        csv.writer(stream).writerows([
            [FRENCH_NAMES.get(name, name) for name in header],
            *(row[:9] + [cell.replace(".", ",") for cell in row[9:]] for row in rows),
        ])
    again = read_measured([french], SITE)
    for name, series in records.values.items():
        assert again.values[name].tobytes() == series.tobytes()


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


def test_every_service_has_a_name_and_a_header() -> None:
    for described in service_descriptions():
        assert described.name and described.header and described.columns


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


def test_rain_of_hours_known_in_part_is_told(tmp_path: Path) -> None:
    """12 rows of 1 mm an hour: 3 missing ones add 3 mm, and 8 of the first hour are left out."""
    rows = [
        f"2024-07-01T{hour:02}:{minute:02}-05:00,1\n" for hour in range(4)
        for minute in range(0, 60, 5) if (hour, minute) >= (0, 20) and (hour != 2 or minute >= 15)
    ]
    (tmp_path / "a.csv").write_text("time,rain [mm]\n" + "".join(rows))
    records = read_measured([tmp_path / "a.csv"], SITE)
    assert records.values["precipitation"].tolist() == [12.0] * 3
    out, added = records.left_out
    assert out.startswith("8 mm of rain in the first or last hour are left out")
    assert added.startswith("3 mm of rain are added")
