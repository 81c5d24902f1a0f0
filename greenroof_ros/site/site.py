"""The parameters of a site (Table I, location and options), read from YAML and checked."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from datetime import datetime, timedelta, timezone, tzinfo
from functools import cached_property
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from greenroof_ros.common.errors import ConfigurationError, suggest_names
from greenroof_ros.common.files import is_there, read_yaml, shared_directory
from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.parameter import Parameter, entry, make_record, parameters_of
from greenroof_ros.common.times import LAST_YEAR
from greenroof_ros.site.clock import QuietHours
from greenroof_ros.site.plain_keys import NO_VALUE, PLAIN, Entry, override, translate

# Bounds of all sites' parameters: within them, nothing that is computed overflows.
_POSITIVE, _NOT_NEGATIVE = (1e-12, 1e9), (0.0, 1e9)
# Bounds of a pump curve; a constant flow of 1 l/h is -1.3e19 (site/plain_keys.py).
_NEGATIVE = (-1e21, -1e-12)
# Relative error up to which a product rounded by a person, such as x2_star, counts as consistent.
_ROUNDING = 1e-6
# According to Eq. (4), water that the soil cannot hold stays on its surface until it drains. No
# more than this stays there: the most rain that ever fell in a day, Foc-Foc, La Reunion, 1966 [WMO]
# (m).
_MAX_PONDED = 1.825
# A cistern reaches up to the roof, or to this multiple of its outlet (Table II) if that is higher.
_ABOVE_OUTLET = 1.3
# Products, computed if a file omits them; the paper's roof has no field capacity.
_FOLLOW_FROM = {"x2_star": ("a2", "z_veg"), "z_cap": ("a2", "z_soil", "field_capacity")}
# Volumes, and what they are proportional to.
_FOLLOW = {
    **_FOLLOW_FROM,
    "initial_cistern": ("a1", "z_o"),
    "initial_roof": ("a2",),
    "initial_layer": ("a2",),
}
# Parameters of the clock, and what makes that part of it, which fails if a value is wrong.
_OF_CLOCK: dict[str, tuple[Callable[[Any], object], str]] = {
    "quiet_hours": (
        lambda intervals: QuietHours(intervals, timezone.utc),
        'must be a list of intervals of the day, such as ["22:00-06:00", "12:00-13:30"], and must '
        "leave some time for pumping",
    ),
    "time_zone": (
        ZoneInfo,
        "must be the IANA name of a time zone known to this computer (package tzdata), such as "
        "America/Toronto",
    ),
}
# Key for the file that contains what a site file omits.
_EXTENDS = "extends"
# What the reader of weather may use, including for computed evapotranspiration.
_OF_WEATHER = {
    "a2", "latitude", "longitude", "elevation", "utc_offset", "time_zone", "albedo", "k_Rs",
    "wind_height", "crop_coefficient", "monthly_evapotranspiration",
}
# Optional parameters that belong together: each needs the others in its line. Field-capacity soil
# can lack a drainage layer.
_TOGETHER = (
    (("field_capacity", "wilting_point", "depletion_fraction"), ()),
    (("drainage_storage", "drainage_time"), ("field_capacity",)),
    (("mains_level", "mains_flow"), ()),
    (("low_outlet_level", "low_outlet_radius"), ()),
    (("low_outlet_valve",), ("low_outlet_level",)),
    (("valve_closed_in_frost",), ("low_outlet_valve",)),
    (("initial_cistern", "initial_roof"), ()),
    (("quiet_hours",), ("time_zone",)),
)


@dataclass(frozen=True)
class Site:
    """The parameters of Table I under the paper's symbols, and optional parameters.

    The definition of each parameter contains its unit, range and meaning; :func:`site_parameters`
    lists them.
    """

    a1: float = entry("area of the cistern's base", *_POSITIVE, unit="m2")
    a_in: float = entry(
        "catchment area from which rain flows into the cistern; in Table I, only the area of the "
        "cistern's inlet", *_POSITIVE,
        unit="m2",
    )
    z_o: float = entry("elevation of the cistern's overflow above its base", *_POSITIVE, unit="m")
    r_o: float = entry("radius of the cistern's overflow", *_POSITIVE, unit="m")
    c_d: float = entry(
        "discharge coefficient of the overflow and of the low outlet", *_POSITIVE, unit="1"
    )
    a2: float = entry("area of the rooftop vegetation", *_POSITIVE, unit="m2")
    z_veg: float = entry("desired depth of water in the substrate", *_POSITIVE, unit="m")
    x2_star: float = entry(
        "desired water volume on the roof, equal to a2 z_veg; computed if omitted", *_POSITIVE,
        unit="m3",
    )
    z_soil: float = entry("depth of the soil on the roof", *_POSITIVE, unit="m")
    z_cap: float = entry(
        "volume of water that the soil holds before it drains, equal to a2 z_soil or, for a "
        "field-capacity soil, to a2 z_soil field_capacity; computed if "
        "omitted", *_POSITIVE, unit="m3",
    )
    K: float = entry("saturated hydraulic conductivity", *_POSITIVE, unit="m/s")
    a_hat: float = entry(
        "quadratic coefficient of the pump curve in Eq. (3b); must be "
        "negative", *_NEGATIVE, unit="s2/m5",
    )
    c_hat: float = entry("constant coefficient of the pump curve in Eq. (3b)", *_POSITIVE, unit="m")
    a_pump: float = entry(
        "cross-sectional area of the flow through the pump", *_POSITIVE, unit="m2",
    )
    d: float = entry("elevation of the vegetation above the cistern's base", *_POSITIVE, unit="m")
    D: float = entry("diameter of the pipe", *_POSITIVE, unit="m")
    F: float = entry("friction factor of the pipe", *_POSITIVE, unit="1")
    k_L: float = entry("minor loss coefficient of the pipe", *_NOT_NEGATIVE, unit="1")
    l: float = entry("length of the pipe", *_POSITIVE, unit="m")  # noqa: E741 - the paper's symbol
    z_pump: float = entry(
        "elevation of the pumps above the cistern's base", *_NOT_NEGATIVE, unit="m",
    )
    z_H: float = entry(
        "minimum water level that the pumps need above their base", *_NOT_NEGATIVE, unit="m",
    )
    g: float = entry("acceleration due to gravity", *_POSITIVE, unit="m/s2")
    epsilon: float = entry(
        "steepness of the sigmoid functions in the smooth model", *_POSITIVE, unit="1",
    )
    tau: float = entry("duration of a tick", 0.001, 3600.0, unit="s")
    M: int = entry("length of the controller's look-ahead", 1, 1000, unit="ticks")
    N: int = entry("length of a run", 1, 2**40, unit="ticks")
    runoff_coefficient: float = entry(
        "share of the rain on the catchment area a_in that reaches the "
        "cistern", 0.01, 1.0, unit="1",
        default=1.0, usual=(0.75, 0.95),
    )
    field_capacity: float | None = entry(
        "volume of water that the substrate holds against gravity, per volume of substrate; if "
        "omitted, the roof has no field-capacity soil, and drains according to Eq. (4)",
        0.01, 0.9, unit="1",
        default=None,
    )
    wilting_point: float | None = entry(
        "volume of water that plants cannot take up, per volume of substrate", 0.0, 0.5, unit="1",
        default=None,
    )
    depletion_fraction: float | None = entry(
        "depletion fraction p in FAO-56 Eq. 84: the share of the water between field capacity "
        "and wilting point that plants can take up before their evapotranspiration "
        "decreases", 0.0, 0.95, unit="1", default=None,
    )
    drainage_storage: float | None = entry(
        "depth of the water in the drainage layer below the substrate when the layer is full; if "
        "omitted, the roof has no drainage layer", 0.0001, 1.0, unit="m", default=None,
    )
    drainage_time: float | None = entry(
        "time constant of the drainage layer: the storage of the full layer divided by its "
        "outflow", 1.0, 1e6,
        unit="s", default=None,
    )
    mains_level: float | None = entry(
        "water level in the cistern below which a float valve adds mains water; if omitted, the "
        "cistern has no mains supply",
        0.01, 100.0, unit="m", default=None,
    )
    mains_flow: float | None = entry(
        "flow of mains water into the cistern", 1e-6, 1.0, unit="m3/s", default=None,
    )
    low_outlet_level: float | None = entry(
        "elevation above the cistern's base of the low outlet, a throttled second outlet below "
        "the overflow that empties the detention volume between storms; if omitted, the cistern "
        "has no low outlet", 0.001,
        100.0,
        unit="m", default=None,
    )
    low_outlet_radius: float | None = entry(
        "radius of the low outlet", 0.001, 1.0, unit="m", default=None,
    )
    low_outlet_valve: bool = entry(
        "true if the low outlet has a valve, which follows /outlet/command; without a valve, the "
        "low outlet is always open", default=False,
    )
    valve_closed_in_frost: bool = entry(
        "true if the valve stays closed during frost, because it could freeze while open; false "
        "for a valve below the frost line, which works even during frost", default=False,
    )
    drainage_to_cistern: float = entry(
        "share of the roof's drainage that flows into the cistern; the rest flows to the sewer",
        0.0, 1.0, unit="1", default=0.0,
    )
    wet_after: float = entry(
        "time after rain during which the sewer still carries storm water, so that water "
        "discharged to the sewer counts as discharge in wet weather "
        "[assumed]", 0.0, 48.0, unit="h", default=2.0,
    )
    event_separation: float = entry(
        "minimum time without rain between two rain events", 0.1, 48.0, unit="h", default=6.0,
    )
    initial_cistern: float | None = entry(
        "water volume in the cistern at the start of a run; if omitted, the volume of the state "
        "low-low in Table II",
        *_NOT_NEGATIVE, unit="m3", default=None,
    )
    initial_roof: float | None = entry(
        "water volume on the roof at the start of a run; if omitted, the volume of the state "
        "low-low in Table II",
        *_NOT_NEGATIVE, unit="m3", default=None,
    )
    initial_layer: float = entry(
        "water volume in the drainage layer at the start of a run, the same for all initial states",
        *_NOT_NEGATIVE, unit="m3", default=0.0,
    )
    pump_efficiency: float = entry(
        "ratio of hydraulic to electric power of pumps and motors", 0.001, 1.0, unit="1",
        default=0.5,
    )
    starts_per_hour: float = entry(
        "maximum number of pump starts per hour; more starts cause a warning, and the controller "
        "lookahead prevents them", 1.0, 3600.0, unit="1/h", default=20.0,
    )
    latitude: float | None = entry(
        "latitude, positive to the north", -90.0, 90.0, unit="degrees", default=None,
    )
    longitude: float | None = entry(
        "longitude, positive to the east of Greenwich", -180.0, 180.0, unit="degrees", default=None,
    )
    elevation: float | None = entry(
        "elevation above mean sea level", -430.0, 6000.0, unit="m", default=None,
    )
    utc_offset: float | None = entry(
        "offset of local standard time from UTC, without daylight saving", -12.0, 14.0,
        unit="h", default=None,
    )
    albedo: float = entry(
        "albedo of the vegetation; the reference grass of FAO-56 has an albedo of "
        "0.23", 0.0, 1.0, unit="1",
        default=0.23,
    )
    k_Rs: float = entry(
        "adjustment coefficient in FAO-56 Eq. 50, which estimates solar radiation that was not "
        "measured: 0.16 inland, 0.19 near a large body of "
        "water", 0.1, 0.25, unit="degC^-0.5", default=0.16,
    )
    wind_height: float = entry(
        "height above the ground at which the wind was measured, for records in this project's "
        "format; other formats contain the wind speed at 10 m", 0.5, 100.0, unit="m",
        default=10.0,
    )
    crop_coefficient: float = entry(
        "ratio of the vegetation's evapotranspiration to that of the reference grass", 0.01, 3.0,
        unit="1", default=1.0,
    )
    monthly_evapotranspiration: tuple[float, ...] | None = entry(
        "mean reference evapotranspiration of each month, from January to December, as a list in "
        "brackets; used at a live site without a forecast, and with weather data that lack "
        "temperature", 0.0, 20.0,
        unit="mm/day", default=None,
    )
    quiet_hours: tuple[str, ...] | None = entry(
        "intervals of the day during which the pump stays off, in the local time of time_zone, "
        "such as "
        '["22:00-06:00", "12:00-13:30"]; if omitted, the pump may run at any time', default=None,
    )
    time_zone: str | None = entry(
        "IANA name of the time zone of quiet_hours and of the web page, such as America/Toronto; "
        "daylight saving time is taken into account, and the standard UTC offset of the zone "
        "must equal utc_offset", default=None,
    )
    max_dose: float | None = entry(
        "maximum volume of a dose that a person may request; if omitted, doses cannot be requested",
        0.001,
        1e6, unit="m3", default=None,
    )

    @cached_property
    def zone(self) -> tzinfo:
        """Time zone of the site's clock: ``time_zone``, or else ``utc_offset``, or else UTC."""
        if self.time_zone is not None:
            return ZoneInfo(self.time_zone)
        return timezone(timedelta(hours=self.utc_offset or 0.0))

    @cached_property
    def quiet(self) -> QuietHours | None:
        """Quiet hours of the site; None if the pump may run at any time."""
        return QuietHours(self.quiet_hours, self.zone) if self.quiet_hours else None

    @cached_property
    def effective_catchment(self) -> float:
        """Effective catchment area (m2): a_in times the runoff coefficient."""
        return self.a_in * self.runoff_coefficient

    @cached_property
    def c_out(self) -> float:
        """Coefficient of the cistern's overflow in Eq. (2) (m^2.5/s)."""
        return self._outlet_coefficient(self.r_o)

    @cached_property
    def c_low(self) -> float:
        """Coefficient of the low outlet (m^2.5/s); 0 without a low outlet."""
        return self._outlet_coefficient(self.low_outlet_radius or 0.0)

    def _outlet_coefficient(self, radius: float) -> float:
        return self.c_d * math.pi * radius**2 * math.sqrt(2 * self.g)

    @cached_property
    def min_outlet_level(self) -> float:
        """Cistern level above which water flows to the sewer (m)."""
        return self.z_o if self.low_outlet_level is None else self.low_outlet_level

    @cached_property
    def always_drains(self) -> bool:
        """Whether the cistern has a low outlet without a valve, which is always open."""
        return self.low_outlet_level is not None and not self.low_outlet_valve

    @cached_property
    def b(self) -> float:
        """Coefficient of the maximum flow in Eq. (3e) (m^2.5/s)."""
        return 1 / math.sqrt(self.pipe_resistance - self.a_hat)

    @cached_property
    def pipe_resistance(self) -> float:
        """Friction and minor head losses per squared flow in Eq. (3c) (s2/m5)."""
        return (self.F * self.l / self.D + self.k_L) / (2 * self.g * self.a_pump**2)

    @cached_property
    def suction_level(self) -> float:
        """Minimum cistern level at which the pumps work, z_pump + z_H (m), Eq. (3a)."""
        return self.z_pump + self.z_H

    @cached_property
    def wilting_volume(self) -> float:
        """Volume of water in a field-capacity soil that plants cannot take up (m3)."""
        return self.a2 * self.z_soil * (self.wilting_point or 0.0)

    @cached_property
    def available_volume(self) -> float:
        """Total available water, between field capacity and wilting point, FAO-56 Eq. 82 (m3)."""
        return self.z_cap - self.wilting_volume

    @cached_property
    def stress_onset(self) -> float:
        """Share of available water below which stress begins: 1 - p, FAO-56 Eq. 84 (1)."""
        return 1 - (self.depletion_fraction or 0.0)

    @cached_property
    def layer_storage(self) -> float:
        """Volume of water in the full drainage layer (m3); 0 without a drainage layer."""
        return self.a2 * (self.drainage_storage or 0.0)

    @property
    def max_cistern_level(self) -> float:
        """Maximum plausible water level in the cistern: three times the overflow's level (m)."""
        return 3 * self.z_o

    @property
    def max_roof_level(self) -> float:
        """Maximum plausible water level on the roof: twice the depth of its soil (m)."""
        return 2 * self.z_soil

    @property
    def clock_offset(self) -> float:
        """UTC offset in the site file, or else the whole hour that is closest to solar time (h)."""
        solar = float(round((self.longitude or 0.0) / 15))
        return solar if self.utc_offset is None else self.utc_offset

    def of_weather(self) -> Site:
        """Return a site that keeps only the parameters that affect the weather; others are 0.

        Weather that is read for the returned site is the same for all sites that share these
        parameters.
        """
        others: dict[str, Any] = dict.fromkeys(asdict(self).keys() - _OF_WEATHER, 0)
        return replace(self, **others)

    def climatic_evapotranspiration(self, month: int) -> float | None:
        """Return the mean evapotranspiration in a month, 1 to 12 (m3/s); None if unknown."""
        if self.monthly_evapotranspiration is None:
            return None
        reference = self.monthly_evapotranspiration[month - 1]
        return self.crop_coefficient * reference / 1000 / 86400 * self.a2

    def cistern_level(self, x1: float) -> float:
        """Return the depth (m) of a water volume x1 (m3) in the cistern."""
        return x1 / self.a1

    def roof_level(self, x2: float) -> float:
        """Return the depth (m) of a water volume x2 (m3) on the roof.

        On a field-capacity soil, x2 is the water in the substrate, excluding the water in the
        drainage layer.
        """
        return x2 / self.a2

    def cistern_volume(self, level: float) -> float:
        """Return the water volume (m3) for a depth (m) in the cistern."""
        return level * self.a1

    def roof_volume(self, level: float) -> float:
        """Return the water volume (m3) for a depth (m) on the roof."""
        return level * self.a2


