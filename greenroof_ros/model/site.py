"""The site: Table I of the paper and its place on earth, read from a YAML file and checked."""

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
from greenroof_ros.model.plain_keys import NO_VALUE, PLAIN, Entry, override, translate
from greenroof_ros.model.quiet_hours import QuietHours

# Bounds of all sites' parameters: within them, nothing that is computed overflows.
_POSITIVE, _NOT_NEGATIVE = (1e-12, 1e9), (0.0, 1e9)
# Bounds of a pump curve; a constant flow of 1 l/h is -1.3e19 (model/plain_keys.py).
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
        'must be times of day in brackets, such as ["22:00-06:00", "12:00-13:30"], and must leave '
        "time to pump",
    ),
    "time_zone": (
        ZoneInfo,
        "must be the IANA name of a time zone that this machine knows (package tzdata), such as "
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
    """The parameters of Table I under the paper's symbols, and optional ones.

    Unit, range and meaning of each are next to it; :func:`site_parameters` lists them.
    """

    a1: float = entry("area of the cistern's base", *_POSITIVE, unit="m2")
    a_in: float = entry(
        "area whose rain flows into the cistern; in Table I the area of its inlet", *_POSITIVE,
        unit="m2",
    )
    z_o: float = entry("elevation of the cistern's overflow", *_POSITIVE, unit="m")
    r_o: float = entry("radius of the cistern's overflow", *_POSITIVE, unit="m")
    c_d: float = entry(
        "discharge coefficient of the overflow and of the low outlet", *_POSITIVE, unit="1"
    )
    a2: float = entry("area of the rooftop vegetation", *_POSITIVE, unit="m2")
    z_veg: float = entry("desired water in the substrate, as a depth", *_POSITIVE, unit="m")
    x2_star: float = entry(
        "desired water volume on the roof: a2 z_veg; computed if omitted", *_POSITIVE,
        unit="m3",
    )
    z_soil: float = entry("soil depth of the roof", *_POSITIVE, unit="m")
    z_cap: float = entry(
        "water that the soil holds before it drains: a2 z_soil; for field-capacity soil, a2 z_soil "
        "field_capacity; computed if omitted", *_POSITIVE, unit="m3",
    )
    K: float = entry("saturated hydraulic conductivity", *_POSITIVE, unit="m/s")
    a_hat: float = entry(
        "coefficient of the pump curve, negative, Eq. (3b)", *_NEGATIVE, unit="s2/m5",
    )
    c_hat: float = entry("coefficient of the pump curve, Eq. (3b)", *_POSITIVE, unit="m")
    a_pump: float = entry("area of flow through the pump", *_POSITIVE, unit="m2")
    d: float = entry("elevation of the vegetation relative to the cistern", *_POSITIVE, unit="m")
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
    epsilon: float = entry("steepness of the smooth model's sigmoids", *_POSITIVE, unit="1")
    tau: float = entry("duration of a tick", 0.001, 3600.0, unit="s")
    M: int = entry("look-ahead of the controller", 1, 1000, unit="ticks")
    N: int = entry("length of a run", 1, 2**40, unit="ticks")
    runoff_coefficient: float = entry(
        "share of the rain on the catchment, a_in, that reaches the cistern", 0.01, 1.0, unit="1",
        default=1.0, usual=(0.75, 0.95),
    )
    field_capacity: float | None = entry(
        "water that the substrate holds against gravity, per volume of substrate; if given, the "
        "roof has a field-capacity soil; if omitted, it drains according to Eq. (4)",
        0.01, 0.9, unit="1",
        default=None,
    )
    wilting_point: float | None = entry(
        "water that plants cannot take up, per volume of substrate", 0.0, 0.5, unit="1",
        default=None,
    )
    depletion_fraction: float | None = entry(
        "p of FAO-56 Eq. 84: share of the water between field capacity and wilting point that "
        "plants take up before they evaporate less", 0.0, 0.95, unit="1", default=None,
    )
    drainage_storage: float | None = entry(
        "depth of water in the full drainage layer below the substrate; if omitted, the roof has "
        "no drainage layer", 0.0001, 1.0, unit="m", default=None,
    )
    drainage_time: float | None = entry(
        "time constant of the full drainage layer: its storage divided by its outflow", 1.0, 1e6,
        unit="s", default=None,
    )
    mains_level: float | None = entry(
        "cistern level below which a valve lets mains water in; if omitted, there is no such valve",
        0.01, 100.0, unit="m", default=None,
    )
    mains_flow: float | None = entry("inflow from the mains", 1e-6, 1.0, unit="m3/s", default=None)
    low_outlet_level: float | None = entry(
        "elevation of a second, throttled outlet of the cistern, below the first: it empties the "
        "detention volume above it between storms; if omitted, there is no such outlet", 0.001,
        100.0,
        unit="m", default=None,
    )
    low_outlet_radius: float | None = entry(
        "radius of the low outlet", 0.001, 1.0, unit="m", default=None,
    )
    low_outlet_valve: bool = entry(
        "whether a valve opens and closes the low outlet, as /outlet/command requests; without a "
        "valve, the outlet is always open", default=False,
    )
    valve_closed_in_frost: bool = entry(
        "whether the valve is closed in frost, because it could freeze open; a valve below the "
        "frost line also works in frost", default=False,
    )
    drainage_to_cistern: float = entry(
        "share of the roof's drainage that flows into the cistern; the rest reaches the sewer",
        0.0, 1.0, unit="1", default=0.0,
    )
    wet_after: float = entry(
        "time after rain during which the sewer still carries storm water, so water that reaches "
        "it counts as discharge in wet weather [assumed]", 0.0, 48.0, unit="h", default=2.0,
    )
    event_separation: float = entry(
        "minimum time without rain between two rain events", 0.1, 48.0, unit="h", default=6.0,
    )
    initial_cistern: float | None = entry(
        "volume in the cistern at the start of a run; if omitted, that of low-low in Table II",
        *_NOT_NEGATIVE, unit="m3", default=None,
    )
    initial_roof: float | None = entry(
        "volume on the roof at the start of a run; if omitted, that of low-low in Table II",
        *_NOT_NEGATIVE, unit="m3", default=None,
    )
    initial_layer: float = entry(
        "volume in the drainage layer at the start of a run, whatever the initial state",
        *_NOT_NEGATIVE, unit="m3", default=0.0,
    )
    pump_efficiency: float = entry(
        "ratio of hydraulic to electric power of pumps and motors", 0.001, 1.0, unit="1",
        default=0.5,
    )
    starts_per_hour: float = entry(
        "how many times an hour the pumps may start; a warning is given if they start more often, "
        "and lookahead does not let them", 1.0, 3600.0, unit="1/h", default=20.0,
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
        "albedo of the vegetation; 0.23 is FAO-56's reference grass", 0.0, 1.0, unit="1",
        default=0.23,
    )
    k_Rs: float = entry(
        "adjustment coefficient of FAO-56 Eq. 50, for radiation that was not measured: 0.16 "
        "inland, 0.19 near a large body of water", 0.1, 0.25, unit="degC^-0.5", default=0.16,
    )
    wind_height: float = entry(
        "height above the ground at which the wind was measured, for records in this project's "
        "format; others are at 10 m", 0.5, 100.0, unit="m",
        default=10.0,
    )
    crop_coefficient: float = entry(
        "ratio of the vegetation's evapotranspiration to that of the reference grass", 0.01, 3.0,
        unit="1", default=1.0,
    )
    monthly_evapotranspiration: tuple[float, ...] | None = entry(
        "means of the reference evapotranspiration, January to December, in brackets; used by a "
        "live site without a forecast, and for weather without temperature", 0.0, 20.0,
        unit="mm/day", default=None,
    )
    quiet_hours: tuple[str, ...] | None = entry(
        "times of day in which the pump stays off, on the clock of time_zone, such as "
        '["22:00-06:00", "12:00-13:30"]; if omitted, it may run at any time', default=None,
    )
    time_zone: str | None = entry(
        "IANA name of the time zone of quiet_hours and of the page, such as America/Toronto; it "
        "includes daylight saving; its standard time is utc_offset", default=None,
    )
    max_dose: float | None = entry(
        "maximum volume of a dose that a person requests; if omitted, no doses can be requested",
        0.001,
        1e6, unit="m3", default=None,
    )

    @cached_property
    def zone(self) -> tzinfo:
        """Its clock: ``time_zone``, which may have daylight saving, or ``utc_offset``, or UTC."""
        if self.time_zone is not None:
            return ZoneInfo(self.time_zone)
        return timezone(timedelta(hours=self.utc_offset or 0.0))

    @cached_property
    def quiet(self) -> QuietHours | None:
        """Its quiet hours; None if the pump may run at any time."""
        return QuietHours(self.quiet_hours, self.zone) if self.quiet_hours else None

    @cached_property
    def effective_catchment(self) -> float:
        """Area whose rain would all reach the cistern (m2): a_in times its runoff coefficient."""
        return self.a_in * self.runoff_coefficient

    @cached_property
    def c_out(self) -> float:
        """Coefficient of the cistern's overflow (m^2.5/s), Eq. (2)."""
        return self._outlet_coefficient(self.r_o)

    @cached_property
    def c_low(self) -> float:
        """Coefficient of the low outlet (m^2.5/s); 0 if there is none."""
        return self._outlet_coefficient(self.low_outlet_radius or 0.0)

    def _outlet_coefficient(self, radius: float) -> float:
        return self.c_d * math.pi * radius**2 * math.sqrt(2 * self.g)

    @cached_property
    def min_outlet_level(self) -> float:
        """Cistern level above which water leaves for the sewer (m)."""
        return self.z_o if self.low_outlet_level is None else self.low_outlet_level

    @cached_property
    def always_drains(self) -> bool:
        """Whether water always leaves through a low outlet: there is one, and it has no valve."""
        return self.low_outlet_level is not None and not self.low_outlet_valve

    @cached_property
    def b(self) -> float:
        """Coefficient of the maximum flow (m^2.5/s), Eq. (3e)."""
        return 1 / math.sqrt(self.pipe_resistance - self.a_hat)

    @cached_property
    def pipe_resistance(self) -> float:
        """Friction and minor head loss per squared flow (s2/m5), Eq. (3c)."""
        return (self.F * self.l / self.D + self.k_L) / (2 * self.g * self.a_pump**2)

    @cached_property
    def suction_level(self) -> float:
        """Minimum cistern level at which the pumps work, z_pump + z_H (m), Eq. (3a)."""
        return self.z_pump + self.z_H

    @cached_property
    def wilting_volume(self) -> float:
        """Water in field-capacity soil that plants cannot take (m3)."""
        return self.a2 * self.z_soil * (self.wilting_point or 0.0)

    @cached_property
    def available_volume(self) -> float:
        """TAW: what plants can take from the soil at field capacity (m3), FAO-56 Eq. 82."""
        return self.z_cap - self.wilting_volume

    @cached_property
    def stress_onset(self) -> float:
        """Filled share below which plants evaporate less (1), 1 - p of FAO-56 Eq. 84."""
        return 1 - (self.depletion_fraction or 0.0)

    @cached_property
    def layer_storage(self) -> float:
        """Volume of the full drainage layer (m3); 0 if there is none."""
        return self.a2 * (self.drainage_storage or 0.0)

    @property
    def max_cistern_level(self) -> float:
        """Three times the outlet's level (m): a higher reading is not a level in metres."""
        return 3 * self.z_o

    @property
    def max_roof_level(self) -> float:
        """Twice the soil's depth (m): a higher reading is not a level in metres."""
        return 2 * self.z_soil

    @property
    def clock_offset(self) -> float:
        """Offset from UTC (h): the file's, or else the whole hour that is closest to solar time."""
        solar = float(round((self.longitude or 0.0) / 15))
        return solar if self.utc_offset is None else self.utc_offset

    def of_weather(self) -> Site:
        """Return a site with only what weather depends on; its other parameters are 0.

        Weather is read for this site, so it is the same for all sites that share these parameters.
        """
        others: dict[str, Any] = dict.fromkeys(asdict(self).keys() - _OF_WEATHER, 0)
        return replace(self, **others)

    def climatic_evapotranspiration(self, month: int) -> float | None:
        """Mean evapotranspiration from the bed in a month, 1 to 12 (m3/s); None if unknown."""
        if self.monthly_evapotranspiration is None:
            return None
        reference = self.monthly_evapotranspiration[month - 1]
        return self.crop_coefficient * reference / 1000 / 86400 * self.a2

    def cistern_level(self, x1: float) -> float:
        """Depth of a water volume x1 (m3) in the cistern (m)."""
        return x1 / self.a1

    def roof_level(self, x2: float) -> float:
        """Depth of a water volume x2 (m3) on the roof (m).

        On field-capacity soil this is the water in the substrate, without the drainage layer.
        """
        return x2 / self.a2

    def cistern_volume(self, level: float) -> float:
        """Water volume (m3) at a depth in the cistern (m)."""
        return level * self.a1

    def roof_volume(self, level: float) -> float:
        """Water volume (m3) at a depth on the roof (m)."""
        return level * self.a2


def _product(name: str, site: Site) -> float:
    """Return a volume that is the product of other parameters (m3)."""
    factors: list[float | None] = [getattr(site, factor) for factor in _FOLLOW_FROM[name]]
    return math.prod(factor for factor in factors if factor is not None)


def find_unheld(site: Site, x1: float, x2: float) -> Iterator[tuple[str, float, str]]:
    """Yield ``cistern`` and ``roof`` if the site cannot hold its volume, and what would be right.

    No rain can lead to such a state, so a unit is wrong.

    Args:
        site: the site.
        x1: volume in the cistern (m3).
        x2: volume on the roof (m3).
    """
    full = site.roof_level(site.z_cap)
    cistern = f"its outlet is at {site.z_o:g} m, and the roof {site.d:g} m above its base"
    roof = (
        f"the soil holds {site.z_cap:g} m3 ({full:g} m), and up to {_MAX_PONDED:g} m can stand on "
        "it"
    )
    for name, volume, area, level, why in (
        ("cistern", x1, site.a1, max(site.d, _ABOVE_OUTLET * site.z_o), cistern),
        ("roof", x2, site.a2, full + _MAX_PONDED, roof),
    ):
        if volume > level * area:
            yield name, volume, (
                f"must be at most {level * area:g} m3, a level of {level:g} m ({why}); is a "
                f"unit wrong? It is a volume in m3; a level of {volume:g} mm is "
                f"{volume / 1000 * area:g} m3"
            )


def site_parameters() -> list[Parameter]:
    """Return all parameters of a site, in the order of Table I, with the place last.

    The default is None if there is none.
    """
    return parameters_of(Site)


SITE_KEYS = (*(parameter.name for parameter in site_parameters()), *PLAIN)
"""what a site file may contain, besides the file that it extends"""


def format_site(site: Site, notes: Mapping[str, str] | None = None) -> str:
    """Return the text of a complete site file, which :func:`read_site` reads as a site.

    Args:
        site: the site.
        notes: words after the value of some parameters, by name; by default, the meaning.
    """
    lines = []
    for parameter, value in zip(site_parameters(), asdict(site).values(), strict=True):
        if value is not None:
            entry = f"{parameter.name}: {json.dumps(value)}"
            note = (notes or {}).get(parameter.name, parameter.meaning)
            lines.append(f"{entry:<29} # {parameter.unit:<7} {note}\n")
    return "".join(lines)


def _entries(path: Path, extended_by: tuple[Path, ...] = ()) -> dict[str, Entry]:
    """Return the entries of a site file by key, including the file that it extends.

    The site file's own entries take precedence.
    """
    mapping = read_yaml(path)
    entries = {key: Entry(value, path, mapping.lines[key]) for key, value in mapping.items()}
    if _EXTENDS not in entries:
        return override({}, entries)
    base, _, line, _ = entries.pop(_EXTENDS)
    chain = (*extended_by, path.resolve())
    expected = (
        "must be the name of another site file, such as site.yaml, next to this one or of this "
        "package"
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

    It can extend another file (``extends: site.yaml``) in its own directory or from this package.
    It then contains only the differences.

    Args:
        path: path of the file.
        changes: parameters, or plain keys, whose values differ from the file's. Volumes that depend
            on them change with them: the products x2_star and z_cap, and the initial volumes (the
            share of the cistern and the level on the roof stay the same).

    Raises:
        ConfigurationError: if a parameter is missing, unknown, not a number, out of its range, or
            inconsistent with another; the message names file, line, key and value.
    """
    file = SiteFile(path)
    return file.change(changes) if changes else file.site


class SiteFile:
    """A site file that has been read, for many sites that differ from it in some values.

    Attributes:
        site: as it is in the file.
    """

    def __init__(self, path: Path) -> None:
        """Read and check the file; see :func:`read_site`."""
        self._path, self._entries = path, _entries(path)
        self.site = _site_of(self._entries, path)

    def change(self, changes: Mapping[str, Any]) -> Site:
        """Return the site with other values than in the file; see :func:`read_site`."""
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
    """Return the text of a site file and of those that it extends, as one file.

    Plain keys stay, so that what they stand for still follows from further changes; for example, a
    pump's flow follows from an irrigation rate and the roof's area.

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
    """Return a site that a program passes, with its numbers as Python numbers.

    Raises:
        ConfigurationError: as for :func:`read_site`; the message names key and value.
    """
    values = {field.name: getattr(site, field.name) for field in fields(site)}
    return _site_of({name: Entry(value) for name, value in values.items() if value is not None})


def _site_of(entries: Mapping[str, Entry], path: Path | None = None) -> Site:
    """Return the site with checked entries, from a file unless a program passes them."""
    return _check(*_record_of(entries, path), path)


def _check(site: Site, named: Mapping[str, Entry], path: Path | None) -> Site:
    """Return a site after checking that its parameters, each in its range, do not conflict."""
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
    """Return the site of entries, each checked alone, and its entries by the paper's names."""
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
    """Add file and line to an error about an entry, or how to add a missing one."""
    try:
        yield
    except ConfigurationError as error:
        name, expected = str(error.key).partition(".")[0], error.expected
        given = entries.get(name, Entry(None, path))
        if name not in entries:
            expected += (
                "; add it, or begin the file with 'extends: site.yaml' to use the paper's values "
                "for all keys that are missing"
            )
        raise ConfigurationError(
            expected, file=given.file, line=given.line, value=error.value,
            key=f"{given.plain} ({error.key})" if given.plain else error.key,
        ) from None


def _standard_offsets(zone: str) -> list[float]:
    """Return a time zone's offsets from UTC (h) without daylight saving, since 2010.

    Where winter time is the exception by law, as in Ireland, its offset counts as one, too.
    """
    days = (
        datetime(year, month, day, tzinfo=ZoneInfo(zone))
        for year in range(2010, LAST_YEAR + 1) for month in range(1, 13) for day in (1, 15)
    )
    offsets = [((day.utcoffset() or timedelta()) / timedelta(hours=1), day.dst()) for day in days]
    return sorted({min(offsets)[0], *(offset for offset, saved in offsets if not saved)})


def _other_zone(zone: str, utc_offset: float, offsets: list[float]) -> str:
    """Return why a time zone is rejected whose standard offset is a different one."""
    found = " or ".join(f"{offset:+g} h" for offset in offsets)
    expected = f"must be the zone of utc_offset, {utc_offset:+g} h; its standard time is {found}"
    if zone.startswith("Etc/GMT"):
        expected += "; in names that begin with Etc/ the sign is reversed: Etc/GMT+5 is UTC-05:00"
    return expected


def _contradictions(site: Site, entries: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield every parameter that contradicts others, and what would be right.

    Args:
        site: site with all parameters in their ranges.
        entries: names of the parameters in its file.
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
        yield "monthly_evapotranspiration", "must be twelve numbers, January to December"
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
            yield name, f"must be below z_o = {site.z_o:g} m, the outlet above it"
        if outlet <= suction:
            yield name, (
                f"must be above z_pump + z_H = {suction:g} m, otherwise it drains all usable water"
            )
    if site.mains_level is not None and not suction < site.mains_level < outlet:
        yield "mains_level", (
            f"must be above z_pump + z_H = {suction:g} m, below which the pumps do not work, and "
            f"below {name} = {outlet:g} m, otherwise its water flows to the sewer"
        )
    if site.initial_layer > site.layer_storage:
        yield "initial_layer", (
            "must be at most what the drainage layer holds, a2 drainage_storage = "
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
                f"must be below x2_star / (a2 z_soil) = {site.x2_star / soil_volume:g}, or else "
                "plants take no water at the target"
            )
    for name, factors in _FOLLOW_FROM.items():
        product = _product(name, site)
        if not math.isclose(getattr(site, name), product, rel_tol=_ROUNDING):
            formula = " ".join(name for name in factors if getattr(site, name) is not None)
            yield name, (
                f"must be {formula} = {product:g} m3; leave this line out and it is computed"
            )
    if site.z_veg >= site.z_soil:
        yield "z_veg", (
            f"must be below z_soil = {site.z_soil:g} m: soil cannot hold more than its depth"
        )
    if site.x2_star >= site.z_cap:
        yield "z_veg", (
            f"must be below z_cap / a2 = {site.z_cap / site.a2:g} m: water above that drains off"
        )
    if site.c_hat - site.d + site.suction_level <= 0:
        yield "c_hat", (
            f"must exceed d - z_pump - z_H = {site.d - site.suction_level:g} m, or the pumps never "
            "lift water to the roof (Eq. 3e)"
        )
    if site.tau * 1e9 != round(site.tau * 1e9):
        yield "tau", "must be a whole number of nanoseconds"
