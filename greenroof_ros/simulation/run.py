"""A run, with its site, weather, controller, initial state, start and length."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import epoch_ns
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.protocol import Controller, note_arrays
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.steps import Forecast
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import SensorAndPump, maximum_pump_flow
from greenroof_ros.physics.storm_water import HOUR_S, time_without_rain
from greenroof_ros.site.site import Site
from greenroof_ros.weather.records import Records
from greenroof_ros.weather.series import Weather, WeatherSeries

Values = NDArray[np.float64]

# Hours of the record before a run that show whether it starts in wet weather: `wet_after` is less.
_BEFORE_H = 72
# Maximum share of the target that the pumps should lift in a tick.
_MAX_SHARE = 0.1


@dataclass(frozen=True)
class Run:
    """All data that determine the results of a run.

    Attributes:
        site_file: site file; None if a program passed the site.
        site: parameters of the site.
        weather: hourly records.
        series: the weather, tick by tick.
        forecast: forecasts that the controller receives.
        start: time of tick 0.
        steps: number of steps, N; the states are x_0..x_N.
        controller: the chosen controller.
        parameters: parameters of the controller.
        initial: name of the initial state, or ``custom``.
        x1: initial volume in the cistern (m3).
        x2: initial volume on the roof (m3).
        forecast_choice: choice of the forecasts that the controller receives.
        sensor_and_pump: deviations of the level sensor and the pumps from those in the paper.
        records: weather records that a program passed; None if they are from files.
    """

    site_file: Path | None
    site: Site
    weather: Weather
    series: WeatherSeries
    forecast: Forecast
    start: datetime
    steps: int
    controller: ControllerChoice
    parameters: dict[str, Any]
    initial: str
    x1: float
    x2: float
    forecast_choice: ForecastChoice = field(default_factory=ForecastChoice)
    sensor_and_pump: SensorAndPump = field(default_factory=SensorAndPump)
    records: Records | None = None

    def __deepcopy__(self, _: object) -> Run:
        """Return the run itself, because it never changes and its weather can be large."""
        return self

    def time_ns(self, tick: int) -> int:
        """Return the time of a tick on the graph's clock (ns since 1970)."""
        return epoch_ns(self.start) + tick * round(self.site.tau * 1e9)

    def read_ticks(
        self, first: int, last: int, site: Site
    ) -> tuple[Values, Values, NDArray[np.bool_], NDArray[np.bool_], Values]:
        """Return what holds in the ticks from one to another (exclusive), each in an array.

        Args:
            first: first tick.
            last: end of the ticks.
            site: site with this weather, whose quiet hours and other demand apply.

        Returns:
            Rain (m/s), evapotranspiration of the run's bed (m3/s), whether there is frost,
            whether the tick is in the quiet hours, and the water that other uses need (m3/s).
        """
        series, quiet = self.series, np.zeros(last - first, np.bool_)
        rain, evapotranspiration, frost = (
            np.frombuffer(values[first:last])
            for values in (series.precipitation, series.evapotranspiration, series.frost)
        )
        if site.quiet is not None:
            quiet = site.quiet.quiet_ticks(self.time_ns(first), round(site.tau * 1e9), last - first)
        needed = series.other_demand_of(site)
        other = np.zeros(last - first) if needed is None else np.frombuffer(needed[first:last])
        return rain, evapotranspiration, frost != 0, quiet, other

    def count_ticks_between(self, every_s: float) -> int:
        """Return the interval between kept ticks (ticks) for a given time (s), rounded."""
        return max(1, round(every_s / self.site.tau))

    def notes(self) -> list[str]:
        """Return notes that a reader should see before the results."""
        kind = self.controller.kind
        return [*self.weather.warnings(self.site), *note_pumps(self.site), *note_arrays(kind)]

    def weather_notes(self) -> list[str]:
        """Return sentences about weather and forecasts that were not used as they were found."""
        return [*self.weather.left_out, *self.series.notes, *self.forecast.notes]

    @cached_property
    def without_rain_s(self) -> float:
        """Time without rain at the start, according to the record (s); infinite without a record.

        Before its first tick, a run is dry unless the record shows rain. Missing values are
        skipped: they are neither rain nor time without rain.
        """
        before = (self.start - self.weather.first).total_seconds()
        first = max(0, math.floor(before / HOUR_S) - _BEFORE_H)
        part = self.weather.cut(first, math.ceil(before / HOUR_S))
        rain, without_rain = part.finest_rain / 1000 / HOUR_S, math.inf  # m/s
        seconds = HOUR_S / rain.shape[1]
        before = before / seconds - first * rain.shape[1]
        for step, rate in enumerate(rain.ravel()[: math.ceil(before)].tolist()):
            if math.isfinite(rate):
                duration = min(1.0, before - step) * seconds
                without_rain = time_without_rain(without_rain, rate, duration)
        return without_rain

    def make_controller(self) -> Controller:
        """Create the run's controller."""
        return self.controller.make(self.site, self.parameters)

    def make_outlet(self, controller: Controller) -> OutletPolicy | None:
        """Create the policy of the outlet valve; return None for a site without a valve.

        Args:
            controller: the run's controller.
        """
        return self.controller.make_outlet(
            self.site, self.parameters, controller, self.without_rain_s
        )


def note_pumps(site: Site) -> Iterator[str]:
    """Yield a warning if the pumps are too large for the duration of a tick."""
    flow = maximum_pump_flow(plant_parameters(site), site.a1 * site.z_o)
    share = site.tau * flow / site.x2_star
    if share > _MAX_SHARE:
        yield (
            f"in a tick of {site.tau:g} s the pumps can deliver {share:.0%} of the target "
            "volume. Simulated pumps stop at the target within the tick, as with a float switch. "
            "Real pumps need such a switch, or ticks of at most "
            f"{_MAX_SHARE * site.x2_star / flow:.3g} s"
        )


def count_ticks(site: Site, length: float | None, key: str, unit_s: float = 3600.0) -> int:
    """Return the number of ticks in a period, such as N for a run.

    Args:
        site: the site, which sets the duration of a tick.
        length: length of the period, in ``unit_s``; None for the N of the site.
        key: option or key that sets the length, for error messages.
        unit_s: unit of the length (s).

    Raises:
        ConfigurationError: if the length is not a whole number of ticks, or is less than one tick.
    """
    if length is None:
        return site.N
    seconds = length * unit_s
    steps = round(seconds / site.tau) if math.isfinite(seconds) else 0
    if steps < 1 or not math.isclose(steps * site.tau, seconds, rel_tol=1e-9):
        raise ConfigurationError(
            f"must be a whole number of ticks of {site.tau:g} s, and at least one tick",
            key=key, value=length,
        )
    return steps
