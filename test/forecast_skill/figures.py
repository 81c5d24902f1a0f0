"""Figures of forecasts against records: what ``skill.csv`` has, of services and of the model."""

from __future__ import annotations

import csv
from datetime import timezone
from pathlib import Path

import numpy as np

from greenroof_ros.weather.records import HOUR

DAYS = (1, 2, 3, 5)
# Hours that are summed, and the least sum that is an event (mm).
SUMS = {1: 1.0, 6: 2.0, 12: 3.0, 24: 5.0}
NAMES = ("r", "POD", "FAR", "bias")


def services(file: Path) -> dict[tuple[int, int], dict[str, np.ndarray]]:
    """Return r, POD, FAR and bias of each service by day ahead and hours of the sum.

    GFS's fifth day is left out: it lacks half of its water, an error of the archive.
    """
    found: dict[tuple[int, int], dict[str, np.ndarray]] = {}
    with file.open() as stream:
        for row in csv.DictReader(line for line in stream if not line.startswith("#")):
            day, hours = int(row["days_ahead"]), int(row["sum_hours"])
            if day in DAYS and (day, row["model"]) != (5, "gfs_seamless"):
                found.setdefault((day, hours), {})[row["model"]] = np.array(
                    [float(row[name.lower()]) for name in NAMES]
                )
    return found


class Warm:
    """The warm seasons of records, May to October, by whole sums."""

    def __init__(self, rain: np.ndarray, first) -> None:
        """Take rain (mm) hour by hour, NaN where missing, and the time of the first."""
        self.rain = rain
        months = np.array([(first + hour * HOUR).month for hour in range(len(rain))])
        self.hours = (months >= 5) & (months <= 10)
        self._sums = []
        for hours, event in SUMS.items():
            length = len(rain) // hours * hours
            use = self.hours[:length].reshape(-1, hours).all(axis=1)
            use &= ~np.isnan(rain[:length]).reshape(-1, hours).any(axis=1)
            observed = rain[:length].reshape(-1, hours).sum(axis=1)[use]
            self._sums.append((hours, length, event, use, observed))

    def figures(self, forecast: np.ndarray) -> np.ndarray:
        """Return r, POD, FAR and bias of a forecast (mm) of each hour, shape (sums, 4).

        Hours without a forecast are NaN, and their sums are left out.
        """
        rows = []
        for hours, length, event, use, observed in self._sums:
            sums = forecast[:length].reshape(-1, hours).sum(axis=1)[use]
            given = ~np.isnan(sums)
            sums, seen = sums[given], observed[given]
            hits = ((sums >= event) & (seen >= event)).sum()
            rows.append((
                np.corrcoef(sums, seen)[0, 1], hits / (seen >= event).sum(),
                1 - hits / (sums >= event).sum(), sums.sum() / seen.sum(),
            ))
        return np.array(rows)


def days_ahead(model, first, hours: int, days: tuple[int, ...]) -> dict[int, np.ndarray]:
    """Return what the newest issue of so many days before had forecast of each hour (mm).

    Open-Meteo's previous runs have it so: of day N, the newest issue that is at least N x 24 h old.
    NaN where there is none.
    """
    forecasts = {day: np.full(hours, np.nan) for day in days}
    begin = -int(first.astimezone(timezone.utc).hour) % 6
    furthest = 24 * max(days)
    for issue in range(begin, hours - furthest - 5, 6):
        rain = model.known(issue, furthest + 6)[0][0]
        for day, forecast in forecasts.items():
            lead = 24 * day
            forecast[issue + lead : issue + lead + 6] = rain[lead : lead + 6]
    return forecasts
