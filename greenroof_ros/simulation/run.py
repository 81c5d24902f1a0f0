"""A run, with its site, weather, controller, initial state, start and length."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import duration, epoch_ns, to_minutes
from greenroof_ros.controllers.outlet import OutletPolicy, find_horizon
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.resampling import Forecast
from greenroof_ros.formats.hourly import Records
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.physics.start import note_full_roof
from greenroof_ros.simulation.pump_size import note_pumps
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.place import format_place, measure_distance
from greenroof_ros.site.site import Site
from greenroof_ros.weather.series import Weather, WeatherSeries

# A weather file from this distance or further does not represent the site (km): rain and wind
# differ even within a city.
_FAR_KM = 50.0


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

    def count_ticks_between(self, every_s: float) -> int:
        """Return the interval between kept ticks (ticks) for a given time (s), rounded."""
        return max(1, round(every_s / self.site.tau))

    @property
    def look_ahead_s(self) -> float:
        """Time for which the controller looks ahead (s)."""
        horizon = self.parameters.get("horizon") or 0.0
        return float(look_ahead_ends(self.site, horizon, find_horizon(self.parameters))[-1])

    def notes(self) -> list[str]:
        """Return notes that a reader should see before the results."""
        return [
            *self._note_short(), *_note_far(self.weather, self.site),
            *filter(None, [self.weather.rain_note]), *note_full_roof(self.site, self.x2),
            *note_pumps(self.site),
        ]

    def _note_short(self) -> Iterator[str]:
        """Yield a note if the run is shorter than the look-ahead."""
        length = self.steps * self.site.tau
        if length < self.look_ahead_s:
            end = self.start + timedelta(seconds=length)
            yield (
                f"the run of {duration(length)} is shorter than the look-ahead of "
                f"{duration(self.look_ahead_s)}, so the controller also plans beyond the end of "
                f"the run at {to_minutes(end)}"
            )

    def make_controller(self) -> Controller:
        """Create the run's controller."""
        return self.controller.make(self.site, self.parameters)

    def make_outlet(self, controller: Controller) -> OutletPolicy | None:
        """Create the policy of the outlet valve; return None for a site without a valve.

        Args:
            controller: the run's controller.
        """
        return self.controller.make_outlet(self.site, self.parameters, controller)


def _note_far(weather: Weather, site: Site) -> Iterator[str]:
    """Yield a note for every weather file whose location is far from the site."""
    if site.latitude is None or site.longitude is None:
        return
    for file, place in weather.places.items():
        away = measure_distance(place, (site.latitude, site.longitude))
        if away > _FAR_KM:
            yield (
                f"{file} is from {format_place(*place)}, {away:.0f} km from the site at "
                f"{format_place(site.latitude, site.longitude)}; check that this weather applies "
                "to the site"
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
