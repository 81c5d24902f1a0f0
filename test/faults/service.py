"""The case at a forecast service: six hours of one of its failures, as a live site meets it.

Requests and answers are real; the time between two requests is not waited for. What the file of
forecasts is worth is asked of it in each ten minutes.
"""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
from cases import Case
from live import Outcome
from places import CONFIG

from greenroof_ros.controllers.decide import decide
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.forecast.live_forecast import ForecastFile, LiveForecast, NoForecastError
from greenroof_ros.forecast.service import Fetcher, Service, ServiceRequest
from greenroof_ros.model.site import read_site
from greenroof_ros.simulators.forecast_service import NONE, ForecastService
from greenroof_ros.weather.reading import default_weather, read_weather
from greenroof_ros.weather.series import FILL

_HOURS = 6
_EVERY_S = 1800.0
# The weather node's: so old a forecast may be (s).
_ISSUE_LIMIT_S = 7200.0
# Backing off from a minute to half an hour, a failing service is asked 5 times in the first half
# hour, and then twice an hour: far below the 600 a minute that it allows.
_MOST_REQUESTS = 18
_START = datetime.fromisoformat("2021-07-07T02:00-05:00")


def run_case(case: Case, directory: Path, outcome: Outcome) -> None:
    """Have a service fail for six hours, and look at what the site knows and does meanwhile."""
    directory.mkdir(parents=True, exist_ok=True)
    site = read_site(CONFIG / "site.yaml")
    server = ForecastService(
        site, read_weather([default_weather()], site, gaps=FILL), _START, 0
    )
    server.start()
    try:
        file = directory / "forecast.csv"
        service = Service(site, ServiceRequest(url=f"{server.address}/v1/forecast"))
        fetcher = Fetcher(service, file, None, _EVERY_S)
        fetcher.fetch()
        if fetcher.problem:
            outcome.fail(f"the service without a fault: {fetcher.problem}")
            return
        good, began = file.read_bytes(), datetime.now(timezone.utc)
        server.fault = case.target
        waits = _requests(fetcher, outcome)
        if file.read_bytes() != good:
            outcome.fail("a bad answer changed the file of forecasts")
        if case.target == "limit" and min(waits) < 120:
            outcome.fail(f"asked again after {min(waits):g} s, where Retry-After says 120 s")
        # Where a connection breaks, the HTTP library asks once more by itself.
        if len(waits) > _MOST_REQUESTS or server.asked - 1 > 2 * len(waits):
            outcome.fail(f"the service was asked {server.asked - 1} times in {_HOURS} h")
        known = _known(LiveForecast(ForecastFile(file), site, 120.0, _ISSUE_LIMIT_S, False), began)
        if not 3600 <= known <= _ISSUE_LIMIT_S:
            outcome.fail(f"the last forecast was used for {known:g} s")
        # Without a forecast, on a dry roof and with water in the cistern.
        choice = find_controller("lookahead")
        values = {one.name: one.default for one in choice.parameters_on(site)}
        command = decide(choice.make(site, values), True, 1.5, 0.01, (), ())
        if not command > 0:
            outcome.fail("a dry roof is not watered without a forecast")
        server.fault = NONE
        if fetcher.fetch() != _EVERY_S or fetcher.problem:
            outcome.fail(f"after the fault: {fetcher.problem}")
        outcome.recovery = "ran on; fetched again at the next request"
    finally:
        server.close()


def _requests(fetcher: Fetcher, outcome: Outcome) -> list[float]:
    """Fetch for six hours, and return the waits; each must say why there was nothing."""
    waits: list[float] = []
    while sum(waits) < 3600 * _HOURS:
        waits.append(fetcher.fetch())
        outcome.alarm = outcome.alarm or fetcher.problem
        if not fetcher.problem:
            outcome.fail("a bad answer was used")
    return waits


def _known(forecast: LiveForecast, began: datetime) -> float:
    """Return for how long after some time there is a forecast (s), of finite numbers."""
    forecast.file.look()
    for minutes in range(0, 60 * _HOURS, 10):
        try:
            rain = forecast.at(began + timedelta(minutes=minutes)).rain
        except NoForecastError:
            return 60.0 * minutes
        assert np.isfinite(rain).all()
    return np.inf