def _product(name: str, site: Site) -> float:
    """Return a volume that is the product of other parameters (m3)."""
    factors: list[float | None] = [getattr(site, factor) for factor in _FOLLOW_FROM[name]]
    return math.prod(factor for factor in factors if factor is not None)


def find_unheld(site: Site, x1: float, x2: float) -> Iterator[tuple[str, float, str]]:
    """Yield each store (``cistern`` or ``roof``) that cannot hold its volume, and a message.

    A volume that exceeds what any rain could produce indicates a wrong unit.

    Args:
        site: the site.
        x1: volume in the cistern (m3).
        x2: volume on the roof (m3).
    """
    full = site.roof_level(site.z_cap)
    cistern = f"its overflow is at {site.z_o:g} m, and the roof is {site.d:g} m above its base"
    roof = (
        f"the soil holds {site.z_cap:g} m3 ({full:g} m), and up to {_MAX_PONDED:g} m of water "
        "can stand on its surface"
    )
    for name, volume, area, level, why in (
        ("cistern", x1, site.a1, max(site.d, _ABOVE_OUTLET * site.z_o), cistern),
        ("roof", x2, site.a2, full + _MAX_PONDED, roof),
    ):
        if volume > level * area:
            yield name, volume, (
                f"must be at most {level * area:g} m3, which is a level of {level:g} m ({why}); "
                f"is the unit wrong? The value must be a volume in m3; a level of {volume:g} mm "
                f"corresponds to {volume / 1000 * area:g} m3"
            )


