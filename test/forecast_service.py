"""A simulated forecast service: Open-Meteo's two interfaces, with records moved to the present.

It forecasts the records themselves, which start again when they end. That is perfect for a site
simulator with the same records. The other members of an ensemble are made up: their rain is scaled.
If the records lack radiation, it is made up too: 0.6 of the solar constant times the sine of the
sun's height.
"""

from __future__ import annotations

import json
import math
from datetime import datetime, timezone
from http.server import BaseHTTPRequestHandler
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from http_service import HttpService
from numpy.typing import NDArray
from places import CONFIG

from greenroof_ros.base.times import hours_since_1970
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.evapotranspiration import sun_height
from greenroof_ros.weather.open_meteo import VARIABLES
from greenroof_ros.weather.quantities import PRECIPITATION, RADIATION
from greenroof_ros.weather.read import default_weather, read_weather
from greenroof_ros.weather.records import HOUR, Records
from greenroof_ros.weather.series import FILL

NONE = "none"
# The service's default units, and how many of them make one of ours.
UNITS = {
    "precipitation": ("mm", 1), "temperature": ("°C", 1), "dew point": ("°C", 1),
    "wind speed": ("km/h", 1), "station pressure": ("hPa", 10), "solar radiation": ("W/m²", 1),
}
_MEMBERS = 11
_SUN_W_PER_M2 = 0.6 * 1367


class ForecastService(HttpService):
    """Answers as the real service does.

    Attributes:
        fault: what is wrong now, and can be changed at any time: connections are "refused";
            answers are "slow" (a few bytes per second) or have a "slow head", are cut in "half",
            "broken" (no JSON), a "limit" (429 Too Many Requests) or an "error" (503); a series has
            the wrong "length"; every value is "missing". Without a fault it is "none".
    """

    def __init__(self, site: Site, records: Records, start: datetime) -> None:
        """Open the port, and answer requests until :meth:`close`.

        Args:
            site: its location.
            records: hourly, in the quantities of Open-Meteo's files.
            start: time in the records that is treated as now.
        """
        self.fault = NONE
        self._site, self._records = site, records
        self._offset = start - datetime.now(timezone.utc)
        super().__init__()

    def respond(self, request: BaseHTTPRequestHandler) -> None:
        """Answer a request for a forecast."""
        place = urlsplit(request.path)
        fault = self.fault
        if fault == "refused":
            request.close_connection = True
        elif fault == "limit":
            reason = b'{"error":true,"reason":"Minutely API request limit exceeded."}'
            self.send(request, 429, reason, {"Retry-After": "120"})
        elif fault == "error":
            self.send(request, 503, b"upstream is down")
        elif fault == "broken":
            self.send(request, 200, b"<html>please log in to the hotel's network</html>")
        else:
            members = _MEMBERS if place.path.endswith("ensemble") else 1
            self.send(request, 200, self.answer(parse_qs(place.query), members), fault=fault)

    def answer(self, query: dict[str, list[str]], members: int) -> bytes:
        """Return the answer to a query, as JSON."""
        days = int(query.get("forecast_days", ["7"])[0])
        first = datetime.now(timezone.utc).replace(hour=0, minute=0, second=0, microsecond=0)
        begins = [first + hour * HOUR for hour in range(24 * days)]
        hourly: dict[str, Any] = {"time": [f"{time:%Y-%m-%dT%H:%M}" for time in begins]}
        units = {"time": "iso8601"}
        variables = query.get("hourly", [""])[0].split(",")
        for quantity, variable in VARIABLES.items():
            if variable not in variables:
                continue
            # The time of rain and radiation is the end of their hour.
            before = int(quantity in (PRECIPITATION, RADIATION))
            for member in range(members if quantity == PRECIPITATION else 1):
                name = variable + (f"_member{member:02}" if member else "")
                series = self._series(quantity, first - before * HOUR, len(begins))
                if member:
                    series = series * (member + 0.5) / 5
                hourly[name] = [
                    None if math.isnan(value) or self.fault == "missing" else round(value, 2)
                    for value in series.tolist()
                ]
                units[name] = UNITS[quantity][0]
        if self.fault == "length":
            hourly[VARIABLES["temperature"]].pop()
        site = self._site
        return json.dumps({
            "latitude": site.latitude, "longitude": site.longitude, "elevation": site.elevation,
            "generationtime_ms": 0.1, "utc_offset_seconds": 0, "timezone": "GMT",
            "timezone_abbreviation": "GMT", "hourly_units": units, "hourly": hourly,
        }).encode()

    def _series(self, quantity: str, first: datetime, hours: int) -> NDArray[np.float64]:
        """Return values of the records, moved to the present, in the service's unit."""
        start = round((first + self._offset - self._records.first) / HOUR)
        if quantity in self._records.values:
            series = self._records.values[quantity] * UNITS[quantity][1]
            index = np.arange(start, start + hours) % len(series)
            return np.asarray(series[index], dtype=np.float64)
        assert quantity == RADIATION
        seconds = 3600 * (hours_since_1970(first) + np.arange(hours)) + 1800
        height = sun_height(
            float(self._site.latitude or 0), seconds, float(self._site.longitude or 0)
        )
        return _SUN_W_PER_M2 * height


def started_service(fault: str = NONE) -> ForecastService:
    """Serve the paper's weather, with its first hour as the present one."""
    site = read_site(CONFIG / "site.yaml")
    records = read_weather([default_weather()], site, gaps=FILL)
    service = ForecastService(site, records, records.first)
    service.fault = fault
    return service
