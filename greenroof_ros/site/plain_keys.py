"""Plain keys of a site file: everyday words that replace parameters of the paper.

A file may use plain keys or the paper's symbols. A site is described on several levels: files that
extend one another, and values that a program changes. A value on one level takes precedence over
all values of the same quantity on lower levels, whichever key they use. Within a level, two keys
for the same quantity are an error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter, entry, make_record, parameters_of

if TYPE_CHECKING:
    from greenroof_ros.site.site import Site

LITRES_PER_HOUR = 1 / 3.6e6
"""factor from l/h to m3/s, and from mm/h on 1 m2 to m3/s"""

# Head of the pump curve that stands for a constant flow (m). According to Eq. (3e), the flow is
# proportional to the square root of this head plus the cistern's level, so a level of 3 m raises
# the flow by only 1.5e-6 of its value.
_HEAD_OF_CONSTANT_FLOW = 1e6


@dataclass(frozen=True)
class Substrate:
    """A named substrate with its drainage layer: the parameters of a field-capacity soil.

    Attributes:
        about: description of the substrate, with the sources of its values.
        depth: usual depth of the substrate, which is used for a new site (m).
        field_capacity: value of the site's parameter ``field_capacity`` (1).
        wilting_point: value of the site's parameter ``wilting_point`` (1).
        depletion_fraction: value of the site's parameter ``depletion_fraction`` (1).
        drainage_storage: value of the site's parameter ``drainage_storage`` (m).
        drainage_time: value of the site's parameter ``drainage_time`` (s).
    """

    about: str
    depth: float
    field_capacity: float
    wilting_point: float
    depletion_fraction: float = 0.5
    drainage_storage: float = 0.0075
    drainage_time: float = 500.0


_OF_SUBSTRATE = (
    "field_capacity", "wilting_point", "depletion_fraction", "drainage_storage", "drainage_time",
)
SUBSTRATES = {
    "neubrandenburg": Substrate(
        "a complete green roof in Germany, including its plants and mat; the values were fitted "
        "to 16 months of measured runoff, see "
        "config/site_neubrandenburg.yaml", 0.108, 0.63, 0.02, drainage_storage=0.0055,
    ),
    "berlin": Substrate(
        "a roof in Berlin with 10 cm of substrate on a drainage layer of 3 mm, half of which is "
        "voids; the values are from a calibration of SWMM 5 (KWB-R/keys.lid, "
        "bbr18.inp)", 0.1, 0.2, 0.1,
        drainage_storage=0.0015,
    ),
    "extensive": Substrate(
        "assumed values: a maximum water capacity of 35 % is quoted as the minimum in the FLL "
        "guidelines (2018) for extensive roofs with more than one layer, but was not verified "
        "against their text; the wilting point and the drainage layer are within the ranges given "
        "in EPA's SWMM Reference Manual III (2016), 0.05 to 0.2 and 3 to 20 mm", 0.1, 0.35, 0.1,
    ),
    "intensive": Substrate(
        "assumed values: those of the substrate 'extensive', except for the maximum water "
        "capacity of 45 %, which is quoted for intensive roofs", 0.3, 0.45, 0.1,
    ),
    "sandy_loam": Substrate(
        "a garden soil; the values are the midpoints of the ranges in FAO-56, Table 19 (0.18 to "
        "0.28 and 0.06 to 0.16)", 0.3, 0.23, 0.11,
    ),
    "loam": Substrate(
        "a garden soil; the values are the midpoints of the ranges in FAO-56, Table 19 (0.20 to "
        "0.30 and 0.07 to 0.17)", 0.3, 0.25, 0.12,
    ),
}
"""The substrates, by name.

The depletion fraction is the middle of the range 0.3 to 0.7 in FAO-56, Table 22. The time constant
of the drainage layer is that of the roof in Neubrandenburg. The storage under garden soils is the
middle of the range in SWMM's manual.
"""


@dataclass(frozen=True)
class PlainKeys:
    """The plain keys, each of which is optional."""

    cistern_volume: float | None = entry(
        "volume of the cistern up to its overflow", 0.01, 1e5, unit="m3", default=None,
        usual=(1, 50),
    )
    cistern_height: float | None = entry(
        "height of the cistern's overflow above its base", 0.1, 50.0, unit="m", default=None,
        usual=(1, 3),
    )
    catchment_area: float | None = entry(
        "area that drains to the cistern", 0.1, 1e6, unit="m2", default=None, usual=(50, 2000),
    )
    roof_area: float | None = entry(
        "area of the green roof", 0.1, 1e6, unit="m2", default=None, usual=(20, 2000),
    )
    substrate: str | None = entry(
        "name of the green roof's substrate", choices=tuple(SUBSTRATES), default=None,
    )
    substrate_depth: float | None = entry(
        "depth of the substrate", 0.02, 2.0, unit="m", default=None, usual=(0.06, 0.5),
    )
    pump_flow: float | None = entry(
        "flow of the pump at full command, independent of the cistern's level", 1.0, 1e6,
        unit="l/h", default=None, usual=(100, 5000),
    )
    irrigation_rate: float | None = entry(
        "flow of the pump at full command, expressed as the depth of water that it adds to the "
        "roof per hour", 0.1, 1000.0, unit="mm/h", default=None, usual=(2, 10),
    )
    emitters: int | None = entry(
        "number of drip emitters that the pump supplies at full command, each with the flow "
        "emitter_flow", 1, 10_000_000, default=None, usual=(100, 5000),
    )
    emitter_flow: float | None = entry(
        "flow of one drip emitter", 0.1, 100.0, unit="l/h", default=None, usual=(1, 4),
    )


PLAIN: dict[str, Parameter] = {each.name: each for each in parameters_of(PlainKeys)}
"""plain keys, by name"""

# Keys that are only another name for a parameter.
_RENAMED = {
    "cistern_height": "z_o", "catchment_area": "a_in", "roof_area": "a2",
    "substrate_depth": "z_soil",
}
# Keys for the same quantity; the keys in an inner tuple belong together.
_SAME: tuple[tuple[tuple[str, ...], ...], ...] = (
    *(((plain,), (name,)) for plain, name in _RENAMED.items()),
    (("cistern_volume",), ("a1",)),
    (("pump_flow",), ("irrigation_rate",), ("emitters", "emitter_flow"), ("a_hat", "c_hat")),
)
# The keys that a key replaces. A key of the soil does not replace the substrate's name.
_RIVALS: dict[str, tuple[str, ...]] = {
    name: tuple(other for group in same if name not in group for other in group)
    for same in _SAME for names in same for name in names
} | {"substrate": _OF_SUBSTRATE}
_PLACE = {"latitude", "longitude"}
NO_VALUE = "must have a value; leave this line out if there is none"
"""reason for rejecting an empty value"""

# Keys that a file for another place does not inherit from the file that it extends.
_FOLLOW_PLACE = (
    "elevation", "utc_offset", "time_zone", "monthly_evapotranspiration", "k_Rs",
)


class Entry(NamedTuple):
    """A value in a site's description, and its source."""

    value: Any
    file: Path | None = None
    """file that contains the value; None if a program set the value"""
    line: int | None = None
    plain: str = ""
    """plain key that determines the value; empty without a plain key"""


