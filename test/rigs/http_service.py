"""Simulated services on the web, ports of this machine, and what spoils their answers.

Open-Meteo's archive and forecasts have the values of this package's weather, without end: the hour
in which the service is opened has the first, and after the last they begin again. That is perfect
for a site simulator with the same records. The other members of an ensemble have scaled rain, and
radiation is 0.6 of the solar constant times the sine of the sun's height. The months of Environment
Canada are the real files of test/data; others have rows without observations, as at a closed
station, and before 2000 there is only a header, as before a station was opened.
"""

from __future__ import annotations

import calendar
import gzip
import json
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from datetime import date, datetime, timezone
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from numpy.typing import NDArray
from places import CONFIG, DATA

from greenroof_ros.base.times import hours_since_1970
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.evapotranspiration import sun_height
from greenroof_ros.weather.open_meteo import VARIABLES
from greenroof_ros.weather.quantities import PRECIPITATION, PRESSURE, RADIATION
from greenroof_ros.weather.read import default_weather, read_weather
from greenroof_ros.weather.records import HOUR, Records
from greenroof_ros.weather.series import FILL

UNITS = dict(zip(VARIABLES, ("mm", "°C", "°C", "km/h", "hPa", "W/m²"), strict=True))
MEMBERS = 11
_SITE = read_site(CONFIG / "site.yaml")
_FIRST_DAY = date(1971, 1, 1)
# Answers that contain no weather.
_REFUSALS = {
    "limit": (429, {"Retry-After": "1"}, "Too many concurrent requests"),
    "long limit": (429, {"Retry-After": "120"}, "Minutely API request limit exceeded."),
    "tomorrow": (429, {}, "Daily API request limit exceeded. Please try again tomorrow."),
    "error": (503, {}, "upstream is down"),
    "unknown": (404, {}, "Not Found"),
    "JSON error": (200, {}, "Something went wrong."),
}
_NONSENSE = {
    "html": b"<!DOCTYPE html><html><body>Please log in to the hotel's network</body></html>",
    "deep": b"[" * 100_000,
}


