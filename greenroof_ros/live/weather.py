"""The weather node of a live site, which publishes the weather and the forecast in every tick.

The values come from the site's gauges and from forecasts, which a file or a service provides, if
available. A fetched forecast is used without the disk: its file is only an archive, which is read
once at the start.
"""

from __future__ import annotations

from greenroof_ros.live.latest_writer import LatestWriter
from greenroof_ros.ros import begin_node

begin_node(__name__)

import math
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DiskThread
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import from_epoch_ns, to_people
from greenroof_ros.forecast.issue import IssuedForecast
from greenroof_ros.forecast.live import (
    ForecastFile,
    LiveForecast,
    NoForecastError,
)
from greenroof_ros.forecast.service import (
    ATTRIBUTION,
    ENSEMBLE,
    INTERFACES,
    MAX_DAYS,
    Fetcher,
    ForecastFiles,
    Service,
)
from greenroof_ros.forecast.steps import Outlook
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.levels import live_parameters
from greenroof_ros.live.live_diagnostics import ERROR, WARN
from greenroof_ros.live.live_input import LiveInput
from greenroof_ros.live.node import LiveNode, live_command
from greenroof_ros.nodes.weather import WeatherNode
from greenroof_ros.ros.parameters import declare, look_ahead_parameters, site_file
from greenroof_ros.site.site import Site