def site_parameters() -> list[Parameter]:
    """Return all parameters of a site, starting with those of Table I in the order of the table.

    A parameter that has no default value is listed with the default None.
    """
    return parameters_of(Site)


SITE_KEYS = (*(parameter.name for parameter in site_parameters()), *PLAIN)
"""keys that a site file may contain, except ``extends``"""


def format_site(site: Site, notes: Mapping[str, str] | None = None) -> str:
    """Return the text of a complete site file, from which :func:`read_site` reads the same site.

    Args:
        site: the site.
        notes: comments on some parameters, by name; the default is the meaning of the parameter.
    """
    lines = []
    for parameter, value in zip(site_parameters(), asdict(site).values(), strict=True):
        if value is not None:
            entry = f"{parameter.name}: {json.dumps(value)}"
            note = (notes or {}).get(parameter.name, parameter.meaning)
            lines.append(f"{entry:<29} # {parameter.unit:<7} {note}\n")
    return "".join(lines)


def _entries(path: Path, extended_by: tuple[Path, ...] = ()) -> dict[str, Entry]:
    """Return the entries of a site file by key, including those of the file that it extends.

    The site file's own entries take precedence.
    """
    mapping = read_yaml(path)
    entries = {key: Entry(value, path, mapping.lines[key]) for key, value in mapping.items()}
    if _EXTENDS not in entries:
        return override({}, entries)
    base, _, line, _ = entries.pop(_EXTENDS)
    chain = (*extended_by, path.resolve())
    expected = (
        "must be the name of another site file, such as site.yaml, in the same directory or in "
        "this package"
    )
    if isinstance(base, str) and is_there(following := _base(path, base)):
        if following.resolve() not in chain:
            return override(_entries(following, chain), entries)
        ring = [*chain[chain.index(following.resolve()):], following.resolve()]
        expected += f"; these files form a loop: {' extends '.join(map(str, ring))}"
    raise ConfigurationError(expected, file=path, line=line, key=_EXTENDS, value=base)


