"""Plain keys of a site file: everyday words that replace parameters of the paper.

A file may use plain keys or the paper's symbols. A site is described on several levels: files that
extend one another, and values that a program changes. A value on one level takes precedence over
all values of the same quantity on lower levels, whichever key they use. Within a level, two keys
for the same quantity are an error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.parameter import entry
from greenroof_ros.site.site import Site

LITRES_PER_HOUR = 1 / 3.6e6
"""factor from l/h to m3/s, and from mm/h on 1 m2 to m3/s"""

# Head of the pump curve that stands for a constant flow (m). According to Eq. (3e), the flow is
# proportional to the square root of this head plus the cistern's level, so a level of 3 m raises
# the flow by only 1.5e-6 of its value.
_HEAD_OF_CONSTANT_FLOW = 1e6

SUBSTRATES: dict[str, dict[str, Any]] = {
    **read_yaml(shared_directory() / "config" / "substrates.yaml")
}
"""the substrates of ``config/substrates.yaml``, by name"""


def _plain(
    determines: str, meaning: str, low: float = -math.inf, high: float = math.inf, unit: str = "",
    usual: tuple[float, float] | None = None, choices: tuple[str, ...] = (),
) -> Any:
    """Return a field for a plain key, see :func:`.entry`, that determines parameters."""
    made = entry(meaning, low, high, unit=unit, default=None, usual=usual, choices=choices)
    return field(default=None, metadata={**made.metadata, "determines": (*determines.split(),)})


@dataclass(frozen=True, kw_only=True)
class PlainKeys:
    """The plain keys, each of which is optional."""

    cistern_volume: float | None = _plain(
        "a1", "volume of the cistern up to its overflow", 0.01, 1e5, "m3", (1, 50)
    )
    cistern_height: float | None = _plain(
        "z_o", "height of the cistern's overflow above its base", 0.1, 50.0, "m", (1, 3)
    )
    catchment_area: float | None = _plain(
        "a_in", "area that drains to the cistern", 0.1, 1e6, "m2", (50, 2000)
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
class Description(Site, PlainKeys):
    """A site as it is described: with the plain keys, which come first and are checked first."""


DETERMINES: dict[str, tuple[str, ...]] = {
    each.name: each.metadata["determines"] for each in fields(PlainKeys)
}
"""the paper's parameters that each plain key determines"""
_EMITTERS = ("emitters", "emitter_flow")
_PLACE = {"latitude", "longitude"}
# Keys that a file for another place does not inherit from the file that it extends.
_FOLLOW_PLACE = {"elevation", "utc_offset", "time_zone", "monthly_evapotranspiration", "k_Rs"}


class Entry(NamedTuple):
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


def translate(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the paper's parameters that follow from plain keys.

    The parameters that :func:`compute` computes have placeholders.
    """
    soil = SUBSTRATES.get(str(values.get("substrate")), {})
    return {
        name: -1.0 if name == "a_hat" else soil.get(name, values[plain])
        for plain, names in DETERMINES.items() if plain in values for name in names
    }


def compute(site: Description) -> Description:
    """Return a site with the parameters that follow from plain keys and other parameters."""
    values = {}
    if site.cistern_volume is not None:
        values["a1"] = site.cistern_volume / site.z_o
    litres = site.pump_flow or (site.emitters or 0) * (site.emitter_flow or 0.0)
    litres = litres or (site.irrigation_rate or 0.0) * site.a2
    if litres:
        flow = litres * LITRES_PER_HOUR
        values["c_hat"] = _HEAD_OF_CONSTANT_FLOW + site.d
        values["a_hat"] = site.pipe_resistance - _HEAD_OF_CONSTANT_FLOW / flow**2
    return replace(site, **values)
