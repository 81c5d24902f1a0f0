"""A gauge's hours and a service's previous runs as files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from pathlib import Path

HOUR = timedelta(hours=1)
FIRST = datetime.fromisoformat("2024-03-01T00:00+00:00")


def write_gauge(file: Path, rain: Iterable[object], first: datetime = FIRST) -> None:
    """Write hours of rain as a weather file; an empty cell is a missing hour."""
    file.write_text("\n".join([
        "time,precipitation [mm/h],given evapotranspiration [mm/day]",
        *(f"{(first + hour * HOUR).isoformat()},{mm},2.0" for hour, mm in enumerate(rain)), "",
    ]))


def write_previous_runs(file: Path, days: dict[int, Sequence[object]]) -> None:
    """Write forecasts by the days before; a service's hours end at their time."""
    rows = enumerate(zip(*days.values(), strict=True), 1)
    file.write_text("\n".join([
        ",".join(["datetime", *(f"precipitation_previous_day{day}" for day in days)]),
        *(f"{FIRST + hour * HOUR:%Y-%m-%d %H:%M:%S},{','.join(map(str, row))}"
          for hour, row in rows), "",
    ]))