class HttpService:
    """Answers as its subclass does; open from the start.

    Attributes:
        address: of the port, as the beginning of a URL.
    """

    def __init__(self) -> None:
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                with suppress(OSError):  # the client has left
                    outer.respond(self)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def respond(self, request: BaseHTTPRequestHandler) -> None:
        """Answer a request."""
        raise NotImplementedError

    def send(
        self, request: BaseHTTPRequestHandler, status: int, body: bytes,
        headers: Mapping[str, str] | None = None, fault: str = "",
    ) -> None:
        """Send an answer, compressed if requested.

        Args:
            request: what is answered.
            status: of the answer.
            body: of the answer.
            headers: beside its length and encoding.
            fault: "half" of the answer, then the connection ends; "slow": a few bytes per second;
                "slow head".
        """
        if fault == "slow head":
            for byte in b"HTTP/1.1 200 OK\r\nX: ":
                request.wfile.write(bytes([byte]))
                time.sleep(0.4)
        request.send_response_only(status)
        if body and "gzip" in request.headers.get("Accept-Encoding", ""):
            body = gzip.compress(body)
            request.send_header("Content-Encoding", "gzip")
        for name, value in {**(headers or {}), "Content-Length": str(len(body))}.items():
            request.send_header(name, value)
        request.end_headers()
        if fault == "half":
            body = body[: len(body) // 2]
        step = 8 if fault == "slow" else len(body) or 1
        for at in range(0, len(body), step):
            request.wfile.write(body[at : at + step])
            time.sleep(1.0 if fault == "slow" else 0.0)

    def close(self) -> None:
        """Close the port."""
        self._server.shutdown()
        self._server.server_close()


class WeatherService(HttpService):
    """Answers as the real services do.

    Attributes:
        fault: what is wrong now, and can be changed at any time; "" if nothing is. The connection
            is "refused"; the answer is "slow", has a "slow head", is cut in "half", is "html" or
            "deep", nested JSON; the service has a "limit", a "long limit" or one until "tomorrow",
            an "error", an "unknown" address, or a "JSON error" with the status 200; any other
            phrase: 400 with this reason; "control": a refusal with control characters, which
            repeats the query. Of the hours, there are "fewer" variables, "short" of a day, "other"
            ones, of ten years before, a "gap" of five, none of precipitation ("dry"), or a wrong
            "length".
        faults: of the next requests, one each, before ``fault``.
        requests: the queries, in order.
    """

    def __init__(self, fault: str = "") -> None:
        self.fault = fault
        self.faults: list[str] = []
        self.requests: list[dict[str, str]] = []
        self._opened = datetime.now(timezone.utc)
        super().__init__()

    def respond(self, request: BaseHTTPRequestHandler) -> None:
        """Answer a request, spoiled by the next fault."""
        address = urlsplit(request.path)
        query = {key: values[0] for key, values in parse_qs(address.query).items()}
        self.requests.append(query)
        fault = self.faults.pop(0) if self.faults else self.fault
        request.close_connection = True
        if fault == "control":
            reason = f"\33[2J\7\u202einvalid String value {address.query}"
            self.send(request, 400, reason.encode())
        elif fault in _REFUSALS or (" " in fault and fault != "slow head"):
            status, headers, reason = _REFUSALS.get(fault, (400, {}, fault))
            body = json.dumps({"error": True, "reason": reason}).encode()
            self.send(request, status, body, headers)
        elif fault != "refused":
            body = _NONSENSE.get(fault) or self.answer(address.path, query, fault)
            self.send(request, 200, body, fault=fault)

    def answer(self, path: str, query: dict[str, str], fault: str = "") -> bytes:
        """Return the answer to a query."""
        if "bulk_data" in path:
            return _bulk_file(query)
        assert query["timezone"] == "GMT"
        today = datetime.now(timezone.utc).replace(hour=0, minute=0, second=0, microsecond=0)
        first, days = today, int(query.get("forecast_days", "7"))
        if "start_date" in query:
            begin, end = (date.fromisoformat(query[f"{end}_date"]) for end in ("start", "end"))
            assert _FIRST_DAY <= begin <= end < today.date()
            first = datetime(begin.year, begin.month, begin.day, tzinfo=timezone.utc)
            days = (end - begin).days + (fault != "short")
        if fault == "other":
            first = first.replace(year=first.year - 10)
        hours = 24 * days
        hourly: dict[str, Any] = {
            "time": [f"{first + hour * HOUR:%Y-%m-%dT%H:%M}" for hour in range(hours)]
        }
        units = {"time": "iso8601"}
        names = query["hourly"].split(",")[: -1 if fault == "fewer" else None]
        for quantity, variable in VARIABLES.items():
            ensemble = quantity == PRECIPITATION and path.endswith("ensemble")
            for member in range(MEMBERS if ensemble else 1) if variable in names else ():
                name = variable + (f"_member{member:02}" if member else "")
                scale = (member + 0.5) / 5 if member else 1.0
                values = scale * self.values(quantity, first, hours)
                units[name], hourly[name] = UNITS[quantity], values.round(2).tolist()
        for series in [*hourly.values()][1:] if fault == "gap" else ():
            series[100:105] = [None] * 5
        if fault == "dry":
            hourly[PRECIPITATION] = [None] * hours
        if fault == "length":
            hourly[VARIABLES["temperature"]].pop()
        return json.dumps({
            "latitude": round(float(query["latitude"]), 1),
            "longitude": round(float(query["longitude"]), 1), "generationtime_ms": 1.5,
            "utc_offset_seconds": 0, "timezone": "GMT", "timezone_abbreviation": "GMT",
            "elevation": 77.0, "hourly_units": units, "hourly": hourly,
        }).encode()

    def values(self, quantity: str, first: datetime, hours: int) -> NDArray[np.float64]:
        """Return a quantity in the service's unit at whole hours; rain is of the hour before."""
        first -= HOUR * (quantity in (PRECIPITATION, RADIATION))
        if quantity == RADIATION:
            seconds = 3600 * (hours_since_1970(first) + np.arange(hours)) + 1800
            return 0.6 * 1367 * sun_height(43.63, seconds, -79.4)
        series = _records().values[quantity] * (10 if quantity == PRESSURE else 1)
        index = round((first - self._opened) / HOUR) + np.arange(hours)
        return np.asarray(series[index % len(series)], dtype=np.float64)


@cache
def _records() -> Records:
    """Return this package's weather, hour by hour."""
    return read_weather([default_weather()], _SITE, gaps=FILL)


def _bulk_file(query: dict[str, str]) -> bytes:
    year, month = int(query["Year"]), int(query["Month"])
    assert (query["format"], query["timeframe"]) == ("csv", "1")
    real = DATA / f"en_climate_hourly_{month:02}-{year}.csv"
    if real.exists():
        return real.read_bytes()
    head = (DATA / "en_climate_hourly_07-2021.csv").read_bytes().splitlines()[0] + b"\r\n"
    if year < 2000:
        return head
    return head + b"".join(
        f'-79.4,43.63,TORONTO CITY CENTRE,6158359,{year}-{month:02}-{day:02} {hour}:00,'
        f'{year},{month},{day},{hour}:00\r\n'.encode()
        for day in range(1, calendar.monthrange(year, month)[1] + 1) for hour in range(24)
    )
