r"""Write a site file for your house.

Only the areas, the volume of the cistern and the place must be given. Everything else is assumed,
and the file states the source of every assumption. Read the file, and replace assumed values with
your own where you know them.

Examples:
  greenroof new-site --roof 120 --catchment 200 --cistern 5 --place 43.63,-79.40
  greenroof new-site --roof 40 --catchment 120 --cistern 3 --place 52.52,13.40 \
      --substrate extensive --substrate-depth 0.08 --emitters 160 --emitter-flow 1.6 \
      --valve --time-zone Europe/Berlin --output berlin.yaml

Exit codes: 0 done, 2 bad usage or answers, 130 interrupted

substrates:
"""

from __future__ import annotations

import argparse
import math
import re
import shlex
import tempfile
import textwrap
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.base.command_line import (
    Parser,
    add_option,
    command,
    make_number_type,
    print_lines,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.ranges import read_number
from greenroof_ros.base.text import escape
from greenroof_ros.commands.new_site_file import ASSUMED, format_new_site
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.simulation.run import note_pumps
from greenroof_ros.site.clock import standard_offset
from greenroof_ros.site.file import SITE_KEYS, SUBSTRATES, read_site
from greenroof_ros.site.site import Site, format_place

# Options that must be given, with the keys that they set; and keys that can be assumed, with their
# defaults.
_NEEDED = {"roof": "roof_area", "catchment": "catchment_area", "cistern": "cistern_volume"}
_ASSUMED = {
    **{key: ASSUMED[key] for key in (
        "cistern_height", "runoff_coefficient", "substrate", "irrigation_rate",
    )},
    "substrate_depth": "the depth in the substrate's source",
    **dict.fromkeys(("pump_flow", "emitters", "emitter_flow", "elevation")),
}
_PLACE_FORM = "latitude,longitude in degrees with decimal points, such as 43.63,-79.40"
# k_Rs of FAO-56, Eq. 50, near a large body of water.
_COAST = 0.19
# No house is further south, and no town is further north than Longyearbyen (degrees).
_SOUTH, _NORTH = -60.0, 79.0
# Standard time differs from solar time by at most the first value, in the west of China, and
# usually by less than the second (h).
_MAX_FROM_SOLAR, _USUAL_FROM_SOLAR = 3.5, 1.6


class Place(NamedTuple):
    """A location on Earth (degrees)."""

    latitude: float
    longitude: float


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
        "--place", type=_read_place, required=True, metavar="LAT,LON", help=_PLACE_FORM
    )
    group = parser.add_argument_group("assumed if they are omitted")
    for key, default in _ASSUMED.items():
        add_option(group, replace(SITE_KEYS[key], default=default))
    group.add_argument(
        "--coast", dest="k_Rs", action="store_const", const=_COAST,
        help=f"the house is at the coast of a sea or a large lake: k_Rs is {_COAST} instead of "
        f"{ASSUMED['k_Rs']} (FAO-56, Eq. 50), which matters for weather without radiation",
    )
    group.add_argument(
        "--target", type=make_number_type(1.0, 1000.0), metavar="X",
        help="water to keep in the substrate (mm, default: onset of stress plus a day's demand)",
    )
    lift = replace(SITE_KEYS["d"], name="lift", default=ASSUMED["d"], low=0.1, high=500.0)
    add_option(group, lift, dest="d")
    add_option(group, SITE_KEYS["time_zone"], metavar="NAME")
    flag = partial(group.add_argument, action="store_true")
    flag("--valve", help="add a low outlet with a valve, which drains the cistern before rain")
    flag("--no-mains", help="do not top up an empty cistern with mains water")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("my_site.yaml"), metavar="FILE.yaml",
        help="write the site to this file, which must not exist yet (default: %(default)s)",
    )
    return parser


