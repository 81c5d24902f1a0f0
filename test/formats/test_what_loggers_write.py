"""Files as loggers and services write them: times, amounts, places, and files of other kinds."""

from __future__ import annotations

import gzip
import itertools
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from places import CONFIG
from refusals import refusal

from greenroof_ros.weather.records import Records
from greenroof_ros.formats.rules import check_hours
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import read_measured

SITE = read_site(CONFIG / "site.yaml")
FIRST = datetime.fromisoformat("2024-06-01T00:00-05:00")
HOUR = 3600


def write_rows(
    count: int, step_s: int = HOUR,
    rain: Callable[[int], object] = lambda row: 0.2 * (row % 5 == 0), *,
    first: datetime = FIRST, late: Callable[[int], int] = lambda row: 0,
    header: str = "time,rain [mm]\n",
) -> str:
    """Return rows a step apart, each some seconds late."""
    times = (
        first + timedelta(seconds=step_s * row + late(row)) for row in range(count)
    )
    return header + "".join(
        f"{time.isoformat()},{rain(row)}\n" for row, time in enumerate(times)
    )


def read(directory: Path, text: str | bytes, stamped: str | None = None) -> Records:
    file = directory / "gauge.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_measured([file], SITE, stamped)


def rain_of(directory: Path, text: str | bytes) -> list[float]:
    rain: list[float] = read(directory, text).values["precipitation"].tolist()
    return rain


# --- times ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("step_s", [300, HOUR])
def test_a_clock_that_is_some_seconds_off(tmp_path: Path, step_s: int) -> None:
    """Each row by itself, at random, or all by the same: the hours are those of a right clock."""
    random = np.random.default_rng(1)
    count = 24 * HOUR // step_s
    expected = read(tmp_path, write_rows(count, step_s))
    for late in (
        lambda row: 7, lambda row: int(random.integers(0, 40)),
        lambda row: int(random.integers(-40, 40)) * (row > 0),
    ):
        records = read(tmp_path, write_rows(count, step_s, late=late))
        assert records.first == expected.first
        np.testing.assert_array_equal(*(
            each.values["precipitation"] for each in (records, expected)
        ))


