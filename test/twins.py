"""Synthetic records of a roof with known parameters, with sensor noise and gaps."""

from __future__ import annotations

import csv
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from paper import PAPER_SITE

from greenroof_ros.analysis.calibration.record import StepRecord, read_csv_record
from greenroof_ros.physics import tick
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.site.site import Site
from greenroof_ros.weather.evapotranspiration import hargreaves, spread_over_day

STEP_S = 300
NOISE_M = 0.002
TIP_MM = 0.005
DAY = 86400 // STEP_S
_TICK_S = 5.0

TWIN = replace(
    PAPER_SITE, a2=100.0, z_soil=0.1, z_veg=0.02, x2_star=2.0, field_capacity=0.42,
    wilting_point=0.06, z_cap=4.2, depletion_fraction=0.35, drainage_storage=0.02,
    drainage_time=900.0, crop_coefficient=0.85, latitude=52.5, longitude=13.4, utc_offset=1.0,
)
"""A roof of 100 m2 that holds 36 mm for its plants."""
FILLED_AT_FIRST = 0.5


def a_record(rain: np.ndarray, step_s: float = 300.0, **series: np.ndarray) -> StepRecord:
    """Return a record from the beginning of May; water that is not given is 0."""
    nothing = np.zeros(len(rain))
    measured = {name: series.pop(name) for name in ("runoff", "level") if name in series}
    start = datetime(2021, 5, 1, tzinfo=timezone.utc)
    return StepRecord(Path("roof.csv"), start, step_s, rain, **{
        "reference": nothing, "pumped": nothing, "measured": measured, **series
    })


def storms(days: int, random: np.random.Generator) -> np.ndarray:
    """Return rain (mm in a step): a storm of about 6 mm about every three days, over hours."""
    rain = np.zeros(days * DAY)
    at = 0.0
    while True:
        at += random.exponential(3 * DAY)
        length = 2 + int(random.exponential(36))
        if at + length >= len(rain):
            return rain
        shape = random.gamma(0.6, 1.0, length)
        rain[int(at):int(at) + length] += random.exponential(6.0) * shape / shape.sum()


@cache
def record_rows(
    site: Site, days: int, seed: int, *, gaps: bool = True, pumping: bool = False
) -> list[list[str]]:
    """Return the rows of a CSV record, the header first.

    The plant steps the true roof, with ticks of 5 s while it rains and with the record's steps
    otherwise. Its level is measured with a noise of 2 mm, its runoff by a counter of tips; three
    gaps of a day have neither. With pumping, every fourth day has two periods of ten minutes
    at a quarter of the flow, if the cistern is not too low.
    """
    random = np.random.default_rng(seed)
    rain = storms(days, random)
    start = datetime(2021, 4, 1)  # noqa: DTZ001 - on the clock of the site
    dates = np.datetime64(start.date()) + np.arange(days)
    middle = 14 - 10 * np.cos(2 * np.pi * (np.arange(days) + 71) / 365) + random.normal(0, 2, days)
    minimum, maximum = middle - 5, middle + 5
    seconds = (np.datetime64(start, "s") + STEP_S * np.arange(len(rain))).astype(np.int64)
    day = np.arange(len(rain)) // DAY
    reference = spread_over_day(
        hargreaves(site.latitude, dates, minimum, maximum), site, seconds, STEP_S
    )
    x2 = site.wilting_volume + FILLED_AT_FIRST * site.available_volume
    state = State(2.5 * site.a1, x2, 0.0)
    wet, dry = (plant_parameters(replace(site, tau=tau)) for tau in (_TICK_S, float(STEP_S)))
    pair = np.arange(len(rain)) % (4 * DAY) // 2
    command = np.where(pumping & ((pair == 40) | (pair == 60)), 0.25, 0.0)
    level, pumped, runoff = [], [], []
    for step, (fell, wanted_mm) in enumerate(zip(rain.tolist(), reference.tolist(), strict=True)):
        plant, ticks = (wet, round(STEP_S / _TICK_S)) if fell > 0 or command[step] > 0 else (dry, 1)
        drained = 0.0
        level.append(state.roof / site.a2)
        pumped.append(0.0)
        if state.cistern / site.a1 < site.suction_level + 0.3:
            command[step] = 0.0
        for _ in range(ticks):
            state, flows = tick.step(
                plant, state, fell / 1000 / STEP_S,
                wanted_mm * site.crop_coefficient * site.a2 / 1000 / STEP_S, 0.0, 1.0,
                float(command[step]) * maximum_pump_flow(plant, state.cistern),
            )
            drained += flows.drainage * STEP_S / ticks
            pumped[-1] += flows.pump * STEP_S / ticks * 1000 / site.a2
        runoff.append(drained * 1000 / site.a2)
    measured = np.array(level) + random.normal(0, NOISE_M, len(level))
    tips = np.diff(np.floor(np.concatenate(([0.0], np.cumsum(runoff))) / TIP_MM)) * TIP_MM
    missing = np.zeros(len(rain), dtype=bool)
    if gaps:
        for begin in random.integers(0, len(rain) - DAY, 3):
            missing[begin:begin + DAY] = True
    rows = [["time", "rain [mm]", "runoff [mm]", "level [m]", "minimum temperature [degC]",
             "maximum temperature [degC]"]]
    for step, fell in enumerate(rain):
        time = start + timedelta(seconds=STEP_S * step)
        cells = ["", ""] if missing[step] else [f"{tips[step]:.3f}", f"{measured[step]:.4f}"]
        rows.append([time.isoformat(), f"{fell:.4f}", *cells,
                     *([f"{minimum[day[step]]:.1f}", f"{maximum[day[step]]:.1f}"]
                       if step % DAY == 0 else ["", ""])])
    if pumping:
        for row, cell in zip(rows, ["pumped [mm]", *(f"{depth:.4f}" for depth in pumped)],
                             strict=True):
            row.append(cell)
    return rows


def summed(rows: list[list[str]], hours: int) -> list[list[str]]:
    """Return the rows that a logger with longer steps would write, the header first.

    Rain and runoff are sums, the level is at the step's beginning, and each row has the
    temperatures of its day; a gap in any part makes the whole step a gap.
    """
    count = hours * 3600 // STEP_S
    result = [rows[0]]
    for at in range(1, len(rows) - count + 1, count):
        part, day = rows[at:at + count], rows[1 + (at - 1) // DAY * DAY]
        sums = ["" if any(not row[column] for row in part)
                else f"{sum(float(row[column]) for row in part):.4f}" for column in (1, 2)]
        result.append([part[0][0], *sums, part[0][3], *day[4:6]])
    return result


def write(rows: list[list[str]], file: Path) -> Path:
    """Write rows as CSV."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows(rows)
    return file


def record_of(rows: list[list[str]], hours: int = 0) -> StepRecord:
    """Return the record in rows; with hours, its sums over this many hours."""
    with TemporaryDirectory() as directory:
        file = write(summed(rows, hours) if hours else rows, Path(directory) / "twin.csv")
        return read_csv_record(file, TWIN)
