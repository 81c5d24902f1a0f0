"""Write a site file from the answers to a few questions: ``greenroof new-site``."""

from __future__ import annotations

import argparse
import re
import select
import shlex
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from zoneinfo import ZoneInfo

from greenroof_ros.base.command_line import Parser, command, make_number_type, print_lines
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.ranges import read_number
from greenroof_ros.base.text import escape
from greenroof_ros.commands.new_site_file import ASSUMED, format_new_site
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.simulation.run import note_pumps
from greenroof_ros.site.clock import standard_offset
from greenroof_ros.site.file import SITE_KEYS, SUBSTRATES, read_site
from greenroof_ros.site.site import Site, format_place

# Options and the keys that they set: those that the command asks for, and those it can assume.
_ASKED = {"roof": "roof_area", "catchment": "catchment_area", "cistern": "cistern_volume"}
_ASSUMED = {
    key.replace("_", "-"): key for key in (
        "cistern_height", "runoff_coefficient", "substrate", "substrate_depth", "pump_flow",
        "irrigation_rate", "emitters", "emitter_flow", "elevation",
    )
}
_PLACE_FORM = "latitude,longitude in degrees with decimal points, such as 43.63,-79.40"
# k_Rs of FAO-56, Eq. 50, near a large body of water.
_COAST = 0.19
# No house is further south, and no town is further north than Longyearbyen (degrees).
_SOUTH, _NORTH = -60.0, 79.0
# Standard time differs from solar time by at most the first value, in the west of China, and
# usually by less than the second (h).
_MAX_FROM_SOLAR, _USUAL_FROM_SOLAR = 3.5, 1.6

_DESCRIPTION = """\
Write a site file for your house. On a terminal, the command asks for --roof, --catchment, --cistern
and --place if they are left out. Everything else is assumed, and the file states the source of
every assumption. Read the file, and replace assumed values with your own where you know them.
"""
_EPILOG = f"""\
examples:
  greenroof new-site
  greenroof new-site --roof 120 --catchment 200 --cistern 5 --place 43.63,-79.40
  greenroof new-site --roof 40 --catchment 120 --cistern 3 --place 52.52,13.40 \\
      --substrate extensive --substrate-depth 0.08 --emitters 160 --emitter-flow 1.6 \\
      --valve --time-zone Europe/Berlin --output berlin.yaml

substrates:
{chr(10).join(textwrap.fill(f"{name}: {each['about']}", 78, initial_indent="  ",
              subsequent_indent="    ") for name, each in SUBSTRATES.items())}

exit codes: 0 done, 2 bad usage or answers, 130 interrupted
"""


class Place(NamedTuple):
    """A location on Earth (degrees)."""

    latitude: float
    longitude: float


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof new-site", usage="%(prog)s [options]", description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    # This makes -33.87,151.21 a value and not an option.
    parser._negative_number_matcher = re.compile(r"-[\d.]")
    group = parser.add_argument_group("asked for if they are omitted")
    for option, key in _ASKED.items():
        _add_option(group, option, key)
    group.add_argument(
        "--place", type=_read_place, metavar="LAT,LON",
        help="set the latitude, positive to the north, and the longitude, positive to the east "
        "(degrees)",
    )
    group = parser.add_argument_group("assumed if they are omitted")
    assumed = {
        **ASSUMED, "substrate_depth": "the depth stated in the substrate's source",
        **dict.fromkeys(("pump_flow", "emitters", "emitter_flow", "elevation"), ""),
    }
    for option, key in _ASSUMED.items():
        _add_option(group, option, key, assumed[key])
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
    group.add_argument(
        "--lift", dest="d", type=make_number_type(0.1, 500.0), metavar="X",
        help="height of the roof above the cistern's base, which affects only the pump's energy "
        f"(m; default: {ASSUMED['d']})",
    )
    group.add_argument(
        "--time-zone", type=_read_zone, metavar="NAME",
        help="IANA time zone, such as America/Toronto (default: the time zone stated in the "
        "weather file)",
    )
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


