"""Make design storms from depths of rain, and compute their peaks and volumes at a site.

The depths are described by a YAML file: a table by duration and return period, such as those of
KOSTRA, NOAA Atlas 14 or Environment and Climate Change Canada; parameters a, b and c; or a record
of rain. A storm is printed as a weather file, with 48 hours without rain before it and 72 after it.
With --run, the peak and the volume of each storm are computed without a green roof, with a
green roof that is not irrigated, and with the site and each policy of its valve, as a table and a
page. In a run, nothing evaporates.

a file of depths for the table beside it (mm or in; mm/h or in/h for intensities):
  file: idf_toronto.txt
  after: Table 2a
  return_periods: [2, 5, 10, 25, 50, 100]
  unit: mm

Examples:
  greenroof storm --depths idf.yaml --return-periods 10 --kind block --duration 60 > storm.csv
  greenroof storm --depths idf.yaml --site config/site_valve.yaml --kind chicago --run
  greenroof storm --depths idf.yaml --site my_site.yaml --rain-factor 1.2 --run future
  greenroof simulate --weather storm.csv --start 2001-07-01 --hours 74

Exit codes: 0 done, 2 bad usage, configuration or file
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from greenroof_ros.base.command_line import Parser, add_site, command, option_of, refuse
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import rename_keys, require_extra


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser.of("storm", __doc__, "--depths FILE [options]")
    for name, kind, default, about in (
        ("kind", str, "euler", "block, euler (type II of DWA-A 118) or chicago"),
        ("duration", int, 120, "duration of the storm (min)"),
        ("step", int, 5, "duration of a step, which divides an hour (min)"),
        ("peak", float, None, "position of the peak as a share of the duration; if omitted, 0.3 "
         "for euler, 0.375 for chicago"),
        ("rain_factor", float, 1.0, "factor by which the rain is multiplied"),
        ("state", str, "wet", "with --run: the roof 48 hours before the storm. wet: at field "
         "capacity; dry: at its target if it is irrigated, or else at the wilting point"),
        ("filled", float, 1.0, "with --run: share of the cistern that is full at that time"),
    ):
        about += f" (default: {default})" if default else ""
        parser.add_argument(option_of(name), type=kind, default=default, metavar="X", help=about)
    parser.add_argument(
        "--return-periods", nargs="+", type=float, default=[2.0, 10.0, 100.0], metavar="YEARS",
        help="return periods; one without --run (default: 2 10 100)",
    )
    parser.add_argument("--depths", type=Path, required=True, metavar="FILE", help="file of depths")
    parser.add_argument(
        "--run", type=Path, nargs="?", const=Path("storms"), metavar="DIR",
        help="compute the discharge of the site, and write a page, a table and a picture to DIR, "
        "which may be new or empty, or may contain earlier ones (default: storms)",
    )
    add_site(parser)
    return parser


@command
def main() -> None:
    """Make the storms named on the command line."""
    given: dict[str, Any] = vars(make_parser().parse_args())
    run, periods = given.pop("run"), given.pop("return_periods")
    of_run = {name: given.pop(name) for name in ("site", "state", "filled")}
    refuse((not run and len(periods) > 1, "--return-periods", periods, "must be one, or use --run"))
    names = {name: option_of(name) for name in (*given, *of_run, "return_periods")}
    with require_extra("study"), rename_keys(names):
        from greenroof_ros.analysis.storms import design_storm, storms

        if not run:
            storm = design_storm(**given, return_period=periods[0]).write_csv()
            stated = ", ".join(f"{name} {each}" for name, each in given.items() if each is not None)
            print(f"# Design storm of {periods[0]:g} years: {stated}\n{storm}", end="")
            return
        result = storms(**given, **of_run, return_periods=periods)
        page = result.save(run)
    console = PlainConsole()
    console.print(result.sentence, style="bold")
    shown = result.shown
    console.print_table(shown.caption, shown.headings()[:-1], [row[:-1] for row in shown.texts()])
    for note in (*result.notes, *result.read):
        console.print(f"NOTE: {note}")
    console.print(f"written to {page}", soft_wrap=True)
