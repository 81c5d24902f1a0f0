"""The inputs of a run that a user specifies, and the function that builds a run from them.

The command line, Python and the grid of a study set the same inputs under the same names, which
:func:`make_inputs` checks. To add an input, add a field to :class:`RunInputs`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import default_site_file, find_shipped
from greenroof_ros.base.parameter import Parameter, entry, make_record, parameters_of
from greenroof_ros.base.times import DEFAULT_START, read_start
from greenroof_ros.controllers.outlet import find_horizon
from greenroof_ros.controllers.registry import DEFAULT, ControllerChoice, find_controller
from greenroof_ros.forecast import choice
from greenroof_ros.forecast.choice import PERFECT, ForecastChoice
from greenroof_ros.forecast.steps import make_forecast
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.physics.pump import PARAMETERS, SensorAndPump
from greenroof_ros.physics.start import INITIAL_STATES, find_state
from greenroof_ros.simulation.run import Run, count_ticks
from greenroof_ros.site.file import check_site, read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.climate import RECORDED, Climate
from greenroof_ros.weather.read import (
    complete_records,
    default_weather,
    find_files,
    find_zone,
    is_frame,
    read_frame,
    read_weather,
)
from greenroof_ros.weather.records import Records
from greenroof_ros.weather.series import GAPS, REFUSE, Weather, WeatherSeries


@dataclass(frozen=True)
class RunInputs(Climate):
    """The inputs of a run, before any file is read.

    Attributes:
        controller: the chosen controller, which decides how much to pump.
        parameters: parameters of the controller; omitted parameters take their default values, some
            of which depend on the site.
        site: site, or path of the site file.
        weather: weather files, a data frame, or records, which are used unchanged if they are
            complete.
        forecast: choice of the forecasts that the controller receives.
        sensor_and_pump: deviations of the level sensor and the pumps from those in the paper.
    """

    controller: ControllerChoice = field(default_factory=partial(find_controller, DEFAULT))
    parameters: Mapping[str, Any] = field(default_factory=dict)
    site: Path | Site = field(default_factory=default_site_file)
    weather: Any = field(default_factory=lambda: (default_weather(),))
    forecast: ForecastChoice = field(default_factory=ForecastChoice)
    sensor_and_pump: SensorAndPump = field(default_factory=SensorAndPump)
    start: str = entry(
        "time of the first tick (ISO 8601); without an offset from UTC, in the site's time_zone "
        "or, if the site has none, in the zone or offset of the weather", default=DEFAULT_START,
    )
    hours: float | None = entry(
        "length of the run; by default, N of the site", 1e-9, 1e9, unit="h", default=None,
    )
    initial: str | None = entry(
        "initial levels in the cistern and on the roof: the name of a state from Table II of the "
        "paper, or 'site' for the levels in the site file (default: site, or low-low if the file "
        "contains no levels)", default=None,
    )
    cistern: float | None = entry(
        "initial volume in the cistern, instead of a named state; roof must also be set", 0.0, 1e9,
        unit="m3", default=None,
    )
    roof: float | None = entry(
        "initial volume on the roof, instead of a named state; cistern must also be set", 0.0, 1e9,
        unit="m3", default=None,
    )
    evapotranspiration: str | None = entry(
        "source of evapotranspiration. fao56: FAO-56 Penman-Monteith; hargreaves: FAO-56 Eq. 52, "
        "from temperature alone; monthly: the site's monthly_evapotranspiration; or the name of a "
        "column of the weather file, such as published (default: the column of the file, if any; "
        "otherwise the first of these three methods for which the data suffice)", default=None,
    )
    gaps: str = entry(
        "treatment of missing hours in the weather, except in short gaps. refuse: stop and list "
        "the hours; fill: treat missing rain as no rain, and replace other values with the mean "
        "for that time of day over the three days before and after", choices=GAPS, default=REFUSE,
    )

    @property
    def climate(self) -> Climate:
        """How the climate differs from that of the record."""
        return Climate(self.rain_factor, self.temperature_change)

    def read_site(self) -> Site:
        """Read and check the site.

        Raises:
            ConfigurationError: if the site is invalid.
        """
        return check_site(self.site) if isinstance(self.site, Site) else read_site(self.site)

    def read_records(self, site: Site) -> tuple[Weather, Records | None]:
        """Read the weather; also return the records, or None if the weather is from files.

        Raises:
            ConfigurationError: if the weather is invalid.
        """
        what = site.place, self.evapotranspiration, self.gaps, self.climate
        records = read_frame(self.weather, site) if is_frame(self.weather) else self.weather
        if isinstance(records, Weather):
            return records, records
        if isinstance(records, Records):
            return complete_records(records, *what), records
        return read_weather(records, *what), None

    def build(self) -> Run:
        """Read the files, and build and check the run.

        Raises:
            ConfigurationError: if an input or a file is invalid, if weather or forecasts do not
                cover the run, or if the nodes would reject a value. The error's key is the name of
                the input, as for :func:`make_inputs`.
        """
        site = self.read_site()
        initial, x1, x2 = find_state(site, self.initial, self.cistern, self.roof)
        weather, records = self.read_records(site)
        zone = find_zone(self.weather) if is_frame(self.weather) else None
        if site.time_zone is not None:
            zone = site.zone
        if self.forecast.file is not None and self.climate != RECORDED:
            raise ConfigurationError(
                f"cannot be combined with another climate ({self.climate}), which archived "
                "forecasts do not know", key="forecast", value=self.forecast.file,
            )
        start = read_start(self.start, zone or weather.first.tzinfo)
        steps = count_ticks(site, self.hours, "hours")
        series = WeatherSeries(weather, site, start, steps)
        _refuse_what_nodes_refuse(site, series, x1, x2)
        parameters = self.controller.complete_parameters(site, self.parameters)
        if "min_on" in parameters:  # the controller knows the limits of its pumps
            parameters["min_on"] = max(parameters["min_on"], self.sensor_and_pump.pump_min_on)
        forecast = make_forecast(
            weather, series, site, start, parameters.get("horizon", 0.0), self.forecast,
            *find_needs(self.controller, parameters),
        )
        return Run(
            self.site if isinstance(self.site, Path) else None, site, weather, series, forecast,
            start, steps, self.controller, parameters, initial, x1, x2, self.forecast,
            self.sensor_and_pump, records,
        )


def find_needs(controller: ControllerChoice, parameters: Mapping[str, Any]) -> tuple[bool, float]:
    """Return whether forecasts include all members, and the look-ahead of an outlet's plan (h)."""
    outlet_horizon = find_horizon(parameters)
    return controller.ensemble or outlet_horizon > 0, outlet_horizon


