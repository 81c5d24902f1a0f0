"""The weather node: publishes the present weather, and the forecast over the look-ahead.

In a simulation it answers each ``/clock`` from records. Live it publishes every tick, from the
site's gauges and a file of forecasts, if there is one.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.common.disk import DiskThread
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.times import (
    DEFAULT_START,
    epoch_ns,
    from_epoch_ns,
    read_start,
    to_people,
)
from greenroof_ros.forecast.choice import (
    MODELS,
    NUMBERS,
    OPTIONS,
    ForecastChoice,
    check_skill,
    choose,
)
from greenroof_ros.forecast.live_forecast import (
    ForecastFile,
    LiveForecast,
    NoForecastError,
)
from greenroof_ros.forecast.resampling import Outlook, look_ahead_ends, make_forecast
from greenroof_ros.forecast.service import (
    ATTRIBUTION,
    ENSEMBLE,
    INTERFACES,
    MOST_DAYS,
    Fetcher,
    Service,
)
from greenroof_ros.forecast.skill import SKILLS
from greenroof_ros.formats.records import SERVICE_DELAY_H
from greenroof_ros.graph.executable import node_command, node_help
from greenroof_ros.graph.inputs import Input
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.live import live_parameters
from greenroof_ros.graph.lockstep import CLOCK
from greenroof_ros.graph.messages import LockstepError, WithFront
from greenroof_ros.graph.parameters import LIVE, declare, site_file
from greenroof_ros.graph.reports import ERROR, OK, WARN
from greenroof_ros.model.look_ahead import LONGEST_HORIZON
from greenroof_ros.model.site import Site
from greenroof_ros.weather.reading import default_weather, find_files, read_weather
from greenroof_ros.weather.series import GAPS, REFUSE, WeatherSeries

# How long the start waits for the first forecast (s); most files take less.
_FIRST_READ_S = 1.0
_FROST = "/weather/frost"
_RAIN, _EVAPOTRANSPIRATION = "/weather/precipitation", "/weather/evapotranspiration"
_RAIN_FORECAST, _EVAPOTRANSPIRATION_FORECAST = (
    "/forecast/precipitation", "/forecast/evapotranspiration",
)
_GAUGES = ("/gauge/precipitation", "/gauge/temperature")


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    forecast, delay = ForecastChoice(), NUMBERS["delay"]
    return [
        LIVE,
        site_file(),
        Parameter("weather_files", [str(default_weather())], meaning="hourly records, joined"),
        Parameter("start", DEFAULT_START, meaning="time of tick 0, ISO 8601"),
        Parameter("run_length", site.N, "ticks", 1, 2**40, "N"),
        Parameter(
            "evapotranspiration", "", meaning="fao56, or the name of the file's own column; "
            "empty: the file's own if it has one",
        ),
        Parameter(
            "gaps", REFUSE, meaning="refuse a run with a missing hour, or fill it: rain with "
            "none, everything else with the mean at that time of day over the three days before "
            "and after",
            among=GAPS,
        ),
        Parameter(
            "horizon", 0.0, "", 0.0, LONGEST_HORIZON, "how far the forecasts reach (h), in "
            "growing steps; 0: the next M ticks",
        ),
        Parameter(
            "all_members", False, meaning="publish all members of an ensemble, for a controller "
            "that takes them (lookahead); false: only the first",
        ),
        Parameter(
            "forecast", str(forecast),
            meaning=f"{', '.join(MODELS)}, or a file or directory of archived ones; live: a "
            "FILE.csv, read again whenever it is replaced, or empty for none",
        ),
        Parameter(
            "fetch", "", meaning="live: fetch the FILE.csv of forecast from this interface of "
            "Open-Meteo, and also keep each new one next to it; empty: somebody else writes the "
            "file",
            among=("", *INTERFACES),
        ),
        Parameter(
            "fetch_model", "", meaning="Open-Meteo's name of the weather model; empty: its choice",
        ),
        Parameter("fetch_url", "", meaning="server compatible with Open-Meteo; empty: its own"),
        Parameter(
            "fetch_every", 30.0, "min", 10.0, 1440.0, "time between two fetched forecasts"
        ),
        Parameter(
            "forecast_skill", forecast.skill,
            meaning=f"errors, ensemble: how good they are: {', '.join(SKILLS)}, or a FILE.yaml",
        ),
        NUMBERS["seed"],
        NUMBERS["members"],
        replace(
            delay, low=delay.default, meaning=f"{delay.meaning}; {delay.default:g}: "
            f"{SERVICE_DELAY_H:g} for the first two, and what is usual for a file's kind",
        ),
        Parameter(
            "issue_limit", 7200.0, "s", 1.0, 1e6, "live: how long ago the newest forecast in the "
            "file may have been issued",
        ),
        Parameter(
            "unknown_frost_may_pump", False, meaning="live: true: an unknown temperature counts "
            "as no frost; false: it keeps the pumps off",
        ),
        *live_parameters(_GAUGES),
    ]


def _forecast(values: dict[str, Any]) -> ForecastChoice:
    """Return the choice of forecasts that the parameters make.

    Raises:
        ConfigurationError: a parameter is wrong.
    """
    name = "forecast"
    try:
        choice = choose(values[name])
        if values["live"] and (choice.file is None or choice.file.suffix.lower() != ".csv"):
            raise ValueError("must be a FILE.csv in a live graph, or empty for none")
        name = "forecast_skill"
        check_skill(values[name])
    except ValueError as error:
        raise ConfigurationError(
            str(error), key=f"parameter {name} of weather", value=values[name]
        ) from error
    options = {name: values[f"forecast_{name}"] for name in OPTIONS}
    if options["delay"] == NUMBERS["delay"].default:
        del options["delay"]
    return replace(choice, **options)


class _Records:
    """Weather and forecasts of a simulated run, from records."""

    def __init__(self, site: Site, values: dict[str, Any]) -> None:
        """Read the records and prepare the forecasts.

        Raises:
            ConfigurationError: a parameter or a file is wrong.
        """
        self.run_length = values["run_length"]
        weather = read_weather(
            # rclpy turns an empty list into None.
            find_files(values["weather_files"] or [], "parameter weather_files of weather"),
            site, values["evapotranspiration"] or None, values["gaps"],
        )
        start = read_start(values["start"], weather.first.tzinfo)
        self.series = WeatherSeries(weather, site, start, self.run_length)
        self.forecast = make_forecast(
            weather, self.series, site, start, values["horizon"], _forecast(values),
            values["all_members"],
        )
        self._start_ns = epoch_ns(start)
        self._tick_ns = round(site.tau * 1e9)

    def tick(self, time_ns: int) -> int:
        """Return the tick that begins at a time.

        Raises:
            LockstepError: no tick of the run begins then.
        """
        tick, remainder = divmod(time_ns - self._start_ns, self._tick_ns)
        if remainder or not 0 <= tick <= self.run_length:
            raise LockstepError(
                f"/clock is at tick {tick} of a run of {self.run_length}; plant and weather were "
                "started for different runs"
            )
        return tick


class WeatherNode(LinkedNode):
    """Publishes weather from records or, live, from gauges and a file of forecasts."""

    def __init__(self) -> None:
        """Declare the parameters and open the topics."""
        super().__init__("weather", "weather")
        self._fetcher: Fetcher | None = None
        site = self.declare_site()
        values = declare(self, parameters(site))
        self._site = site
        if self.live:
            self._unknown_frost = 0.0 if values["unknown_frost_may_pump"] else math.nan
            # A file of many members, or on a slow disk, takes seconds to read.
            self._reader, self._files_read = DiskThread(), 0
            self._live_forecast: LiveForecast | None = None
            if values["forecast"] and (file := _forecast(values).file) is not None:
                self._live_forecast = LiveForecast(
                    ForecastFile(file), site, values["horizon"], values["issue_limit"],
                    values["all_members"],
                )
                self._reader.do(self._live_forecast.file.look)
                self._reader.wait(_FIRST_READ_S)
                self._fetcher = self._fetch(values, file) if values["fetch"] else None
            self._gauges: set[str] = set()  # that have been good
            self._rain_gauge, self._thermometer = (
                self.subscribe(name, optional=True) for name in _GAUGES
            )
        else:
            self._records = _Records(site, values)
            self._time = self.subscribe(CLOCK)
        # Prefix of each forecast: the time of its issue, NaN if it has none, and the ends of its
        # steps (s from now).
        self._front = array("d", [math.nan, *look_ahead_ends(site, values["horizon"])[1:]])
        self.open_outputs(
            _FROST, _RAIN, _EVAPOTRANSPIRATION, _RAIN_FORECAST, _EVAPOTRANSPIRATION_FORECAST
        )

    def on_inputs(self) -> None:
        """Publish the weather of the tick, and the forecasts known at that time."""
        if self.live:
            self._publish_live()
            return
        records = self._records
        tick = records.tick(self._time.value)
        hour = records.series.at(tick)
        # The controller's inputs come first, since it takes the longest.
        forecast = records.forecast
        front = self._front_of(forecast.issued(tick))
        self.publish(_FROST, hour.frost)
        self.publish(_RAIN_FORECAST, WithFront(front, forecast.precipitation(tick)))
        self.publish(
            _EVAPOTRANSPIRATION_FORECAST, WithFront(front, forecast.evapotranspiration(tick))
        )
        self.publish(_RAIN, hour.precipitation)
        self.publish(_EVAPOTRANSPIRATION, hour.evapotranspiration)
        self.set_time(self._time.value)

    def _front_of(self, issued: datetime | None) -> array[float]:
        """Return the prefix of a forecast from its issue."""
        self._front[0] = math.nan if issued is None else issued.timestamp()
        return self._front

    def _publish_live(self) -> None:
        """Publish what is known now; readers notice a missing value by its age."""
        now = from_epoch_ns(self.get_clock().now().nanoseconds)
        rain = self._rain_gauge.value if self._rain_gauge.good else None
        if self._fetcher is not None:
            self.say(
                "forecast service", self._fetcher.problem, ATTRIBUTION, "forecast_not_fetched", WARN
            )
        forecast = self._live_forecast
        outlook = None if forecast is None else self._outlook(forecast, now, rain)
        temperature = math.nan if outlook is None else outlook.temperature
        if self._thermometer.good:
            temperature = self._thermometer.value
        instead = "" if forecast is None else (
            ", and no forecast" if outlook is None
            else ", and the forecast has no column of temperature"
        )
        thermometer = self._thermometer
        why = thermometer.problem if thermometer.heard else "no reading of a thermometer"
        self.publish(_FROST, self._frost(temperature, f"{why}{instead}"))
        evapotranspiration: float | None
        if outlook is not None:
            front = self._front_of(outlook.issued)
            self.publish(_RAIN_FORECAST, WithFront(front, outlook.rain))
            self.publish(
                _EVAPOTRANSPIRATION_FORECAST, WithFront(front, outlook.evapotranspiration)
            )
            rain, evapotranspiration = outlook.rain_now, outlook.evapotranspiration_now
        else:
            evapotranspiration = self._site.climatic_evapotranspiration(self._month(now))
        if rain is not None:
            self.publish(_RAIN, rain)
        if evapotranspiration is not None:
            self.publish(_EVAPOTRANSPIRATION, evapotranspiration)
        instead = "unknown" if forecast is None else "forecast"
        self._say_gauge("rain gauge", self._rain_gauge, f"the present rain is {instead}")
        self._say_gauge(
            "thermometer", self._thermometer, f"the present temperature is {instead}"
        )

    def _fetch(self, values: dict[str, Any], file: Path) -> Fetcher:
        """Begin to fetch forecasts on a separate thread."""
        days = math.ceil(values["horizon"] / 24) + 2  # from midnight UTC; used until issue_limit
        service = Service(
            self._site, ensemble=values["fetch"] == ENSEMBLE, model=values["fetch_model"],
            days=min(days, MOST_DAYS), url=values["fetch_url"],
        )
        fetcher = Fetcher(service, file, file.with_suffix(""), 60 * values["fetch_every"])
        fetcher.start()
        return fetcher

    def _month(self, now: datetime) -> int:
        """Return the month at the site, for its usual evapotranspiration."""
        return now.astimezone(timezone(timedelta(hours=self._site.utc_offset or 0.0))).month

    def progress(self) -> dict[str, Any]:
        """Return the source of the forecast, which its licence requires to be shown."""
        return {} if self._fetcher is None else {"forecast_by": ATTRIBUTION}

    def on_stop(self) -> None:
        """End the fetching."""
        if self._fetcher is not None:
            self._fetcher.end()

    def _outlook(
        self, forecast: LiveForecast, now: datetime, rain: float | None
    ) -> Outlook | None:
        """Return the outlook, None without a forecast, and report its issue or problem.

        Args:
            forecast: reads the file of forecasts.
            now: the time.
            rain: from the gauge (m/s); None if unknown.
        """
        self._reader.do(forecast.file.look)
        if forecast.file.count != self._files_read:
            self._files_read = forecast.file.count
            self.get_logger().info("the file of forecasts was read")
        problem = forecast.file.problem
        unreadable = "forecast_unreadable" if problem else ""
        try:
            outlook, short = forecast.at(now, rain), forecast.shortage(now)
        except NoForecastError as error:
            reading = "the file is still being read" if self._reader.late else ""
            why = "; ".join(filter(None, [str(error), problem, reading]))
            self.reports.numbers.pop("forecast", None)
            code = "forecast_missing" if self._fetcher is None else "forecast_service_silent"
            self.diagnose("forecast", ERROR, why, code, unreadable)
            return None
        assert outlook.issued is not None  # a file's forecasts have issues
        age = (now - outlook.issued).total_seconds()
        self.reports.numbers["forecast"] = {"issued_ago_s": age}
        issued = f"the newest forecast was issued at {to_people(outlook.issued)}"
        trouble = problem and f"{issued}; the previously read forecast stays in use: {problem}"
        self.say("forecast", trouble or short, issued, unreadable or "forecast_short", WARN)
        return outlook

    def _frost(self, temperature: float, why: str) -> float:
        """Return 1 in frost, else 0; if unknown, report that and return NaN, or 0 if allowed.

        Args:
            temperature: degC; NaN if unknown.
            why: it would be unknown.
        """
        if not math.isnan(temperature):
            self.diagnose("frost", OK, "the temperature is known")
            return float(temperature <= 0)
        level, pumps = WARN, "may run anyway"
        if math.isnan(self._unknown_frost):
            level, pumps = ERROR, "are kept off"
        self.diagnose(
            "frost", level, f"the temperature is unknown, so there may be frost ({why}): the pumps "
            f"{pumps} (unknown_frost_may_pump)", self._no_temperature(),
        )
        return self._unknown_frost

    def _no_temperature(self) -> str:
        """Return the code for an unknown temperature, by what the site has."""
        thermometer = self._thermometer
        if thermometer.heard and thermometer.verdict.code == "input_recovering":
            return "input_recovering"
        if thermometer.heard or thermometer.publishers.count:
            return "thermometer_lost"
        return "temperature_unknown" if self._fetcher is None else "temperature_not_fetched"

    def _say_gauge(self, part: str, gauge: Input, instead: str) -> None:
        """Report the state of a gauge, if it was ever heard; a site may do without."""
        if gauge.good:
            self._gauges.add(part)
        if not gauge.heard:
            return
        bad, well = "", f"{gauge.name} is good"
        if part not in self._gauges and not gauge.publishers.count:
            well = f"nobody publishes {gauge.name}"
        elif part not in self._gauges and gauge.verdict.code == "input_recovering":
            well = gauge.problem  # it has just come for the first time
        elif not gauge.good:
            bad = f"{gauge.problem}; {instead}"
        self.say(part, bad, well, "gauge_bad", WARN, gauge.verdict.code)


main = node_command(WeatherNode, partial(
    node_help, "weather", "weather", __doc__, parameters, "--ros-args -p forecast:=persistence",
))


if __name__ == "__main__":
    main()
