"""District files: buildings, weather, adoption and sewer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import YamlMapping, find_named, read_yaml
from greenroof_ros.base.parameter import Parameter, entry, find, read_record
from greenroof_ros.controllers import outlet
from greenroof_ros.controllers.onoff import LEVEL
from greenroof_ros.forecast.choice import ERRORS, MODELS
from greenroof_ros.site.file import SITE_KEYS
from greenroof_ros.weather.climate import Climate
from greenroof_ros.weather.series import GAPS, REFUSE

ROOF, NONE, ORIFICE, DRAIN, PLAN = OUTLETS = (
    "roof", "none", "orifice", outlet.DRAIN, outlet.PLAN,
)
"""a green roof without cistern and irrigation, or ways to empty a cistern: the overflow alone; an
orifice that is always open; a valve with one of two policies"""
POLICY_KEYS = {each.name: each for each in (LEVEL, *outlet.PARAMETERS) if each.name != "outlet"}
"""parameters of the pump's controller and of the valve, whose kind the district file chooses"""
# Numbers that all buildings share: weather, clock, and valves.
_COMMON = {
    "tau", "M", "N", "wet_after", "event_separation", "latitude", "longitude", "elevation",
    "utc_offset", "albedo", "k_Rs", "wind_height", "valve_moves_per_hour", "valve_travel_time",
}
BUILDING_KEYS: dict[str, Parameter] = {
    name: each for name, each in SITE_KEYS.items()
    if each.kind in (float, float | None, int | None) and name not in _COMMON
} | POLICY_KEYS
"""keys of a site and of policies whose numbers can differ between buildings"""


@dataclass(frozen=True)
class Draw:
    """The distribution of a key over the buildings."""

    mean: float | None = entry("mean of a log-normal distribution", 1e-12, 1e9, default=None)
    sd: float | None = entry("standard deviation of this distribution", 1e-12, 1e9, default=None)
    low: float | None = entry("lower limit of this distribution", 0.0, 1e9, default=None)
    high: float | None = entry("upper limit", 0.0, 1e9, default=None)
    values: tuple[float, ...] = entry(
        "equally likely numbers to draw from, instead of a distribution", -1e9, 1e9, default=()
    )
    times: str | None = entry(
        "key whose value in the same building multiplies the drawn number", default=None
    )


@dataclass(frozen=True, kw_only=True)
class DistrictWeather(Climate):
    """The weather, and the days that are simulated in every year."""

    file: str = entry("weather file, or glob pattern such as '2021_*.csv', for all buildings")
    season: str | None = entry(
        "first and last day of the seasons, such as 05-01/10-31 (default: May to October, or "
        "November to April south of the equator)", default=None,
    )
    evapotranspiration: str | None = entry("method of computing evapotranspiration", default=None)
    gaps: str = entry("treatment of missing hours", choices=GAPS, default=REFUSE)


@dataclass(frozen=True)
class Orifice:
    """An orifice that replaces the valve and is always open; its defaults are the valve's."""

    low_outlet_level: float | None = entry(
        "level of the orifice above the cistern's base", 0.001, 100.0, unit="m", default=None
    )
    low_outlet_radius: float | None = entry("its radius", 0.001, 1.0, unit="m", default=None)


@dataclass(frozen=True)
class District:
    """The keys of a district file."""

    site: str = entry("site file with the values that all buildings have in common")
    weather: DistrictWeather = entry("weather file and simulated seasons")
    buildings: int | None = entry(
        "number of buildings, whose properties are drawn from distributions", 1, 1_000_000,
        default=None,
    )
    file: str | None = entry(
        "CSV file with one row per building; replaces the key buildings", default=None
    )
    seed: int = entry(
        "random seed of the first draw of the buildings and of the errors of forecasts; each "
        "further draw has the next seed", 0, 2**31 - 1_000, default=1
    )
    draws: int = entry(
        "number of draws, each of which is simulated in every season", 1, 1000, default=5
    )
    draw: dict[str, Draw] = entry(
        "distributions of keys of the site, and of outlet_reserve, outlet_price, outlet_reach and "
        "level, by the name of the key", factory=dict,
    )
    tau: float = entry("duration of a tick", 1.0, 300.0, unit="s", default=60.0)
    outlets: tuple[str, ...] = entry(
        "types of outlet to simulate; roof is a green roof without irrigation and cistern, and "
        "none is always included", choices=OUTLETS, default=OUTLETS
    )
    orifice: Orifice = entry("orifice that replaces the valve, by default as low and as large",
                             factory=Orifice)
    adoption: tuple[float, ...] = entry(
        "shares of the buildings that have a green roof and a cistern, each of which is simulated",
        0.0, 1.0, unit="1", default=(0.1, 0.25, 0.5, 1.0),
    )
    forecast: str = entry(
        "forecast that the outlet policy plan receives: with the skill of a weather service "
        "(errors), ten of these (ensemble), or the future rain (perfect)", choices=MODELS,
        default=ERRORS,
    )
    sewer_capacity: float = entry(
        "capacity of the sewer per unit of the connected area of all buildings [default assumed]",
        1e-6, 1000.0, unit="mm/h", default=5.0,
    )
    path: Path = Path()
    """path of the file"""

    @property
    def shares(self) -> list[float]:
        """The shares of adoption above 0 in ascending order, without duplicates."""
        return sorted({*self.adoption} - {0.0})

    def refuse(self, key: str, expected: str, value: Any = None) -> ConfigurationError:
        """Return an error about a key of the file, by default with the value in the file."""
        line, place = find(read_yaml(self.path), key)
        if value is None and not isinstance(place, (list, YamlMapping)):
            value = place
        return ConfigurationError(expected, file=self.path, line=line, key=key, value=value)

    def find_files(self, key: str, name: str) -> list[Path]:
        """Return files that match a name or pattern, next to the district file or in this package.

        Args:
            key: key that contains the name, for the error message.
            name: name or pattern of the files.

        Raises:
            ConfigurationError: if there is no such file.
        """
        try:
            return find_named(name, self.path, key)
        except ConfigurationError as error:
            raise self.refuse(key, error.expected, name) from None


def read_district(path: Path) -> District:
    """Read and check a district file.

    Args:
        path: path of the file.

    Raises:
        ConfigurationError: if a key is unknown, missing or invalid, or if two keys contradict each
            other.
    """
    record = read_record(District, path, lambda district, _: _find_mistakes(district))
    return replace(record, path=path)


def _find_mistakes(district: District) -> Iterator[tuple[str, str]]:
    """Yield the key of each contradiction, and a sentence that states what would be right."""
    known = BUILDING_KEYS
    if (district.buildings is None) == (district.file is None):
        yield "buildings", "must be set, or else file, a CSV file that lists the buildings"
    for name, draw in district.draw.items():
        if name not in known:
            yield f"draw.{name}", f"cannot differ between buildings; {suggest_names(name, known)}"
        given = {each for each in vars(draw) if getattr(draw, each) not in (None, ())} - {"times"}
        if given != {"values"} and given - {"low", "high"} != {"mean", "sd"}:
            yield f"draw.{name}", "must have mean and sd, or values"
        if draw.high is not None and draw.high <= (draw.low or 0.0):
            yield f"draw.{name}", "must have high above low"
        other = district.draw.get(draw.times or "")
        if draw.times is not None and (draw.times not in known or (other and other.times)):
            yield f"draw.{name}.times", "must be a key of a building that is not itself multiplied"