def _read_place(text: str) -> Place:
    """Parse a location, at which there can be a house."""
    place = Place(math.nan, math.nan)
    with suppress(ValueError, TypeError):
        place = Place(*map(read_number, re.split(r"[,;\s]+", text.strip())))
    if not _is_place(*place):
        swapped = Place(*reversed(place))
        meant = "; did you mean {:g},{:g}?".format(*swapped) if _is_place(*swapped) else ""
        raise argparse.ArgumentTypeError(
            f"must be {_PLACE_FORM}, with a latitude from {_SOUTH:g} to {_NORTH:g} and a "
            f"longitude from -180 to 180, not {text}{meant}"
        )
    return place


def _is_place(latitude: float, longitude: float) -> bool:
    return _SOUTH <= latitude <= _NORTH and -180 <= longitude <= 180


@command
def main() -> None:
    """Write the site file that the command line and the answers describe."""
    arguments = make_parser().parse_args()
    output: Path = arguments.output
    refuse_unwritable(output, ".yaml", ".yml")
    place = arguments.place
    if arguments.time_zone is not None:
        _check_clock(place, arguments.time_zone)
    keys = (*_NEEDED.values(), *_ASSUMED, "time_zone", "d", "k_Rs")
    given = {key: value for key in keys if (value := getattr(arguments, key)) is not None}
    target = {} if arguments.target is None else {"z_veg": arguments.target / 1000}
    text = format_new_site(
        {**given, **target, **place._asdict()}, valve=arguments.valve, mains=not arguments.no_mains
    )
    try:
        with tempfile.TemporaryDirectory() as directory:
            file = Path(directory, output.name)
            file.write_text(text, encoding="utf-8")
            site = read_site(file)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"no valid site file can be written from these answers: {error.wrong}"
        ) from error
    print_lines("note", (*_note(given, site), *note_pumps(site)))
    with add_path_to_errors(output), output.open("x", encoding="utf-8") as stream:
        stream.write(text)
    print(escape(f"written: {output}, for a house at {format_place(*place)}"))
    where = "a coastal place" if site.k_Rs == _COAST else "an interior place; --coast changes it"
    name, start = escape(shlex.quote(str(output))), "06" if place.latitude >= 0 else "01"
    print(
        f"k_Rs:    {site.k_Rs}, for {where}\n"
        f"weather: greenroof fetch-weather --site {name} --years 2021-2025 --output weather.csv\n"
        f"run:     greenroof simulate --site {name} --weather weather.csv --start 2025-{start}-01 "
        "--hours 720 --controller onoff --pump-min-off 1800"
    )


def _check_clock(place: Place, zone: str) -> None:
    """Reject a location far from its time zone, since its coordinates may be swapped.

    Raises:
        ConfigurationError: if there is no such time zone, or if the location cannot be in it.
    """
    try:
        offset = standard_offset(zone)
    except (OSError, ValueError, KeyError):
        raise ConfigurationError(
            "must be the IANA name of a time zone, such as America/Toronto", key="--time-zone",
            value=zone,
        ) from None
    # Two places with the same solar time can lie on different sides of the date line.
    swapped, away = (abs((offset - degrees / 15 + 12) % 24 - 12) for degrees in place)
    if away > _MAX_FROM_SOLAR or swapped < _USUAL_FROM_SOLAR < away:
        raise ConfigurationError(
            f"is not in {zone}, which is {offset:+g} h from UTC; must be {_PLACE_FORM}",
            key="--place", value="{:g},{:g}".format(*place),
        )


def _note(given: dict[str, Any], site: Site) -> Iterator[str]:
    """Yield a note about each number whose unit may be wrong.

    It is far outside its usual range, or plants lack water at the target.
    """
    for key, value in given.items():
        if usual := SITE_KEYS[key].usual:
            low, high = usual
            if not low / 2 <= value <= 2 * high:
                yield (
                    f"{key} = {value:g} {SITE_KEYS[key].unit} is unusual; is the unit right? The "
                    f"value is usually {low:g} to {high:g}"
                )
    onset = site.wilting_volume + site.stress_onset * site.available_volume
    if site.x2_star < onset:
        yield (
            f"plants lack water at the target of {1000 * site.z_veg:g} mm; water stress begins "
            f"at {1000 * site.roof_level(onset):.1f} mm"
        )
