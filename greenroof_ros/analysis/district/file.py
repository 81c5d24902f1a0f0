"""District files: buildings, weather, adoption and sewer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import YamlMapping, find_matches, read_yaml, shared_directory
from greenroof_ros.base.parameter import Parameter, entry, find, read_record
from greenroof_ros.controllers import outlet
from greenroof_ros.controllers.onoff import LEVEL
from greenroof_ros.forecast.choice import ENSEMBLE, ERRORS, PERFECT, ForecastChoice
from greenroof_ros.site.file import SITE_KEYS
from greenroof_ros.site.site import VALVE_KEYS, Site
from greenroof_ros.weather.series import GAPS, REFUSE

NONE, ORIFICE, DRAIN, PLAN = OUTLETS = ("none", "orifice", outlet.DRAIN, outlet.PLAN)
"""ways to empty the cisterns: the overflow alone; an orifice that is always open; a valve with one
of two policies"""
NO_FORECAST = "none"
_MAX_BUILDINGS = 1_000_000
# Keys that all buildings share: weather, clock, and the outlets, which the district's file chooses.
_COMMON = {
    "tau", "M", "N", "wet_after", "event_separation", "latitude", "longitude", "elevation",
    "utc_offset", "time_zone", "quiet_hours", "albedo", "k_Rs", "wind_height",
    "monthly_evapotranspiration", "low_outlet_valve", "valve_closed_in_frost", *VALVE_KEYS,
}
# Parameters of the pump's controller and of the valve. The district's file sets the kind of outlet.
_OF_POLICY = {
    parameter.name: parameter
    for parameter in (LEVEL, *outlet.PARAMETERS) if parameter.name != "outlet"
}


def building_keys() -> dict[str, Parameter]:
    """Return the keys of a site and of policies that can differ between buildings, by name."""
    of_site = {name: each for name, each in SITE_KEYS.items() if name not in _COMMON}
    return of_site | _OF_POLICY


def is_of_policy(name: str) -> bool:
    """Return whether a building's key belongs to its controller or outlet, not to its site."""
    return name in _OF_POLICY


@dataclass(frozen=True)
class Draw:
    """The distribution of a key over the buildings."""

    mean: float | None = entry(
        "mean of a log-normal distribution, which is positive and skewed like the distribution "
        "of building sizes", 1e-12, 1e9, default=None,
    )
    sd: float | None = entry(
        "standard deviation of the log-normal distribution", 0.0, 1e9, default=None
    )
    low: float | None = entry(
        "minimum of a uniform distribution, or lower limit of the log-normal "
        "distribution", -1e9, 1e9,
        default=None,
    )
    high: float | None = entry(
        "maximum of a uniform distribution, or upper limit of the log-normal "
        "distribution", -1e9, 1e9,
        default=None,
    )
    values: tuple[float, ...] | None = entry(
        "list of equally likely numbers to draw from, instead of a distribution", -1e9, 1e9,
        default=None,
    )
    names: tuple[str, ...] | None = entry(
        "list of equally likely names to draw from, instead of a distribution", default=None
    )
    times: str | None = entry(
        "key whose value in the same building multiplies the drawn number", default=None
    )

    @property
    def mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield the key of each contradiction, and a sentence that states what would be right."""
        names = "mean", "sd", "low", "high", "values", "names"
        given = {name for name in names if getattr(self, name) is not None}
        if given not in ({"values"}, {"names"}, {"low", "high"}) and not (
            {"mean", "sd"} <= given <= {"mean", "sd", "low", "high"}
        ):
            yield "", (
                "must be one distribution: mean and sd, with or without the limits low and high; "
                "low and high alone; values; or names"
            )
        elif self.low is not None and self.high is not None and self.low >= self.high:
            yield "low", f"must be below high = {self.high:g}"
        elif self.names is not None and self.times is not None:
            yield "times", "can multiply numbers, but not names"
        elif () in (self.values, self.names):
            yield "values" if self.names is None else "names", "must list at least one entry"


@dataclass(frozen=True)
class DistrictWeather:
    """The weather of all cells, and the period that is simulated."""

    season: str | None = entry(
        "first and last day of a season, such as 05-01/10-31; every season that the record covers "
        "is simulated (default: May to October, or November to April south of the equator)",
        default=None,
    )
    start: str | None = entry(
        "time of the first tick (ISO 8601) of a single run of the length hours, instead of "
        "seasons; it is the same instant in all cells. Without a UTC offset, it is in the site's "
        "time_zone or, without one, in the zone or at the offset of the first cell's weather",
        default=None,
    )
    hours: float | None = entry(
        "length of the single run that begins at start", 1e-9, 1e6, unit="h", default=None
    )
    file: str | None = entry(
        "weather file, or glob pattern such as '2021_*.csv', for all buildings", default=None
    )
    cells: dict[str, str] | None = entry(
        "weather file or glob pattern for each cell, by the name of the cell; replaces file",
        default=None,
    )
    evapotranspiration: str | None = entry("method of computing evapotranspiration", default=None)
    gaps: str = entry("treatment of missing hours", choices=GAPS, default=REFUSE)


@dataclass(frozen=True)
class Orifice:
    """An orifice that replaces the valve and is always open; its defaults are the valve's."""

    low_outlet_level: float | None = entry(
        "level of the orifice above the cistern's base; by default, that of the building's low "
        "outlet", 0.001, 100.0, unit="m", default=None
    )
    low_outlet_radius: float | None = entry(
        "radius of the orifice; by default, that of the building's low "
        "outlet", 0.001, 1.0, unit="m", default=None
    )