def _add_option(
    group: argparse._ArgumentGroup, option: str, key: str, default: str = ""
) -> None:
    """Add the option that sets a key of a site file.

    Args:
        group: group of options.
        option: name of the option, without dashes.
        key: the key.
        default: description of the default; empty if there is none.
    """
    entry = SITE_KEYS[key]
    about = [_describe_unit(entry), default and f"default: {default}"]
    end = "; ".join(filter(None, about))
    settings: dict[str, Any] = {"metavar": "X"}
    if entry.among:
        settings = {"choices": entry.among}
    else:
        settings["type"] = _reader(key)
    group.add_argument(
        f"--{option}", dest=key, help=entry.meaning + (f" ({end})" if end else ""), **settings
    )


def _reader(key: str) -> Callable[[str], float]:
    """Return a function that parses the numeric value of a key."""
    entry = SITE_KEYS[key]
    return make_number_type(entry.low, entry.high, int if key == "emitters" else float)


def _describe_unit(entry: Parameter) -> str:
    usual = "" if entry.usual is None else f"usually {entry.usual[0]:g} to {entry.usual[1]:g}"
    return ", ".join(filter(None, (entry.unit if entry.unit != "1" else "", usual)))


def _read_place(text: str) -> Place:
    """Parse a location.

    Raises:
        argparse.ArgumentTypeError: if the text is not a location, or if there can be no house at
            the location.
    """
    parts = re.split(r"[,;\s]+", text.strip())
    try:
        latitude, longitude = map(read_number, parts)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be {_PLACE_FORM}, not {text}") from None
    if not (_SOUTH <= latitude <= _NORTH and -180 <= longitude <= 180):
        swapped = _SOUTH <= longitude <= _NORTH and -180 <= latitude <= 180
        meant = f"; did you mean {longitude:g},{latitude:g}?" if swapped else ""
        raise argparse.ArgumentTypeError(
            f"must be {_PLACE_FORM}, with a latitude from {_SOUTH:g} to {_NORTH:g} and a "
            f"longitude from -180 to 180, not {text}{meant}"
        )
    return Place(latitude, longitude)


def _read_zone(text: str) -> str:
    """Read the name of a time zone.

    Raises:
        argparse.ArgumentTypeError: if there is no time zone with this name.
    """
    try:
        return ZoneInfo(text).key
    except (OSError, ValueError, KeyError):
        raise argparse.ArgumentTypeError(
            f"must be the IANA name of a time zone, such as America/Toronto, not {text}"
        ) from None


