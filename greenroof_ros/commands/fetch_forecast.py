"""Request the forecast for the site from Open-Meteo, and write the file that a live site reads.

The data are licensed under CC BY 4.0; the service is free for non-commercial use. 'greenroof live
--forecast open-meteo' fetches the forecast every half hour.

Examples:
  greenroof fetch-forecast --site site.yaml --ensemble
  greenroof fetch-forecast --site site.yaml --keep forecasts/    # every hour, from cron
  greenroof verify forecasts/ --site site.yaml --weather gauge.csv

Exit codes: 0 done, 1 the service returned no forecast, 2 bad usage or configuration, 130
interrupted
"""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

from greenroof_ros.base.command_line import Parser, add_site, command, refuse
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import to_people
from greenroof_ros.commands.fetch_weather import add_url
from greenroof_ros.forecast.live import ATTRIBUTION, ForecastFiles, Service
from greenroof_ros.site.file import read_site


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("fetch-forecast", __doc__)
    add_site(parser, "site file, which gives the location and the vegetation")
    parser.add_argument(
        "--ensemble", action="store_true",
        help="request all members of an ensemble, for lookahead (default: a single forecast)",
    )
    parser.add_argument(
        "--model", default="", metavar="NAME",
        help="weather model, such as icon_seamless (default: the service's choice for the place)",
    )
    add_url(parser, "https://customer-api.open-meteo.com/v1/forecast?apikey=KEY")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("forecast.csv"), metavar="FILE",
        help="write the forecast to this file, and replace an earlier one (default: %(default)s)",
    )
    parser.add_argument(
        "--keep", type=Path, metavar="DIR",
        help="keep every new forecast in DIR, up to 2 GB, for verify and simulate --forecast",
    )
    return parser


@command
def main() -> None:
    """Fetch a forecast."""
    arguments = make_parser().parse_args()
    output = arguments.output
    refuse((output.suffix != ".csv", "--output", str(output), "must end in .csv"))
    service = Service(
        read_site(arguments.site), ensemble=arguments.ensemble, model=arguments.model,
        url=arguments.url,
    )
    files = ForecastFiles(output, arguments.keep)
    issue = service.fetch(datetime.now(timezone.utc))
    files.write(issue)
    print(escape(
        f"{output}: issued {to_people(issue.issued)}, {issue.hours} h, {len(issue.rain)} members; "
        f"{ATTRIBUTION}"
    ))
    for note in issue.notes:
        print(escape(f"  {note}"))
