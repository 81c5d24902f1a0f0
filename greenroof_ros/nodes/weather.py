"""The weather node, which answers every ``/clock`` message with recorded weather and forecasts."""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math
from array import array
from dataclasses import replace

from greenroof_ros.base.errors import LockstepError
from greenroof_ros.base.parameter import Parameter, make_record
from greenroof_ros.base.times import DEFAULT_START, epoch_ns, read_start
from greenroof_ros.forecast.choice import INPUTS, MODELS, PERFECT, choose
from greenroof_ros.forecast.steps import Outlook, make_forecast
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.lockstep import CLOCK, LockstepNode
from greenroof_ros.ros.messages import WithFront
from greenroof_ros.ros.parameters import declare, look_ahead_parameters, site_file
from greenroof_ros.ros.spin import node_command
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site
from greenroof_ros.weather.climate import CLIMATE, Climate
from greenroof_ros.weather.read import default_weather, find_files, read_weather
from greenroof_ros.weather.records import Array
from greenroof_ros.weather.series import GAPS, REFUSE, Hour, WeatherSeries

_FROST, _OTHER_DEMAND = "/weather/frost", "/cistern/other_demand"
_RAIN, _EVAPOTRANSPIRATION = "/weather/precipitation", "/weather/evapotranspiration"
_FORECASTS = "/forecast/precipitation", "/forecast/evapotranspiration"
# A parameter of a node must have a value: this one stands for the usual delay (h).
_USUAL_DELAY = -1.0


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(),
        Parameter(
            "weather_files", [str(default_weather())], meaning="weather files, which are joined",
        ),
        Parameter("start", DEFAULT_START, meaning="time of tick 0 (ISO 8601, with UTC offset)"),
        Parameter("run_length", site.N, "ticks", 1, 2**40, "number N of the last tick"),
        Parameter(
            "evapotranspiration", "", meaning="method for evapotranspiration: fao56, hargreaves, "
            "monthly, or a column of the weather file; if empty, its own column or else the first "
            "method for which it has the data",
        ),
        Parameter(
            "gaps", REFUSE, meaning="treatment of a missing hour: fill assumes no rain, and for "
            "other quantities the mean at this time of day over three days before and after",
            among=GAPS,
        ),
        *CLIMATE.values(),
        *look_ahead_parameters(),
        Parameter(
            "forecast", PERFECT,
            meaning=f"forecast model ({', '.join(MODELS)}), or a file or directory of archived "
            "forecasts",
        ),
        *(
            replace(parameter, default=_USUAL_DELAY, low=_USUAL_DELAY,
                    meaning=f"{parameter.meaning}; {_USUAL_DELAY:g} for the usual value")
            if parameter.default is None else parameter
            for parameter in INPUTS.values()
        ),
    ]


class WeatherNode(GraphNode):
    """Node that publishes weather and forecasts; a subclass adds their source and the pace."""

    def open_weather(self, ends: Array) -> None:
        """Open the topics.

        Args:
            ends: boundaries of the forecasts' steps (s from now), starting at 0.
        """
        # Prefix of every forecast: the time of its issue (s since 1970), and the ends of its steps
        # (s from now).
        self._front = array("d", [math.nan, *ends[1:]])
        self.open_outputs(_FROST, _RAIN, _EVAPOTRANSPIRATION, *_FORECASTS)

    def publish_weather(
        self, frost: float, outlook: Outlook | None, rain: float | None,
        evapotranspiration: float | None,
    ) -> None:
        """Publish what is known; the controller's inputs come first, since it takes the longest.

        Args:
            frost: 1 in frost, otherwise 0; NaN if unknown.
            outlook: the forecasts; None if there are none.
            rain: current rain (m/s); None if unknown.
            evapotranspiration: current evapotranspiration of the bed (m3/s); None if unknown.
        """
        self.publish(_FROST, frost)
        if outlook is not None:
            self._front[0] = math.nan if outlook.issued is None else outlook.issued.timestamp()
            forecasts = outlook.rain, outlook.evapotranspiration
            for topic, forecast in zip(_FORECASTS, forecasts, strict=True):
                self.publish(topic, WithFront(self._front, forecast))
        if rain is not None:
            self.publish(_RAIN, rain)
        if evapotranspiration is not None:
            self.publish(_EVAPOTRANSPIRATION, evapotranspiration)


class RecordedWeather(WeatherNode, LockstepNode):
    """Weather node of a simulated graph, with recorded weather."""

    def __init__(self) -> None:
        """Declare the parameters, read the records and open the topics.

        Raises:
            ConfigurationError: if a parameter or a weather file is invalid.
        """
        super().__init__("weather", "weather")
        site = self.declare_site()
        values = declare(self, parameters(site))
        self._last_tick = values["run_length"]
        weather = read_weather(
            # rclpy turns an empty list into None.
            find_files(values["weather_files"] or [], "parameter weather_files of weather"),
            site, values["evapotranspiration"] or None, values["gaps"],
            make_record(Climate, {name: values[name] for name in CLIMATE}),
        )
        zone = weather.first.tzinfo if site.time_zone is None else site.zone
        start = read_start(values["start"], zone)
        self._series = WeatherSeries(weather, site, start, self._last_tick)
        forecast = choose(values["forecast"], {
            name.removeprefix("forecast_"): values[name] for name, parameter in INPUTS.items()
            if values[name] not in (parameter.default, _USUAL_DELAY)
        })
        self._forecast = make_forecast(
            weather, self._series, site, start, values["horizon"], forecast,
            values["all_members"], values["outlet_horizon"],
        )
        self._start_ns, self._tick_ns = epoch_ns(start), round(site.tau * 1e9)
        self._hour: Hour | None = None
        self.subscribe(CLOCK)
        self._has_other_demand = site.monthly_other_demand is not None
        if self._has_other_demand:
            self.open_outputs(_OTHER_DEMAND)
        self.open_weather(look_ahead_ends(site, values["horizon"], values["outlet_horizon"]))

    def on_inputs(self) -> None:
        """Publish the weather of the tick, and the forecasts known at the time of the tick.

        Raises:
            LockstepError: if no tick of the run begins now.
        """
        tick, remainder = divmod(self.time_ns - self._start_ns, self._tick_ns)
        if remainder or not 0 <= tick <= self._last_tick:
            raise LockstepError(
                f"/clock is at tick {tick}, but this run has ticks 0 to {self._last_tick}: the "
                "plant node and the weather node were started for different runs"
            )
        hour = self._hour
        if hour is None or tick >= hour.until:
            hour = self._hour = self._series.at(tick)
        if self._has_other_demand:
            self.publish(_OTHER_DEMAND, hour.other_demand)
        self.publish_weather(
            hour.frost, self._forecast.at(tick), hour.precipitation, hour.evapotranspiration
        )


main = node_command(RecordedWeather, __doc__)


if __name__ == "__main__":
    main()
