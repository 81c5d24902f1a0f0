"""Simulate a site with its sensors and its drive or relay: ``greenroof simulators site``."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.base.command_line import Parser, command
from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import Endpoint, read_endpoint
from greenroof_ros.live.devices.modbus_line import check_installed
from greenroof_ros.live.devices.relay import RelayEndpoint
from greenroof_ros.live.devices.sensor_file import Sensors, default_sensors, read_sensors
from greenroof_ros.simulation.options import add_site_arguments, build_run

if TYPE_CHECKING:
    from greenroof_ros.simulation.run import Run

# Time without a request after which the simulated relay switches itself off (s).
_TIMER_S = 5.0


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof simulators site",
        usage="%(prog)s [options]",
        description="Simulate the devices of a live site in real time: cistern and roof with their "
        "sensors on Modbus or MQTT, and the pump with its drive on Modbus or its relay on MQTT. "
        "The registers, control words, fault codes and communication timeout are those of the "
        "drive file. The air temperature is 15 degC.",
        epilog="examples:\n"
        "  greenroof simulators site\n"
        "  greenroof simulators site --drive abb_acs880 --at gateway://127.0.0.1:5020\n"
        "  greenroof simulators site --drive tasmota --at mqtt://127.0.0.1/roof-pump\n\n"
        "The first line of output states that the simulator is ready, and lists its addresses. "
        "Ctrl-C stops the simulator.\n\n"
        "exit codes: 0 ended by Ctrl-C or SIGTERM, 2 bad usage or configuration",
    )
    devices = parser.add_argument_group(
        "devices", "Anyone who can reach the addresses of the simulated devices can operate them.",
    )
    devices.add_argument(
        "--drive", default="danfoss_fc202", metavar="NAME",
        help="simulate this drive or relay: a name in config/drives/, or your own file "
        "(default: %(default)s)",
    )
    devices.add_argument(
        "--at", default="gateway://127.0.0.1:5020", metavar="ADDRESS",
        help="address of the drive or relay: tcp://HOST:PORT, gateway://HOST:PORT for a gateway to "
        "the drive's serial port, a serial line, or mqtt://HOST/TOPIC for a relay (default: "
        "%(default)s)",
    )
    devices.add_argument(
        "--sensors", type=Path, metavar="FILE",
        help="simulate the sensors in this file (default: config/sensors.yaml)",
    )
    add_site_arguments(parser.add_argument_group(
        "the site",
        "After --hours, the simulator continues with the last weather values.",
    ))
    return parser


@command
def main() -> None:
    """Simulate the site that the command line specifies."""
    arguments = make_parser().parse_args()
    check_installed()
    endpoint = read_endpoint(find_drive_file(arguments.drive), arguments.at, "--at")
    sensors = read_sensors(arguments.sensors or default_sensors())
    run = build_run(arguments)
    asyncio.run(_simulate(run, sensors, endpoint))


async def _simulate(run: Run, sensors: Sensors, endpoint: Endpoint) -> None:
    from greenroof_ros.live.simulators.drive import SimulatedDrive, drive_server
    from greenroof_ros.live.simulators.relay import SimulatedRelay
    from greenroof_ros.live.simulators.server import Server
    from greenroof_ros.live.simulators.site import SimulatedSite

    began, ended = time.monotonic(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)

    def log(text: str) -> None:
        print(f"{time.monotonic() - began:9.2f} s  {text}", flush=True)

    def speed() -> float:
        if isinstance(device, SimulatedDrive):
            device.advance()
        return device.speed

    device: SimulatedDrive | SimulatedRelay
    servers: list[Server] = []
    tasks: list[Coroutine[Any, Any, None]] = []
    if isinstance(endpoint, RelayEndpoint):
        device = relay = SimulatedRelay(
            endpoint.file, endpoint.broker, endpoint.device, _TIMER_S
        )
        tasks.append(relay.run(ended))
    else:
        device = drive = SimulatedDrive(endpoint.file, endpoint.address.interface)
        servers.append(drive_server(drive, endpoint.file, endpoint.address))
    weather = run.series.precipitation, run.series.evapotranspiration
    site = SimulatedSite(run.site, *weather, (run.x1, run.x2), sensors, speed)
    if isinstance(device, SimulatedDrive):
        device.flow, device.log = site.flow, log
    servers += site.servers
    for server in servers:
        await server.open()
    print(f"ready: drive {endpoint}, {site.addresses}", flush=True)
    await asyncio.gather(site.run(ended), *tasks)
    for server in servers:
        server.close()
