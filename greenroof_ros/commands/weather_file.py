"""Describe weather files, and write them as one plain CSV: ``greenroof weather FILE``."""

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
from greenroof_ros.weather.records import HOUR, Records, describe_rows, name_files, write_records
from greenroof_ros.weather.series import Weather
from greenroof_ros.weather.summary import as_lines, summarize
from greenroof_ros.weather.table import Rows

_DESCRIPTION = """\
Read weather files in the same way as simulate, and show what they contain: the period, the rain of
each month or year, the wettest hour and day, the range of every quantity, missing hours, and the
method by which evapotranspiration would be computed. Nothing in a file is guessed or changed: what
its columns mean is stated by its header or by a description, a YAML file beside it, whose keys are
also options of this command. If more than one file is given, the files are joined.
"""
_EPILOG = """\
a file in the package's own form needs no description:
  time,rain [mm],temperature [degC]
  2024-06-01T00:00-05:00,0.0,17.3
  2024-06-01T00:05-05:00,0.2,17.2

examples:
  greenroof weather logger.csv --site my_site.yaml
  greenroof weather gauge.csv --describe > gauge.yaml
  greenroof weather gauge.yaml --output gauge_plain.csv
  greenroof weather gauge.csv --columns "time=[Datum, Uhrzeit]" "rain=Regen [mm]" --rows end
  greenroof weather gauge.csv --na-values=-99 --na-values=---
  greenroof simulate --weather gauge.yaml --start 2021-07-01

exit codes: 0 done, 2 bad usage, configuration or file
"""
_DASH = "A value that begins with a dash is written as --na-values=-99"
_MAX_FILES = 12
_NOT_OPTIONS = "name", "file", "header"


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(prog="greenroof weather", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "files", nargs="+", metavar="FILE",
        help="weather files, descriptions of weather files, directories, or a pattern in quotes",
    )
    add_site(parser, "use the location, time zone and monthly means in this site file")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE.csv",
        help="write the weather to this new CSV file, in the package's own form; a run with this "
        "file yields the same numbers",
    )
    parser.add_argument(
        "--describe", action="store_true",
        help="print a description of the file, filled in as far as its first lines say it; a "
        "person must replace each question mark",
    )
    group = parser.add_argument_group(
        "keys of a description", "They apply to files that are not named by a description. "
        f"{_DASH}."
    )
    parser.hint = _DASH
    for key in _options():
        group.add_argument(
            option_of(key.name), help=key.description.replace("%", "%%"), dest=key.name,
            metavar="NAME=VALUE" if _is_mapping(key) else "VALUE",
            nargs="*" if _has_many(key) else None, action="extend" if _has_many(key) else "store",
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
    given = dict[str, Any]()
    for key in _options():
        value = getattr(arguments, key.name)
        if value is None:
            continue
        if _is_mapping(key):
            pairs = [item.partition("=") for item in value]
            value = {
                name: parse_yaml(text, Path(option_of(key.name))) if text.startswith("[") else text
                for name, _, text in pairs
            }
        elif "str" not in str(key.kind):  # a number as in a description
            texts = value if _has_many(key) else [value]
            numbers = [parse_yaml(text, Path(option_of(key.name))) for text in texts]
            value = numbers[0] if len(numbers) == 1 else numbers
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
    console = PlainConsole()
    console.print(grid("Weather", [*_describe(measured, site), *sources]))
    if output is not None:
        with add_path_to_errors(output):
            output.write_text(
                write_records(measured, "\n".join((*measured.applied, "Written by greenroof "
                                                   "weather."))), encoding="utf-8",
            )
        console.print(f"written: {output}", soft_wrap=True)


def _describe(measured: Records, site: Site) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of the table, each with a label, a value and a description."""
    try:
        weather = complete_records(measured, site)
        unknown = ""
    except ConfigurationError as error:
        weather, unknown = complete_records(measured, site, method=""), str(error)
    for text in (*measured.applied, *measured.left_out):
        yield "read", "", text
    yield from _describe_places(measured, site)
    last = measured.first + (measured.hours - 1) * HOUR
    yield "hours", str(measured.hours), f"{to_people(measured.first)} to {to_people(last)}"
    if measured.rain_late:
        yield "rain", "1 h late", "each time is the end of an hour; a run treats it as the start"
    if measured.rain_kind:
        yield "rain", measured.rain_kind, measured.rain_note
    summary = summarize(measured, site)
    for name, about in summary["quantities"].items():
        yield name, about["unit"], (
            f"{about['minimum']:g} to {about['maximum']:g}, mean {about['mean']:.3g}; "
            f"{about['missing']} hours missing"
        )
    for line in as_lines(summary):
        yield "summary", "", line
    yield _describe_evapotranspiration(weather, unknown)
    yield from _average_months(weather, site)


def _describe_sources(
    files: Sequence[Path], site: Site, options: Description | None
) -> Iterator[tuple[str, str, str]]:
    """Yield a row for each quantity of each source if there is more than one.

    A source is a file or, of more than a dozen files, all files that are read in the same way.
    """
    found = list(expand(files, options))
    sources = dict[str, list[Rows]]()
    for file, described in found if len(found) > 1 else ():
        for rows in read_file(file, site, described):
            key = str(file) if len(found) <= _MAX_FILES else describe_rows(rows)
            sources.setdefault(key, []).append(rows)
    for members in sources.values():
        name = name_files([rows.table.file for rows in members])
        for quantity in members[0].values:
            values = np.concatenate([rows.values[quantity] for rows in members])
            known = values[~np.isnan(values)]
            if known.size:
                yield quantity, QUANTITIES[quantity].unit, (
                    f"{name}: {known.min():g} to {known.max():g}, mean {known.mean():.3g}; "
                    f"{values.size - known.size} of {values.size} rows without a value"
                )


def _describe_places(measured: Records, site: Site) -> Iterator[tuple[str, str, str]]:
    """Yield a row for every location in the records, with its distance from the site if known."""
    for place in dict.fromkeys(measured.places.values()):
        away = ""
        if site.latitude is not None and site.longitude is not None:
            own = site.latitude, site.longitude
            away = (
                f"{measure_distance(place, own):.0f} km from the site, {format_place(*own)} "
                "(--site)"
            )
        yield "place", format_place(*place), away
    if not measured.places:
        yield "place", "not stated", ""


def _describe_evapotranspiration(weather: Weather, unknown: str) -> tuple[str, str, str]:
    """Return the row for evapotranspiration, with its method and mean, or the reason if unknown."""
    if unknown:
        return "EVAPOTRANSPIRATION", "unknown", unknown
    known = weather.evapotranspiration[~np.isnan(weather.evapotranspiration)]
    mean = f"mean {known.mean():.2f} mm/day" if known.size else "mean unknown"
    lost = weather.hours - known.size
    return "evapotranspiration", weather.method, (
        mean + (f", unknown in {lost} hours" if lost else "")
    )


def _average_months(weather: Weather, site: Site) -> Iterator[tuple[str, str, str]]:
    """Yield the monthly means for reference grass, as in a site file, if all of them are known."""
    first = np.datetime64(weather.first.replace(tzinfo=None), "h")
    months = (first + np.arange(weather.hours)).astype("datetime64[M]").astype(int) % 12
    known = ~np.isnan(weather.evapotranspiration)
    hours = np.bincount(months[known], minlength=12)
    if weather.method in (FAO56, HARGREAVES) and hours.all():
        sums = np.bincount(months[known], weather.evapotranspiration[known])
        means = np.round(sums / hours / site.crop_coefficient, 2).tolist()
        yield "evapotranspiration", "monthly", f"monthly_evapotranspiration: {means}"
