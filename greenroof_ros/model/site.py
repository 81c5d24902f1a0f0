"""The site: Table I of the paper and its place on earth, from a YAML file and checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import number, read_yaml

_MAY_BE_ZERO = {"k_L", "z_pump", "z_H"}
_MOST_TICKS = {"M": 1000, "N": 31_622_400}
# No parameter of any site is beyond these, and nothing computed from them overflows.
_LEAST, _LARGEST = 1e-12, 1e9
# A product that a person rounds when writing it down, such as x2_star, is still consistent.
_ROUNDING = 1e-6
# What only a computed evapotranspiration needs, with its range.
_PLACE = {
    "latitude": (-66.0, 66.0),
    "longitude": (-180.0, 180.0),
    "elevation": (-430.0, 6000.0),
    "utc_offset": (-12.0, 14.0),
    "albedo": (0.0, 1.0),
    "k_Rs": (0.1, 0.25),
    "wind_height": (0.5, 100.0),
    "crop_coefficient": (0.01, 3.0),
}


@dataclass(frozen=True)
class Site:
    """The parameters of Table I under the paper's symbols, and the place, which may be left out.

    Attributes:
        a1: bottom surface area of the cistern (m2).
        a_in: area of flow through the cistern's inlet (m2).
        z_o: elevation of the cistern's outlet (m).
        r_o: radius of the cistern's outlet (m).
        c_d: discharge coefficient of the outlet (1).
        a2: bottom surface area of the rooftop vegetation (m2).
        z_veg: desired water depth on the roof (m).
        x2_star: desired water volume on the roof, a2 z_veg (m3).
        z_soil: soil depth of the roof (m).
        z_cap: soil capacity, a2 z_soil (m3).
        K: saturated hydraulic conductivity (m/s).
        a_hat: coefficient of the pump curve, negative (s2/m5), Eq. (3b).
        c_hat: coefficient of the pump curve (m), Eq. (3b).
        a_pump: area of flow through the pump (m2).
        d: elevation of the vegetation relative to the cistern (m).
        D: diameter of the pipe (m).
        F: friction factor of the pipe (1).
        k_L: minor loss coefficient of the pipe (1).
        l: length of the pipe (m).
        z_pump: elevation of the pumps above the cistern's base (m).
        z_H: least water level above the pumps' base that they need (m).
        g: acceleration due to gravity (m/s2).
        epsilon: steepness of the smooth model's sigmoids (1).
        tau: duration of a tick (s).
        M: look-ahead of the controller (ticks).
        N: length of a run (ticks).
        latitude: of the site (degrees north).
        longitude: of the site (degrees, positive to the east of Greenwich).
        elevation: of the site above the sea (m).
        utc_offset: of the local standard time (h), without daylight saving.
        albedo: of the vegetation (1); 0.23 is FAO-56's reference grass.
        k_Rs: adjustment coefficient of FAO-56 Eq. 50 (degC^-0.5), for radiation that was not
            measured; 0.16 inland, 0.19 by a large water.
        wind_height: above the ground, at which the wind was measured (m).
        crop_coefficient: evapotranspiration of the vegetation over that of the reference grass (1).
    """

    a1: float
    a_in: float
    z_o: float
    r_o: float
    c_d: float
    a2: float
    z_veg: float
    x2_star: float
    z_soil: float
    z_cap: float
    K: float
    a_hat: float
    c_hat: float
    a_pump: float
    d: float
    D: float
    F: float
    k_L: float
    l: float  # noqa: E741 - the paper's symbol
    z_pump: float
    z_H: float
    g: float
    epsilon: float
    tau: float
    M: int
    N: int
    latitude: float | None = None
    longitude: float | None = None
    elevation: float | None = None
    utc_offset: float | None = None
    albedo: float = 0.23
    k_Rs: float = 0.16
    wind_height: float = 10.0
    crop_coefficient: float = 1.0

    @cached_property
    def c_out(self) -> float:
        """Coefficient of the cistern's outlet (m^2.5/s), Eq. (2)."""
        return self.c_d * math.pi * self.r_o**2 * math.sqrt(2 * self.g)

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
        """Lowest cistern level at which the pumps work, z_pump + z_H (m), Eq. (3a)."""
        return self.z_pump + self.z_H

    def cistern_level(self, x1: float) -> float:
        """Depth of a water volume x1 (m3) in the cistern (m)."""
        return x1 / self.a1

    def roof_level(self, x2: float) -> float:
        """Depth of a water volume x2 (m3) on the roof (m)."""
        return x2 / self.a2

    def cistern_volume(self, level: float) -> float:
        """Water volume (m3) of a depth in the cistern (m)."""
        return level * self.a1

    def roof_volume(self, level: float) -> float:
        """Water volume (m3) of a depth on the roof (m)."""
        return level * self.a2