INPUTS: dict[str, Parameter] = {
    parameter.name: parameter for parameter in (
        Parameter("site", None, meaning="site file"),
        Parameter(
            "weather", None, meaning="weather files, which are joined in chronological order, or a "
            "pattern such as 'weather/2021_*.csv'. The files can be CSV in this project's format "
            "or in that of a service (config/formats), descriptions of other CSV files, or JSON of "
            "Open-Meteo, in which rain and radiation are moved from the end of their hour to its "
            "start (default: config/weather/toronto_2021-07.csv)",
        ),
        *parameters_of(RunInputs),
        Parameter(
            "forecast", PERFECT, meaning="the controller's knowledge of the weather ahead. "
            "perfect: complete knowledge; errors: a forecast with errors, by default as large as "
            "those of real forecasts; ensemble: an ensemble of such forecasts; path of a file or a "
            "directory of files: archived forecasts in this project's CSV format, or CSV or JSON "
            "from Open-Meteo. errors and ensemble are issued every 6 hours, and archived forecasts "
            "at their own times",
        ),
        *choice.INPUTS.values(),
        *PARAMETERS.values(),
    )
}
"""the inputs of a run, by name, apart from its controller and the controller's parameters"""
_SCALARS = {parameter.name for parameter in parameters_of(RunInputs)}


def make_inputs(controller: ControllerChoice, given: Mapping[str, Any]) -> RunInputs:
    """Make the inputs of a run from their values by name: options, keywords or a grid's keys.

    Args:
        controller: choice of the controller.
        given: values of :data:`INPUTS` and of the controller's parameters; None stands for the
            default. ``site`` may be a site, and ``weather`` can be one or more file names, records
            or a data frame. ``start`` may be a date or a datetime, and ``initial`` the two volumes.

    Raises:
        ConfigurationError: if a name is unknown or a value is invalid; the error's key is the name.
    """
    values = {name: value for name, value in given.items() if value is not None}
    own = {
        name: parameter.read(values.pop(name), key=name)
        for name, parameter in controller.parameters.items() if name in values
    }
    for name, value in values.items():
        if name not in INPUTS:
            known = [*INPUTS, *controller.parameters]
            raise ConfigurationError(
                f"is neither an input nor a parameter of {controller.name}; "
                f"{suggest_names(name, known)}", key=name, value=value,
            )
    if "start" in values:
        values["start"] = str(values["start"])
    if not isinstance(values.get("initial", ""), str):
        initial = values.pop("initial")
        try:
            values["cistern"], values["roof"] = initial
        except (TypeError, ValueError) as error:
            raise ConfigurationError(
                f"must be one of {', '.join(INITIAL_STATES)}, or the volumes in the cistern and on "
                "the roof (m3)", key="initial", value=initial,
            ) from error
    if "site" in values and not isinstance(values["site"], Site):
        values["site"] = find_shipped(Path(str(values["site"])))
    if "weather" in values:
        values["weather"] = _find_weather(values["weather"])
    return replace(
        make_record(RunInputs, {name: values[name] for name in _SCALARS if name in values}),
        controller=controller,
        parameters=own,
        forecast=choice.choose(str(values.get("forecast", PERFECT)), {
            name: values[f"forecast_{name}"] for name in choice.OPTIONS
            if f"forecast_{name}" in values
        }),
        sensor_and_pump=make_record(SensorAndPump, {
            name: values[name] for name in PARAMETERS if name in values
        }),
        **{name: values[name] for name in ("site", "weather") if name in values},
    )


def _find_weather(weather: Any) -> Any:
    """Return records or a data frame unchanged, or else the files with the given names."""
    if isinstance(weather, Records) or is_frame(weather):
        return weather
    names = weather if isinstance(weather, (list, tuple)) else [weather]
    if not all(isinstance(name, (str, os.PathLike)) for name in names):
        raise ConfigurationError(
            "must be a file name, a glob pattern or a list of these, or a polars or pandas data "
            "frame", key="weather", value=weather,
        )
    return tuple(find_files(map(os.fspath, names), "weather"))


def _refuse_what_nodes_refuse(site: Site, series: WeatherSeries, x1: float, x2: float) -> None:
    """Reject values that the nodes would reject, so that runs with and without ROS agree."""
    for name, value in (
        ("/cistern/level", site.cistern_level(x1)),
        ("/roof/level", site.roof_level(x2)),
        ("/weather/precipitation", series.precipitation.maximum),
        ("/weather/evapotranspiration", series.evapotranspiration.maximum),
    ):
        topic = read_topics()[name]
        if value > topic.high:
            raise ConfigurationError(
                f"{name} would reach {value:g} {topic.unit} in the run, but at most {topic.high:g} "
                "is accepted (msg_defs/topics.yaml); is a unit wrong?"
            )
