r"""Write a site file for your house.

Only the areas, the volume of the cistern and the place must be given. Everything else is assumed,
and the file states the source of every assumption. Read the file, and replace assumed values with
your own where you know them.

Examples:
  greenroof new-site --roof 120 --catchment 200 --cistern 5 --place 43.63,-79.40
  greenroof new-site --roof 40 --catchment 120 --cistern 3 --place 52.52,13.40 \
      --substrate extensive --substrate-depth 0.08 --valve --time-zone Europe/Berlin \
      --output berlin.yaml

Exit codes: 0 done, 2 bad usage or answers, 130 interrupted

substrates:
"""

from __future__ import annotations

import math
import re
import textwrap
from collections import ChainMap
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any

from greenroof_ros.base.command_line import (
    Parser,
    add_option,
    command,
    make_number_type,
    print_lines,
    refuse_unwritable,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.text import escape
from greenroof_ros.physics.cistern import EMPTIED_H, find_outlet_radius
from greenroof_ros.simulation.run import note_pumps
from greenroof_ros.site.clock import standard_offset
from greenroof_ros.site.file import LITRES_PER_HOUR, SITE_KEYS, SUBSTRATES, read_site
from greenroof_ros.site.site import MUCH_RAIN, format_place

# The site file of a house about which nothing is known. It contains the assumed values and their
# sources, so that its readers can correct the assumptions.
_TEMPLATE = Path(__file__).with_name("new_site.yaml").read_text(encoding="utf-8")
# An entry, which may be a comment, its unit, and its meaning that ends with its source in brackets.
_ENTRY = re.compile(
    r"^(?P<off># )?(?P<key>\w+): (?P<value>\S+) *# (?P<unit>\S*) +(?P<meaning>[^\[]*)"
    r"(?P<source>\[[^]]*\])", re.MULTILINE,
)
_ASSUMED = {entry["key"]: entry["value"] for entry in _ENTRY.finditer(_TEMPLATE)}
# Options that must be given, with the keys that they set; and keys that can be assumed.
_NEEDED = {"roof": "roof_area", "catchment": "catchment_area", "cistern": "cistern_volume"}
_OPTIONAL = (
    "cistern_height", "runoff_coefficient", "substrate", "irrigation_rate", "substrate_depth",
    "time_zone",
)
# No house is further south, and no town is further north than Longyearbyen (degrees).
_read_latitude, _read_longitude = make_number_type(-60.0, 79.0), make_number_type(-180.0, 180.0)
# Evapotranspiration of reference grass on a July day in Toronto (m).
_DAY = 0.004
# The target is at most this share of the water that the substrate holds.
_MAX_FILLED = 0.95
# Minimum flow from the mains (m3/s), from config/site_valve.yaml.
_MAINS_FLOW = 2e-4


def make_parser() -> Parser:
    """Return the command's parser."""
    substrates = (
        textwrap.fill(f"{name}: {each['about']}", 78, initial_indent="  ", subsequent_indent="    ")
        for name, each in SUBSTRATES.items()
    )
    parser = Parser.of(
        "new-site", "\n".join([str(__doc__).rstrip(), *substrates]),
        "--roof M2 --catchment M2 --cistern M3 --place LAT,LON [options]",
    )
    # This makes -33.87,151.21 a value and not an option.
    parser._negative_number_matcher = re.compile(r"-[\d.]")
    group = parser.add_argument_group("the house")
    for name, key in _NEEDED.items():
        add_option(group, replace(SITE_KEYS[key], name=name), dest=key, required=True)
    group.add_argument(
        "--place", type=_read_place, required=True, metavar="LAT,LON",
        help="latitude,longitude in degrees with decimal points, such as 43.63,-79.40",
    )
    group = parser.add_argument_group("assumed if they are omitted")
    for key in _OPTIONAL:
        assumed = _ASSUMED[key] if key in _OPTIONAL[:4] else None
        add_option(group, replace(SITE_KEYS[key], default=assumed))
    group.add_argument(
        "--coast", dest="k_Rs", action="store_const", const=0.19,
        help="the house is at the coast of a sea or a large lake: k_Rs is 0.19 instead of 0.16 "
        "(FAO-56, Eq. 50), which matters for weather without radiation",
    )
    group.add_argument(
        "--valve", action="store_true",
        help="add a low outlet with a valve, which drains the cistern before rain",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("my_site.yaml"), metavar="FILE.yaml",
        help="write the site to this file, which must not exist yet (default: %(default)s)",
    )
    return parser


def _read_place(text: str) -> tuple[float, float]:
    """Parse a latitude and a longitude."""
    latitude, _, longitude = text.partition(",")
    return _read_latitude(latitude.strip()), _read_longitude(longitude.strip())


def format_new_site(given: Mapping[str, Any], *, valve: bool = False) -> str:
    """Return the text of a site file.

    Args:
        given: given values, by their keys in a site file. ``roof_area``, ``catchment_area``,
            ``cistern_volume``, ``latitude`` and ``longitude`` are required; other values replace
            assumptions.
        valve: whether the cistern has a low outlet with a valve.
    """
    paper, known = read_site(default_site_file()), ChainMap({**given}, _ASSUMED)
    substrate, volume = SUBSTRATES[known["substrate"]], given["cistern_volume"]
    depth = given.get("substrate_depth", substrate["depth"])
    capacity, wilting = substrate["field_capacity"], substrate["wilting_point"]
    onset = depth * (wilting + (1 - substrate["depletion_fraction"]) * (capacity - wilting))
    # As recommended in doc/howto/choose-target-and-controller.md.
    day = _DAY * float(known["crop_coefficient"])
    target = math.floor(1e4 * min(onset + day, _MAX_FILLED * depth * capacity)) / 1e4
    litres = float(known["irrigation_rate"]) * given["roof_area"]
    height = float(known["cistern_height"])
    inflow, below = MUCH_RAIN / 3.6e6 * given["catchment_area"], float(known["d"]) - height
    share = inflow / paper.c_out / math.sqrt(max(below, 0.01) / 2)
    emptied = find_outlet_radius(
        paper, volume / height, height - float(known["low_outlet_level"]), 3600 * EMPTIED_H
    )
    values = {
        "r_o": max(paper.r_o, math.ceil(100 * paper.r_o * math.sqrt(share)) / 100),
        "low_outlet_radius": max(0.001, float(f"{emptied:.2g}")),
        "mains_flow": max(_MAINS_FLOW, float(f"{1.2 * litres * LITRES_PER_HOUR:.2g}")),
        "substrate_depth": depth, "z_veg": target, "pump_flow": float(f"{litres:.3g}"),
        "initial_cistern": volume / 2, "initial_roof": target * given["roof_area"],
        "utc_offset": float(round(given["longitude"] / 15)), **given,
    }
    with suppress(KeyError, ValueError, OSError):  # reading the file rejects a wrong time zone
        values["utc_offset"] = standard_offset(given["time_zone"])

    def complete(entry: re.Match[str]) -> str:
        """Put a value into an entry, and align its parts."""
        key, value = entry["key"], values.get(entry["key"], entry["value"])
        stated = key in given or (key == "utc_offset" and "time_zone" in given)
        off = "" if stated or (valve and key.startswith("low_outlet_")) else entry["off"] or ""
        if isinstance(value, float) and value % 1:
            value = f"{value:.6g}"
        source = "[given]" if key in given else entry["source"]
        return f"{f'{off}{key}: {value}':<29} # {entry['unit']:<7} {entry['meaning']}{source}"

    return _ENTRY.sub(complete, Template(_TEMPLATE).substitute(
        much_rain=f"{MUCH_RAIN:g}", onset=f"{1000 * onset:.1f}", day=f"{1000 * day:.1f}",
    ))


@command
def main() -> None:
    """Write the site file that the command line describes."""
    arguments = make_parser().parse_args()
    output, place = arguments.output, arguments.place
    refuse_unwritable(output, ".yaml", ".yml")
    keys = (*_NEEDED.values(), *_OPTIONAL, "k_Rs")
    given = {key: value for key in keys if (value := getattr(arguments, key)) is not None}
    given["latitude"], given["longitude"] = place
    with output.open("x", encoding="utf-8") as stream:
        stream.write(format_new_site(given, valve=arguments.valve))
    try:
        site = read_site(output)
    except ConfigurationError:
        output.unlink()
        raise
    print_lines("note", note_pumps(site))
    print(escape(f"written: {output}, for a house at {format_place(*place)}"))