def _base(path: Path, name: str) -> Path:
    """Return the file that a site file extends: in its own directory, or from this package."""
    own, shipped = Path(path).parent / name, shared_directory() / "config" / name
    return shipped if is_there(shipped) and not is_there(own) else own


def read_site(path: Path, changes: Mapping[str, Any] | None = None) -> Site:
    """Read and check a site file such as ``config/site.yaml``.

    A site file can extend another file (``extends: site.yaml``) in its own directory or from this
    package, and then contains only the differences.

    Args:
        path: path of the file.
        changes: values of parameters or plain keys that replace those in the file. Volumes that
            depend on the changed parameters are adjusted: the products x2_star and z_cap, and the
            initial volumes (the filled share of the cistern and the level on the roof stay the
            same).

    Raises:
        ConfigurationError: if a parameter is missing, unknown, not a number, outside its range, or
            inconsistent with another parameter; the message names the file, line, key and value.
    """
    file = SiteFile(path)
    return file.change(changes) if changes else file.site


class SiteFile:
    """A site file that is read once, and from which sites with changed values can be derived.

    Attributes:
        site: site with the values in the file.
    """

    def __init__(self, path: Path) -> None:
        """Read and check the file; see :func:`read_site`."""
        self._path, self._entries = path, _entries(path)
        self.site = _site_of(self._entries, path)

    def change(self, changes: Mapping[str, Any]) -> Site:
        """Return the site with some values changed; see :func:`read_site`."""
        site, entries = self.site, self._entries
        new = override(entries, {name: Entry(value) for name, value in changes.items()})
        changed, named = _record_of(new, self._path)
        followed = False
        for volume, factors in _FOLLOW.items():
            if volume not in entries or volume in changes:
                continue
            ratio = math.prod(
                (getattr(changed, name) or 1.0) / (getattr(site, name) or 1.0) for name in factors
            )
            if ratio != 1:
                new[volume], followed = Entry(getattr(site, volume) * ratio), True
        return _site_of(new, self._path) if followed else _check(changed, named, self._path)


