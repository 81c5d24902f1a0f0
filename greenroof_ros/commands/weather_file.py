"""Read weather files in the same way as simulate, and show what they contain.

The table has the period, the rain of each month or year, the wettest hour and day, the range of
every quantity, missing hours, and the method by which evapotranspiration would be computed. Nothing
in a file is guessed or changed: what its columns mean is stated by its header or by a description,
a YAML file beside it, whose keys are also options of this command. If more than one file is given,
the files are joined.

a file in the package's own form needs no description:
  time,rain [mm],temperature [degC]
  2024-06-01T00:00-05:00,0.0,17.3
  2024-06-01T00:05-05:00,0.2,17.2

Examples:
  greenroof weather logger.csv --site my_site.yaml
  greenroof weather gauge.csv --describe > gauge.yaml
  greenroof weather gauge.yaml --output gauge_plain.csv
  greenroof weather gauge.csv --columns "time=[Datum, Uhrzeit]" "rain=Regen [mm]" --rows end
  greenroof weather gauge.csv --na-values=-99 --na-values=---
  greenroof simulate --weather gauge.yaml --start 2021-07-01

Exit codes: 0 done, 2 bad usage, configuration or file
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.base.command_line import Parser, add_site, command, option_of
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import ConfigurationError, rename_keys
from greenroof_ros.base.files import add_path_to_errors, parse_yaml
from greenroof_ros.base.parameter import Parameter, parameters_of
from greenroof_ros.base.times import to_people
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.simulation.screen import grid
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site, format_place, measure_distance
from greenroof_ros.weather.describe import describe
from greenroof_ros.weather.description import Description, make_description
from greenroof_ros.weather.evapotranspiration import FAO56, HARGREAVES
from greenroof_ros.weather.quantities import QUANTITIES
from greenroof_ros.weather.read import (
    complete_records,
    expand,
    find_files,
    read_file,
    read_measured,
)
from greenroof_ros.weather.records import HOUR, Records, name_hours, write_records
from greenroof_ros.weather.series import Weather
from greenroof_ros.weather.summary import as_lines, summarize

_DASH = "A value that begins with a dash is written as --na-values=-99"
_NOT_OPTIONS = "name", "file", "header"
# Files that are shown one by one, and gaps that are named.
_MAX_FILES, _MAX_NAMED = 12, 3

Row = tuple[str, str, str]
"""a label, a value and a description"""


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("weather", __doc__, "FILE [FILE ...] [options]")
    parser.add_argument(
        "files", nargs="+", metavar="FILE",
        help="weather files, descriptions of weather files, directories, or a pattern in quotes",
    )
    add_site(parser, "use the location, time zone and monthly means in this site file")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv",
        help="write the weather to this new CSV file, with which a run yields the same numbers",
    )
    parser.add_argument(
        "--describe", action="store_true",
        help="print a description of the file, in which a person must replace each question mark",
    )
    about = f"They apply to files that are not named by a description. {_DASH}."
    group = parser.add_argument_group("keys of a description", about)
    parser.hint = _DASH
    for key in _options():
        settings: Any = {"nargs": "*", "action": "extend"} if _has_many(key) else {}
        group.add_argument(
            option_of(key.name), help=key.description.replace("%", "%%"), dest=key.name,
            metavar="NAME=VALUE" if _is_mapping(key) else "VALUE", **settings,
        )
    return parser


def _options() -> list[Parameter]:
    return [key for key in parameters_of(Description) if key.name not in _NOT_OPTIONS]


def _is_mapping(key: Parameter) -> bool:
    return "dict" in str(key.kind)


def _has_many(key: Parameter) -> bool:
    return _is_mapping(key) or "tuple" in str(key.kind)


def _read_options(arguments: Namespace) -> Description | None:
    """Return the description that the options state; None without such options."""
    def read(text: str) -> Any:
        return parse_yaml(text, Path(option))

    given = dict[str, Any]()
    for key in _options():
        option, value = option_of(key.name), getattr(arguments, key.name)
        if value is None:
            continue
        if _is_mapping(key):
            pairs = [item.partition("=") for item in value]
            value = {name: read(text) if text[:1] == "[" else text for name, _, text in pairs}
        elif "str" not in str(key.kind):
            value = [*map(read, value)] if _has_many(key) else read(value)
        given[key.name] = value
    return make_description(given) if given else None


@command
def main() -> None:
    """Describe the files named on the command line."""
    arguments = make_parser().parse_args()
    output: Path | None = arguments.output
    if output is not None:
        refuse_unwritable(output, ".csv")
    files = find_files(arguments.files, "FILE")
    if arguments.describe:
        own = {} if arguments.encoding is None else {"encodings": [arguments.encoding]}
        print(describe(files[0], **own), end="")
        return
    site = read_site(arguments.site)
    # A file for another place is described, too; a run rejects it, or warns.
    anywhere = replace(site, latitude=None, longitude=None, elevation=None)
    with rename_keys({key.name: option_of(key.name) for key in _options()}):
        options = _read_options(arguments)
        measured = read_measured(files, anywhere, options)
        sources = [*_describe_sources(files, anywhere, options)]
    show_records(measured, site, sources)
    if output is not None:
        about = "\n".join((*measured.applied, "Written by greenroof weather."))
        with add_path_to_errors(output):
            output.write_text(write_records(measured, about), encoding="utf-8")
        PlainConsole().print(f"written: {output}", soft_wrap=True)


def show_records(measured: Records, site: Site, more: Sequence[Row] = ()) -> None:
    """Print a table of what a weather record contains, and more rows."""
    PlainConsole().print(grid("Weather", [*_describe(measured, site), *more]))


def _describe(measured: Records, site: Site) -> Iterator[Row]:
    try:
        weather, unknown = complete_records(measured, site), ""
    except ConfigurationError as error:
        weather, unknown = complete_records(measured, site, method=""), str(error)
    for text in measured.left_out:
        yield "left out", "", text
    for place in dict.fromkeys(measured.places.values()):
        away = ""
        if site.latitude is not None and site.longitude is not None:
            own = site.latitude, site.longitude
            away = f"{measure_distance(place, own):.0f} km from the site, {format_place(*own)}"
        yield "place", format_place(*place), away
    last = measured.first + (measured.hours - 1) * HOUR
    yield "hours", str(measured.hours), f"{to_people(measured.first)} to {to_people(last)}"
    if measured.rain_late:
        yield "rain", "1 h late", "each time is the end of an hour; a run treats it as the start"
    if measured.rain_kind:
        yield "rain", measured.rain_kind, measured.rain_note
    for line in as_lines(summarize(measured, site)):
        yield "summary", "", line
    for name, series in measured.values.items():
        missing = np.isnan(series)
        if spans := name_hours(measured.first, missing):
            more = f", and {len(spans) - _MAX_NAMED} more" if len(spans) > _MAX_NAMED else ""
            yield f"no {name}", f"{missing.sum()} h", ", ".join(spans[:_MAX_NAMED]) + more
    known = weather.evapotranspiration[~np.isnan(weather.evapotranspiration)]
    if known.size:
        lost = f", unknown in {weather.hours - known.size} hours" * (known.size < weather.hours)
        yield "evapotranspiration", weather.method, f"mean {known.mean():.2f} mm/day{lost}"
    else:
        yield "EVAPOTRANSPIRATION", "unknown", unknown
    yield from _average_months(weather, site)


def _average_months(weather: Weather, site: Site) -> Iterator[Row]:
    """Yield the monthly means for reference grass, as in a site file, if all of them are known."""
    first = np.datetime64(weather.first.replace(tzinfo=None), "h")
    months = (first + np.arange(weather.hours)).astype("datetime64[M]").astype(int) % 12
    known = ~np.isnan(weather.evapotranspiration)
    hours = np.bincount(months[known], minlength=12)
    if weather.method in (FAO56, HARGREAVES) and hours.all():
        sums = np.bincount(months[known], weather.evapotranspiration[known])
        means = np.round(sums / hours / site.crop_coefficient, 2).tolist()
        yield "evapotranspiration", "monthly", f"monthly_evapotranspiration: {means}"


def _describe_sources(
    files: Sequence[Path], site: Site, options: Description | None
) -> Iterator[Row]:
    """Yield a row for each quantity of each file if there are two to a dozen files."""
    found = list(expand(files, options))
    for file, described in found if 1 < len(found) <= _MAX_FILES else ():
        for rows in read_file(file, site, described):
            for quantity, values in rows.values.items():
                known = values[~np.isnan(values)]
                if known.size:
                    yield quantity, QUANTITIES[quantity].unit, (
                        f"{file}: {known.min():g} to {known.max():g}, mean {known.mean():.3g}; "
                        f"{values.size - known.size} of {values.size} rows without a value"
                    )