def read_site(path: Path) -> Site:
    """Read and check a site file such as ``config/site.yaml``.

    Raises:
        ConfigurationError: a parameter is missing, unknown, not a finite number, of the wrong
            sign, or inconsistent with another; the message names the file, line, key and value.
    """
    mapping = read_yaml(path)
    names = [field.name for field in fields(Site)]
    for key, line in mapping.lines.items():
        if key not in names:
            raise ConfigurationError(
                f"is not a parameter of a site; they are {', '.join(names)}",
                file=path, line=line, key=key,
            )
    values: dict[str, float] = {}
    for name in names:
        if name not in mapping:
            if name in _PLACE:
                continue
            raise ConfigurationError("is missing", file=path, key=name)
        value = number(path, mapping, name)

        def refuse(expected: str, name: str = name) -> ConfigurationError:
            return ConfigurationError(
                expected, file=path, line=mapping.lines[name], key=name, value=mapping[name]
            )

        if not math.isfinite(value):
            raise refuse("must be finite")
        if name in _PLACE:
            low, high = _PLACE[name]
            if not low <= value <= high:
                raise refuse(f"must be from {low:g} to {high:g}")
            values[name] = value
            continue
        least = 0.0 if value == 0 or name in _MAY_BE_ZERO else _LEAST
        if not least <= abs(value) <= _LARGEST:
            raise refuse(f"must be from {least:g} to {_LARGEST:g} in size; is a unit wrong?")
        if name == "a_hat":
            if value >= 0:
                raise refuse("must be negative: the head of a pump falls as its flow rises")
        elif name in _MAY_BE_ZERO:
            if value < 0:
                raise refuse("must not be negative")
        elif value <= 0:
            raise refuse("must be greater than 0")
        if name in _MOST_TICKS:
            if value != int(value) or value > _MOST_TICKS[name]:
                raise refuse(f"must be a whole number of ticks, at most {_MOST_TICKS[name]}")
            value = int(value)
        values[name] = value
    site = Site(**values)  # type: ignore[arg-type]  # M and N were made whole above
    for name, product, formula in (
        ("x2_star", site.a2 * site.z_veg, "a2 z_veg"),
        ("z_cap", site.a2 * site.z_soil, "a2 z_soil"),
    ):
        if not math.isclose(values[name], product, rel_tol=_ROUNDING):
            raise ConfigurationError(
                f"must be {formula} = {product:g} m3",
                file=path, line=mapping.lines[name], key=name, value=mapping[name],
            )
    if site.z_veg >= site.z_soil:
        raise ConfigurationError(
            f"must be below z_soil = {site.z_soil:g} m: soil cannot hold more than its depth",
            file=path, line=mapping.lines["z_veg"], key="z_veg", value=mapping["z_veg"],
        )
    if site.c_hat - site.d + site.suction_level <= 0:
        raise ConfigurationError(
            f"must exceed d - z_pump - z_H = {site.d - site.suction_level:g} m, "
            "or the pumps never lift water to the roof (Eq. 3e)",
            file=path, line=mapping.lines["c_hat"], key="c_hat", value=mapping["c_hat"],
        )
    if not 0.001 <= site.tau <= 3600 or site.tau * 1e9 != round(site.tau * 1e9):
        raise ConfigurationError(
            "must be a whole number of nanoseconds, from 0.001 s to an hour, as weather is hourly",
            file=path, line=mapping.lines["tau"], key="tau", value=mapping["tau"],
        )
    return site
