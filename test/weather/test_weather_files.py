"""A weather file means what its header, its comments or its description say, and nothing else."""

from __future__ import annotations

import re
import time
import tracemalloc
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import yaml
from places import CONFIG, DATA, refusal

from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_measured
from greenroof_ros.weather.records import Records
from greenroof_ros.weather.table import parse_text

SITE = read_site(CONFIG / "site.yaml")
FIRST = datetime.fromisoformat("2024-06-01T00:00-05:00")


def rows(values: list[object], step_s: int = 3600, late: int = 0) -> str:
    """Return rows with these values, whose times are some seconds late."""
    return "".join(
        f"{(FIRST + timedelta(seconds=step_s * n + late)).isoformat()},{value}\n"
        for n, value in enumerate(values)
    )


def read(directory: Path, text: str, **keys: object) -> Records:
    file = directory / "gauge.csv"
    encoding = str(keys.get("encoding", "utf-8"))
    file.write_bytes(text.encode(encoding))
    if keys:
        description = directory / "gauge.yaml"
        description.write_text(yaml.safe_dump({"file": file.name, **keys}))
        return read_measured([description], SITE)
    return read_measured([file], SITE)


def rain_of(directory: Path, text: str, **keys: object) -> list[float]:
    values: list[float] = read(directory, text, **keys).values["precipitation"].tolist()
    return values


# --- values are kept ------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "values", "step_s", "total"), [
    # 20.1 + 99.9 + 60.2 + 12.4 mm/h, each for five minutes, are 192.6 / 12 mm.
    ("mm/h", [20.1, 99.9, 60.2, 12.4] + 8 * [0], 300, 16.05),
    ("mm", [99.9, 999, 32.767, 7777 / 100], 3600, 99.9 + 999 + 32.767 + 77.77),
    # 31.2 mm in a minute is the record; 1,872 mm/h.
    ("mm", [31.2] + 59 * [0], 60, 31.2),
])
def test_no_rain_is_changed(
    tmp_path: Path, unit: str, values: list[object], step_s: int, total: float
) -> None:
    records = read(tmp_path, f"time,rain [{unit}]\n{rows(values, step_s)}")
    assert records.values["precipitation"].sum() == pytest.approx(total)


@pytest.mark.parametrize(("quantity", "unit", "value", "expected"), [
    ("rain", "mm", 2.54, 2.54), ("rain", "in", 0.1, 2.54), ("rain", "0.1 mm", 25.4, 2.54),
    ("rain", "cm", 0.254, 2.54), ("rain", "mm/day", 60.96, 2.54), ("rain", "l/m²", 2.54, 2.54),
    ("temperature", "°F", 68, 20), ("temperature", "K", 293.15, 20),
    ("temperature", "0.1 degC", 200, 20), ("wind speed", "m/s", 10, 36),
    ("wind speed", "kn", 10, 18.52), ("wind speed", "mph", 10, 16.09344),
    ("station pressure", "hPa", 1013, 101.3), ("station pressure", "inHg", 30, 101.591670),
    ("solar radiation", "kW/m2", 0.5, 500), ("solar radiation", "MJ/m2", 1.8, 500),
    ("solar radiation", "J/cm²", 180, 500), ("evapotranspiration", "mm/h", 0.1, 2.4),
])
def test_units(
    tmp_path: Path, quantity: str, unit: str, value: float, expected: float
) -> None:
    """The unit in the header, for hourly rows; the factors are those of the SI brochure."""
    text = f"time,rain [mm],{quantity} [{unit}]\n".replace("rain [mm],rain", "rain")
    cells = f"0,{value}" if "rain [mm]," in text else value
    values = read(tmp_path, text + rows(2 * [cells])).values
    assert values[quantity.replace("rain", "precipitation")][0] == pytest.approx(expected)


@pytest.mark.parametrize("text", ["inf", "1e999", "0x1", "1_0", "12,5", "-999", "nan", "\u0661"])
def test_what_is_no_number_is_named(tmp_path: Path, text: str) -> None:
    """With its text, line and column."""
    cell = f'"{text}"' if "," in text else text
    message = refusal(read, tmp_path, f"time,rain [mm]\n{rows([0, cell, 0])}")
    assert f"gauge.csv, line 3: rain [mm] = '{text}'" in message


