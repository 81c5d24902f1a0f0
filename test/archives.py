"""Made-up weather and forecasts in the format of a forecast service."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any

_UNITS = {
    "temperature_2m": "°C", "dew_point_2m": "°C", "relative_humidity_2m": "%",
    "wind_speed_10m": "km/h", "surface_pressure": "hPa", "shortwave_radiation": "W/m²",
}


def answer(first: str, hours: int, **columns: Sequence[Any]) -> dict[str, Any]:
    """Return an answer of Open-Meteo about Toronto, in GMT; without a value a unit is undefined."""
    start = datetime.fromisoformat(first)
    return {
        "latitude": 43.62, "longitude": -79.42, "elevation": 77.0, "utc_offset_seconds": 0,
        "hourly_units": {"time": "iso8601", **{
            name: "undefined" if set(values) == {None} else _UNITS.get(name, "mm")
            for name, values in columns.items()
        }},
        "hourly": {
            "time": [f"{start + timedelta(hours=hour):%Y-%m-%dT%H:%M}" for hour in range(hours)],
            **columns,
        },
    }