@pytest.mark.parametrize("step_s", [300, 600, HOUR])
def test_rows_that_end_at_their_times(tmp_path: Path, step_s: int) -> None:
    """By a comment, or an option: rain of the row stamped 01:00 fell from midnight on."""
    text = write_rows(24 * HOUR // step_s, step_s, first=FIRST + timedelta(seconds=step_s))
    starts = read(tmp_path, write_rows(24 * HOUR // step_s, step_s))
    for records in (read(tmp_path, f"# stamped: end\n{text}"), read(tmp_path, text, "end")):
        assert records.first == FIRST
        assert records.values["precipitation"].tolist() == (
            starts.values["precipitation"].tolist()
        )
        assert "the time of each row was the end of its interval" in records.notes[0]


@pytest.mark.parametrize(("before_s", "after_s"), [(300, HOUR), (HOUR, 600), (600, 900)])
def test_a_step_that_changes(tmp_path: Path, before_s: int, after_s: int) -> None:
    """Twelve hours of each, with 0.1 mm in a row: an hour has as much as it has rows."""
    half = 12 * HOUR
    for shift, head in ((0, ""), (1, "# stamped: end\n")):
        parts = [
            write_rows(
                half // step_s, step_s, lambda row: 0.1, header="",
                first=FIRST + timedelta(seconds=begin + shift * step_s),
            ) for begin, step_s in ((0, before_s), (half, after_s))
        ]
        records = read(tmp_path, f"{head}time,rain [mm]\n{''.join(parts)}")
        assert records.first == FIRST
        np.testing.assert_allclose(records.values["precipitation"], [
            0.1 * HOUR / step_s for step_s in (before_s, after_s) for _ in range(12)
        ])
        assert any("the interval between rows changes" in note for note in records.notes)


@pytest.mark.parametrize("late", [-60, -1, 60])
def test_hours_that_begin_a_minute_off(tmp_path: Path, late: int) -> None:
    """As of rows that end at 00:59: they are whole hours."""
    text = write_rows(24, first=FIRST + timedelta(hours=1, seconds=late))
    assert read(tmp_path, text, "end").first == FIRST


@pytest.mark.parametrize("step_h", [1.5, 3, 24])
def test_rows_more_than_an_hour_apart(tmp_path: Path, step_h: float) -> None:
    """A day's rain is not an hour's."""
    text = write_rows(30, round(step_h * HOUR))
    assert "rows must be at most one hour apart" in refusal(read, tmp_path, text)


@pytest.mark.parametrize("head", ["sep=;\n", "sep=;\r\n", '"sep=;"\r\n', "\ufeffSEP=;\r\n"])
def test_the_separator_in_a_line_of_its_own(tmp_path: Path, head: str) -> None:
    """As spreadsheets write it."""
    rows = "".join(f"2024-06-01T0{hour}:00Z;0,4\r\n" for hour in range(5))
    assert rain_of(tmp_path, f"{head}time;rain [mm]\r\n{rows}") == [0.4] * 5


@pytest.mark.parametrize("line", [",mm", '"TS","mm"', "Sum,12.4", "Summe,", "---,---", "End"])
def test_lines_that_are_no_records(tmp_path: Path, line: str) -> None:
    """Units below the header, and totals at the end."""
    for text in (write_rows(3).replace("\n", f"\n{line}\n", 1), f"{write_rows(3)}{line}\n"):
        assert "units or a total instead of a record, delete it" in refusal(read, tmp_path, text)


def test_files_that_were_appended(tmp_path: Path) -> None:
    """The same header again is left out, also after a byte order mark; another one is refused."""
    later = write_rows(24, first=FIRST + timedelta(days=1))
    for mark in ("", "\ufeff"):
        records = read(tmp_path, write_rows(24) + mark + later)
        assert records.hours == 48
        assert "line 26 repeats the header" in records.notes[0]
    for comment in ("stamped: end", "wind_height: 3", "latitude: 43"):
        text = f"{write_rows(24)}# {comment}\n{later}"
        assert "split the file into separate files" in refusal(read, tmp_path, text)
        read(tmp_path, f"# {comment}\n{text}")
    other = later.replace("rain [mm]", "temperature [degC]")
    assert "line 26: is a second header" in refusal(read, tmp_path, write_rows(24) + other)


# --- amounts --------------------------------------------------------------------------------------


def add_up(every: int, wet: tuple[int, ...], amount: float = 0.4) -> Callable[[int], float]:
    """Return a total that begins again after ``every`` rows; amounts come in the wet rows."""
    return lambda row: round(1e-9 + amount * sum(
        begin in wet for begin in range(row // every * every, row + 1)
    ), 3)


@pytest.mark.parametrize(("total", "first"), [
    (add_up(1000, (5, 6, 7, 30, 31)), 0.0), (add_up(1000, (5, 6, 7, 30, 31)), 32.4),
    (add_up(24, (5, 6, 7, 8, 30, 31, 47, 48, 49)), 0.0), (add_up(48, (3, 4, 5, 60, 61, 62)), 0.0),
])
def test_running_totals_are_noted(
    tmp_path: Path, total: Callable[[int], float], first: float
) -> None:
    """Of all rows, of a counter that does not begin at 0, and since midnight or another time."""
    records = read(tmp_path, write_rows(96, rain=lambda row: first + total(row)))
    assert any("rain [mm] is a running total" in note for note in records.notes)
    assert records.values["precipitation"].max() == first + max(map(total, range(96)))


@pytest.mark.parametrize("step_s", [300, HOUR])
def test_a_sum_in_the_last_row(tmp_path: Path, step_s: int) -> None:
    """With a time, as of a month's report."""
    records = read(tmp_path, write_rows(96, step_s) + "2024-07-01 00:00,4\n")
    assert any("the sum of the other values in its last row" in note for note in records.notes)


def test_no_good_rain_is_refused_or_changed(tmp_path: Path) -> None:
    """A cloudburst with a rate of 99.9 mm/h, a drizzle and a warm front are read as they are."""
    burst, hours = (20.1, 99.9, 60.2, 12.4), np.zeros(24)
    hours[0] = sum(burst) / 12  # 16.05 mm
    header = "time,rain [mm/h]\n"
    text = write_rows(
        288, 300, lambda row: burst[row] if row < 4 else 0.0, header=header,
    )
    assert rain_of(tmp_path, text) == pytest.approx(hours.tolist())
    for rates in ((0.1, 0.2, 0.3), (0.2, 0.4, 0.6, 0.8), (10.125, 100.0)):
        rows = write_rows(
            72, HOUR, lambda row, r=rates: r[row * len(r) // 72], header=header,
        )
        assert rain_of(tmp_path, rows) == pytest.approx(np.repeat(rates, 72 // len(rates)))


def test_rain_that_rises_is_no_running_total(tmp_path: Path) -> None:
    """Nor is a drizzle that stays the same, nor a broken gauge."""
    for rain in ((0.2, 0.4, 1.0, 3.0, 5.0, 8.0, 0.0), (0.1,) * 24, (0.2, 0.2, 0.2, 0.4, 0.2, 0.0)):
        assert rain_of(tmp_path, write_rows(96, rain=lambda row, r=rain: r[row % len(r)]))


def test_a_total_that_only_rises(tmp_path: Path) -> None:
    """Since the event began, or in each row: noted, since a storm may rise so, too."""
    for step_s, rain in ((HOUR, lambda row: EVENTS[row]), (600, lambda row: 0.2 + row / 10)):
        (note,) = (
            note for note in read(tmp_path, write_rows(144, step_s, rain)).notes
            if "total since the rain event began" in note
        )
        assert note.startswith("gauge.csv: rain [mm] rises ")


def slide(rain: list[float], rows: int) -> Callable[[int], float]:
    """Return sums of the last rows."""
    return lambda row: round(sum(rain[max(0, row - rows + 1) : row + 1]), 3)


@pytest.mark.parametrize(("step_s", "rows", "unit"), [
    (600, 6, "mm"), (300, 12, "mm"), (HOUR, 3, "mm/h"), (HOUR, 24, "mm"), (600, 36, "mm/h"),
])
def test_sums_of_the_last_rows_are_noted(
    tmp_path: Path, step_s: int, rows: int, unit: str
) -> None:
    """Of an hour every ten or five minutes, and of three hours or a day every hour or so."""
    random = np.random.default_rng(7)
    rain = [
        float(round(0.2 * wet * tips, 1)) for wet, tips in zip(
            np.repeat(random.random(180) < 0.2, 3 * rows), random.poisson(0.3, 540 * rows),
            strict=True,
        )
    ]
    text = write_rows(540 * rows, step_s, slide(rain, rows), header=f"time,rain [{unit}]\n")
    found = f"no wet spell of fewer than {rows} rows"
    assert any(found in note for note in read(tmp_path, text).notes)


def test_rain_that_lasts_is_no_sum_of_the_last_rows(tmp_path: Path) -> None:
    """A mean of the last hour has the right depth; models repeat three hours, or interpolate."""
    random = np.random.default_rng(8)
    three_hours = np.round(np.where(random.random(400) < 0.3, random.gamma(1.0, 2.0, 400), 0.0), 1)
    between = np.interp(np.arange(1198), 3 * np.arange(400), three_hours)
    for rain in (three_hours.repeat(3), between, three_hours):
        read(tmp_path, write_rows(len(rain), rain=lambda row, r=rain: r[row]))
    hourly = slide(three_hours.tolist(), 6)
    read(tmp_path, write_rows(400, 600, hourly, header="time,rain [mm/h]\n"))


def test_what_is_smooth_is_no_sum_of_the_last_rows(tmp_path: Path) -> None:
    """Evapotranspiration of a fortnight, which rises and falls each day, and never by night."""
    text = write_rows(
        336, rain=lambda row: f"0,{(0.2 + row // 24 % 9 / 50) * shine(row):.3f}",
        header="time,rain [mm],station evapotranspiration [mm]\n",
    )
    assert read(tmp_path, text).method == "station"


def test_a_gauge_that_tips_in_drizzle_is_no_running_total(tmp_path: Path) -> None:
    """Such a drizzle, at Neubrandenburg, was refused: it rises often, and falls to 0."""
    tip = 0.066
    rain = [
        tip * count for count in (
            *(0, 1, 1, 1, 1, 0, 1, 1, 0, 2, 1, 1, 0, 1, 1, 1, 3, 1, 0, 1, 1, 0, 0, 1, 0, 1, 1, 0),
            *(3, 6, 10, 0, 1, 1, 1, 0, 1, 1, 0, 2, 1, 1, 1, 0, 0, 0, 1, 0),
        )
    ]
    records = read(tmp_path, write_rows(len(rain), 300, lambda row: round(rain[row], 3)))
    assert records.values["precipitation"].sum() == pytest.approx(sum(rain))


@pytest.mark.parametrize("text", ["T", "traces", "Tr.", "0.0T", "<0.1", "< 0.05", '"<0,1"'])
def test_a_trace_is_nothing(tmp_path: Path, text: str) -> None:
    """Less than 0.1 mm is a trace (WMO-No. 8, Guide to Instruments, 6.1.2, Units and scales)."""
    assert rain_of(tmp_path, write_rows(5, rain=lambda row: text if row % 2 else 0.4)) == (
        [0.4, 0.0, 0.4, 0.0, 0.4]
    )


def test_negative_amounts_of_short_rows(tmp_path: Path) -> None:
    """A weighing gauge's -0.1 mm in five minutes is 0, and -1 is no value."""
    rain = rain_of(tmp_path, write_rows(24, 300, lambda row: (0.5, -0.1)[row % 2]))
    assert rain == pytest.approx([3.0, 3.0])
    rain = rain_of(tmp_path, write_rows(24, 300, lambda row: -1 if row < 12 else 0.1))
    assert rain == pytest.approx([np.nan, 1.2], nan_ok=True)


def shine(row: int) -> float:
    return max(0.0, float(np.sin((row % 24 - 6) / 12 * np.pi)))


@pytest.mark.parametrize(("column", "peak", "sentence"), [
    ("station evapotranspiration [mm/day]", 0.55, "what the sun could evaporate"),
    ("station evapotranspiration [mm/h]", 0.55, ""),
    ("station evapotranspiration [mm]", 0.55, ""),
])
def test_evapotranspiration_in_another_unit(
    tmp_path: Path, column: str, peak: float, sentence: str
) -> None:
    """0.55 mm/h at noon is 4.2 mm a day in June; taken for mm/day it is a twenty-fourth."""
    for hours in (24, 240):
        records = read(tmp_path, write_rows(
            hours, rain=lambda row: f"0,{peak * shine(row):.3f}",
            header=f"time,rain [mm],{column}\n",
        ))
        found = check_hours(records, SITE, range(12))
        assert [sentence in each for each in found] == [True] * bool(sentence)


def test_a_dew_point_in_another_unit(tmp_path: Path) -> None:
    """36 degF under 5 degC."""
    header = "time,rain [mm],temperature [degC],dew point [degC]\n"
    records = read(tmp_path, write_rows(48, rain=lambda row: "0,5,36", header=header))
    found = check_hours(records, SITE, range(12))
    assert any("is 31 K above the temperature" in sentence for sentence in found)


def test_fractions_of_humidity(tmp_path: Path) -> None:
    """Under percent they are noted; they have a unit of their own."""
    text = write_rows(
        48, rain=lambda row: f"0,20,{0.6 + 0.42 * shine(row):.2f}",
        header="time,rain [mm],temperature [degC],relative humidity [%]\n",
    )
    notes = read(tmp_path, text).notes
    assert any("are the values fractions? If so, the unit is [1]" in note for note in notes)
    fractions = read(tmp_path, text.replace("[%]", "[1]"))
    # By FAO-56 Eqs. 11 and 14: 0.6 of 2.338 kPa at 20 degC is 1.403 kPa, which 12.0 degC have.
    assert fractions.values["dew point"][0] == pytest.approx(12.0, abs=0.05)


@pytest.mark.parametrize(("rain", "header", "sentence"), [
    (lambda row: 5 + 3 * (row % 7) if row % 10 == 0 else 0, "time,rain [mm]\n", "in tenths"),
    (lambda row: 0.2 if row % 4 == 0 else 0, "time,rain [mm/h]\n", "of an amount per row is"),
])
def test_rain_in_another_unit(
    tmp_path: Path, rain: Callable[[int], float], header: str, sentence: str
) -> None:
    """Tenths of millimetres, and the amounts of rows as rates."""
    records = read(tmp_path, write_rows(24 * 30, rain=rain, header=header))
    assert any(sentence in each for each in check_hours(records, SITE, range(12)))


@pytest.mark.parametrize(("cells", "is_refused"), [
    (("512.5", '"1,019"'), True), (("512", '"1,019"'), True), (("512", '"1,5"'), False),
    (('"0,045"', '"0,19"'), False),
])
def test_commas_between_thousands(tmp_path: Path, cells: tuple[str, str], is_refused: bool) -> None:
    """A comma before three digits is a decimal mark only where others are."""
    text = write_rows(
        24, rain=lambda row: f"0,{cells[row % 2]}",
        header="time,rain [mm],solar radiation [W/m2]\n",
    )
    if is_refused:
        assert "decimal mark or a thousands separator" in refusal(read, tmp_path, text)
    else:
        read(tmp_path, text)


@pytest.mark.parametrize("radiation", [
    "1'019", "1\u2019019.5", "1\u202f019", "1\u00a0019", "1 019", "1_019", "1.019,5", "1,019.5",
    "1,01,900", "1.019.000",
])
def test_marks_between_digits(tmp_path: Path, radiation: str) -> None:
    """One such number is enough: it is not left out as an implausible one would be."""
    text = write_rows(
        200, rain=lambda row: f'0,"{radiation if row == 150 else 512}"',
        header="time,rain [mm],solar radiation [W/m2]\n",
    )
    assert "line 152: solar radiation [W/m2]" in refusal(read, tmp_path, text)


@pytest.mark.parametrize(("cells", "is_refused"), [
    (("0,2;512", "0,4;1.019"), True), (("0;512", "1;1.019"), True), (("0;0.512", "1;1.019"), False),
    (("0;512.000", "1;1.019"), False), (("0,2;51.5", "0,4;1.01"), False),
])
def test_points_between_thousands(
    tmp_path: Path, cells: tuple[str, str], is_refused: bool
) -> None:
    """A point before three digits is a decimal mark, unless commas are, or some have no point."""
    text = "time;rain [mm];solar radiation [W/m2]\n" + "".join(
        f"2024-06-01T{hour:02}:00Z;{cells[hour % 2]}\n" for hour in range(24)
    )
    if is_refused:
        assert "'1.019': is '.' a decimal mark" in refusal(read, tmp_path, text)
    else:
        read(tmp_path, text)


HOT, SUN = "temperature [degC]", "solar radiation [W/m2]"
DEW, WIND = "dew point [degC]", "wind speed [km/h]"
SUSPICIOUS: dict[str, tuple[str, Callable[[int], object], str]] = {
    "right": ("", lambda row: RAIN[row], ""),
    "tips": ("", lambda row: round(RAIN[row] / 0.2), "is it a count of bucket tips"),
    "a day's total": ("", lambda row: DAILY[row // 24] * (row % 24 == 0), "only every 24 h"),
    "six hours'": ("", lambda row: round(sum(RAIN[row // 6 * 6:][:6]), 1), "only every 6 h"),
    "km/h": (WIND, lambda row: f"{RAIN[row]},{15 + 10 * shine(row):.0f}", ""),
    "km/h as m/s": ("wind speed [m/s]", lambda row: f"{RAIN[row]},{15 + 10 * shine(row):.0f}",
                    "more than 43 is rare: is the unit right?"),
    "degC of dew": (f"{HOT},{DEW}", lambda row: f"{RAIN[row]},{20 + 5 * shine(row)},"
                    f"{9 + row // 72 % 3}", ""),
    "hPa of vapour": (f"{HOT},{DEW}", lambda row: f"{RAIN[row]},{20 - 9 * shine(row)},13.1",
                      "is it vapour pressure, or was it measured at a different location?"),
    "kPa of vapour": (f"{HOT},{DEW}", lambda row: f"{RAIN[row]},{20 + 5 * shine(row)},"
                      f"{1.2 + row // 72 % 3 / 10}", "is it vapour pressure?"),
    "W/m2": (SUN, lambda row: f"{RAIN[row]},{700 * shine(row):.0f}", ""),
    "J/cm2": (SUN, lambda row: f"{RAIN[row]},{252 * shine(row):.0f}", "is the unit right?"),
    "MJ/m2": (SUN, lambda row: f"{RAIN[row]},{2.52 * shine(row):.2f}", "is the unit right?"),
    "all day": (SUN, lambda row: f"{RAIN[row]},700", "more than 1 is rare"),
    "degC": (HOT, lambda row: f"{RAIN[row]},{25 + shine(row):.1f}", ""),
    "degF": (HOT, lambda row: f"{RAIN[row]},{45 + shine(row):.1f}", "degC as a median"),
    "a day's ET": (
        "station evapotranspiration [mm]", lambda row: f"{RAIN[row]},0.8", "more than 1 is rare",
    ),
}
_RANDOM = np.random.default_rng(5)
RAIN = [
    round(0.2 * int(amount), 1)
    for amount in _RANDOM.poisson(6, 720) * (_RANDOM.random(720) < np.repeat([0.3, 0.02], 360))
]
DAILY = [round(sum(RAIN[24 * day:][:24]), 1) for day in range(30)]
EVENTS = [*itertools.accumulate(RAIN, lambda so_far, rain: round(so_far + rain, 1) * (rain > 0))]


@pytest.mark.parametrize("name", SUSPICIOUS)
def test_columns_that_are_suspicious(tmp_path: Path, name: str) -> None:
    """A month of June, with right values and with others."""
    columns, values, sentence = SUSPICIOUS[name]
    header = ",".join(filter(None, ("time,rain [mm]", columns)))
    records = read(tmp_path, write_rows(720, rain=values, header=f"{header}\n"))
    found = check_hours(records, SITE, range(12))
    assert [sentence in each for each in found] == [True] * bool(sentence), found


# --- places ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("comment", [
    "latitude: 43.63 N, longitude: 79.40 W", "latitude: 43.63; longitude = -79.4",
    "latitude: 43\N{DEGREE SIGN}37.8' N, longitude: 79\N{DEGREE SIGN}24'00\" W",
    "Latitude: N 43 37 48, Longitude: W 79 24 0", "latitude: 43,63; longitude: -79,40",
    "latitude: 43.63 degrees north, longitude: 79.40 degrees west",
    "Gauge 7 (latitude: 43.63, longitude: -79.40), on the roof. See latitude: of the plan",
    "latitude: 43.63 N longitude: 79.40 W elevation: 77 m",
])
def test_places_in_comments(tmp_path: Path, comment: str) -> None:
    """All are 43.63 degrees north, 79.40 degrees west."""
    (place,) = read(tmp_path, f"# {comment}\n{write_rows(3)}").places.values()
    assert place == pytest.approx((43.63, -79.40))


@pytest.mark.parametrize("comment", [
    "latitude: 95 steps from the door", "longitude: see map", "latitude: 43.63 W",
    "wind_height: about 2 m", "stamped: by hand", "longitude: -79.40 elevation 77 m",
])
def test_prose_in_comments(tmp_path: Path, comment: str) -> None:
    """It is ignored, with a note."""
    records = read(tmp_path, f"# {comment}\n{write_rows(3)}")
    assert (records.places, records.wind_height) == ({}, None)
    assert records.notes == (
        "gauge.csv: the comment in line 1 was ignored because its value is invalid: " + comment,
    )


@pytest.mark.parametrize("comment", [
    "latitude: 95", "longitude: -79.40 W", "longitude: 280.6", "rain_late: 0.5 h",
])
def test_places_that_are_none(tmp_path: Path, comment: str) -> None:
    """Out of range, or with two signs; and half an hour that only a fit would correct."""
    assert "line 1: " in refusal(read, tmp_path, f"# {comment}\n{write_rows(3)}")


# --- files of other kinds and services ------------------------------------------------------------


RAIN_OF_DWD = (
    "STATIONS_ID;MESS_DATUM;QN_8;  R1;RS_IND;WRTR;eor\n"
    "       1219;2024060100;    1;   0.0;   0;-999;eor\n"
    "       1219;2024060101;    1;   1.5;   1;-999;eor\n"
    "       1219;2024060102;    1;-999;-999;-999;eor\n"
    "       1219;2024060103;    1;   0.2;   1;-999;eor\n"
)


GEOMET = (
    "x,y,STATION_NAME,LOCAL_DATE,TEMP,TEMP_FLAG,PRECIP_AMOUNT_FLAG,PRECIP_AMOUNT,WIND_SPEED\n"
    "-79.4,43.63,TORONTO,2021-07-07 01:00:00,23.5,,M,1.2,11\n"
    "-79.4,43.63,TORONTO,2021-07-07T00:00:00,24.5,,,0.4,5\n"
    "-79.4,43.63,TORONTO,2021/07/07 02:00,22.7,,,0.6,9\n"
)


@pytest.mark.parametrize(("content", "what"), [
    ("<!DOCTYPE html><html>", "a web page"), ("\n <HTML>\n", "a web page"),
    ('{"code": "x", "description": "Invalid query"}', "service: Invalid query"),
    ('{"error": true, "reason": "limit exceeded"}', "service: limit exceeded"),
    ("Too Many Requests\n", "is it a message from a service?"),
    ("Error 503: Unavailable, try again\n", "is it a message from a service?"),
    (gzip.compress(b"time", mtime=0), "gzip"), (b"PK\x03\x04", "workbook"),
    (b"\xd0\xcf\x11\xe0", "Excel"),
    ("time,rain [mm]".encode("utf-16"), "UTF-16"), (b"%PDF-1.4", "PDF"),
    ("time,precipitation,temperature\n2024-06-01T00:00,1,20\n",
     "the form 'name [unit]', such as 'rain [mm]'"),
    ("time,precipitation (mm)\n2024-06-01T00:00,1\n",
     "the form 'name [unit]', such as 'rain [mm]'"),
    ("date,precipitation\n2024-06-01T00:00,1\n", "the first column must be 'time'"),
    ("# STN,YYYYMMDD,   HH,    T,   RH\n  260,20240601,    1,  150,  -1\n", "KNMI, hourly"),
    ("STN,YYYYMMDD,TG,RH\n260,20240601,150,10\n", "KNMI, daily"),
    ("station_abbr;reference_timestamp;tre200h0;rre150h0\nBER;x;15;0\n", "MeteoSwiss, hourly"),
    ("station_abbr;reference_timestamp;rre150d0\nBER;x;0\n", "MeteoSwiss, values other than"),
    ("-BEGIN HEADER-\nNASA/POWER\n-END HEADER-\nYEAR,MO,DY,HR,T2M\n24,6,1,0,1\n", "POWER, hourly"),
    ("YEAR,DOY,T2M\n2024,6,1\n", "NASA POWER, values other than hourly"),
    ('"STATION","DATE","SOURCE","AA1"\n"7","2024-06-01","7","01,0000,9,5"\n', "Integrated Surface"),
    ("STATION,DATE,REPORT_TYPE,HourlyPrecipitation\n1,2,FM-15,T\n", "Local Climatological"),
    ("STATION,STATION_NAME,DATE,HPCP\n1,X,2,0.1\n", "hourly precipitation"),
    ("STATIONS_ID;MESS_DATUM;  QN;RWS_10;eor\n1;202406010000;3;0.0;eor\n", "without hourly rain"),
    ("BRON: KNMI\n\nSTN,YYYYMMDD,   HH,   DD\n 260,19910101,    1,  200\n", "[mm]' = RH / 10"),
    ("abbr;time;tre200h0;rre150h0\nBAS;201701010000;-3.2;0.0\n", "MeteoSwiss, hourly"),
    ("Station_ID|Station_name|Year|Month\nUSW1|X|2024|1\n", "Climatology Network hourly"),
    ("NUM_POSTE;NOM_USUEL;AAAAMMJJHH;RR1\n1;X;2024060100;0\n", "'rain [mm]' = RR1"),
    ("NUM_POSTE;NOM_USUEL;AAAAMMJJ;RR\n1;X;20240601;0\n", "France, values other than hourly"),
    ('[{"station_code": 260, "hour": 1}]', "not an Open-Meteo response with hourly"),
    ('{"type": "FeatureCollection", "features": []}', "not an Open-Meteo response with hourly"),
    ('[{"hourly": {}}]', "download each location separately"),
    (RAIN_OF_DWD.replace("1219;2024060102", "44;2024060102"), "line 4: STATIONS_ID = '44'"),
    (GEOMET + "-79,43,HAMILTON,2021-07-07 03:00,20,,,0,5\n", "line 5: STATION_NAME = 'HAMILTON'"),
])
def test_files_of_other_kinds(tmp_path: Path, content: str | bytes, what: str) -> None:
    """The message states what they are."""
    assert what in refusal(read, tmp_path, content)


AIR_OF_DWD = (
    "STATIONS_ID;MESS_DATUM;QN_9;TT_TU;RF_TU;eor\n"
    "       1219;2024060100;    3;  10.0; 100.0;eor\n"
    "       1219;2024060101;    3;  11.0;  90.0;eor\n"
    "       1219;2024060102;    3;  12.0;  80.0;eor\n"
)


def test_hours_of_dwd(tmp_path: Path) -> None:
    """R1 of 01 UTC is the rain from midnight on, and TT_TU the temperature at its time."""
    rain, air = tmp_path / "produkt_rr_stunde_1.txt", tmp_path / "produkt_tu_stunde_1.txt"
    rain.write_text(RAIN_OF_DWD)
    air.write_text(AIR_OF_DWD)
    alone = read_measured([rain], SITE)
    assert alone.first.isoformat() == "2024-05-31T23:00:00+00:00"
    assert alone.values["precipitation"].tolist() == pytest.approx(
        [0.0, 1.5, np.nan, 0.2], nan_ok=True
    )
    both = read_measured([air, rain], SITE)
    assert both.first.isoformat() == "2024-06-01T00:00:00+00:00"
    assert both.values["precipitation"].tolist() == pytest.approx([1.5, np.nan, 0.2], nan_ok=True)
    assert both.values["temperature"].tolist() == [10.0, 11.0, 12.0]
    assert both.values["dew point"][0] == pytest.approx(10.0)
    assert "contains no precipitation" in refusal(read_measured, [air], SITE)




def test_hours_of_geomet(tmp_path: Path) -> None:
    """In any order, in local standard time, with flags by their names; rain is as in bulk files."""
    records = read(tmp_path, GEOMET)
    assert records.first.isoformat() == "2021-07-07T00:00:00-05:00"
    assert records.values["precipitation"].tolist() == pytest.approx(
        [0.4, np.nan, 0.6], nan_ok=True
    )
    assert records.values["temperature"].tolist() == [24.5, 23.5, 22.7]
    assert (records.rain_late, [*records.places.values()]) == (1, [(43.63, -79.4)])
    assert "Environment Canada that contains daily" in refusal(
        read, tmp_path, "x,y,LOCAL_DATE,MAX_TEMPERATURE\n-79.4,43.63,2021-07-07 00:00:00,3\n"
    )


def test_hours_after_a_section_of_quarters(tmp_path: Path) -> None:
    """Most rows show what a section holds, not the first two, between which rows are missing."""
    quarters = [0, 4, *range(5, 90)]  # the first two are an hour apart
    text = (
        "latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation\n"
        "43.63,-79.4,77.0,0,GMT,GMT\n\ntime,precipitation (mm)\n"
    ) + "".join(
        f"2024-06-0{1 + each // 96}T{each // 4 % 24:02}:{each % 4 * 15:02},0.1\n"
        for each in quarters
    ) + "\ntime,precipitation (mm)\n" + "".join(
        f"2024-06-01T{hour:02}:00,{hour}\n" for hour in range(24)
    )
    assert rain_of(tmp_path, text) == [float(hour) for hour in range(24)]


def test_a_wall_clock_with_summer_time(tmp_path: Path) -> None:
    """Stamped at the end: the hour that the clock shows twice is two hours."""
    site = replace(SITE, time_zone="America/Toronto")
    file = tmp_path / "gauge.csv"
    file.write_text("# stamped: end\ntime,rain [mm]\n" + "".join(
        f"2024-11-03 {time},{rain}\n"
        for time, rain in (("00:00", 1), ("01:00", 2), ("01:00", 3), ("02:00", 4), ("03:00", 5))
    ))
    records = read_measured([file], site)
    assert records.first.isoformat() == "2024-11-02T23:00:00-04:00"
    assert records.values["precipitation"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]


OPEN_METEO = (
    "latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation\n"
    "43.63,-79.4,77.0,0,GMT,GMT\n\ntime,precipitation (mm)\n{}"
)


def test_open_meteo_downloads_that_were_appended(tmp_path: Path) -> None:
    """Of one place they are one; what would be lost or is of another place is refused."""
    days = [
        "".join(f"2024-06-0{day}T{hour:02}:00,{day}\n" for hour in range(24)) for day in (1, 2, 3)
    ]
    first, second = (OPEN_METEO.format(day) for day in days[:2])
    for text in (first + second, f"{first}\n{second}", OPEN_METEO.format(f"{days[0]}time,precipita"
                 f"tion (mm)\n{days[1]}")):
        assert rain_of(tmp_path, text) == [1.0] * 24 + [2.0] * 24
    for text, what in (
        (first + second.replace("43.63", "48.1"), "line 29: begins a download for a different"),
        (first + second.replace(",0,GMT", ",-14400,GMT"), "line 29: begins a download"),
        (first + second.replace("(mm)", "(inch)"), "line 32: is a second header"),
        (second + first, "line 33: time = '2024-06-01T00:00'"),
    ):
        assert what in refusal(read, tmp_path, text)


def test_names_like_open_meteos(tmp_path: Path) -> None:
    """A logger's own temp_2m is not the service's temperature_2m, whose times would be in UTC."""
    text = "time,precipitation,temp_2m\n2024-06-01 00:00,1,20\n2024-06-01 01:00,1,20\n"
    assert "the form 'name [unit]', such as 'rain [mm]'" in refusal(read, tmp_path, text)