@pytest.mark.parametrize(("quantity", "fits", "value"), [
    ("rain [mm/h]", 2000, 2001), ("rain [mm/h]", 0, -0.1), ("temperature [degF]", 140, 150),
    ("temperature [degC]", -90, 293), ("station pressure [kPa]", 110, 1013),
    ("wind speed [m/s]", 138, 140), ("solar radiation [W/m2]", -15, -20),
])
def test_what_is_out_of_range_is_refused(
    tmp_path: Path, quantity: str, fits: float, value: float
) -> None:
    head = f"time,rain [mm],{quantity}\n".replace("rain [mm],rain", "rain")
    first = "0," * (head.count(",") - 1)
    read(tmp_path, head + rows([f"{first}{fits}"]))
    message = refusal(read, tmp_path, head + rows([f"{first}{each}" for each in (fits, value)]))
    assert f"gauge.csv, line 3: {quantity} = '{value}'" in message


def test_missing_values_are_declared(tmp_path: Path) -> None:
    """Empty cells are missing, and what na_values names, in whatever form the number is written."""
    text = f"time,rain [mm]\n{rows([1, '', -99, '-99.0', 'n/a', 2])}"
    assert np.isnan(rain_of(tmp_path, text, na_values=[-99, "n/a"])).tolist() == [
        False, True, True, True, True, False,
    ]
    assert rain_of(tmp_path, f"time,rain [mm]\n{rows(['T', 1])}", zero_values="T") == [0, 1]


@pytest.mark.parametrize(("encoding", "ends"), [("utf-16", "\n"), ("utf-8", "\r")])
def test_encodings_and_line_ends(tmp_path: Path, encoding: str, ends: str) -> None:
    text = f"time,rain [mm],é [%]\n{rows(['0.5,1', '0.25,1'])}".replace("\n", ends)
    assert rain_of(tmp_path, text, encoding=encoding) == [0.5, 0.25]
    if encoding != "utf-8":
        message = refusal(read_measured, [tmp_path / "gauge.csv"], SITE)
        assert "line 1: is not text in UTF-8" in message and "--describe" in message


# --- running totals -------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "totals", "expected"), [
    # It begins again in the fourth row; the row after a missing value is missing.
    ("mm", [10.0, 10.2, 10.2, 0.4, 0.6, "", 2.6, 2.8], [None, 0.2, 0, 0.4, 0.2, None, None, 0.2]),
    ("in", [1.00, 1.01, 0.02], [None, 0.254, 0.508]), ("0.2 mm", [7, 7, 10], [None, 0, 0.6]),
])
def test_the_rain_is_the_difference_of_a_counter(
    tmp_path: Path, unit: str, totals: list[object], expected: list[float | None]
) -> None:
    values = rain_of(tmp_path, f"time,rain [counter {unit}]\n{rows(totals)}")
    assert values == pytest.approx([*map(float, np.array(expected, float))], nan_ok=True)


def test_a_counter_does_not_fall_by_little(tmp_path: Path) -> None:
    """The level of a weighing gauge does; it would be 205.1 mm of rain."""
    text = f"time,rain [counter mm]\n{rows([205.0, 205.2, 205.1])}"
    assert "line 4: rain [counter mm] = '205.1'" in refusal(read, tmp_path, text)
    text = f"time,rain [counter mm/h]\n{rows([1])}"
    assert "the unit of precipitation" in refusal(read, tmp_path, text)