class Translation(NamedTuple):
    """A site's entries, converted to the paper's names."""

    entries: dict[str, Entry]
    """entries by name; entries in `computed` have a placeholder as their value"""
    computed: dict[str, Callable[[Site], float]]
    """functions that compute parameters from a site's other parameters, by name"""


def determined_by(key: str) -> tuple[str, ...]:
    """Return the paper's parameters that a plain key determines."""
    return tuple(name for name in _RIVALS[key] if name not in PLAIN)


def override(base: Mapping[str, Entry], own: Mapping[str, Entry]) -> dict[str, Entry]:
    """Return the entries of one level of a site, together with those of the levels below.

    Entries of the level itself take precedence.

    Args:
        base: entries of the lower levels; may be empty.
        own: entries of the level itself.

    Raises:
        ConfigurationError: if two keys of the level set the same parameter; the message names both
            keys.
    """
    replaced = {rival for name in own for rival in _RIVALS.get(name, ())}
    for name, (value, file, line, _) in own.items():
        rivals = _RIVALS.get(name, ())
        for rival in (rival for rival in rivals if rival in own and name in PLAIN):
            where = "" if own[rival].line is None else f" in line {own[rival].line}"
            raise ConfigurationError(
                f"contradicts {rival} = {own[rival].value}{where}, which sets the same quantity: "
                "remove one of the two keys", file=file, line=line, key=name, value=value,
            )
    if own.keys() >= _PLACE:
        replaced.update(_FOLLOW_PLACE)
    return {**{name: each for name, each in base.items() if name not in replaced}, **own}


def translate(entries: Mapping[str, Entry]) -> Translation:
    """Convert plain keys, and return all entries under the paper's names.

    Raises:
        ConfigurationError: if a plain key has an invalid value, or if another key that the plain
            key requires is missing.
    """
    given = {name: each.value for name, each in entries.items() if name in PLAIN}
    for name, value in given.items():
        if value is None:
            raise ConfigurationError(NO_VALUE, key=name)
    keys = make_record(PlainKeys, given)
    named = {name: each for name, each in entries.items() if name not in PLAIN}
    computed: dict[str, Callable[[Site], float]] = {}

    def place(plain: str, name: str, value: float) -> None:
        named[name] = entries[plain]._replace(value=value, plain=plain)

    for plain, name in _RENAMED.items():
        if plain in given:
            place(plain, name, getattr(keys, plain))
    if keys.substrate is not None:
        substrate = SUBSTRATES[keys.substrate]
        for name in _OF_SUBSTRATE:
            if name not in named:  # otherwise a level above the substrate's sets it
                place("substrate", name, getattr(substrate, name))
    if (volume := keys.cistern_volume) is not None:
        place("cistern_volume", "a1", 1.0)
        computed["a1"] = lambda site: volume / site.z_o
    if (pump := _find_pump(keys)) is not None:
        plain, flow = pump
        place(plain, "c_hat", 1.0)
        place(plain, "a_hat", -1.0)
        computed["c_hat"] = lambda site: _HEAD_OF_CONSTANT_FLOW + site.d
        computed["a_hat"] = lambda site: (
            site.pipe_resistance - _HEAD_OF_CONSTANT_FLOW / flow(site) ** 2
        )
    return Translation(named, computed)


def _find_pump(keys: PlainKeys) -> tuple[str, Callable[[Site], float]] | None:
    """Return the key that sets the pump's flow, and a function that returns the flow (m3/s).

    Raises:
        ConfigurationError: if only one of the number and the flow of emitters is given.
    """
    litres, rate = keys.pump_flow, keys.irrigation_rate
    if litres is not None:
        return "pump_flow", lambda _: litres * LITRES_PER_HOUR
    if rate is not None:
        return "irrigation_rate", lambda site: rate * site.a2 * LITRES_PER_HOUR
    number, each = keys.emitters, keys.emitter_flow
    if number is not None and each is not None:
        return "emitters", lambda _: number * each * LITRES_PER_HOUR
    for name, other in (("emitters", "emitter_flow"), ("emitter_flow", "emitters")):
        if (value := getattr(keys, name)) is not None:
            raise ConfigurationError(f"also needs {other}", key=name, value=value)
    return None