@dataclass(frozen=True)
class District:
    """The keys of a district file."""

    site: str = entry("site file with the values that all buildings have in common")
    weather: DistrictWeather = entry("weather files and simulated period")
    buildings: int | None = entry(
        "number of buildings, whose properties are drawn from "
        "distributions", 1, _MAX_BUILDINGS, default=None
    )
    file: str | None = entry(
        "CSV file with one row per building; replaces the key buildings", default=None
    )
    seed: int = entry(
        "random seed of the first draw of the buildings, of the order of adoption and of the "
        "errors of forecasts; each further draw has the next seed", 0, 2**31 - 1_000, default=1
    )
    draws: int = entry(
        "number of draws, each of which is simulated in every season", 1, 1000, default=5
    )
    draw: dict[str, Draw] = entry(
        "distributions of site keys, outlet_reserve, outlet_price, outlet_reach and level, each "
        "listed under the name of the key", factory=dict,
    )
    tau: float = entry("duration of a tick", 1.0, 300.0, unit="s", default=60.0)
    outlets: tuple[str, ...] = entry(
        "types of outlet to simulate; 'none' is always included", choices=OUTLETS,
        default=OUTLETS,
    )
    orifice: Orifice = entry("orifice that replaces the valve", factory=lambda: Orifice())
    adoption: tuple[float, ...] = entry(
        "shares of the buildings that have a green roof and a cistern, each of which is "
        "simulated", 0.0, 1.0, unit="1",
        default=(0.0, 0.1, 0.25, 0.5, 1.0),
    )
    valve_share: float = entry(
        "share of the cisterns that have a low outlet with a valve or the orifice; the other "
        "cisterns can only overflow", 0.0, 1.0, unit="1", default=1.0,
    )
    forecast: str = entry(
        "forecast of rain that the outlet policy plan receives: a forecast with the skill of a "
        "weather service (errors), an ensemble of such forecasts, which takes ten times as long "
        "(ensemble), the exact future rain (perfect), or no forecast (none)",
        choices=(ERRORS, ENSEMBLE, PERFECT, NO_FORECAST), default=ERRORS,
    )
    sewer_capacity: float | None = entry(
        "capacity of the sewer per unit of the connected area of all buildings; the sewer "
        "overflows at higher flows", 1e-6, 1000.0, unit="mm/h", default=None,
    )
    path: Path = Path()
    """path of the file"""

    @property
    def shares(self) -> tuple[float, ...]:
        """The shares of adoption above 0 in ascending order, without duplicates."""
        return tuple(sorted({*self.adoption} - {0.0}))

    @property
    def ticks(self) -> dict[str, Any]:
        """Values that replace those of the site file, by key."""
        return {"tau": self.tau, "M": 1}

    def choose_forecast(self, draw: int) -> ForecastChoice:
        """Return the choice of forecasts for a draw, counted from 0."""
        if self.forecast in (ENSEMBLE, ERRORS):
            return ForecastChoice(self.forecast, seed=self.seed + draw)
        return ForecastChoice()

    def refuse(self, key: str, expected: str, value: Any = None) -> ConfigurationError:
        """Return an error about a key of the file."""
        line, place = find(read_yaml(self.path), key)
        if value is None and not isinstance(place, (list, YamlMapping)):
            value = place
        return ConfigurationError(expected, file=self.path, line=line, key=key, value=value)

    def find_files(self, key: str, name: str, places: Sequence[Path] = ()) -> list[Path]:
        """Return files that match a name or pattern, next to the district file or in this package.

        Args:
            key: key that contains the name, for the error message.
            name: name or pattern of the files.
            places: additional directories to search.

        Raises:
            ConfigurationError: if there is no such file.
        """
        shipped = shared_directory() / "config"
        everywhere = [self.path.parent, *places, shipped, shipped / "weather"]
        if found := find_matches(name, everywhere):
            return found
        raise self.refuse(
            key, f"there is no such file in {', '.join(str(place) for place in everywhere)}", name
        )


