"""The weather node of a live site, which publishes the weather and the forecast in every tick.

The values come from the site's gauges and from forecasts, which a file or a service provides, if
available. A fetched forecast is used without the disk: its file is only an archive, which is read
once at the start.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DISK, DiskThread
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import from_epoch_ns, to_people
from greenroof_ros.forecast.live import (
    ATTRIBUTION,
    MAX_DAYS,
    Fetcher,
    ForecastFile,
    ForecastFiles,
    LiveForecast,
    NoForecastError,
    Service,
)
from greenroof_ros.forecast.steps import Outlook
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.live_input import LiveInput, live_parameters
from greenroof_ros.live.node import LiveNode, live_command
from greenroof_ros.live.pumping.input_rules import AWAITED
from greenroof_ros.nodes.weather import WeatherNode
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.parameters import declare, look_ahead_parameters, site_file
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site

# Interval at which forecasts are fetched (s).
_FETCH_S = 1800.0
_GAUGES = ("/gauge/precipitation", "/gauge/temperature")


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(),
        *look_ahead_parameters(),
        Parameter(
            "forecast", "", meaning="forecast file (FILE.csv), read again whenever it is replaced",
        ),
        Parameter(
            "fetch", False, meaning="whether forecasts are fetched from Open-Meteo, and kept in "
                "the file that forecast names",
        ),
        Parameter("fetch_url", "", meaning="address of another server like Open-Meteo's"),
        Parameter(
            "issue_limit", 7200.0, "s", 1.0, 1e6,
                "maximum age of the latest forecast since its time of issue",
        ),
        Parameter(
            "unknown_frost_may_pump", False, meaning="whether an unknown temperature counts as "
                "frost-free, instead of keeping the pumps off",
        ),
        *live_parameters(_GAUGES),
    ]


class LiveWeatherNode(WeatherNode, LiveNode):
    """Weather node of a live site, with gauges, and forecasts from a file or a service."""

    def __init__(self) -> None:
        """Declare the parameters and open the topics.

        Raises:
            ConfigurationError: if a parameter is invalid.
        """
        super().__init__("weather", "weather")
        self._site = site = self.declare_site()
        values = declare(self, parameters(site))
        may_run = values["unknown_frost_may_pump"] or not site.stops_in_frost
        self._unknown_frost = 0.0 if may_run else math.nan
        # A file with many members, or on a slow disk, takes seconds to read.
        self._reader = DiskThread()
        self._file = ForecastFile(file := Path(values["forecast"])) if values["forecast"] else None
        self._fetcher: Fetcher | None = None
        ends = look_ahead_ends(site, values["horizon"], values["outlet_horizon"])
        self._forecast = LiveForecast(site, ends, values["issue_limit"], values["all_members"])
        if self._file is not None:
            self._reader.do(self._file.update)
            if values["fetch"]:
                self._fetch(values, file)
        self._rain_gauge, self._thermometer = (
            self.subscribe(name, optional=True) for name in _GAUGES
        )
        self.open_weather(ends)

    def _fetch(self, values: dict[str, Any], file: Path) -> None:
        """Start fetching forecasts on a separate thread."""
        hours = max(values["horizon"], values["outlet_horizon"])
        days = math.ceil(hours / 24) + 2  # from midnight UTC; used until issue_limit
        service = Service(
            self._site, ensemble=values["all_members"], days=min(days, MAX_DAYS),
            url=values["fetch_url"],
        )
        files = ForecastFiles(file, file.with_suffix(""))
        self._fetcher = Fetcher(
            service, lambda issue: DISK.do(partial(files.write, issue)), _FETCH_S
        )
        self._fetcher.start()

    def on_inputs(self) -> None:
        """Publish the values known now; subscribers recognize a missing value by its age."""
        now = from_epoch_ns(self.time_ns)
        rain = self._rain_gauge.value if self._rain_gauge.good else None
        outlook = None if self._file is None else self._find_outlook(self._file, now, rain)
        temperature, evapotranspiration = math.nan, _find_monthly_mean(self._site, now)
        if outlook is not None:
            temperature, rain = outlook.temperature, outlook.rain_now
            evapotranspiration = outlook.evapotranspiration_now
        if self._thermometer.good:
            temperature = self._thermometer.value
        frost = self._unknown_frost if math.isnan(temperature) else float(temperature <= 0)
        self.publish_weather(frost, outlook, rain, evapotranspiration)
        if self._site.stops_in_frost:
            self._diagnose_frost(temperature)
        self._diagnose_gauge("rain gauge", self._rain_gauge)
        self._diagnose_gauge("thermometer", self._thermometer)
        if self._fetcher is not None:
            unfetched = Diagnosis.if_any("forecast_not_fetched", self._fetcher.problem)
            self.reports.diagnose("forecast service", unfetched, ATTRIBUTION, WARN)

    def progress(self) -> dict[str, Any]:
        """Return the source of the forecast, which its licence requires to be shown."""
        return {} if self._fetcher is None else {"forecast_by": ATTRIBUTION}

    def _find_outlook(
        self, file: ForecastFile, now: datetime, rain: float | None
    ) -> Outlook | None:
        """Return the outlook, or None without a forecast; report its time of issue or a problem.

        Args:
            file: the forecast file.
            now: the current time.
            rain: rain from the gauge (m/s); None if unknown.
        """
        problem, self._forecast.issues = "", file.issues
        if self._fetcher is None:
            self._reader.do(file.update)
            problem = file.problem
        elif self._fetcher.newest is not None:
            self._forecast.issues = [self._fetcher.newest]
        try:
            outlook = self._forecast.at(now, rain)
        except NoForecastError as error:
            why = "; ".join(filter(None, [str(error), problem]))
            self.reports.diagnose("forecast", Diagnosis.of("forecast_missing", why=why))
            return None
        assert outlook.issued is not None
        issued = to_people(outlook.issued)
        wrong = Diagnosis.if_any("forecast_short", self._forecast.shortage(now))
        if problem:
            wrong = Diagnosis.of("forecast_unreadable", issued=issued, why=problem)
        self.reports.diagnose(
            "forecast", wrong, f"the latest forecast was issued at {issued}", WARN
        )
        return outlook

    def _diagnose_frost(self, temperature: float) -> None:
        """Report frost, or an unknown temperature (NaN, degC)."""
        gauge, diagnosis, level = self._thermometer, None, WARN
        if temperature <= 0:
            source = "measured" if gauge.good else "forecast"
            diagnosis = Diagnosis.of("freezing", source, temperature=temperature)
        elif math.isnan(temperature):
            lost = gauge.diagnosis if gauge.received else None
            why = "no thermometer reading" if lost is None else lost.sentence
            why += ", and no forecast with a temperature column"
            level, case = (ERROR, "off") if math.isnan(self._unknown_frost) else (WARN, "may_run")
            diagnosis = Diagnosis.of("temperature_unknown", case, why=why)
            if lost is not None and lost.code in AWAITED:  # it will soon be known
                diagnosis = diagnosis.change_code(lost.code)
        self.reports.diagnose("frost", diagnosis, "the temperature is known", level)

    def _diagnose_gauge(self, part: str, gauge: LiveInput) -> None:
        """Report the state of a gauge unless it is awaited; a site may have no gauges."""
        bad = gauge.diagnosis
        if not gauge.received or (bad is not None and bad.code in AWAITED):
            return
        diagnosis = bad and Diagnosis.of(
            "gauge_bad", problem=bad, topic=gauge.publishers.full_name
        )
        cause = bad.code if bad else ""
        self.reports.diagnose(part, diagnosis, f"{gauge.name} is good", WARN, cause)


def _find_monthly_mean(site: Site, now: datetime) -> float | None:
    """Return the mean evapotranspiration of the bed in a month (m3/s), if known."""
    if site.monthly_evapotranspiration is None:
        return None
    reference = site.monthly_evapotranspiration[now.astimezone(site.zone).month - 1]
    return site.crop_coefficient * reference / 1000 / 86400 * site.a2


main = live_command(LiveWeatherNode, __doc__)


if __name__ == "__main__":
    main()