# How long the start waits for the first forecast (s), which is more than most files take.
_FIRST_READ_S = 1.0
_GAUGES = ("/gauge/precipitation", "/gauge/temperature")


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(),
        *look_ahead_parameters(),
        Parameter(
            "forecast", "", meaning="forecast file (FILE.csv), which is read again whenever it is "
                "replaced; empty for no forecast",
        ),
        Parameter(
            "fetch", "", meaning="Open-Meteo API from which forecasts are fetched; they "
                "are stored in the file that the parameter forecast names, and next to it. If "
                "empty, another program writes that file",
            among=("", *INTERFACES),
        ),
        Parameter(
            "fetch_model", "", meaning="Open-Meteo's name for the weather model; if empty, "
                "Open-Meteo chooses the model",
        ),
        Parameter("fetch_url", "", meaning="address of an Open-Meteo-compatible server; if empty, "
            "Open-Meteo's own server is used"),
        Parameter(
            "fetch_every", 30.0, "min", 10.0, 1440.0, "interval at which forecasts are fetched"
        ),
        Parameter(
            "issue_limit", 7200.0, "s", 1.0, 1e6,
                "maximum age of the latest forecast in the file, counted from its time of issue",
        ),
        Parameter(
            "unknown_frost_may_pump", False, meaning="whether an unknown temperature is treated as "
                "frost-free; if false, an unknown temperature keeps the pumps off",
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
        self._unknown_frost = 0.0 if values["unknown_frost_may_pump"] else math.nan
        # A file with many members, or on a slow disk, takes seconds to read.
        self._reader = DiskThread()
        self._forecast: LiveForecast | None = None
        self._fetcher: Fetcher | None = None
        self._unkept = ""  # why the last fetched forecast is not kept
        if values["forecast"]:
            self._file = ForecastFile(file := Path(values["forecast"]))
            if file.suffix.lower() != ".csv":
                raise ConfigurationError(
                    "must be a FILE.csv, or empty for none", key="parameter forecast of weather",
                    value=values["forecast"],
                )
            self._forecast = LiveForecast(
                site, values["horizon"], values["issue_limit"], values["all_members"]
            )
            self._reader.do(self._file.update)
            self._reader.wait(_FIRST_READ_S)
            self._fetcher = self._fetch(values, file) if values["fetch"] else None
        self._gauges: set[str] = set()  # those that have been good
        self._rain_gauge, self._thermometer = (
            self.subscribe(name, optional=True) for name in _GAUGES
        )
        self.open_weather(site, values["horizon"])

    def on_inputs(self) -> None:
        """Publish the values known now; subscribers recognize a missing value by its age."""
        now = from_epoch_ns(self.time_ns)
        rain = self._rain_gauge.value if self._rain_gauge.good else None
        forecast, outlook, instead = self._forecast, None, "unknown"
        why = "no thermometer reading"
        if self._thermometer.received and self._thermometer.diagnosis is not None:
            why = self._thermometer.diagnosis.sentence
        if forecast is not None:
            outlook, instead = self._outlook(forecast, now, rain), "forecast"
            lacks = "no forecast" if outlook is None else "the forecast has no temperature column"
            why += f", and {lacks}"
        temperature, evapotranspiration = math.nan, _find_monthly_mean(self._site, now)
        if outlook is not None:
            temperature, rain = outlook.temperature, outlook.rain_now
            evapotranspiration = outlook.evapotranspiration_now
        if self._thermometer.good:
            temperature = self._thermometer.value
        source = "measured" if self._thermometer.good else "forecast"
        frost = self._frost(temperature, source, why)
        self.publish_weather(frost, outlook, rain, evapotranspiration)
        self._diagnose_gauge("rain gauge", self._rain_gauge, f"the current rain rate is {instead}")
        self._diagnose_gauge(
            "thermometer", self._thermometer, f"the current temperature is {instead}"
        )
        self._diagnose_service()

    def _fetch(self, values: dict[str, Any], file: Path) -> Fetcher:
        """Start fetching forecasts on a separate thread."""
        days = math.ceil(values["horizon"] / 24) + 2  # from midnight UTC; used until issue_limit
        service = Service(
            self._site, ensemble=values["fetch"] == ENSEMBLE, model=values["fetch_model"],
            days=min(days, MAX_DAYS), url=values["fetch_url"],
        )
        files = ForecastFiles(file, file.with_suffix(""))
        self._kept = LatestWriter[IssuedForecast](files.write, str)
        fetcher = Fetcher(service, self._kept.write, 60 * values["fetch_every"])
        fetcher.start()
        return fetcher

    def _diagnose_service(self) -> None:
        if self._fetcher is None:
            return
        unfetched = Diagnosis.if_any("forecast_not_fetched", self._fetcher.problem)
        self.reports.diagnose("forecast service", unfetched, ATTRIBUTION, WARN)
        before, self._unkept = self._unkept, self._kept.problem
        if self._unkept not in ("", before):
            self.get_logger().warning(
                f"the forecast is used, but has not been saved: {self._unkept}")

    def progress(self) -> dict[str, Any]:
        """Return the source of the forecast, which its licence requires to be shown."""
        return {} if self._fetcher is None else {"forecast_by": ATTRIBUTION}

    def _outlook(
        self, forecast: LiveForecast, now: datetime, rain: float | None
    ) -> Outlook | None:
        """Return the outlook, or None without a forecast; report its time of issue or a problem.

        Args:
            forecast: forecast for the look-ahead.
            now: the current time.
            rain: rain from the gauge (m/s); None if unknown.
        """
        problem, forecast.issues = "", self._file.issues
        if self._fetcher is None:
            self._reader.do(self._file.update)
            problem = self._file.problem
        elif self._fetcher.newest is not None:
            forecast.issues = [self._fetcher.newest]
        unreadable = "forecast_unreadable" if problem else ""
        try:
            outlook, short = forecast.at(now, rain), forecast.shortage(now)
        except NoForecastError as error:
            reading = "the file is still being read" if self._reader.late else ""
            why = "; ".join(filter(None, [str(error), problem, reading]))
            code = "forecast_missing" if self._fetcher is None else "forecast_service_silent"
            self.reports.diagnose("forecast", Diagnosis.of(code, why=why), cause=unreadable)
            return None
        assert outlook.issued is not None
        issued, wrong = to_people(outlook.issued), Diagnosis.if_any("forecast_short", short)
        if problem:
            wrong = Diagnosis.of("forecast_unreadable", issued=issued, why=problem)
        self.reports.diagnose(
            "forecast", wrong, f"the latest forecast was issued at {issued}", WARN
        )
        return outlook

    def _frost(self, temperature: float, source: str, why: str) -> float:
        """Return 1 in frost, otherwise 0.

        If the temperature is unknown, report this and return NaN, or 0 if that is allowed.

        Args:
            temperature: air temperature (degC); NaN if unknown.
            source: ``measured`` or ``forecast``.
            why: reason why the temperature is unknown, if it is.
        """
        if not math.isnan(temperature):
            freezing = Diagnosis.of("freezing", source, temperature=temperature)
            self.reports.diagnose(
                "frost", freezing if temperature <= 0 else None, "the temperature is known", WARN
            )
            return float(temperature <= 0)
        level, case = (ERROR, "off") if math.isnan(self._unknown_frost) else (WARN, "may_run")
        diagnosis = Diagnosis.of("temperature_unknown", case, why=why)
        self.reports.diagnose("frost", diagnosis.change_code(self._temperature_code()), level=level)
        return self._unknown_frost

    def _temperature_code(self) -> str:
        """Return the code for an unknown temperature, which depends on the site's equipment."""
        thermometer = self._thermometer
        diagnosis = thermometer.diagnosis
        if thermometer.received and diagnosis is not None and diagnosis.code == "input_recovering":
            return diagnosis.code
        if thermometer.received or thermometer.publishers.count:
            return "thermometer_lost"
        return "temperature_unknown" if self._fetcher is None else "temperature_not_fetched"

    def _diagnose_gauge(self, part: str, gauge: LiveInput, instead: str) -> None:
        """Report the state of a gauge if it has ever sent a reading; a site may have no gauges."""
        if gauge.good:
            self._gauges.add(part)
        if not gauge.received:
            return
        bad, well, diagnosis = None, f"{gauge.name} is good", gauge.diagnosis
        if part not in self._gauges and not gauge.publishers.count:
            well = f"no node publishes {gauge.name}"
        elif diagnosis is not None and diagnosis.code == "input_recovering" and (
            part not in self._gauges  # it has just been received for the first time
        ):
            well = diagnosis.sentence
        elif diagnosis is not None:
            bad = Diagnosis.of(
                "gauge_bad", problem=diagnosis, instead=instead, topic=gauge.publishers.full_name
            )
        self.reports.diagnose(part, bad, well, WARN, diagnosis.code if diagnosis else "")


def _find_monthly_mean(site: Site, now: datetime) -> float | None:
    """Return the mean evapotranspiration of the bed in a month (m3/s), if known."""
    if site.monthly_evapotranspiration is None:
        return None
    at_site = now.astimezone(timezone(timedelta(hours=site.utc_offset or 0.0)))
    reference = site.monthly_evapotranspiration[at_site.month - 1]
    return site.crop_coefficient * reference / 1000 / 86400 * site.a2


main = live_command(LiveWeatherNode, __doc__)


if __name__ == "__main__":
    main()
