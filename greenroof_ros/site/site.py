"""The parameters of a site (Table I, location and options): the records of its parts."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from datetime import timedelta, timezone, tzinfo
from functools import cached_property
from typing import Any
from zoneinfo import ZoneInfo

from greenroof_ros.base.parameter import entry
from greenroof_ros.site.clock import QuietHours

# Bounds of all sites' parameters: within them, nothing that is computed overflows.
_POSITIVE, _NOT_NEGATIVE = (1e-12, 1e9), (0.0, 1e9)
# Bounds of a pump curve; a constant flow of 1 l/h is -1.3e19 (site/file.py).
_NEGATIVE = (-1e21, -1e-12)

_EARTH_KM = 6371.0
_ROUNDING = 1 + 1e-9
HIGH = 1.3
"""the high states of Table II, as multiples of the volumes at the overflow and at the target"""
MUCH_RAIN = 500.0
"""rain (mm/h) that the overflow of a cistern must carry, and above which a note is printed: the
record of an hour is 401 mm (Shangdu, China, 1975)
"""
MAX_RAIN, MAX_EVAPOTRANSPIRATION = 2000.0, 50.0
"""rain (mm/h) and evapotranspiration (mm/day) above which a value is an error: the record of rain
is 31.2 mm in a minute (Unionville, USA, 1956; WMO)
"""


@dataclass(frozen=True, kw_only=True)
class Cistern:
    """The cistern with its catchment, outlets and mains supply, tank 1 of the paper."""

    a1: float = entry("area of the cistern's base", *_POSITIVE, unit="m2")
    a_in: float = entry(
        "catchment area; in Table I, only the area of the cistern's inlet", *_POSITIVE, unit="m2",
    )
    runoff_coefficient: float = entry(
        "share of the rain on a_in that reaches the cistern", 0.01, 1.0, unit="1", default=1.0,
        usual=(0.75, 0.95),
    )
    z_o: float = entry("elevation of the cistern's overflow above its base", *_POSITIVE, unit="m")
    r_o: float = entry("radius of the cistern's overflow", *_POSITIVE, unit="m")
    c_d: float = entry("discharge coefficient of overflow and low outlet", *_POSITIVE, unit="1")
    low_outlet_level: float | None = entry(
        "height of the low outlet above the cistern's base; if omitted, there is no low outlet",
        0.001, 100.0, unit="m", default=None,
    )
    low_outlet_radius: float | None = entry(
        "radius of the low outlet", 0.001, 1.0, unit="m", default=None,
    )
    low_outlet_valve: bool = entry(
        "true if the low outlet has a valve; without one, it is always open", default=False,
    )
    valve_closed_in_frost: bool | None = entry(
        "true for a valve that could freeze while open, and stays closed in frost; false for a "
        "valve below the frost line; if omitted, true on a live site alone", default=None,
    )
    valve_moves_per_hour: float | None = entry(
        "maximum number of moves of the valve; if omitted, 4 on a live site, and no limit in a "
        "simulation", 2.0, 3600.0, unit="1/h", default=None,
    )
    valve_travel_time: float | None = entry(
        "maximum time in which a live valve opens or closes; if omitted, 30 s", 0.1, 600.0,
        unit="s", default=None,
    )
    valve_without_power: str | None = entry(
        "what a live valve does if its power fails: closes, by a spring or a battery, or "
        "may_stay_open, if the owner accepts this; if omitted, closes",
        choices=("closes", "may_stay_open"), default=None,
    )
    mains_level: float | None = entry(
        "level of the cistern below which a float valve adds mains water; if omitted, there is no "
        "mains supply", 0.01, 100.0, unit="m", default=None,
    )
    mains_flow: float | None = entry("flow of mains water", 1e-6, 0.2, unit="m3/s", default=None)
    monthly_other_demand: tuple[float, ...] | None = entry(
        "mean of the water that other uses than the roof need in each month, such as toilets or a "
        "garden, in a list from January to December; drawn from the cistern after the pump, down "
        "to the level at which the pumps stop, while the mains supply the rest; a column 'other "
        "demand' of the weather replaces the list", 0.0, 1e6,
        unit="l/day", default=None,
    )
    drainage_to_cistern: float = entry(
        "share of the roof's drainage that flows into the cistern, not the sewer", 0.0, 1.0,
        unit="1", default=0.0,
    )
    wet_after: float = entry(
        "time after rain during which the sewer still carries storm water [assumed]", 0.0, 48.0,
        unit="h", default=2.0,
    )
    event_separation: float = entry(
        "minimum time without rain between two rain events", 0.1, 48.0, unit="h", default=6.0,
    )

    @cached_property
    def effective_catchment(self) -> float:
        """Effective catchment area (m2): a_in times the runoff coefficient."""
        return self.a_in * self.runoff_coefficient

    @cached_property
    def other_flows(self) -> tuple[float, ...] | None:
        """Water that other uses than the roof need in each month (m3/s); None for none."""
        months = self.monthly_other_demand
        return None if months is None else tuple(each / 24 / 1000 / 3600 for each in months)

    @cached_property
    def min_outlet_level(self) -> float:
        """Cistern level above which water flows to the sewer (m)."""
        return self.z_o if self.low_outlet_level is None else self.low_outlet_level

    @cached_property
    def always_drains(self) -> bool:
        """Whether the cistern has a low outlet without a valve, which is always open."""
        return self.low_outlet_level is not None and not self.low_outlet_valve

    @property
    def max_cistern_level(self) -> float:
        """Maximum plausible water level in the cistern: three times the overflow's level (m)."""
        return 3 * self.z_o

    def cistern_level(self, x1: float) -> float:
        """Return the depth (m) of a water volume x1 (m3) in the cistern."""
        return x1 / self.a1

    def cistern_volume(self, level: float) -> float:
        """Return the water volume (m3) for a depth (m) in the cistern."""
        return level * self.a1


