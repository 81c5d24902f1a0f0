"""Simulate a forecast service: ``greenroof simulators forecast``."""

from __future__ import annotations

import signal
import time

from greenroof_ros.common.command_line import Parser, add_site, command, within
from greenroof_ros.common.times import DEFAULT_START, read_start
from greenroof_ros.live.simulators.forecast_service import FAULTS, NONE, ForecastService
from greenroof_ros.model.site import read_site
from greenroof_ros.weather.reading import default_weather, find_files, read_weather
from greenroof_ros.weather.series import FILL

_PORT = 8099


def make_parser() -> Parser:
    """Return the command's parser."""
    faults = "\n".join(f"  {name:10} {meaning}" for name, meaning in FAULTS.items())
    parser = Parser(
        prog="greenroof simulators forecast",
        usage="%(prog)s [options]",
        description="Answer as Open-Meteo's forecast and ensemble interfaces do: the contents of "
        "a weather file from --start on become the forecast from now on.",
        epilog="faults; at run time, set one with 'curl -X POST "
        f"http://127.0.0.1:{_PORT}/fault/NAME':\n{faults}\n\n"
        "examples:\n"
        "  greenroof simulators forecast\n"
        f"  greenroof fetch-forecast --url http://127.0.0.1:{_PORT}/v1/ensemble --ensemble\n\n"
        "Its first line states when it is ready, and where. Ctrl-C ends it.",
    )
    add_site(parser, "site file, for its place")
    parser.add_argument(
        "--weather", action="append", metavar="FILE",
        help="hourly records with temperature, dew point, wind and pressure (default: the paper's)",
    )
    parser.add_argument(
        "--start", default=DEFAULT_START, metavar="TIME",
        help="time in the records that is treated as now (default: %(default)s)",
    )
    parser.add_argument(
        "--port", type=within(0, 65535, int), default=_PORT, help="TCP port on 127.0.0.1, 0 for a "
        "free one (default: %(default)s)",
    )
    parser.add_argument(
        "--fault", choices=list(FAULTS), default=NONE, metavar="NAME",
        help="fault that is active from the start; see the list of faults",
    )
    return parser


@command
def main() -> None:
    """Run the service that the command line asks for."""
    arguments = make_parser().parse_args()
    site = read_site(arguments.site)
    files = find_files(arguments.weather or [str(default_weather())], "--weather")
    records = read_weather(files, site, gaps=FILL)
    service = ForecastService(
        site, records, read_start(arguments.start, records.first.tzinfo), arguments.port
    )
    service.fault = arguments.fault
    # A script that starts this in its background has it ignore SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    service.start()
    print(f"ready: {service.address}/v1/forecast and {service.address}/v1/ensemble", flush=True)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        service.close()
