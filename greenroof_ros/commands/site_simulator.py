"""Simulate cistern and roof with sensors on Modbus or MQTT: ``greenroof simulators site``."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

from greenroof_ros.common.command_line import Parser, command, within
from greenroof_ros.experiment.options import add_site_arguments, run_from_arguments
from greenroof_ros.live.devices.modbus_line import Address, check_installed, parse_address
from greenroof_ros.live.devices.sensor_file import default_sensors, read_sensors
from greenroof_ros.live.simulators import faults
from greenroof_ros.live.simulators.faults import SITE_FAULTS

_WORKBENCH = 5032
_MM_PER_HOUR = 1e-3 / 3600
_MM_PER_DAY = 1e-3 / 86400


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof simulators site",
        usage="%(prog)s [options]",
        description="Simulate cistern and roof in real time and answer as their sensors, over "
        "Modbus, or publish on MQTT. The flow follows from a drive simulator's true speed. The "
        "air is at 15 degC.",
        epilog="The workbench is a Modbus TCP port, device 247, holding registers:\n"
        "  1 fault, by its number\n"
        "  2 its parameter, 65535 for the default; write it before 1\n\n"
        f"faults:\n{faults.list_faults(SITE_FAULTS)}\n\n"
        "examples:\n"
        "  greenroof simulators drive --drive abb_acs880\n"
        "  greenroof simulators site --drive-at tcp://127.0.0.1:5021 --output levels.csv\n"
        "  greenroof simulators site --rain 4 --fault roof_frozen\n\n"
        "Its first line states when it is ready, and where. Ctrl-C ends it.\n\n"
        "exit codes: 0 ended by Ctrl-C or SIGTERM, 2 wrong usage or configuration",
    )
    place = parser.add_argument_group("sensors and drive")
    place.add_argument(
        "--sensors", type=Path, metavar="FILE",
        help="file of the sensors (default: config/sensors.yaml)",
    )
    place.add_argument(
        "--drive-at", metavar="ADDRESS",
        help="the drive simulator's workbench, such as tcp://127.0.0.1:5021; without it the pump "
        "never runs; the simulator warns of that at its start",
    )
    place.add_argument(
        "--workbench", type=within(0, 65535, int), default=_WORKBENCH, metavar="PORT",
        help="TCP port of the workbench on 127.0.0.1, 0 for a free one (default: %(default)s)",
    )
    add_site_arguments(parser.add_argument_group(
        "the site",
        "After --hours the weather keeps its last values; the simulator continues.",
    ))
    weather = parser.add_argument_group("constants instead of the weather file")
    weather.add_argument(
        "--rain", type=within(0, 1000), metavar="MM", help="constant rain (mm/h)"
    )
    weather.add_argument(
        "--constant-evapotranspiration", type=within(0, 1000), metavar="MM",
        help="constant evapotranspiration (mm/day)",
    )
    parser.add_argument(
        "--factor", type=within(1e-3, 1e4), default=1.0,
        help="simulated time per real time; a sensor's readings are then that much further apart "
        "(default: %(default)g)",
    )
    parser.add_argument(
        "--output", type=Path, metavar="CSV",
        help="file with a line per tick: time, levels, speed, flow, pumped volume, weather, fault",
    )
    faults.add_option(parser, SITE_FAULTS)
    return parser


@command
def main() -> None:
    """Simulate the site that the command line asks for."""
    arguments = make_parser().parse_args()
    check_installed()
    from greenroof_ros.live.simulators.simulated_site import SiteBench
    sensors = read_sensors(arguments.sensors or default_sensors())
    drive = None
    if arguments.drive_at is not None:
        drive = parse_address(arguments.drive_at, "--drive-at")
    run = run_from_arguments(arguments)
    rain: Sequence[float] = run.series.precipitation
    evapotranspiration: Sequence[float] = run.series.evapotranspiration
    if arguments.rain is not None:
        rain = [arguments.rain * _MM_PER_HOUR]
    if arguments.constant_evapotranspiration is not None:
        evapotranspiration = [
            arguments.constant_evapotranspiration * _MM_PER_DAY * run.site.a2
        ]
    table = arguments.output
    with table.open("w", encoding="utf-8") if table else contextlib.nullcontext() as output:
        bench = SiteBench(
            run.site, rain, evapotranspiration, (run.x1, run.x2), sensors,
            Address(host="127.0.0.1", port=arguments.workbench), drive, arguments.factor, output,
        )
        bench.serve(*arguments.fault)
