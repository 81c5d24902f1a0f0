"""Rain by the minute: each tick has the rain of its own time, whatever step the rows have."""

from __future__ import annotations

import csv
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from paper import weather_of
from places import CONFIG, DATA, refusal

import greenroof_ros as gr
from greenroof_ros.forecast.choice import choose
from greenroof_ros.forecast.steps import make_forecast
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.read import complete_records, read_frame, read_measured
from greenroof_ros.weather.records import Records, write_records
from greenroof_ros.weather.series import FILL, REFUSE, WeatherSeries

SITE = read_site(CONFIG / "site.yaml")
FIRST = datetime(2024, 6, 1, tzinfo=timezone.utc)
KOLKATA = replace(
    SITE, time_zone="Asia/Kolkata", utc_offset=5.5, latitude=None, longitude=None,
)


class Row(NamedTuple):
    """A row of a gauge's file."""

    begin: datetime
    seconds: float
    rain: float
    """mm"""


def rows_of(steps_s: Sequence[float], first: datetime = FIRST, seed: int = 1) -> list[Row]:
    """Return rows of these steps, four in ten of them wet."""
    random = np.random.default_rng(seed)
    begins = first.timestamp() + np.append(0, np.cumsum(steps_s))
    return [
        Row(
            datetime.fromtimestamp(begin, timezone.utc), step_s,
            round(random.gamma(0.5), 1) * (random.random() < 0.4),
        ) for begin, step_s in zip(begins.tolist(), steps_s, strict=False)
    ]


def write(
    file: Path, rows: Sequence[Row], head: str = "", late: Callable[[int], float] = lambda row: 0,
    time: Callable[[datetime], str] = datetime.isoformat, missing: Sequence[int] = (),
) -> Path:
    file.write_text(f"{head}time,rain [mm]\n" + "".join(
        f"{time(row.begin + timedelta(seconds=late(number)))},{row.rain}\n"
        for number, row in enumerate(rows) if number not in missing
    ))
    return file


def fall(rows: Sequence[Row], begin: datetime, end: datetime) -> float:
    """Return the rain between two times (mm), row by row."""
    total = 0.0
    for row in rows:
        row_end = row.begin + timedelta(seconds=row.seconds)
        overlap = (min(end, row_end) - max(begin, row.begin)).total_seconds()
        total += row.rain * max(0.0, overlap) / row.seconds
    return total