VALVE_KEYS = ("valve_moves_per_hour", "valve_travel_time", "valve_without_power")
"""optional keys that only a site with a valve can have, besides ``valve_closed_in_frost``"""
WITHOUT_VALVE: dict[str, Any] = {
    "low_outlet_valve": False, "valve_closed_in_frost": False, **dict.fromkeys(VALVE_KEYS),
}
"""changes that take the valve from a site"""


@dataclass(frozen=True, kw_only=True)
class Roof:
    """The green roof with its soil and drainage layer, tank 2 of the paper."""

    a2: float = entry("area of the rooftop vegetation", *_POSITIVE, unit="m2")
    z_veg: float = entry("desired depth of water in the substrate", *_POSITIVE, unit="m")
    x2_star: float = entry(
        "desired volume on the roof; if omitted, a2 z_veg", *_POSITIVE, unit="m3",
    )
    z_soil: float = entry("depth of the soil on the roof", *_POSITIVE, unit="m")
    z_cap: float = entry(
        "water volume that the soil holds before it drains; if omitted, a2 z_soil, times the "
        "field_capacity if any", *_POSITIVE, unit="m3",
    )
    K: float = entry("saturated hydraulic conductivity", *_POSITIVE, unit="m/s")
    field_capacity: float | None = entry(
        "water that the substrate holds against gravity, per volume of substrate; if omitted, the "
        "roof drains according to Eq. (4)", 0.01, 0.9, unit="1", default=None,
    )
    percolation_exponent: float = entry(
        "exponent beta: of the arriving water, S^beta percolates, where S is the filled share of "
        "the available water", 1.0, 10.0, unit="1", default=2.0,
    )
    wilting_point: float | None = entry(
        "water that plants cannot take up, per volume of soil", 0.0, 0.5, unit="1", default=None,
    )
    depletion_fraction: float | None = entry(
        "p in FAO-56 Eq. 84: share of the available water that plants can take up before their "
        "evapotranspiration decreases", 0.0, 0.95, unit="1", default=None,
    )
    drainage_storage: float | None = entry(
        "water in the full drainage layer below the substrate, as a depth; if omitted, there is no "
        "such layer", 0.0001, 1.0, unit="m", default=None,
    )
    drainage_time: float | None = entry(
        "time constant of the drainage layer: storage divided by outflow", 1.0, 1e6, unit="s",
        default=None,
    )

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
    def max_roof_level(self) -> float:
        """Maximum plausible water level on the roof: twice the depth of its soil (m)."""
        return 2 * self.z_soil

    def roof_level(self, x2: float) -> float:
        """Return the depth (m) of a water volume x2 (m3) on the roof.

        On a field-capacity soil, x2 is the water in the substrate, excluding the water in the
        drainage layer.
        """
        return x2 / self.a2

    def roof_volume(self, level: float) -> float:
        """Return the water volume (m3) for a depth (m) on the roof."""
        return level * self.a2