@pytest.mark.parametrize(("step_s", "begins_every"), [(3600, 300), (300, 500), (300, 288)])
def test_a_running_total_is_not_rain(tmp_path: Path, step_s: int, begins_every: int) -> None:
    """A tip of 0.2 mm in each third row, from 400 mm or 0, and what it looks like."""
    totals = [(400 if step_s == 3600 else 0) + 0.2 * (n % begins_every // 3) for n in range(8000)]
    message = refusal(read, tmp_path, f"time,rain [mm]\n{rows(totals, step_s)}")
    assert "'rain [mm]': looks like a running total" in message and "counter mm" in message


def test_the_heaviest_rain_is_no_running_total(tmp_path: Path) -> None:
    """1,825 mm in a day, the record (WMO), rises and falls; so do the hours of the services."""
    day: list[object] = [1825 / 144 * min(n, 24 - n) for n in range(24)]
    assert sum(rain_of(tmp_path, f"time,rain [mm]\n{rows(day)}")) == pytest.approx(1825)
    for file in DATA.glob("en_climate_hourly_*.csv"):
        hours = 12 * read_measured([file], SITE).values["precipitation"]
        rain_of(tmp_path, "time,rain [mm]\n" + rows([*hours]).replace("nan", ""))


# --- times ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("late", [-3, 74])
def test_a_clock_that_is_some_seconds_off(tmp_path: Path, late: int) -> None:
    """A time counts for the nearest boundary, at most a quarter of a step away."""
    text = "time,rain [mm]\n" + rows([0.1] + 11 * [0] + [7] + 11 * [0], 300, late)
    assert rain_of(tmp_path, text) == pytest.approx([0.1, 7.0])


def test_rows_that_begin_between_the_boundaries(tmp_path: Path) -> None:
    """Minutes 2, 7, 12: the first row is further than a quarter of a step from a boundary."""
    records = read(tmp_path, "time,rain [mm]\n" + rows([5] + 10 * [0], 300, 120))
    assert records.minutes is not None
    assert np.flatnonzero(records.minutes.ravel() > 0).tolist() == [2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("step_s", "rain", "expected"), [(3600, [0, 1.5, 0.2], [0, 1.5, 0.2]),
                                     (1800, [0, 1.5, 0.2, 0.3], [1.5, 0.5])],
)
def test_rows_that_end_at_their_times(
    tmp_path: Path, step_s: int, rain: list[object], expected: list[float]
) -> None:
    text = "time,rain [mm]\n" + rows(rain, step_s, step_s)
    assert rain_of(tmp_path, "# rows: end\n" + text) == pytest.approx(expected)
    records = read(tmp_path, text, rows="end")
    assert records.first == FIRST and "whose time is their end" in records.applied[0]


def test_a_time_that_the_clocks_skip(tmp_path: Path) -> None:
    """The message has the time in the form of the file."""
    text = "t,r\n" + "".join(f"31.03.2024 0{hour}:00,1\n" for hour in (0, 1, 2))
    keys = {"columns": {"time": "t", "rain": "r"}, "units": {"rain": "mm"},
            "time_format": "%d.%m.%Y %H:%M", "time_zone": "Europe/Berlin"}
    assert "line 4: t = '31.03.2024 02:00': is in an hour that the clocks in Europe/Berlin" in (
        refusal(lambda: read(tmp_path, text, **keys))
    )


@pytest.mark.parametrize("step_s", [90, 1000])
def test_a_step_that_is_no_whole_minute(tmp_path: Path, step_s: int) -> None:
    """Five hours of rows with 1 mm that agree exactly."""
    text = "time,rain [mm]\n" + rows((18000 // step_s) * [1], step_s)
    assert rain_of(tmp_path, text) == pytest.approx(5 * [3600 / step_s])


def test_missing_rows(tmp_path: Path) -> None:
    """A multiple of the step is missing rows; half of the rows agree, or the step is stated."""
    lines = rows(12 * [1]).splitlines(True)
    text = "time,rain [mm]\n" + "".join(lines[:10] + lines[11:])
    assert np.isnan(rain_of(tmp_path, text)).tolist() == 10 * [False] + [True, False]
    text = "time,rain [mm]\n" + "".join(lines[each] for each in (0, 4, 5, 7))
    assert "line 3: time = '2024-06-01T04:00:00-05:00': this row is 4 h after the previous row" in (
        refusal(read, tmp_path, text)
    )
    text = "time,rain [mm]\n" + "".join(lines[:1] + lines[3:])
    assert np.isnan(rain_of(tmp_path, "# step: 3600\n" + text)).sum() == 2
    assert rain_of(tmp_path, f"time,rain [mm]\n{rows([1])}") == [1]  # a single row is an hour


@pytest.mark.parametrize(("form", "text", "expected"), [
    ("%H:%M %Y %m %d", "23:30 2023 05 24", "2023-05-24T23:30"),
    ("%H:%M %Y %m %d", "24:00 2024 01 24", "2024-01-25T00:00"),
    ("%Y%m%d%H", "2024012424", "2024-01-25T00:00"), ("%d/%m/%y %H:%M", "24/12/24 24:30", None),
    ("%Y %m %d", "2024 01 24", "2024-01-24T00:00"), ("%Y %m %d", "2024 24 01", None),
])
def test_24_is_an_hour_only_in_place_of_the_hour(
    form: str, text: str, expected: str | None
) -> None:
    read_time = None
    with suppress(ValueError):
        read_time = parse_text(text, form).isoformat(timespec="minutes")
    assert read_time == expected


@pytest.mark.parametrize("step", ["", "# step: 300\n", "# step: 1\n"])
def test_a_row_for_each_tip_is_refused_with_the_way_out(tmp_path: Path, step: str) -> None:
    times = (FIRST + timedelta(seconds=s) for s in (0, 7, 95, 110, 1400, 9000, 9013, 90_000))
    text = step + "time,rain [mm]\n" + "".join(f"{each.isoformat()},0.2\n" for each in times)
    assert "if each row is a tip of a gauge, sum the tips to 5" in refusal(read, tmp_path, text)


@pytest.mark.parametrize(("line", "seconds"), [(13, -300), (14, 120), (14, -240), (14, 76)])
def test_times_that_do_not_fit(tmp_path: Path, line: int, seconds: int) -> None:
    """Rows of five minutes, of which one is not later, between steps, or more than 75 s off."""
    lines = rows(14 * [0], 300).splitlines(True)
    time = FIRST + timedelta(seconds=300 * (line - 2) + seconds)
    lines[line - 2] = f"{time.isoformat()},0\n"
    assert f"line {line}: time" in refusal(read, tmp_path, "time,rain [mm]\n" + "".join(lines))


# --- tables ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("text", "line", "wrong"), [
    ("time,rain [mm]\n2024-06-01T00:00,1,2\n", 2, "2 cells"),
    ('time,rain [mm]\n2024-06-01T00:00,"1\n', 2, "not a line of CSV"),
    ("time,rain [mm],precipitation [mm/h]\n2024-06-01T00:00,1,1\n", 1, "an earlier column"),
    ("time,rain\n2024-06-01T00:00,1\n", 1, "'rain'"),
    ("time,rain [l]\n2024-06-01T00:00,1\n", 1, "rain"),
    ("# Nowhere\ndate,rain [mm]\n2024-06-01T00:00,1\n", 2, "'date'"),
    ("# rows: sometimes\ntime,rain [mm]\n", 1, "rows = 'sometimes'"),
    ("# stamped: end\ntime,rain [mm]\n", 1, "stamped = 'end'"),
    ("# rows: end\n# rows: start\ntime,rain [mm]\n", 2, "the key rows appears twice"),
    ("time,rain [mm]\n01.06.2024 00:00,1\n", 2, "time = '01.06.2024 00:00'"),
    ("time,rain [mm]\n2024-06-01T00:00Z,1\n2024-06-01T01:00,1\n", 3, "UTC"),
    ("time,rain [mm]\n2024-06-01T00:00Z,99.90\n2024-06-01T00:01Z,1\n", 2, "rain [mm] = '99.90'"),
    ("time,rain [mm]\n", None, "no rows"), ("# nothing\n", None, "header"),
    (' {"hourly": 1}', None, ".json"),
])
def test_what_is_no_table(tmp_path: Path, text: str, line: int | None, wrong: str) -> None:
    place = f"gauge.csv, line {line}: " if line else "gauge.csv"
    assert re.search(f"{re.escape(place)}.*{re.escape(wrong)}", refusal(read, tmp_path, text))


def test_comments_and_columns_that_are_not_used(tmp_path: Path) -> None:
    text = (
        "# The gauge on the roof; its latitude: unknown\n# latitude: 52.5, longitude: 13.4\n"
        "# rain_kind: forecast\n# wind_height: 2\ntime,rain [mm],Qualität,battery [V]\n"
        + rows(["1,gut,12", ",schlecht,11"])
    )
    records = read(tmp_path, text)
    assert [*records.places.values()] == [(52.5, 13.4)] and records.wind_height == 2
    assert records.rain_kind == "forecast"
    assert "not read: Qualität, battery [V]" in records.applied[0]


@pytest.mark.parametrize("place", ["line", "header", "columns", "comment", "quotes"])
def test_the_time_to_refuse_a_file_is_linear_in_its_size(tmp_path: Path, place: str) -> None:
    """2 MB take no more than some seconds; 20 kB took 2.9 s."""
    size = 2_000_000
    text = {
        "line": "a " * (size // 2), "header": "time," + " [" * (size // 2) + "\n" + rows([1]),
        "columns": "," * size + "\n" + rows([1]), "comment": "# rows" + " " * size + ": \n",
        "quotes": 'time,rain [mm]\n"' + '""' * (size // 2) + "\n",
    }[place]
    began = time.process_time()
    refusal(read, tmp_path, text)
    assert time.process_time() - began < 10


def test_memory_of_a_valid_file(tmp_path: Path) -> None:
    """160 kB of weather take less than 5 MB."""
    text = "time,precipitation [mm/h],temperature [degC]\n" + rows(
        [f"{n % 9 / 10},{n % 300 / 10}" for n in range(5000)]
    )
    read(tmp_path, text)  # imports what it needs
    tracemalloc.start()
    hours_read = read(tmp_path, text).hours
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert hours_read == 5000
    assert peak < 5e6 + 2 * len(text)


def test_a_run_reads_the_rain_of_rows_that_begin_between_minutes() -> None:
    """The storms of Neubrandenburg, whose rows begin at minutes 2, 7, 12."""
    file = DATA / "neubrandenburg_storms.csv"
    cells = [line.split(",")[1] for line in file.read_text().splitlines() if line[:1].isdigit()]
    records = read_measured([file], read_site(CONFIG / "site_neubrandenburg.yaml"))
    assert records.minutes is not None
    listed = sum(float(cell) for cell in cells if cell)
    assert np.nansum(records.minutes) / 60 == pytest.approx(listed)