@command
def main() -> None:
    """Write the site file that the command line and the answers describe."""
    arguments = make_parser().parse_args()
    output: Path = arguments.output
    refuse_unwritable(output, ".yaml", ".yml")
    _ask_what_is_missing(arguments)
    _check_clock(arguments.place, arguments.time_zone)
    text = format_new_site(
        _collect(arguments), valve=arguments.valve, mains=not arguments.no_mains
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
    for option, key in (*_ASKED.items(), *_ASSUMED.items()):
        _note_unusual(option, SITE_KEYS[key], getattr(arguments, key))
    print_lines("note", (*_note_target(site), *note_pumps(site)))
    with add_path_to_errors(output), output.open("x", encoding="utf-8") as stream:
        stream.write(text)
    print(escape(f"written: {output}, for a house at {format_place(*arguments.place)}"))
    where = "a coastal place" if site.k_Rs == _COAST else "an interior place; --coast changes it"
    print(f"k_Rs:    {site.k_Rs}, for {where}")
    name = escape(shlex.quote(str(output)))
    start = "2025-06-01" if site.latitude is None or site.latitude >= 0 else "2025-01-01"
    print(
        f"weather: greenroof fetch-weather --site {name} --years 2021-2025 --output weather.csv\n"
        f"run:     greenroof simulate --site {name} --weather weather.csv --start {start} "
        "--hours 720 --controller onoff --pump-min-off 1800"
    )


def _ask_what_is_missing(arguments: argparse.Namespace) -> None:
    """Ask on a terminal for the values that cannot be assumed.

    Raises:
        ConfigurationError: if there is no terminal, or if the input ends.
    """
    questions = [
        *((f"--{option}", key, _reader(key), SITE_KEYS[key].meaning, _describe_unit(SITE_KEYS[key]))
          for option, key in _ASKED.items()),
        ("--place", "place", _read_place, "place", _PLACE_FORM),
    ]
    missing = [each for each in questions if getattr(arguments, each[1]) is None]
    if missing and not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigurationError(
            "must be specified, since there is no terminal on which to ask for missing values",
            key=", ".join(each[0] for each in missing),
        )
    for option, key, read, meaning, about in missing:
        while getattr(arguments, key) is None:
            print(f"{meaning[0].upper()}{meaning[1:]} ({about}): ", end="", flush=True)
            # Unlike input(), this does not lose a Ctrl-C that arrives just before it waits.
            while not select.select([sys.stdin], [], [], 1.0)[0]:
                pass
            if not (answer := sys.stdin.readline()):
                raise ConfigurationError(
                    "is missing, since the question was not answered", key=option
                )
            try:
                setattr(arguments, key, read(answer.strip()))
            except argparse.ArgumentTypeError as error:
                print(escape(f"  {error}"))


def _collect(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the values of the options and answers by site-file key."""
    keys = (*_ASKED.values(), *_ASSUMED.values(), "time_zone", "d", "k_Rs")
    given = {key: value for key in keys if (value := getattr(arguments, key)) is not None}
    if arguments.target is not None:
        given["z_veg"] = arguments.target / 1000
    return {**given, **arguments.place._asdict()}


def _check_clock(place: Place, zone: str | None) -> None:
    """Reject a location far from its time zone, since its coordinates may be swapped.

    Args:
        place: the location.
        zone: name of the time zone; None if it is not known.

    Raises:
        ConfigurationError: if the location cannot be in the time zone.
    """
    if zone is None:
        return
    offset = standard_offset(zone)
    # Two places with the same solar time can lie on different sides of the date line.
    away, swapped = (
        abs((offset - degrees / 15 + 12) % 24 - 12) for degrees in (place.longitude, place.latitude)
    )
    if away > _MAX_FROM_SOLAR or swapped < _USUAL_FROM_SOLAR < away:
        raise ConfigurationError(
            f"is not in {zone}, which is {offset:+g} h from UTC; must be "
            f"{_PLACE_FORM}", key="--place",
            value=f"{place.latitude:g},{place.longitude:g}",
        )


def _note_target(site: Site) -> Iterator[str]:
    """Yield a note if plants lack water at the target, since the target's unit may be wrong."""
    onset = site.wilting_volume + site.stress_onset * site.available_volume
    if site.x2_star < onset:
        yield (
            f"plants lack water at the target of {1000 * site.z_veg:g} mm; water stress begins "
            f"at {1000 * site.roof_level(onset):.1f} mm"
        )


def _note_unusual(option: str, entry: Parameter, value: Any) -> None:
    """Print a note about a number far outside its usual range, since its unit may be wrong.

    Args:
        option: name of the option, without dashes.
        entry: the key that the option sets, with its usual range.
        value: value of the option.
    """
    if isinstance(value, (int, float)) and entry.usual and not (
        entry.usual[0] / 2 <= value <= 2 * entry.usual[1]
    ):
        unit = f" {entry.unit}" if entry.unit not in ("", "1") else ""
        print(
            f"note: --{option} {value:g}{unit} is unusual; is the unit right? The value is usually "
            f"{entry.usual[0]:g} to {entry.usual[1]:g}", file=sys.stderr,
        )