def merge_site_file(path: Path, changes: Mapping[str, Any]) -> str:
    """Return the merged text of a site file and of the files that it extends.

    Plain keys are kept, so that the parameters that they determine still depend on other changes.
    For example, a pump's flow still follows from the irrigation rate and the roof's area.

    Args:
        path: path of the file.
        changes: as for :func:`read_site`.

    Raises:
        ConfigurationError: if a file cannot be read.
    """
    own = {name: Entry(value) for name, value in changes.items()}
    entries = override(_entries(path), own)
    return "".join(f"{name}: {json.dumps(each.value)}\n" for name, each in entries.items())


def check_site(site: Site) -> Site:
    """Check a site that a program created, and return it with its values as Python numbers.

    Raises:
        ConfigurationError: if a value is invalid, as in :func:`read_site`; the message names the
            key and the value.
    """
    values = {field.name: getattr(site, field.name) for field in fields(site)}
    return _site_of({name: Entry(value) for name, value in values.items() if value is not None})


def _site_of(entries: Mapping[str, Entry], path: Path | None = None) -> Site:
    """Check entries, and return the site that they describe; the path is None without a file."""
    return _check(*_record_of(entries, path), path)


def _check(site: Site, named: Mapping[str, Entry], path: Path | None) -> Site:
    """Return a site after checking that its parameters do not contradict each other."""
    with _add_place_to_errors(named, path):
        for name, expected in _contradictions(site, named):
            value = named[name].value
            raise ConfigurationError(
                expected, key=name, value=getattr(site, name) if named[name].plain else value
            )
    return site


