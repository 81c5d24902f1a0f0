"""Cases of a failing forecast service: six hours of one failure, as a live site meets it.

Requests and answers are real, but the time between requests is skipped. For every ten minutes the
file of forecasts is read, and controller and pump control use it, in this process.
"""

from __future__ import annotations

import math
import time
from datetime import datetime, timedelta, timezone
from pathlib import Path

from faults.cases import Case
from faults.live import Outcome
from forecast_service import NONE, ForecastService
from places import CONFIG
from pump_rig import settings_for

from greenroof_ros.controllers.decide import decide
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.forecast.live_forecast import LiveForecast, NoForecastError
from greenroof_ros.forecast.service import Fetcher, ForecastFiles, Service
from greenroof_ros.live.pumping.ledger import Ledger
from greenroof_ros.live.pumping.pump_control import PumpControl
from greenroof_ros.live.pumping.pump_inputs import Observation
from greenroof_ros.model.site import Site, read_site
from greenroof_ros.weather.reading import default_weather, read_weather
from greenroof_ros.weather.series import FILL

_HOURS = 6
_EVERY_S = 1800.0
# Limit of the weather node for the age of a forecast (s).
_ISSUE_LIMIT_S = 7200.0
# With waits from a minute to half an hour, a failing service gets 5 requests in the first half
# hour, and then two an hour: far below the 600 a minute that it allows.
_MOST_REQUESTS = 18
_START = datetime.fromisoformat("2021-07-07T02:00-05:00")


def run_case(case: Case, directory: Path, outcome: Outcome) -> None:
    """Let a service fail for six hours, and check what the site knows and does meanwhile."""
    directory.mkdir(parents=True, exist_ok=True)
    site = read_site(CONFIG / "site.yaml")
    server = ForecastService(
        site, read_weather([default_weather()], site, gaps=FILL), _START, 0
    )
    server.start()
    try:
        file = directory / "forecast.csv"
        service = Service(site, url=f"{server.address}/v1/forecast")
        fetcher = Fetcher(service, ForecastFiles(file, None).write, _EVERY_S)
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
            outcome.fail(f"asked again after {min(waits):g} s, where Retry-After reports 120 s")
        # If a connection breaks, the HTTP library repeats the request once automatically.
        if len(waits) > _MOST_REQUESTS or server.requests - 1 > 2 * len(waits):
            outcome.fail(f"the service was asked {server.requests - 1} times in {_HOURS} h")
        forecast = LiveForecast(site, 120.0, _ISSUE_LIMIT_S, False)
        forecast.issues = [fetcher.newest] if fetcher.newest else []
        known = _at_rest_from(site, forecast, began, thermometer=False)
        if not 3600 <= known <= _ISSUE_LIMIT_S:
            outcome.fail(f"without a thermometer the pump stood from {known:g} s on")
        if (rest_from := _at_rest_from(site, forecast, began, thermometer=True)) < math.inf:
            outcome.fail(f"with a thermometer the pump stood from {rest_from:g} s on")
        server.fault = NONE
        if fetcher.fetch() != _EVERY_S or fetcher.problem:
            outcome.fail(f"after the fault: {fetcher.problem}")
        outcome.recovery = "ran on; without a thermometer until the forecast was too old"
    finally:
        server.close()


def _requests(fetcher: Fetcher, outcome: Outcome) -> list[float]:
    """Fetch for six hours, and return the waits; each attempt must report why it failed."""
    waits: list[float] = []
    while sum(waits) < 3600 * _HOURS:
        waits.append(fetcher.fetch())
        outcome.reason = outcome.reason or fetcher.problem
        if not fetcher.problem:
            outcome.fail("a bad answer was used")
    return waits


def _at_rest_from(
    site: Site, forecast: LiveForecast, began: datetime, *, thermometer: bool
) -> float:
    """Return the time (s) from which a pump that should run stands; infinite if it never does.

    Every ten minutes a new pump control runs for a quarter of a minute, so its own limits do not
    count. While there is a forecast the pump is commanded to run, then `lookahead` decides, with a
    dry roof. Without a thermometer the temperature comes from the forecast.
    """
    choice = find_controller("lookahead")
    values = {setting.name: setting.default for setting in choice.parameters_on(site)}
    for minutes in range(0, 60 * _HOURS, 10):
        try:
            outlook = forecast.at(began + timedelta(minutes=minutes))
            command, frost = 1.0, outlook.temperature <= 0
        except NoForecastError:
            command = decide(choice.make(site, values), True, 1.5, 0.01, (), ())
            frost = False if thermometer else None
        control = PumpControl(site, settings_for(site), Ledger(None, time.time), 15.0)
        seen = Observation(
            command=command, cistern_level=1.5, roof_level=0.01, frost=frost, speed=0.0,
            drive_ready=True,
        )
        for _ in range(15):
            decision = control.step(1.0, seen, 0.0)
        if decision.speed is None:
            assert list(decision.interlocks) == ["frost_unknown"], decision.why
            return 60.0 * minutes
    return math.inf
