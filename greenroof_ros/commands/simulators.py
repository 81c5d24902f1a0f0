"""Simulate the devices of a live site in real time.

They are, as far as the site has them: cistern and roof with their sensors on Modbus or MQTT, the
pump with its drive on Modbus or its relay on MQTT, and the valve of the low outlet with its relay
on MQTT. The registers, control words, fault codes and communication timeout are those of the drive
file. The air temperature is 15 degC.

Examples:
  greenroof simulators site
  greenroof simulators site --drive abb_acs880 --at gateway://127.0.0.1:5020
  greenroof simulators site --drive tasmota --at mqtt://127.0.0.1/roof-pump
  greenroof simulators site --site config/site_valve.yaml --valve-fault leak

the first line of output states that the simulator is ready, and lists its addresses. Ctrl-C stops
the simulator.

Exit codes: 0 ended by Ctrl-C or SIGTERM, 2 bad usage or configuration
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import time
from functools import partial
from pathlib import Path

from greenroof_ros.base.command_line import Parser, command
from greenroof_ros.base.mqtt import parse_topic
from greenroof_ros.live.devices.drive_file import find_drive_file, read_relay_file
from greenroof_ros.live.devices.exchange import Endpoint, read_endpoint
from greenroof_ros.live.devices.modbus_line import check_installed
from greenroof_ros.live.devices.relay import RelayEndpoint
from greenroof_ros.live.devices.sensor_file import Sensors, default_sensors, read_sensors
from greenroof_ros.live.pumping.valve_control import TRAVEL_S
from greenroof_ros.live.simulators.relay import FAULTS, SimulatedRelay, SimulatedValve
from greenroof_ros.simulation.options import add_site_arguments, build_run
from greenroof_ros.simulation.run import Run

# Time without a request after which a simulated relay switches itself off (s).
_TIMER_S = 5.0


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("simulators site", __doc__)
    devices = parser.add_argument_group(
        "devices", "Anyone who can reach the addresses of the simulated devices can operate them.",
    )
    devices.add_argument(
        "--drive", default="danfoss_fc202", metavar="NAME",
        help="drive or relay of the pump: name in config/drives/ or file (default: %(default)s)",
    )
    devices.add_argument(
        "--at", default="gateway://127.0.0.1:5020", metavar="ADDRESS",
        help="its address: tcp://HOST:PORT, gateway://HOST:PORT for a gateway to its serial port, "
        "a serial line, or mqtt://HOST/TOPIC for a relay (default: %(default)s)",
    )
    devices.add_argument(
        "--valve", default="tasmota", metavar="NAME",
        help="relay of the valve: name in config/drives/ or file (default: %(default)s)",
    )
    devices.add_argument(
        "--valve-at", default="mqtt://127.0.0.1/valve", metavar="ADDRESS",
        help="its address: mqtt://HOST/TOPIC (default: %(default)s)",
    )
    add_valve_fault(devices)
    devices.add_argument(
        "--sensors", type=Path, metavar="FILE",
        help="file of the sensors (default: config/sensors.yaml)",
    )
    about = "After --hours, the simulator continues with the last weather values."
    add_site_arguments(parser.add_argument_group("the site", about))
    return parser


def add_valve_fault(group: argparse._ActionsContainer) -> None:
    """Add the option for a fault of the valve."""
    group.add_argument(
        "--valve-fault", choices=FAULTS, default="",
        help="let the valve fail: it does not close any more, does not open any more, leaks 2 "
        "L/min while it is closed, or has an end switch that always reports that it is open",
    )


@command
def main() -> None:
    """Simulate the site that the command line specifies."""
    arguments = make_parser().parse_args()
    check_installed()
    run, fault = build_run(arguments), arguments.valve_fault
    places: dict[str, Endpoint] = {}
    if run.site.irrigated:
        places["drive"] = read_endpoint(find_drive_file(arguments.drive), arguments.at, "--at")
    if run.site.low_outlet_valve:
        relay = read_relay_file(find_drive_file(arguments.valve))
        places["valve"] = RelayEndpoint(relay, *parse_topic(arguments.valve_at, "--valve-at"))
    sensors = read_sensors(arguments.sensors or default_sensors())
    asyncio.run(_simulate(run, sensors, places, fault))


async def _simulate(run: Run, sensors: Sensors, places: dict[str, Endpoint], fault: str) -> None:
    """Simulate a site with the drive and the valve at the given places, until a signal."""
    from greenroof_ros.live.simulators.drive import SimulatedDrive, drive_server
    from greenroof_ros.live.simulators.site import SimulatedSite

    began, ended = time.monotonic(), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)

    def log(text: str) -> None:
        print(f"{time.monotonic() - began:9.2f} s  {text}", flush=True)

    def speed() -> float:
        if isinstance(pump, SimulatedDrive):
            pump.advance()
        return pump.speed if pump else 0.0

    devices: dict[str, SimulatedDrive | SimulatedRelay] = {}
    servers, tasks = [], []
    for name, place in places.items():
        if isinstance(place, RelayEndpoint):
            relay = SimulatedRelay(place.file, place.broker, place.device, _TIMER_S)
            devices[name] = relay
            tasks.append(relay.run(ended))
        else:
            devices[name] = drive = SimulatedDrive(place.file, place.address.interface)
            servers.append(drive_server(drive, place.file, place.address))
    pump, of_valve = devices.get("drive"), devices.get("valve")
    valve = None
    if isinstance(of_valve, SimulatedRelay):
        travel_s = (run.site.valve_travel_time or TRAVEL_S) / 3  # faster than it must be
        valve = SimulatedValve(partial(getattr, of_valve, "on"), travel_s, fault)
    weather = run.series.precipitation, run.series.evapotranspiration
    site = SimulatedSite(run.site, *weather, (run.x1, run.x2), sensors, speed, valve)
    if isinstance(pump, SimulatedDrive):
        pump.flow, pump.log = site.flow, log
    servers += site.servers
    for server in servers:
        await server.open()
    named = [f"{name} {place}" for name, place in places.items()]
    print(f"ready: {', '.join([*named, site.addresses])}", flush=True)
    await asyncio.gather(site.run(ended), *tasks)
    for server in servers:
        server.close()
