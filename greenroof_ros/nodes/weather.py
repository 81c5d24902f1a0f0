"""The weather node: on each ``/clock`` the weather now, and the forecast of the look-ahead."""

from __future__ import annotations

import sys
from dataclasses import replace

from rclpy.node import Node

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import DEFAULT_START, epoch_ns, read_start
from greenroof_ros.controllers.protocol import HORIZON
from greenroof_ros.forecast.choice import MODELS, OPTIONS, ForecastChoice, choose
from greenroof_ros.forecast.resampling import make_forecast
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.lockstep import CLOCK, LockstepNode
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site
from greenroof_ros.weather.joining import find_files
from greenroof_ros.weather.reading import default_weather, read_weather
from greenroof_ros.weather.series import WeatherSeries


def _declare_forecast(node: Node) -> ForecastChoice:
    """Declare the parameters that choose the forecasts, and return the choice."""
    default = ForecastChoice()
    text = declare(node, "forecast", str(default), f"{', '.join(MODELS)}, or a FILE.csv")
    try:
        choice = choose(text)
    except ValueError as error:
        key = f"parameter forecast of {node.get_name()}"
        raise ConfigurationError(str(error), key=key, value=text) from error
    return replace(
        choice,
        size=declare(
            node, "forecast_size", default.size,
            "errors, ensemble: 0.25 small, 0.5 medium, 1 large", *OPTIONS["size"],
        ),
        seed=declare(
            node, "forecast_seed", default.seed, "errors, ensemble: of the errors",
            *OPTIONS["seed"],
        ),
        members=declare(
            node, "forecast_members", default.members, "ensemble: number of its members",
            *OPTIONS["members"],
        ),
    )


class WeatherNode(LockstepNode):
    """Holds the weather of a run."""

    def __init__(self) -> None:
        """Declare the parameters and open the topics."""
        super().__init__("weather", "weather")
        site = declare_site(self)
        files = declare(
            self, "weather_files", [str(default_weather())], "hourly records, joined"
        )
        start_text = declare(self, "start", DEFAULT_START, "time of tick 0, ISO 8601")
        self._run_length = declare(self, "run_length", site.N, "N (ticks)", low=1, high=2**40)
        method = declare(
            self, "evapotranspiration", "",
            "fao56, or the name of the file's own column; empty: the file's own if it has one",
        )
        weather = read_weather(
            # rclpy makes None of an empty list.
            find_files(files or [], "parameter weather_files of weather"), site, method or None
        )
        start = read_start(start_text, weather.first.tzinfo)
        horizon = declare(
            self, "horizon", 0.0,
            "h that the forecasts reach, in steps that grow; 0: the M ticks that come",
            0.0, HORIZON.high,
        )
        all_members = declare(
            self, "all_members", False, "of an ensemble: for scenario_mpc; otherwise the first"
        )
        self._series = WeatherSeries(weather, site, start, self._run_length)
        self._forecast = make_forecast(
            weather, self._series, site, start, horizon, _declare_forecast(self), all_members
        )
        self._start_ns = epoch_ns(start)
        self._tick_ns = round(site.tau * 1e9)

        self._time = self.subscribe(CLOCK)
        self._publish_rain_forecast = self.publish_topic("/forecast/precipitation")
        self._publish_evapotranspiration_forecast = self.publish_topic(
            "/forecast/evapotranspiration"
        )
        self._publish_rain = self.publish_topic("/weather/precipitation")
        self._publish_evapotranspiration = self.publish_topic("/weather/evapotranspiration")
        self._publish_frost = self.publish_topic("/weather/frost")

    def on_inputs(self) -> None:
        """Publish the weather of the tick, and the forecasts that are known at it."""
        tick, rest = divmod(self._time.value - self._start_ns, self._tick_ns)
        if rest or not 0 <= tick <= self._run_length:
            raise LockstepError(
                f"/clock is at tick {tick} of a run of {self._run_length}; plant and weather were "
                "started for different runs"
            )
        # What the controller waits for comes first: it needs longest.
        self._publish_frost(self._series.frost[tick])
        self._publish_rain_forecast(self._forecast.precipitation(tick))
        self._publish_evapotranspiration_forecast(self._forecast.evapotranspiration(tick))
        self._publish_rain(self._series.precipitation[tick])
        self._publish_evapotranspiration(self._series.evapotranspiration[tick])
        self.set_time(self._time.value)


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node(WeatherNode, args))


if __name__ == "__main__":
    main()
