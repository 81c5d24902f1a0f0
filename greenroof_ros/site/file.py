"""Site files: read, checked, changed and written.

A site file contains parameters of :class:`.site.Site` and plain keys, everyday words that replace
the paper's symbols, and may extend another file. So a site is described on several levels: files
that extend one another, and values that a program changes. A value on one level takes precedence
over all values of the same quantity on lower levels, whichever key they use. Within a level, two
keys for the same quantity are an error.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import is_there, read_yaml, shared_directory
from greenroof_ros.base.parameter import Parameter, entry, make_record, parameters_of
from greenroof_ros.site.clock import standard_offset
from greenroof_ros.site.site import HIGH, MUCH_RAIN, VALVE_KEYS, Site, describe_max_volume

LITRES_PER_HOUR = 1 / 3.6e6
"""factor from l/h to m3/s, and from mm/h on 1 m2 to m3/s"""

# Head of the pump curve that stands for a constant flow (m). According to Eq. (3e), the flow is
# proportional to the square root of this head plus the cistern's level, so a level of 3 m raises
# the flow by only 1.5e-6 of its value.
_HEAD_OF_CONSTANT_FLOW = 1e6
# What stands for parameters until they are computed.
_PLACEHOLDERS: dict[str, Any] = {"a_hat": -1.0, "monthly_other_demand": [0.0] * 12}

# The pump of a site that is not irrigated: its numbers have no effect.
_NO_PUMP: dict[str, Any] = {
    "a_hat": -1.0, "c_hat": 1e6, "a_pump": 1.0, "d": 1e6, "D": 1.0, "F": 1.0, "k_L": 0.0, "l": 1.0,
    "z_pump": 0.0, "z_H": 0.0,
}

SUBSTRATES: dict[str, dict[str, Any]] = {
    **read_yaml(shared_directory() / "config" / "substrates.yaml")
}
"""the substrates of ``config/substrates.yaml``, by name"""

# Relative error up to which a product rounded by a person, such as x2_star, counts as consistent.
_ROUNDING = 1e-6
# Products, computed if a file omits them; the paper's roof has no field capacity.
_PRODUCTS = {"x2_star": ("a2", "z_veg"), "z_cap": ("a2", "z_soil", "field_capacity")}
# Volumes, and what they are proportional to.
_FOLLOW = {
    **_PRODUCTS,
    "initial_cistern": ("a1", "z_o"),
    "initial_roof": ("a2",),
    "initial_layer": ("a2",),
}
# Key for the file that contains what a site file omits.
_EXTENDS = "extends"
# Optional keys that belong together: each needs the others in its line. Field-capacity soil can
# lack a drainage layer.
_TOGETHER = (
    (("emitters", "emitter_flow"), ()),
    (("field_capacity", "wilting_point", "depletion_fraction"), ()),
    (("drainage_storage", "drainage_time"), ("field_capacity",)),
    (("mains_level", "mains_flow"), ()),
    (("low_outlet_level", "low_outlet_radius"), ()),
    (("low_outlet_valve",), ("low_outlet_level",)),
    *(((key,), ("low_outlet_valve",)) for key in ("valve_closed_in_frost", *VALVE_KEYS)),
    (("initial_cistern", "initial_roof"), ()),
    (("quiet_hours",), ("time_zone",)),
)
_EMITTERS = ("emitters", "emitter_flow")
_PLACE = {"latitude", "longitude"}
# Keys that a file for another place does not inherit from the file that it extends.
_FOLLOW_PLACE = {"elevation", "utc_offset", "time_zone", "monthly_evapotranspiration", "k_Rs"}


def _plain(
    determines: str, meaning: str, low: float = -math.inf, high: float = math.inf, unit: str = "",
    usual: tuple[float, float] | None = None, choices: tuple[str, ...] = (),
) -> Any:
    """Return a field for a plain key, see :func:`.entry`, that determines parameters."""
    made = entry(meaning, low, high, unit=unit, default=None, usual=usual, choices=choices)
    return field(default=None, metadata={**made.metadata, "determines": (*determines.split(),)})


@dataclass(frozen=True, kw_only=True)
class _PlainKeys:
    """The plain keys, each of which is optional."""

    cistern_volume: float | None = _plain(
        "a1", "volume of the cistern up to its overflow", 0.01, 5e3, "m3", (1, 50)
    )
    cistern_height: float | None = _plain(
        "z_o", "height of the cistern's overflow above its base", 0.1, 50.0, "m", (1, 3)
    )
    catchment_area: float | None = _plain(
        "a_in", "area that drains to the cistern", 0.1, 1e6, "m2", (50, 2000)
    )
    other_demand: float | None = _plain(
        "monthly_other_demand", "water that other uses than the roof need all year, such as "
        "toilets", 0.0, 1e6, "l/day", (20, 2000),
    )
    roof_area: float | None = _plain("a2", "area of the green roof", 0.1, 1e6, "m2", (20, 2000))
    substrate: str | None = _plain(
        "field_capacity wilting_point depletion_fraction drainage_storage drainage_time",
        "name of the green roof's substrate", choices=tuple(SUBSTRATES),
    )
    substrate_depth: float | None = _plain(
        "z_soil", "depth of the substrate", 0.02, 2.0, "m", (0.06, 0.5)
    )
    pump_flow: float | None = _plain(
        "a_hat c_hat", "flow of the pump at full command, independent of the cistern's level", 1.0,
        1e6, "l/h", (100, 5000),
    )
    irrigation_rate: float | None = _plain(
        "a_hat c_hat", "flow of the pump at full command, expressed as the depth of water that it "
        "adds to the roof per hour", 0.1, 1000.0, "mm/h", (2, 10),
    )
    emitters: int | None = _plain(
        "a_hat c_hat", "number of drip emitters that the pump supplies at full command, each with "
        "the flow emitter_flow", 1, 10_000_000, usual=(100, 5000),
    )
    emitter_flow: float | None = _plain(
        "a_hat c_hat", "flow of one drip emitter", 0.1, 100.0, "l/h", (1, 4)
    )


@dataclass(frozen=True, kw_only=True)
class _Description(Site, _PlainKeys):
    """A site as it is described: with the plain keys, which come first and are checked first."""


SITE_KEYS: dict[str, Parameter] = {each.name: each for each in parameters_of(_Description)}
"""keys that a site file may contain, except ``extends``, by name"""
DETERMINES: dict[str, tuple[str, ...]] = {
    each.name: each.metadata["determines"] for each in fields(_PlainKeys)
}
"""the paper's parameters that each plain key determines"""


