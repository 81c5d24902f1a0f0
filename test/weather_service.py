"""A simulated weather archive: Open-Meteo's, and the bulk files of Environment Canada.

Open-Meteo's values are made up, the same at each time. ECCC's months are the real files of
test/data; others have rows without observations, as at a closed station, and before 2000 there is
only a header, as before a station was opened.
"""

from __future__ import annotations

import calendar
import json
import time
from datetime import date, datetime, timedelta, timezone
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
from http_service import HttpService

HTML = b"<!DOCTYPE html><html><body>The site is under maintenance</body></html>"
_NONSENSE = {"html": HTML, "deep": b"[" * 100_000}
_DATA = Path(__file__).parent / "data"
_UNITS = {
    "precipitation": "mm", "temperature_2m": "°C", "dew_point_2m": "°C", "wind_speed_10m": "km/h",
    "surface_pressure": "hPa", "shortwave_radiation": "W/m²",
}
_FIRST_DAY = date(1971, 1, 1)


def open_meteo_values(variable: str, first: datetime, hours: int) -> list[float | None]:
    """Return the made-up values of a variable, as the service rounds them."""
    hour = round(first.timestamp() / 3600) + np.arange(hours)
    day, year = 2 * np.pi * hour / 24, 2 * np.pi * hour / 8766
    warmth = 12 - 12 * np.cos(year) - 5 * np.cos(day)
    values = {
        "precipitation": np.maximum(0.0, np.sin(hour / 17.3) * np.sin(hour / 5.1) - 0.7) * 12,
        "temperature_2m": warmth,
        "dew_point_2m": warmth - 4 - 2 * np.sin(hour / 31),
        "wind_speed_10m": 12 + 8 * np.sin(hour / 13),
        "surface_pressure": 1005 + 9 * np.sin(hour / 97),
        "shortwave_radiation": np.maximum(0.0, -np.cos(day - 1.3)) * (400 - 300 * np.cos(year)),
    }
    return [round(float(value), 1) for value in values[variable]]


class WeatherService(HttpService):
    """Answers as the real services do.

    Attributes:
        faults: of the next requests, one each: "" for none; "html"; "half" of the answer, then the
            connection ends; "limit", "limit 1" with Retry-After, and "tomorrow": 429; "error": 503;
            "refusal": 400 with a reason; any other phrase: 400 with this reason; "missing": 404;
            "slow": a pause of 20 s; "fewer" variables; "short": a day less; "other" hours, of ten
            years before; "gap": five hours without values; "dry": no values of precipitation at
            all; "JSON error": an answer with status 200 that is an error; "odd": no list of times;
            "deep": nested JSON; "control": a refusal with control characters, which repeats the
            query.
        requests: the queries, in order.
    """

    def __init__(self) -> None:
        self.faults: list[str] = []
        self.requests: list[dict[str, str]] = []
        super().__init__()

    def respond(self, request: BaseHTTPRequestHandler) -> None:
        """Answer a request, spoiled by the next fault."""
        path = urlsplit(request.path)
        query = {key: values[0] for key, values in parse_qs(path.query).items()}
        self.requests.append(query)
        fault = self.faults.pop(0) if self.faults else ""
        if fault == "slow":
            time.sleep(20)
        refusal = {
            "limit": (429, {}, "Too many concurrent requests"),
            "limit 1": (429, {"Retry-After": "1"}, "Too many concurrent requests"),
            "tomorrow": (429, {}, "Daily API request limit exceeded. Please try again tomorrow."),
            "error": (503, {}, "upstream is down"),
            "refusal": (400, {}, "Parameter 'end_date' is out of allowed range"),
            "missing": (404, {}, "Not Found"),
            "JSON error": (200, {}, "Something went wrong."),
        }.get(fault, (400, {}, fault) if " " in fault else None)
        if fault == "control":
            status, headers = 400, {}
            body = f"\33[2J\7\u202einvalid String value {path.query}".encode()
        elif refusal is not None:
            status, headers, reason = refusal
            body = json.dumps({"error": True, "reason": reason}).encode()
        else:
            status, headers = 200, {}
            body = _NONSENSE.get(fault) or self.answer(path.path, query, fault)
        self.send(request, status, body, headers, fault if fault == "half" else "")
        request.close_connection = True

    def answer(self, path: str, query: dict[str, str], fault: str = "") -> bytes:
        """Return the answer to a query."""
        return _bulk_file(query) if "bulk_data" in path else _archive(query, fault)


def _archive(query: dict[str, str], fault: str) -> bytes:
    first, last = (date.fromisoformat(query[f"{end}_date"]) for end in ("start", "end"))
    assert _FIRST_DAY <= first <= last < datetime.now(timezone.utc).date()
    assert query["timezone"] == "GMT"
    begin = datetime(first.year, first.month, first.day, tzinfo=timezone.utc)
    hours = 24 * ((last - first).days + (fault != "short"))
    if fault == "other":
        begin = begin.replace(year=begin.year - 10)
    names = query["hourly"].split(",")[: -1 if fault == "fewer" else None]
    times = [f"{begin + timedelta(hours=hour):%Y-%m-%dT%H:%M}" for hour in range(hours)]
    hourly = {name: open_meteo_values(name, begin, hours) for name in names}
    if fault == "gap":
        for series in hourly.values():
            series[100:105] = [None] * 5
    if fault == "dry":
        hourly["precipitation"] = [None] * hours
    return json.dumps({
        "latitude": round(float(query["latitude"]), 1),
        "longitude": round(float(query["longitude"]), 1), "generationtime_ms": 1.5,
        "utc_offset_seconds": 0, "timezone": "GMT", "timezone_abbreviation": "GMT",
        "elevation": 77.0, "hourly_units": {"time": "iso8601", **_UNITS},
        "hourly": {"time": 5 if fault == "odd" else times, **hourly},
    }).encode()


def _bulk_file(query: dict[str, str]) -> bytes:
    year, month = int(query["Year"]), int(query["Month"])
    assert (query["format"], query["timeframe"]) == ("csv", "1")
    real = _DATA / f"en_climate_hourly_{month:02}-{year}.csv"
    if real.exists():
        return real.read_bytes()
    head = (_DATA / "en_climate_hourly_07-2021.csv").read_bytes().splitlines()[0] + b"\r\n"
    if year < 2000:
        return head
    return head + b"".join(
        f'-79.4,43.63,TORONTO CITY CENTRE,6158359,{year}-{month:02}-{day:02} {hour}:00,'
        f'{year},{month},{day},{hour}:00\r\n'.encode()
        for day in range(1, calendar.monthrange(year, month)[1] + 1) for hour in range(24)
    )
