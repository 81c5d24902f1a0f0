"""The weather node: on each ``/clock`` the weather now, and the forecast of the look-ahead."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from greenroof_ros.common.command_line import EXIT_DONE, command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import DEFAULT_START, epoch_ns, read_start
from greenroof_ros.controllers.protocol import HORIZON
from greenroof_ros.forecast.choice import MODELS, OPTIONS, ForecastChoice, choose
from greenroof_ros.forecast.resampling import make_forecast
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.lockstep import CLOCK, LockstepNode
from greenroof_ros.graph.node_help import NodeParser, node_help
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import (
    NodeParameter,
    declare,
    declare_site,
    default_site,
    site_file,
)
from greenroof_ros.model.site import Site
from greenroof_ros.weather.joining import find_files
from greenroof_ros.weather.reading import default_weather, read_weather
from greenroof_ros.weather.series import WeatherSeries


def parameters(site: Site) -> list[NodeParameter]:
    """Return the node's parameters, but that of the site."""
    forecast = ForecastChoice()
    return [
        NodeParameter("weather_files", [str(default_weather())], "hourly records, joined"),
        NodeParameter("start", DEFAULT_START, "time of tick 0, ISO 8601"),
        NodeParameter("run_length", site.N, "N (ticks)", 1, 2**40),
        NodeParameter(
            "evapotranspiration", "",
            "fao56, or the name of the file's own column; empty: the file's own if it has one",
        ),
        NodeParameter(
            "horizon", 0.0,
            "h that the forecasts reach, in steps that grow; 0: the M ticks that come",
            0.0, HORIZON.high,
        ),
        NodeParameter(
            "all_members", False, "of an ensemble: for scenario_mpc; otherwise the first"
        ),
        NodeParameter("forecast", str(forecast), f"{', '.join(MODELS)}, or a FILE.csv"),
        NodeParameter(
            "forecast_size", forecast.size, "errors, ensemble: 0.25 small, 0.5 medium, 1 large",
            *OPTIONS["size"],
        ),
        NodeParameter(
            "forecast_seed", forecast.seed, "errors, ensemble: of the errors", *OPTIONS["seed"]
        ),
        NodeParameter(
            "forecast_members", forecast.members, "ensemble: number of its members",
            *OPTIONS["members"],
        ),
    ]


def _forecast(values: dict[str, Any]) -> ForecastChoice:
    """Return the forecasts that the parameters choose."""
    text = values["forecast"]
    try:
        choice = choose(text)
    except ValueError as error:
        raise ConfigurationError(
            str(error), key="parameter forecast of weather", value=text
        ) from error
    return replace(choice, **{name: values[f"forecast_{name}"] for name in OPTIONS})


class WeatherNode(LockstepNode):
    """Holds the weather of a run."""

    def __init__(self) -> None:
        """Declare the parameters and open the topics."""
        super().__init__("weather", "weather")
        site = declare_site(self)
        values = declare(self, parameters(site))
        self._run_length = values["run_length"]
        weather = read_weather(
            # rclpy makes None of an empty list.
            find_files(values["weather_files"] or [], "parameter weather_files of weather"),
            site, values["evapotranspiration"] or None,
        )
        start = read_start(values["start"], weather.first.tzinfo)
        self._series = WeatherSeries(weather, site, start, self._run_length)
        self._forecast = make_forecast(
            weather, self._series, site, start, values["horizon"], _forecast(values),
            values["all_members"],
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


def _help() -> str:
    return node_help(
        "weather", "weather", __doc__, [site_file(), *parameters(default_site())],
        "--ros-args -p forecast:=persistence",
    )


@command
def main() -> int:
    """Run the node."""
    if NodeParser().own_arguments().help:
        print(_help())
        return EXIT_DONE
    return run_node(WeatherNode)


if __name__ == "__main__":
    main()
