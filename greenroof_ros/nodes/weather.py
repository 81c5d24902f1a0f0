"""The weather node: on each ``/clock`` the weather now, and the forecast of the look-ahead."""

from __future__ import annotations

import sys
from array import array
from dataclasses import replace

from rclpy.node import Node
from std_msgs.msg import Float64, Float64MultiArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.times import epoch_ns, read_start
from greenroof_ros.experiment.run import DEFAULT_START
from greenroof_ros.forecast.choice import MODELS, OPTIONS, ForecastChoice, choose
from greenroof_ros.forecast.resampling import make_forecast
from greenroof_ros.graph.lockstep import Link, LockstepError
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site
from greenroof_ros.weather.joining import find_files
from greenroof_ros.weather.reading import read_weather
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


class WeatherNode:
    """Holds the weather of a run."""

    def __init__(self, node: Node) -> None:
        """Declare the parameters and open the topics."""
        site = declare_site(node)
        default = shared_directory() / "config" / "weather" / "toronto_2021-07.csv"
        files = declare(node, "weather_files", [str(default)], "hourly records, joined")
        start_text = declare(node, "start", DEFAULT_START, "time of tick 0, ISO 8601")
        self._steps = declare(node, "steps", site.N, "N, ticks to run", low=1, high=2**40)
        method = declare(
            node, "evapotranspiration", "",
            "fao56, or the name of the file's own column; empty: the file's own if it has one",
        )
        weather = read_weather(
            # rclpy makes None of an empty list.
            find_files(files or [], "parameter weather_files of weather"), site, method or None
        )
        start = read_start(start_text, weather.first.tzinfo)
        horizon = declare(
            node, "horizon", 0.0,
            "h that the forecasts reach, in steps that grow; 0: the M ticks that come", 0.0, 48.0,
        )
        all_members = declare(
            node, "all_members", False, "of an ensemble: for scenario_mpc; otherwise the first"
        )
        self._series = WeatherSeries(weather, site, start, self._steps)
        self._forecast = make_forecast(
            weather, self._series, site, start, horizon, _declare_forecast(node), all_members
        )
        self._start_ns = epoch_ns(start)
        self._tick_ns = round(site.tau * 1e9)

        self.link = link = Link(node, "weather", self._on_clock)
        self._clock = link.take_topic("/clock")
        self._publish_rain_forecast = link.publish_topic("/forecast/precipitation")
        self._publish_evapotranspiration_forecast = link.publish_topic(
            "/forecast/evapotranspiration"
        )
        self._publish_rain = link.publish_topic("/weather/precipitation")
        self._publish_evapotranspiration = link.publish_topic("/weather/evapotranspiration")
        self._publish_frost = link.publish_topic("/weather/frost")
        self._window = Float64MultiArray()
        self._value = Float64()

    def _on_clock(self) -> None:
        tick, rest = divmod(self._clock.value - self._start_ns, self._tick_ns)
        if rest or not 0 <= tick <= self._steps:
            raise LockstepError(
                f"/clock is at tick {tick} of a run of {self._steps}; plant and weather were "
                "started for different runs"
            )
        # What the controller takes comes first: it needs longest.
        self._value.data = self._series.frost[tick]
        self._publish_frost(self._value)
        rain = self._forecast.precipitation(tick)
        self._window.data = rain if isinstance(rain, array) else array("d", rain.tobytes())
        self._publish_rain_forecast(self._window)
        self._window.data = self._forecast.evapotranspiration(tick)
        self._publish_evapotranspiration_forecast(self._window)
        self._value.data = self._series.precipitation[tick]
        self._publish_rain(self._value)
        self._value.data = self._series.evapotranspiration[tick]
        self._publish_evapotranspiration(self._value)


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("weather", lambda node: WeatherNode(node).link, args))


if __name__ == "__main__":
    main()