def check_ticks(
    records: Records, rows: Sequence[Row], site: Site = SITE, gaps: str = REFUSE,
    taus: Sequence[float] = (1.0, 7.0, 30.0, 60.0, 90.0, 300.0, 420.0, 3600.0),
) -> None:
    """Each tick, and all of them together, have what the rows say; from several starts."""
    weather = complete_records(records, site, gaps=gaps)
    known = np.flatnonzero(~np.isnan(weather.precipitation)).tolist()
    begin, end = (
        weather.first + timedelta(hours=hour) for hour in (known[0], known[-1] + 1)
    )
    end = min(end, rows[-1].begin + timedelta(seconds=rows[-1].seconds))
    for tau in taus:
        for late in (0, 17, 5000):
            start = begin + timedelta(seconds=late)
            steps = int((end - start).total_seconds() // tau)
            series = WeatherSeries(weather, replace(site, tau=tau, M=1), start, steps)
            rain = np.frombuffer(series.precipitation[:steps])
            due = fall(rows, start, start + timedelta(seconds=steps * tau))
            assert 1000 * tau * rain.sum() == pytest.approx(due, rel=1e-9, abs=1e-9), (tau, late)
            for tick in range(0, steps, max(1, steps // 7)):
                times = [start + timedelta(seconds=each * tau) for each in (tick, tick + 1)]
                assert 1000 * tau * rain[tick] == pytest.approx(fall(rows, *times), abs=1e-8)
            tick = 0
            while tick < steps:  # as runs read it
                now = series.at(tick)
                assert (rain[tick : now.until] == now.precipitation).all()
                assert now.until > tick
                tick = now.until


# --- rows -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("step_min", [1, 4, 5, 7, 10, 12, 20, 45])
def test_rows_are_simulated_as_they_are(tmp_path: Path, step_min: int) -> None:
    """Also where rows do not divide an hour; a run of another start or tick has no other water."""
    rows = rows_of([60.0 * step_min] * (480 // step_min), seed=step_min)
    check_ticks(read_measured([write(tmp_path / "gauge.csv", rows)], SITE), rows)


ROWS = [300.0] * 48, [600.0] * 24, [3600.0] * 7, [60.0] * 120, [900.0] * 16
_JITTER = np.random.default_rng(3).integers(-40, 40, 96)
_JITTER[0] = 0


def test_a_step_that_changes(tmp_path: Path) -> None:
    """From five minutes to ten, an hour, one and fifteen: in files of their own, also by ends."""
    rows = rows_of([seconds for part in ROWS for seconds in part], seed=5)
    starts, ends, first = list[Path](), list[Path](), 0
    for part in ROWS:
        of_part = rows[first : first + len(part)]
        first += len(part)
        starts.append(write(tmp_path / f"start{first}.csv", of_part))
        ends.append(write(tmp_path / f"end{first}.csv", [
            row._replace(begin=row.begin + timedelta(seconds=row.seconds)) for row in of_part
        ], "# rows: end\n"))
    check_ticks(read_measured(starts, SITE), rows)
    check_ticks(read_measured(ends, SITE), rows, taus=(60.0, 420.0))


@pytest.mark.parametrize("late", [lambda row: int(_JITTER[row]), lambda row: row // 20])
def test_a_clock_that_errs(tmp_path: Path, late: Callable[[int], float]) -> None:
    """At random, or more and more: rows begin at the minutes of a right clock."""
    rows = rows_of([300.0] * 96)
    check_ticks(read_measured([write(tmp_path / "gauge.csv", rows, late=late)], SITE), rows)


def test_gaps(tmp_path: Path) -> None:
    """Less than a quarter of an hour has the mean of the rest; more is missing, or nothing fell."""
    rows = [row._replace(rain=1.2) for row in rows_of([600.0] * 24)]
    one, many = [7], [12, 13, 14]
    head = "# step: 600\n"
    records = read_measured([write(tmp_path / "gauge.csv", rows, head, missing=one)], SITE)
    assert records.values["precipitation"].tolist() == [7.2] * 4
    check_ticks(records, rows)
    records = read_measured([write(tmp_path / "gauge.csv", rows, missing=many)], SITE)
    assert "precipitation is missing at 2024-06-01T02:00" in refusal(check_ticks, records, rows)
    fallen = [row._replace(rain=0.0) if at in many else row for at, row in enumerate(rows)]
    check_ticks(records, fallen, gaps=FILL)
    filled = complete_records(records, SITE, gaps=FILL)
    assert filled.precipitation.tolist() == pytest.approx([7.2, 7.2, 3.6, 7.2])
    assert filled.filled["precipitation"].tolist() == [False, False, True, False]


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("site", [SITE, KOLKATA])
def test_files_that_end_within_an_hour(tmp_path: Path, site: Site) -> None:
    """As of a card that was changed, in any order; also where hours begin at half past in UTC.

    One is on the site's clock, and one in UTC: no rain is lost where they meet.
    """
    rows = rows_of([600.0] * 60, FIRST + timedelta(minutes=30))
    first = write(tmp_path / "a.csv", rows[:22], time=lambda time: (
        time.astimezone(site.zone).replace(tzinfo=None).isoformat()
    ))
    second = write(tmp_path / "b.csv", rows[22:])
    for files in ([first, second], [second, first]):
        check_ticks(read_measured(files, site), rows, site, taus=(60.0, 300.0))


@pytest.mark.parametrize(("first", "second", "late_min"), [
    ([3600.0] * 48, [3600.0] * 48, 30), ([3600.0] * 4, [3600.0] * 4, 40),
    ([300.0] * 30, [3600.0] * 3, 120), ([3600.0] * 2, [300.0] * 20, 90),
    ([600.0] * 6, [600.0] * 6, 50), ([420.0] * 6, [420.0] * 6, 21),
])
def test_rows_of_two_files_that_overlap(
    tmp_path: Path, first: Sequence[float], second: Sequence[float], late_min: int
) -> None:
    """Wherever their hours and steps begin, no row is left out or counted by half in silence."""
    begin = FIRST + timedelta(minutes=late_min)
    one = write(tmp_path / "one.csv", rows_of(first), f"# step: {first[0]:g}\n")
    two = write(tmp_path / "two.csv", rows_of(second, begin), f"# step: {second[0]:g}\n")
    text = f"{two}: precipitation at {begin:%Y-%m-%dT%H:%M}.*: is also in {one}: files must not"
    refusal(read_measured, [two, one], SITE, match=text)


def test_rain_and_temperature_in_files_of_their_own(tmp_path: Path) -> None:
    rows = rows_of([300.0] * 96, FIRST + timedelta(hours=3))
    air = tmp_path / "air.csv"
    air.write_text("time,temperature [degC]\n" + "".join(
        f"{(FIRST + timedelta(hours=hour)).isoformat()},{hour}\n" for hour in range(11)
    ))
    for files in ([write(tmp_path / "rain.csv", rows), air], [air, tmp_path / "rain.csv"]):
        records = read_measured(files, SITE)
        assert records.values["temperature"].tolist() == [*range(11)]
        check_ticks(records, rows, taus=(60.0,))


@pytest.mark.parametrize(("step_min", "lines"), [(5, 12), (7, 60), (20, 3), (60, 1)])
def test_records_that_are_written_again(tmp_path: Path, step_min: int, lines: int) -> None:
    """With the longest rows that hold them, bit for bit, also numbers with all their digits."""
    rows = rows_of([60.0 * step_min] * (420 // step_min))
    file = tmp_path / "gauge.csv"
    file.write_text("time,rain [mm],my evapotranspiration [mm/day]\n" + "".join(
        f"{row.begin.isoformat()},{row.rain},{2 + row.begin.hour % 3 / 7}\n" for row in rows
    ))
    records = read_measured([file], SITE)
    copy = tmp_path / "copy.csv"
    copy.write_text(write_records(records, "a copy"))
    assert len(copy.read_text().splitlines()) == 3 + lines * records.hours
    again = read_measured([copy], SITE)
    for name, series in records.values.items():
        np.testing.assert_array_equal(again.values[name], series)
    if records.minutes is not None:
        np.testing.assert_array_equal(again.minutes, records.minutes)


@pytest.mark.parametrize("library", ["polars", "pandas"])
def test_a_data_frame_without_times(library: str) -> None:
    frame = pytest.importorskip(library).DataFrame({"rain [mm]": [0.0, 0.1]})
    refusal(lambda: gr.simulate("onoff", weather=frame), match="^the data frame.*time.*must be a")
    refusal(lambda: gr.simulate("onoff", weather=frame[:0]), match="^the data frame: must have")


def test_a_pandas_frame() -> None:
    """Each of its missing values is one; a boolean is no amount of rain; columns differ in name."""
    pandas = pytest.importorskip("pandas")
    times = [FIRST + timedelta(hours=hour) for hour in range(4)]
    frame = pandas.DataFrame({"rain [mm]": [pandas.NA, 1.5, None, np.nan]}, index=times)
    for kind in (object, "Float64"):
        rain = read_frame(frame.astype(kind), SITE).values["precipitation"]
        assert rain.tolist() == pytest.approx([np.nan, 1.5, np.nan, np.nan], nan_ok=True)
    wet = pandas.DataFrame({"rain [mm]": [True, False]}, index=times[:2])
    refusal(read_frame, wet, SITE, match="row 0: rain .* = 'True': must be a number[^;]*$")
    frame.columns = ["rain [mm]"]
    refusal(read_frame, pandas.concat([frame, frame], axis=1), SITE, match="more than one column")


# --- a measured roof ------------------------------------------------------------------------------

# Highest runoff measured in 15 and 60 min (mm/h) of two storms at Neubrandenburg, and their hours.
STORMS = {
    "2014-10-21T15:00+01:00": (23, {15: 3.15, 60: 2.85}),
    "2015-05-05T18:00+01:00": (11, {15: 5.18, 60: 3.21}),
}


@pytest.mark.parametrize("begin", STORMS)
@pytest.mark.filterwarnings("ignore")
def test_peaks_of_a_measured_roof(begin: str) -> None:
    """With the roof as wet before the storm as the measured volume of runoff shows."""
    hours, measured = STORMS[begin]
    site = replace(read_site(CONFIG / "site_neubrandenburg.yaml"), tau=60.0, M=1, latitude=None)
    file = DATA / "neubrandenburg_storms.csv"
    with file.open() as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    first = datetime.fromisoformat(begin)
    volume = sum(
        float(row["runoff [mm]"]) for row in rows
        if first <= datetime.fromisoformat(row["time"]) < first + timedelta(hours=hours)
    )
    records = read_measured([file], site)
    dry, wet = site.wilting_volume, site.z_cap
    for _ in range(7):
        result = gr.simulate(
            lambda *_: 0.0, site=site, weather=records, start=first, hours=float(hours),
            initial=(20.0, (dry + wet) / 2), gaps=FILL,
        )
        runoff = 60_000 / site.a2 * np.asarray(result.ticks.drainage)[:-1]
        if runoff.sum() > volume:
            wet = (dry + wet) / 2
        else:
            dry = (dry + wet) / 2
    peaks = {
        minutes: 60 * np.convolve(runoff, np.full(minutes, 1 / minutes), "valid").max()
        for minutes in measured
    }
    assert peaks == pytest.approx(measured, rel=0.2)


# --- forecasts, evapotranspiration and memory ---------------------------------------------------


def test_forecasts_are_of_hours_and_the_present_rain_is_what_falls(tmp_path: Path) -> None:
    """At 01:25 it pours, 72 mm/h of 12 mm in that hour; its rest is known by the mean.

    What falls now falls for the tick of a minute, which is the first six steps.
    """
    rows = [
        Row(FIRST + timedelta(minutes=10 * row), 600.0, 12.0 * (row == 8)) for row in range(360)
    ]
    weather = complete_records(read_measured([write(tmp_path / "gauge.csv", rows)], SITE), SITE)
    site = replace(SITE, tau=60.0)
    series = WeatherSeries(weather, site, FIRST, 60 * 10)
    forecast = make_forecast(weather, series, site, FIRST, 24.0, choose("perfect"))
    for minute, now in ((85, 72.0), (91, 0.0)):
        rain = 3.6e6 * np.array(forecast.at(minute).rain)
        assert rain[:8] == pytest.approx([*[now] * 6, 12.0, 12.0])


def test_ten_years_of_minutes() -> None:
    """They take 42 MB; a run's own rain takes as much, and nothing for each of its seconds."""
    hours = 87_660
    rain = np.zeros((hours, 60))
    rain[::7, 10:20] = 6.0
    weather = weather_of(rain)
    assert weather.minutes is not None
    assert weather.minutes.nbytes == pytest.approx(42e6, rel=0.01)
    WeatherSeries(weather, replace(SITE, tau=1.0, M=10), weather.first, 3600)  # imports
    tracemalloc.start()
    series = WeatherSeries(weather, replace(SITE, tau=1.0, M=10), weather.first, 87_000 * 3600)
    series.at(87_000 * 3600)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 50e6 and peak < 250e6
