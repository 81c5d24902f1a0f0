"""Fetch a forecast from the internet into a file: ``greenroof fetch-forecast``."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

from greenroof_ros.base.command_line import (
    EXIT_DONE,
    EXIT_FAILED,
    Parser,
    add_site,
    command,
    make_number_type,
)
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.http import ServiceError
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import to_people
from greenroof_ros.forecast.service import ATTRIBUTION, MAX_DAYS, ForecastFiles, Service
from greenroof_ros.site.file import read_site


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof fetch-forecast",
        usage="%(prog)s [options]",
        description="Request the forecast for the site from Open-Meteo, and write the file that a "
        "live site reads. The data are licensed under CC BY 4.0; the service is free for "
        "non-commercial use.",
        epilog="examples:\n"
        "  greenroof fetch-forecast --site site.yaml --ensemble\n"
        "  greenroof fetch-forecast --site site.yaml --keep forecasts/    # every hour, from cron\n"
        "  greenroof verify forecasts/ --site site.yaml --weather gauge.csv\n\n"
        "'greenroof live --forecast open-meteo' fetches the forecast every half hour.\n\n"
        "exit codes: 0 done, 1 the service returned no forecast, 2 bad usage or configuration, "
        "130 interrupted",
    )
    add_site(parser, "site file, which gives the location and the vegetation")
    parser.add_argument(
        "--ensemble", action="store_true",
        help="request all members of an ensemble, for lookahead (default: a single forecast)",
    )
    parser.add_argument(
        "--model", default="", metavar="NAME",
        help="use this weather model, specified by the service's own name for it, such as "
        "icon_seamless (default: the model that the service chooses for the location)",
    )
    parser.add_argument(
        "--days", type=make_number_type(1, MAX_DAYS, int), default=7, metavar="N",
        help="request a forecast for this many days, starting today (default: %(default)s)",
    )
    parser.add_argument(
        "--url", default="",
        help="use another server with the same API, with an API key if necessary, such as "
        "https://customer-api.open-meteo.com/v1/forecast?apikey=KEY; the key is neither printed "
        "nor stored (default: Open-Meteo's server)",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("forecast.csv"), metavar="FILE",
        help="write the forecast to this file, replacing any earlier forecast (default: "
             "%(default)s)",
    )
    parser.add_argument(
        "--keep", type=Path, metavar="DIR",
        help="keep every new forecast in this directory, up to 2 GB, for use with verify and "
             "simulate --forecast",
    )
    return parser


@command
def main() -> int:
    """Fetch a forecast."""
    arguments = make_parser().parse_args()
    if arguments.output.suffix != ".csv":
        raise ConfigurationError(
            "must end in .csv", key="--output", value=str(arguments.output)
        )
    site = read_site(arguments.site)
    service = Service(
        site, ensemble=arguments.ensemble, model=arguments.model, days=arguments.days,
        url=arguments.url,
    )
    files = ForecastFiles(arguments.output, arguments.keep)
    try:
        issue = service.fetch(datetime.now(timezone.utc))
        files.write(issue)
    except (ServiceError, OSError) as error:
        print(escape(f"no forecast: {error}"))
        return EXIT_FAILED
    print(escape(
        f"{arguments.output}: issued {to_people(issue.issued)}, "
        f"{issue.hours} h, {len(issue.rain)} members; {ATTRIBUTION}"
    ))
    for note in issue.notes:
        print(escape(f"  {note}"))
    return EXIT_DONE
