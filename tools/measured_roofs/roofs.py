"""The roofs in Neubrandenburg and Berlin, as records in this project's format.

Rain and runoff every five minutes and daily temperatures, from the repository KWB-R/keys.lid
(Kompetenzzentrum Wasser Berlin, MIT). Its files are not part of this repository.
"""

from __future__ import annotations

import csv
import lzma
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.analysis.calibration.record import RoofRecord, in_months
from greenroof_ros.model.site import Site

STEP_S = 300


class Roof(NamedTuple):
    """A roof; its files begin with its name."""

    name: str
    rain: str
    """file of its rain"""
    runoff: str
    area: float
    """m2"""
    soil: float
    """depth of the substrate (m), from the SWMM model of the roof"""
    latitude: float
    longitude: float


ROOFS = (
    Roof("neubrandenburg", "neubrandenburg_5min.csv.xz", "neubrandenburg_5min.csv.xz",
         101.0, 0.108, 53.56, 13.26),
    Roof("berlin", "berlin_rain_5min.csv.xz", "berlin_runoff_5min.csv.xz",
         194.0, 0.100, 52.52, 13.40),
)


def read_roof(roof: Roof, directory: Path, site: Site, scratch: Path) -> RoofRecord:
    """Write a roof's record as CSV in this project's format, and read that."""
    rain = _series(directory / roof.rain, "rain [mm/5min]")
    runoff = _series(directory / roof.runoff, "runoff [mm/5min]")
    extremes = temperatures(directory / f"{roof.name}_temperature_daily.txt")
    # Loggers set their clocks now and then; values in the same step of the clock are added up.
    first = max(min(rain), min(runoff))
    file = scratch / f"{roof.name}.csv"
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", "rain [mm]", "runoff [mm]", "least temperature [degC]",
                         "greatest temperature [degC]"])
        for slot in range(first, max(rain) + 1):
            time = datetime.fromisoformat(str(np.datetime64(slot * STEP_S, "s")))
            maximum, minimum = extremes[time.date().isoformat()]
            writer.writerow([
                time.isoformat(), _cell(rain.get(slot)), _cell(runoff.get(slot)), minimum, maximum,
            ])
    return read_csv_record(file, site)


def _cell(value: float | None) -> str:
    return "" if value is None or np.isnan(value) else repr(value)


def _series(file: Path, column: str) -> dict[int, float]:
    """Return the sum in each five minutes of the clock; NaN if a part is missing."""
    sums: dict[int, float] = {}
    with lzma.open(file, "rt", encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            seconds = int(np.datetime64(row["time"], "s").astype(np.int64))
            value = float(row[column] or "nan")
            sums[seconds // STEP_S] = sums.get(seconds // STEP_S, 0.0) + value
    return sums


def temperatures(file: Path) -> dict[str, tuple[float, float]]:
    """Return maximum and minimum temperature (degC) by date."""
    extremes = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        _, year, month, day, maximum, minimum = line.split()
        extremes[f"{int(year)}-{int(month):02}-{int(day):02}"] = (float(maximum), float(minimum))
    return extremes


def warm(record: RoofRecord) -> np.ndarray:
    """Return which steps are in April to October; in winter the runoff is melted snow."""
    return in_months(record, "4-10")