def _record_of(
    entries: Mapping[str, Entry], path: Path | None
) -> tuple[Site, dict[str, Entry]]:
    """Check each entry on its own; return the site, and its entries under the paper's names."""
    with _add_place_to_errors(entries, path):
        for name, (value, *_) in entries.items():
            if name not in SITE_KEYS:
                raise ConfigurationError(
                    f"is not a valid key; {suggest_names(name, SITE_KEYS)}", key=name, value=value
                )
        named, following = translate(entries)
    with _add_place_to_errors(named, path):
        values = {name: each.value for name, each in named.items()}
        omitted = _FOLLOW_FROM.keys() - named.keys()
        site = make_record(Site, {**values, **dict.fromkeys(omitted, 1.0)})
    computed: dict[str, Any] = {name: compute(site) for name, compute in following.items()}
    site = replace(site, **computed)
    products: dict[str, Any] = {name: _product(name, site) for name in omitted}
    return replace(site, **products), named


@contextmanager
def _add_place_to_errors(entries: Mapping[str, Entry], path: Path | None) -> Iterator[None]:
    """Add the file and line to an error about an entry, or advice on adding a missing entry."""
    try:
        yield
    except ConfigurationError as error:
        name, expected = str(error.key).partition(".")[0], error.expected
        given = entries.get(name, Entry(None, path))
        if name not in entries:
            expected += (
                "; add it, or begin the file with 'extends: site.yaml' to use the paper's values "
                "for all missing keys"
            )
        raise ConfigurationError(
            expected, file=given.file, line=given.line, value=error.value,
            key=f"{given.plain} ({error.key})" if given.plain else error.key,
        ) from None