class _Entry(NamedTuple):
    """A value in a site's description, and its source."""

    value: Any
    file: Path | None = None
    """file that contains the value; None if a program set the value"""
    line: int | None = None


def _find_rivals(key: str) -> set[str]:
    """Return the keys for the same quantity, which a key replaces.

    A key of the soil does not replace the substrate's name.
    """
    names = set(DETERMINES.get(key, (key,)))
    rivals = names.union(plain for plain, of in DETERMINES.items() if names.intersection(of))
    return rivals.difference(_EMITTERS if key in _EMITTERS else (key,), ("substrate",))


def _override(base: Mapping[str, _Entry], own: Mapping[str, _Entry]) -> dict[str, _Entry]:
    """Return a level's own entries with those of the levels below, over which they take precedence.

    Raises:
        ConfigurationError: if two keys of the level set the same parameter; the message names both
            keys.
    """
    replaced = _FOLLOW_PLACE if own.keys() >= _PLACE else set()
    for name, (value, file, line) in own.items():
        rivals = _find_rivals(name)
        for rival in [key for key in own if name in DETERMINES and key in rivals]:
            where = "" if own[rival].line is None else f" in line {own[rival].line}"
            raise ConfigurationError(
                f"contradicts {rival} = {own[rival].value}{where}, which sets the same quantity: "
                "remove one of the two keys", file=file, line=line, key=name, value=value,
            )
        replaced = replaced | rivals
    return {**{name: each for name, each in base.items() if name not in replaced}, **own}


