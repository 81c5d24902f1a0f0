r"""Write a site file for your house.

On a terminal, the command asks for --roof, --catchment, --cistern and --place if they are left out.
Everything else is assumed, and the file states the source of every assumption. Read the file, and
replace assumed values with your own where you know them.

Examples:
  greenroof new-site
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
import select
import shlex
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo

from greenroof_ros.base.command_line import (
    Parser,
    add_option,
    command,
    command_parser,
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

# Options and the keys that they set: those that the command asks for, and those it can assume, each
# with its default.
_ASKED = {"roof": "roof_area", "catchment": "catchment_area", "cistern": "cistern_volume"}
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
    parser = command_parser("new-site", "\n".join([str(__doc__).rstrip(), *substrates]))
    # This makes -33.87,151.21 a value and not an option.
    parser._negative_number_matcher = re.compile(r"-[\d.]")
    group = parser.add_argument_group("asked for if they are omitted")
    for name, key in _ASKED.items():
        add_option(group, replace(SITE_KEYS[key], name=name), dest=key)
    group.add_argument("--place", type=_read_place, metavar="LAT,LON", help=_PLACE_FORM)
    group = parser.add_argument_group("assumed if they are omitted")
    for key, default in _ASSUMED.items():
        add_option(group, replace(SITE_KEYS[key], default=default))
    group.add_argument(
        "--coast", dest="k_Rs", action="store_const", const=_COAST,
        help=f"the house is at the coast of a sea or a large lake: k_Rs is {_COAST}, and not "
        f"{ASSUMED['k_Rs']} as for interior places (FAO-56, Eq. 50), which matters for weather "
        "files without radiation",
    )
    group.add_argument(
        "--target", type=make_number_type(1.0, 1000.0), metavar="X",
        help="water to keep in the substrate (mm; default: the depth at which plants begin to lack "
        "water, plus one day's demand)",
    )
    lift = replace(SITE_KEYS["d"], name="lift", default=ASSUMED["d"], low=0.1, high=500.0)
    add_option(group, lift, dest="d")
    add_option(group, SITE_KEYS["time_zone"], type=_read_zone, metavar="NAME")
    group.add_argument(
        "--valve", action="store_true",
        help="add a low outlet with a valve, which drains the cistern before rain",
    )
    group.add_argument(
        "--no-mains", action="store_true",
        help="do not top up an empty cistern with mains water",
    )
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


def _read_zone(text: str) -> str:
    """Read the name of a time zone."""
    try:
        return ZoneInfo(text).key
    except (OSError, ValueError, KeyError):
        raise argparse.ArgumentTypeError(
            f"must be the IANA name of a time zone, such as America/Toronto, not {text}"
        ) from None


@command
def main() -> None:
    """Write the site file that the command line and the answers describe."""
    parser = make_parser()
    arguments = parser.parse_args()
    output: Path = arguments.output
    refuse_unwritable(output, ".yaml", ".yml")
    _ask_what_is_missing(parser, arguments)
    place = arguments.place
    _check_clock(place, arguments.time_zone)
    keys = (*_ASKED.values(), *_ASSUMED, "time_zone", "d", "k_Rs")
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


def _ask_what_is_missing(parser: Parser, arguments: argparse.Namespace) -> None:
    """Ask on a terminal for the values that cannot be assumed.

    Raises:
        ConfigurationError: if there is no terminal, or if the input ends.
    """
    asked = (*_ASKED.values(), "place")
    missing = [
        action for action in parser._actions
        if action.dest in asked and getattr(arguments, action.dest) is None
    ]
    if missing and not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigurationError(
            "must be specified, since there is no terminal on which to ask for missing values",
            key=", ".join(action.option_strings[0] for action in missing),
        )
    for action in missing:
        read: Any = action.type
        while getattr(arguments, action.dest) is None:
            print(f"{str(action.help).capitalize()}: ", end="", flush=True)
            # Unlike input(), this does not lose a Ctrl-C that arrives just before it waits.
            while not select.select([sys.stdin], [], [], 1.0)[0]:
                pass
            if not (answer := sys.stdin.readline()):
                raise ConfigurationError(
                    "is missing, since the question was not answered", key=action.option_strings[0]
                )
            try:
                setattr(arguments, action.dest, read(answer.strip()))
            except argparse.ArgumentTypeError as error:
                print(escape(f"  {error}"))


def _check_clock(place: Place, zone: str | None) -> None:
    """Reject a location far from its time zone, since its coordinates may be swapped.

    Raises:
        ConfigurationError: if the location cannot be in the time zone.
    """
    if zone is None:
        return
    offset = standard_offset(zone)
    # Two places with the same solar time can lie on different sides of the date line.
    swapped, away = (abs((offset - degrees / 15 + 12) % 24 - 12) for degrees in place)
    if away > _MAX_FROM_SOLAR or swapped < _USUAL_FROM_SOLAR < away:
        raise ConfigurationError(
            f"is not in {zone}, which is {offset:+g} h from UTC; must be {_PLACE_FORM}",
            key="--place", value=f"{place.latitude:g},{place.longitude:g}",
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