@dataclass(frozen=True, kw_only=True)
class Pump:
    """The pumps and the pipe to the roof."""

    irrigation: str | None = entry(
        "none for a roof that is not irrigated, whose site needs no parameters of pumps",
        choices=("none",), default=None,
    )
    a_hat: float = entry(
        "quadratic coefficient of the pump curve in Eq. (3b); negative", *_NEGATIVE, unit="s2/m5",
    )
    c_hat: float = entry("constant coefficient of the pump curve in Eq. (3b)", *_POSITIVE, unit="m")
    a_pump: float = entry("cross section of the flow through the pump", *_POSITIVE, unit="m2")
    d: float = entry("elevation of the vegetation above the cistern's base", *_POSITIVE, unit="m")
    D: float = entry("diameter of the pipe", *_POSITIVE, unit="m")
    F: float = entry("friction factor of the pipe", *_POSITIVE, unit="1")
    k_L: float = entry("minor loss coefficient of the pipe", *_NOT_NEGATIVE, unit="1")
    l: float = entry("length of the pipe", *_POSITIVE, unit="m")  # noqa: E741 - the paper's symbol
    z_pump: float = entry("height of the pumps above the cistern's base", *_NOT_NEGATIVE, unit="m")
    z_H: float = entry("minimum water level above the pumps' base", *_NOT_NEGATIVE, unit="m")
    pump_efficiency: float = entry(
        "ratio of hydraulic to electric power of pump and motor", 0.001, 1.0, unit="1", default=0.5,
    )
    starts_per_hour: float = entry(
        "maximum number of pump starts; more cause a warning in a simulation", 1.0, 3600.0,
        unit="1/h", default=20.0,
    )
    max_dose: float | None = entry(
        "maximum volume of a dose that a person may request; if omitted, no doses", 0.001, 1e6,
        unit="m3", default=None,
    )

    @property
    def irrigated(self) -> bool:
        """Whether the site has pumps that water the roof."""
        return self.irrigation is None

    @cached_property
    def suction_level(self) -> float:
        """Minimum cistern level at which the pumps work, z_pump + z_H (m), Eq. (3a)."""
        return self.z_pump + self.z_H


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where a site is, its clock, and what its plants and instruments make of the weather."""

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
        "offset of local standard time from UTC", -12.0, 14.0, unit="h", default=None,
    )
    time_zone: str | None = entry(
        "IANA name of the site's time zone, such as America/Toronto, whose standard UTC offset "
        "must equal utc_offset", default=None,
    )
    albedo: float = entry(
        "albedo of the vegetation; 0.23 for the reference grass", 0.0, 1.0, unit="1", default=0.23,
    )
    k_Rs: float = entry(
        "coefficient in FAO-56 Eq. 50: 0.16 inland, 0.19 near a large body of water", 0.1, 0.25,
        unit="degC^-0.5", default=0.16,
    )
    wind_height: float = entry(
        "height at which the wind was measured, unless the weather file states it", 0.5, 100.0,
        unit="m", default=10.0,
    )
    crop_coefficient: float = entry(
        "evapotranspiration relative to the reference grass", 0.01, 3.0, unit="1", default=1.0,
    )
    monthly_evapotranspiration: tuple[float, ...] | None = entry(
        "mean reference evapotranspiration of the twelve months, used without a forecast or "
        "temperature", 0.0, 20.0, unit="mm/day", default=None,
    )
    quiet_hours: tuple[str, ...] | None = entry(
        "times of the day at which the pump is off, on the clock of time_zone, such as "
        '["22:00-06:00", "12:00-13:30"]', default=None,
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

    @property
    def clock_offset(self) -> float:
        """UTC offset in the site file, or else the whole hour that is closest to solar time (h)."""
        solar = float(round((self.longitude or 0.0) / 15))
        return solar if self.utc_offset is None else self.utc_offset


@dataclass(frozen=True, kw_only=True)
class Site(Place, Pump, Roof, Cistern):
    """The parameters of Table I under the paper's symbols, and optional parameters.

    The definition of each parameter contains its unit, range and meaning.
    """

    g: float = entry("acceleration due to gravity", *_POSITIVE, unit="m/s2")
    epsilon: float = entry("steepness of the smooth model's sigmoids", *_POSITIVE, unit="1")
    tau: float = entry("duration of a tick", 0.001, 3600.0, unit="s")
    M: int = entry("length of the controller's look-ahead", 1, 1000, unit="ticks")
    N: int = entry("length of a run", 1, 2**40, unit="ticks")
    initial_cistern: float | None = entry(
        "water volume at the start of a run; if omitted, that of low-low in Table II",
        *_NOT_NEGATIVE, unit="m3", default=None,
    )
    initial_roof: float | None = entry(
        "water volume at the start of a run; if omitted, that of low-low in Table II",
        *_NOT_NEGATIVE, unit="m3", default=None,
    )
    initial_layer: float = entry(
        "water volume in the drainage layer at the start of a run", *_NOT_NEGATIVE, unit="m3",
        default=0.0,
    )
    contact: str | None = entry("whom to call, and where the main switch is", default=None)

    @property
    def stops_in_frost(self) -> bool:
        """Whether a live site stops in frost: its pumps, or a valve above the frost line."""
        return self.irrigated or self.valve_closed_in_frost is not False

    @property
    def place(self) -> Place:
        """The place alone, for readers of weather."""
        return Place(**{field.name: getattr(self, field.name) for field in fields(Place)})

    @property
    def max_volumes(self) -> dict[str, float]:
        """The most water with which ``cistern`` and ``roof`` can start (m3).

        These are the high states of Table II, or a full soil.
        """
        roof = max(self.z_cap, HIGH * self.x2_star)
        return {"cistern": HIGH * self.a1 * self.z_o * _ROUNDING, "roof": roof * _ROUNDING}

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
    def b(self) -> float:
        """Coefficient of the maximum flow in Eq. (3e) (m^2.5/s); 0 without irrigation."""
        if not self.irrigated:
            return 0.0
        return 1 / math.sqrt(self.pipe_resistance - self.a_hat)

    @cached_property
    def pipe_resistance(self) -> float:
        """Friction and minor head losses per squared flow in Eq. (3c) (s2/m5)."""
        return (self.F * self.l / self.D + self.k_L) / (2 * self.g * self.a_pump**2)


def describe_max_volume(most: float) -> str:
    """Return what an initial volume must be (m3)."""
    return f"must be at most {most:.6g} m3, which is all that fits; is the unit wrong?"


def measure_distance(here: tuple[float, float], there: tuple[float, float]) -> float:
    """Return the great-circle distance (km) between two points (latitude, longitude)."""
    (north, east), (north2, east2) = (map(math.radians, place) for place in (here, there))
    chord = math.sin((north2 - north) / 2) ** 2 + (
        math.cos(north) * math.cos(north2) * math.sin((east2 - east) / 2) ** 2
    )
    return 2 * _EARTH_KM * math.asin(min(1.0, math.sqrt(chord)))


def format_place(latitude: float | None, longitude: float | None) -> str:
    """Return a location as text, such as '43.63 N, 79.40 W'."""
    if latitude is None or longitude is None:
        return "location not stated"
    return (
        f"{abs(latitude):.2f} {'N' if latitude >= 0 else 'S'}, "
        f"{abs(longitude):.2f} {'E' if longitude >= 0 else 'W'}"
    )