def _translate(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the paper's parameters that follow from other keys.

    The parameters that :func:`_compute` computes have placeholders.
    """
    soil = SUBSTRATES.get(str(values.get("substrate")), {})
    return (_NO_PUMP if "irrigation" in values else {}) | {
        name: _PLACEHOLDERS.get(name) or soil.get(name, values[plain])
        for plain, names in DETERMINES.items() if plain in values for name in names
    }


def _compute(site: _Description) -> _Description:
    """Return a site with the parameters that follow from plain keys and other parameters."""
    values: dict[str, Any] = {}
    if site.other_demand is not None:
        values["monthly_other_demand"] = (site.other_demand,) * 12
    if site.cistern_volume is not None:
        values["a1"] = site.cistern_volume / site.z_o
    litres = site.pump_flow or (site.emitters or 0) * (site.emitter_flow or 0.0)
    litres = litres or (site.irrigation_rate or 0.0) * site.a2
    if litres:
        flow = litres * LITRES_PER_HOUR
        values["c_hat"] = _HEAD_OF_CONSTANT_FLOW + site.d
        values["a_hat"] = site.pipe_resistance - _HEAD_OF_CONSTANT_FLOW / flow**2
    return replace(site, **values)


def _product(site: Site, names: Collection[str]) -> float:
    """Return the product of parameters, without those that are None."""
    return math.prod(getattr(site, name) or 1.0 for name in names)


def format_site(site: Site, notes: Mapping[str, str] | None = None) -> str:
    """Return the text of a complete site file, from which :func:`read_site` reads the same site.

    Args:
        site: the site.
        notes: comments on some parameters, by name; the default is the meaning of the parameter.
    """
    lines = []
    for parameter, value in zip(parameters_of(Site), asdict(site).values(), strict=True):
        if value is not None:
            entry = f"{parameter.name}: {json.dumps(value)}"
            note = (notes or {}).get(parameter.name, parameter.meaning)
            lines.append(f"{entry:<29} # {parameter.unit:<7} {note}\n")
    return "".join(lines)


def _read_entries(path: Path, extended_by: tuple[Path, ...] = ()) -> dict[str, _Entry]:
    """Return the entries of a site file by key, including those of the file that it extends.

    The site file's own entries take precedence.
    """
    mapping = read_yaml(path)
    entries = {key: _Entry(value, path, mapping.lines[key]) for key, value in mapping.items()}
    if _EXTENDS not in entries:
        return _override({}, entries)
    name, _, line = entries.pop(_EXTENDS)
    chain = (*extended_by, path.resolve())
    # A path of a text that is not on a disk has a directory that is.
    places = Path(path).parent, shared_directory() / "config"
    base = next(filter(is_there, (place / str(name) for place in places)), None)
    if base is None or base.resolve() in chain:
        raise ConfigurationError(
            "must be the name of another site file, such as site.yaml, in the same directory or "
            "in this package, which does not extend this file itself",
            file=path, line=line, key=_EXTENDS, value=name,
        )
    return _override(_read_entries(base, chain), entries)


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
        self._path, self._entries = path, _read_entries(path)
        self.site = _make_site(self._entries, path)

    def change(self, changes: Mapping[str, Any]) -> Site:
        """Return the site with some values changed; see :func:`read_site`."""
        own = {name: _Entry(value) for name, value in changes.items()}
        return _make_site(_override(self._entries, own), self._path, self.site)


def check_site(site: Site) -> Site:
    """Check a site that a program created, and return it with its values as Python numbers.

    Raises:
        ConfigurationError: if a value is invalid, as in :func:`read_site`; the message names the
            key and the value.
    """
    return _make_site({
        name: _Entry(value) for name, value in asdict(site).items() if value is not None
    })


def _make_site(
    entries: Mapping[str, _Entry], path: Path | None = None, unchanged: Site | None = None
) -> Site:
    """Check entries, and return the site that they describe.

    Args:
        entries: the entries.
        path: the file; None without a file.
        unchanged: site of the file's own entries; volumes among these follow the changes.
    """
    values = {name: each.value for name, each in entries.items()}
    try:
        for name, value in values.items():
            if value is None:
                raise ConfigurationError(
                    "must have a value; leave this line out if there is none", key=name
                )
        given = {**_translate(values), **values}
        omitted = _PRODUCTS.keys() - given.keys()
        site = _compute(make_record(_Description, {**dict.fromkeys(omitted, 1.0), **given}))
        volumes: dict[str, Any] = {name: _product(site, _PRODUCTS[name]) for name in omitted}
        if unchanged is not None:
            volumes |= {
                volume: getattr(unchanged, volume) * math.prod(
                    (getattr(site, name) or 1.0) / (getattr(unchanged, name) or 1.0)
                    for name in names
                ) for volume, names in _FOLLOW.items()
                if volume in entries and entries[volume].file is not None
            }
        site = replace(site, **volumes)
        # Volumes that are not stated here are no more than what the store holds.
        stated = path if unchanged is None else None
        site = replace(site, **{
            f"initial_{name}": min(getattr(site, f"initial_{name}"), most)
            for name, most in site.max_volumes.items()
            if f"initial_{name}" in entries and entries[f"initial_{name}"].file != stated
        })
        for name, expected in _find_contradictions(site, given):
            raise ConfigurationError(expected, key=name, value=getattr(site, name))
        return Site(**{field.name: getattr(site, field.name) for field in fields(Site)})
    except ConfigurationError as error:
        name, key, expected = str(error.key).partition(".")[0], error.key, error.expected
        if name not in entries:
            plain = next((each for each in entries if name in DETERMINES.get(each, ())), None)
            name, key = plain or name, f"{plain} ({key})" if plain else key
            if plain is None:
                expected += (
                    "; add it, or begin the file with 'extends: site.yaml' to use the paper's "
                    "values for all missing keys"
                )
        source = entries.get(name, _Entry(None, path))
        raise ConfigurationError(
            expected, file=source.file, line=source.line, key=key, value=error.value
        ) from None


def _find_contradictions(site: Site, given: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield each key that contradicts other keys, and a description of valid values.

    Args:
        site: site with all parameters in their ranges.
        given: names of the keys in the site file, and of the parameters that they determine.
    """
    for names, further in _TOGETHER:
        there = {name for name in given if getattr(site, name) is not False}
        present = [name for name in names if name in there]
        missing = [name for name in (*names, *further) if name not in there]
        if present and missing:
            yield present[0], f"needs {', '.join(missing)} as well"
    for attribute, name, expected in (
        ("zone", "time_zone", "must be the IANA name of a time zone known to this computer "
         "(package tzdata), such as America/Toronto"),
        ("quiet", "quiet_hours", 'must be a list of intervals of the day, such as ["22:00-06:00", '
         '"12:00-13:30"], and must leave some time for pumping'),
    ):
        try:
            getattr(site, attribute)
        except (OSError, ValueError, KeyError):
            yield name, expected
    if site.time_zone is not None and site.utc_offset is not None:
        offset = standard_offset(site.time_zone)
        if site.utc_offset != offset:
            yield "time_zone", (
                f"must be a time zone whose standard UTC offset is utc_offset = "
                f"{site.utc_offset:+g} h, but that of {site.time_zone} is {offset:+g} h; in names "
                "that begin with Etc/ the sign is reversed"
            )
    outlet = "z_o" if site.low_outlet_level is None else "low_outlet_level"
    for name, above in (("low_outlet_level", "z_o"), ("mains_level", outlet)):
        level, limit = getattr(site, name), getattr(site, above)
        if level is not None and not site.suction_level < level < limit:
            yield name, (
                f"must be above z_pump + z_H = {site.suction_level:g} m, below which the pumps do "
                f"not work, and below {above} = {limit:g} m, above which water flows to the sewer"
            )
    for name, most in site.max_volumes.items():
        if (getattr(site, f"initial_{name}") or 0.0) > most:
            yield f"initial_{name}", describe_max_volume(most)
    for name, factors in _PRODUCTS.items():
        product = _product(site, factors)
        if not math.isclose(getattr(site, name), product, rel_tol=_ROUNDING):
            formula = " ".join(name for name in factors if getattr(site, name) is not None)
            yield name, (
                f"must be {formula} = {product:g} m3; leave this line out to have it computed"
            )
    months = "a list of twelve numbers, January to December"
    inflow = MUCH_RAIN / 3.6e6 * (site.effective_catchment + site.drainage_to_cistern * site.a2)
    top = max(HIGH * site.z_o, site.z_o + (inflow / site.c_out) ** 2)
    for name, holds, expected in (
        ("monthly_evapotranspiration", len(site.monthly_evapotranspiration or months[:12]) == 12,
         months),
        ("monthly_other_demand", len(site.monthly_other_demand or months[:12]) == 12, months),
        ("z_o", top < site.d, f"lower, or r_o larger, so that the water stays below the roof at d "
         f"= {site.d:g} m; at {HIGH} z_o, or in rain of {MUCH_RAIN:g} mm/h, it is at {top:.4g} m"),
        ("initial_layer", site.initial_layer <= site.layer_storage, "at most the volume of the "
         f"drainage layer, a2 drainage_storage = {site.layer_storage:g} m3"),
        ("z_veg", site.x2_star < site.z_cap,
         f"below z_cap / a2 = {site.z_cap / site.a2:g} m: water above this level drains off"),
        ("wilting_point", site.wilting_volume < site.x2_star, f"below z_veg / z_soil = "
         f"{site.z_veg / site.z_soil:g}; otherwise plants take up no water at the target"),
        ("c_hat", not site.irrigated or site.c_hat - site.d + site.suction_level > 0,
         f"above d - z_pump - z_H = {site.d - site.suction_level:g} m; otherwise the pumps cannot "
         "lift water to the roof (Eq. 3e)"),
        ("tau", site.tau * 1e9 == round(site.tau * 1e9), "a whole number of nanoseconds"),
    ):
        if not holds:
            yield name, f"must be {expected}"