def read_district(path: Path) -> District:
    """Read and check a district file.

    Raises:
        ConfigurationError: if a key is unknown, missing or invalid, or if two keys contradict each
            other.
    """
    record = read_record(District, path, lambda district, _: _find_mistakes(district))
    return replace(record, path=path)


def check_outlets(district: District, site: Site) -> None:
    """Refuse outlets that the site does not have."""
    missing = [DRAIN, PLAN] * (not site.low_outlet_valve)
    missing += [ORIFICE] * (site.low_outlet_level is None)
    if wrong := [outlet for outlet in district.outlets if outlet in missing]:
        raise district.refuse(
            "site", f"needs low_outlet_level, low_outlet_radius and, for a valve, "
            f"low_outlet_valve for {' and '.join(wrong)}, as in site_valve.yaml; alternatively, "
            "leave out of outlets what the site does not have"
        )


def _find_mistakes(district: District) -> Iterator[tuple[str, str]]:
    """Yield the key of each contradiction, and a sentence that states what would be right."""
    if (district.buildings is None) == (district.file is None):
        yield "buildings", (
            "is missing; set it, or set file to a CSV file that lists the buildings"
            if district.file is None
            else "cannot be combined with file, which lists the buildings"
        )
    weather = district.weather
    if (weather.file is None) == (weather.cells is None):
        yield "weather.file" if weather.file else "weather", (
            "must contain either file, for all buildings, or cells, with one file per cell"
        )
    if weather.cells == {}:
        yield "weather.cells", "must name at least one cell"
    if (weather.start is None) != (weather.hours is None):
        yield "weather", "must contain both start and hours, or neither for whole seasons"
    if weather.season is not None and weather.start is not None:
        yield "weather.season", "cannot be combined with start and hours of a single run"
    known = building_keys()
    for name, draw in district.draw.items():
        if name not in known:
            why = (
                "all buildings share this key" if name in _COMMON else suggest_names(name, known)
            )
            yield f"draw.{name}", f"cannot differ between buildings; {why}"
        for key, expected in draw.mistakes:
            yield f"draw.{name}.{key}" if key else f"draw.{name}", expected
        if draw.times is not None:
            other = district.draw.get(draw.times)
            if draw.times not in known:
                yield f"draw.{name}.times", suggest_names(draw.times, known)
            elif draw.times == name or (other is not None and other.times is not None):
                yield f"draw.{name}.times", "must be a key whose value is not itself multiplied"
    if not district.adoption:
        yield "adoption", "must list at least one share"
