"""Functions that format locations and compute the distance between two locations."""

from __future__ import annotations

import math

_EARTH_KM = 6371.0


def measure_distance(here: tuple[float, float], there: tuple[float, float]) -> float:
    """Return the great-circle distance (km) between two points (latitude, longitude)."""
    (north, east), (north2, east2) = (map(math.radians, place) for place in (here, there))
    chord = math.sin((north2 - north) / 2) ** 2 + (
        math.cos(north) * math.cos(north2) * math.sin((east2 - east) / 2) ** 2
    )
    return 2 * _EARTH_KM * math.asin(min(1.0, math.sqrt(chord)))


def format_place(latitude: float | None, longitude: float | None) -> str:
    """Return a location as text, such as '43.63 N, 79.40 W'."""
    if latitude is None or longitude is None:
        return "location not stated"
    return (
        f"{abs(latitude):.2f} {'N' if latitude >= 0 else 'S'}, "
        f"{abs(longitude):.2f} {'E' if longitude >= 0 else 'W'}"
    )