def _standard_offsets(zone: str) -> list[float]:
    """Return the UTC offsets (h) that a time zone's standard time has had since 2010.

    In Ireland, summer time is the standard time by law; the offset of its winter time is included
    as well.
    """
    days = (
        datetime(year, month, day, tzinfo=ZoneInfo(zone))
        for year in range(2010, LAST_YEAR + 1) for month in range(1, 13) for day in (1, 15)
    )
    offsets = [((day.utcoffset() or timedelta()) / timedelta(hours=1), day.dst()) for day in days]
    return sorted({min(offsets)[0], *(offset for offset, saved in offsets if not saved)})


def _other_zone(zone: str, utc_offset: float, offsets: list[float]) -> str:
    """Return the reason for rejecting a time zone whose standard offset is different."""
    found = " or ".join(f"{offset:+g} h" for offset in offsets)
    expected = (
        f"must be a time zone whose standard UTC offset is utc_offset = {utc_offset:+g} h, but "
        f"the standard offset of {zone} is {found}"
    )
    if zone.startswith("Etc/GMT"):
        expected += "; in names that begin with Etc/ the sign is reversed: Etc/GMT+5 is UTC-05:00"
    return expected


def _contradictions(site: Site, entries: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield each parameter that contradicts other parameters, and a description of valid values.

    Args:
        site: site with all parameters in their ranges.
        entries: names of the parameters in the site file.
    """
    for name in entries:
        if getattr(site, name) is None:
            yield name, NO_VALUE
    for name, (make, expected) in _OF_CLOCK.items():
        try:
            if name in entries:
                make(getattr(site, name))
        except (OSError, ValueError, KeyError):
            yield name, expected
    if site.monthly_evapotranspiration and len(site.monthly_evapotranspiration) != 12:
        yield "monthly_evapotranspiration", "must be a list of twelve numbers, January to December"
    for name, topic in (("z_o", "/cistern/level"), ("z_veg", "/roof/level")):
        high = read_topics()[topic].high
        if _ABOVE_OUTLET * getattr(site, name) > high:
            yield name, (
                f"must be at most {high / _ABOVE_OUTLET:.4g} m, since levels above {high:g} m "
                "are rejected; is a unit wrong?"
            )
    for names, further in _TOGETHER:
        there = {name for name in entries if getattr(site, name) is not False}
        present = [name for name in names if name in there]
        missing = [name for name in (*names, *further) if name not in there]
        if present and missing:
            yield present[0], f"needs {', '.join(missing)} as well"
    if site.time_zone is not None and site.utc_offset is not None:
        offsets = _standard_offsets(site.time_zone)
        if site.utc_offset not in offsets:
            yield "time_zone", _other_zone(site.time_zone, site.utc_offset, offsets)
    outlet, name, suction = site.min_outlet_level, "z_o", site.suction_level
    if site.low_outlet_level is not None:
        name = "low_outlet_level"
        if outlet >= site.z_o:
            yield name, f"must be below z_o = {site.z_o:g} m, the level of the overflow"
        if outlet <= suction:
            yield name, (
                f"must be above z_pump + z_H = {suction:g} m; otherwise the low outlet drains "
                "all usable water"
            )
    if site.mains_level is not None and not suction < site.mains_level < outlet:
        yield "mains_level", (
            f"must be above z_pump + z_H = {suction:g} m, below which the pumps do not work, and "
            f"below {name} = {outlet:g} m; otherwise mains water flows to the sewer"
        )
    if site.initial_layer > site.layer_storage:
        yield "initial_layer", (
            "must be at most the volume of the drainage layer, a2 drainage_storage = "
            f"{site.layer_storage:g} m3"
        )
    if site.initial_cistern is not None and site.initial_roof is not None:
        for name, _, expected in find_unheld(site, site.initial_cistern, site.initial_roof):
            yield f"initial_{name}", expected
    if site.field_capacity is not None:
        soil_volume = site.a2 * site.z_soil
        if site.wilting_volume >= soil_volume * site.field_capacity:
            yield "wilting_point", f"must be below field_capacity = {site.field_capacity:g}"
        if site.wilting_volume >= site.x2_star:
            yield "wilting_point", (
                f"must be below x2_star / (a2 z_soil) = {site.x2_star / soil_volume:g}; "
                "otherwise plants take up no water at the target"
            )
    for name, factors in _FOLLOW_FROM.items():
        product = _product(name, site)
        if not math.isclose(getattr(site, name), product, rel_tol=_ROUNDING):
            formula = " ".join(name for name in factors if getattr(site, name) is not None)
            yield name, (
                f"must be {formula} = {product:g} m3; leave this line out to have it computed"
            )
    if site.z_veg >= site.z_soil:
        yield "z_veg", (
            f"must be below z_soil = {site.z_soil:g} m: the water in the soil cannot be deeper "
            "than the soil"
        )
    if site.x2_star >= site.z_cap:
        yield "z_veg", (
            f"must be below z_cap / a2 = {site.z_cap / site.a2:g} m: water above this level "
            "drains off"
        )
    if site.c_hat - site.d + site.suction_level <= 0:
        yield "c_hat", (
            f"must exceed d - z_pump - z_H = {site.d - site.suction_level:g} m; otherwise the "
            "pumps cannot lift water to the roof (Eq. 3e)"
        )
    if site.tau * 1e9 != round(site.tau * 1e9):
        yield "tau", "must be a whole number of nanoseconds"
