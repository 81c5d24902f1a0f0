"""Made-up forecast archives in the format of a forecast service."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path


def write_runs(directory: Path, first: str = "2021-07-06T18:00", count: int = 8) -> Path:
    """Write Open-Meteo runs six hours apart; run n forecasts n.LL mm/h at lead time LL."""
    directory.mkdir()
    start = datetime.fromisoformat(first)
    for number in range(count):
        run = start + number * timedelta(hours=6)
        times = [(run + timedelta(hours=hour)).strftime("%Y-%m-%dT%H:%M") for hour in range(49)]
        (directory / f"run_{run:%Y%m%d%H}.json").write_text(json.dumps({
            "latitude": 43.63, "longitude": -79.4, "elevation": 77.0, "utc_offset_seconds": 0,
            "hourly_units": {"time": "iso8601", "precipitation": "mm"},
            "hourly": {
                "time": times,
                "precipitation": [None, *(number + hour / 100 for hour in range(48))],
            },
        }))
    return directory
