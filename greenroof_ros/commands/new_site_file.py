"""The site file of a house about which little is known, made from the template ``new_site.yaml``.

The template contains the assumed values and their sources, so that readers of a site file can
correct the assumptions. Given values take their place, and are marked.
"""

from __future__ import annotations

import math
import re
from collections import ChainMap
from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

from greenroof_ros.base.files import default_site_file
from greenroof_ros.physics.cistern import EMPTIED_H, find_outlet_radius
from greenroof_ros.site.clock import standard_offset
from greenroof_ros.site.file import LITRES_PER_HOUR, SUBSTRATES, read_site
from greenroof_ros.site.site import MUCH_RAIN

_TEMPLATE = Path(__file__).with_name("new_site.yaml").read_text(encoding="utf-8")
# An entry, which may be a comment, its unit, and its meaning that ends with its source in brackets.
_ENTRY = re.compile(
    r"^(?P<off># |\$\{\w+\})?(?P<key>\w+): (?P<value>\S+) *# (?P<unit>\S*) +(?P<meaning>[^\[]*)"
    r"(?P<source>\[[^]]*\])", re.MULTILINE,
)
ASSUMED = {entry["key"]: entry["value"] for entry in _ENTRY.finditer(_TEMPLATE)}
"""what the template assumes, by key"""

# Evapotranspiration of reference grass on a July day in Toronto (m).
_DAY = 0.004
# The target is at most this share of the water that the substrate holds.
_MAX_FILLED = 0.95
# Minimum flow from the mains (m3/s), from config/site_valve.yaml.
_MAINS_FLOW = 2e-4


def format_new_site(
    given: Mapping[str, Any], *, valve: bool = False, mains: bool = True
) -> str:
    """Return the text of a site file.

    Args:
        given: given values, by their keys in a site file. ``roof_area``, ``catchment_area``,
            ``cistern_volume``, ``latitude`` and ``longitude`` are required; other values replace
            assumptions.
        valve: whether the cistern has a low outlet with a valve.
        mains: whether mains water is added when the cistern is nearly empty.
    """
    values = ChainMap({**given}, ASSUMED)

    def number(key: str) -> float:
        return float(values[key])

    substrate = SUBSTRATES[values["substrate"]]
    depth = given.get("substrate_depth", substrate["depth"])
    capacity, wilting = substrate["field_capacity"], substrate["wilting_point"]
    onset = depth * (wilting + (1 - substrate["depletion_fraction"]) * (capacity - wilting))
    # As recommended in doc/howto/choose-target-and-controller.md.
    day = _DAY * number("crop_coefficient")
    target = math.floor(1e4 * min(onset + day, _MAX_FILLED * depth * capacity)) / 1e4
    litres = given.get("pump_flow") or given.get("emitters", 0) * given.get("emitter_flow", 0.0)
    litres = litres or number("irrigation_rate") * given["roof_area"]
    height, volume, zone = number("cistern_height"), given["cistern_volume"], given.get("time_zone")
    computed = {
        "no_zone": zone is None, "no_mains": not mains, "no_valve": not valve,
        "no_rate": not given.keys().isdisjoint(("pump_flow", "emitters")),
        "utc_offset": standard_offset(zone) if zone else float(round(given["longitude"] / 15)),
        "mains_flow": max(_MAINS_FLOW, float(f"{1.2 * litres * LITRES_PER_HOUR:.2g}")),
        "overflow": _find_overflow_radius(given["catchment_area"], number("d") - height),
        "valve_radius": _find_radius(volume, height, height - 0.1),
        "orifice_radius": _find_radius(volume, height, height / 2),
        "much_rain": f"{MUCH_RAIN:g}", "middle": height / 2, "substrates": ", ".join(SUBSTRATES),
        "depth": depth, "target": target, "onset": f"{1000 * onset:.1f}",
        "day": f"{1000 * day:.1f}", "litres": f"{litres:.3g}", "half": volume / 2,
        "roof_volume": float(f"{given.get('z_veg', target) * given['roof_area']:.6g}"),
    }
    text = Template(_TEMPLATE).substitute({key: _format(value) for key, value in computed.items()})

    def complete(entry: re.Match[str]) -> str:
        """Put a given value into an entry, and align its parts."""
        key, off, value, source = entry["key"], entry["off"] or "", entry["value"], entry["source"]
        if key in given:
            off, value, source = "", _format(given[key]), "[given]"
        return f"{f'{off}{key}: {value}':<29} # {entry['unit']:<7} {entry['meaning']}{source}"

    return _ENTRY.sub(complete, text)


def _find_overflow_radius(catchment: float, below: float) -> float:
    """Return the radius (m) of an overflow for a catchment (m2) at a height below the roof (m)."""
    paper, inflow = read_site(default_site_file()), MUCH_RAIN / 3.6e6 * catchment
    share = inflow / paper.c_out / math.sqrt(max(below, 0.01) / 2)
    return max(paper.r_o, math.ceil(100 * paper.r_o * math.sqrt(share)) / 100)


def _find_radius(volume: float, height: float, head: float) -> float:
    """Return the radius (m) of an outlet that drains a cistern by a height of water in 12 h."""
    paper = read_site(default_site_file())
    radius = find_outlet_radius(paper, volume / height, max(0.0, head), 3600 * EMPTIED_H)
    return max(0.001, float(f"{radius:.2g}"))


def _format(value: object) -> str:
    """Return a value as the site file states it; a Boolean makes an entry a comment."""
    if isinstance(value, bool):
        return "# " if value else ""
    return f"{value:.6g}" if isinstance(value, float) and value % 1 else str(value)
