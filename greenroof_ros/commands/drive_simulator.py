"""Simulate a drive on Modbus, or a relay on MQTT: ``greenroof simulators drive``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from greenroof_ros.common.command_line import Parser, add_site, command, within
from greenroof_ros.common.errors import ConfigurationError, must_be_one_of
from greenroof_ros.common.files import read_yaml
from greenroof_ros.common.mqtt import parse_topic
from greenroof_ros.live.devices.drive_file import find_drive_file, read_drive_file
from greenroof_ros.live.devices.modbus_line import Address, check_installed
from greenroof_ros.live.devices.relay_file import read_relay_file
from greenroof_ros.live.simulators import faults
from greenroof_ros.live.simulators.faults import DRIVE_FAULTS, RELAY_FAULTS
from greenroof_ros.model.site import read_site

if TYPE_CHECKING:
    from greenroof_ros.live.simulators.server import Bench

_PORT = 5020
_LAST_PORT = 65535


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof simulators drive",
        usage="%(prog)s --drive NAME [options]",
        description="Simulate a variable-speed drive with a motor on Modbus: registers, control "
        "word, ramp, fault codes and communication timeout of the make that a drive file "
        "describes, with faults on request. With --at it is a relay on MQTT, with its timer.",
        epilog="The workbench is a Modbus TCP port next to the drive's, device 247, holding "
        "registers:\n"
        "  0 true speed in 0.01 %\n"
        "  1 fault, by its number\n"
        "  2 its parameter, 65535 for the default; write it before 1\n"
        "  3 power cycle: write 1\n"
        "  4 local control at the panel: 1, 0\n"
        "  5 cistern level in 0.1 mm, for drives that report their flow\n\n"
        "For a relay, register 0 is 10000 while its contact is closed, and register 4 is its "
        "button.\n\n"
        f"faults:\n{faults.list_faults(DRIVE_FAULTS)}\n\n"
        f"faults of a relay:\n{faults.list_faults(RELAY_FAULTS)}\n\n"
        "examples:\n"
        "  greenroof simulators drive --drive abb_acs880\n"
        "  greenroof simulators drive --drive danfoss_fc202 --fault late=900\n"
        "  greenroof simulators drive --drive schneider_atv630 --serial pty\n"
        "  greenroof simulators drive --drive tasmota --at mqtt://127.0.0.1/roof\n\n"
        "Its first line states when it is ready, and where. Ctrl-C ends it.\n\n"
        "exit codes: 0 ended by Ctrl-C or SIGTERM, 2 wrong usage or configuration",
    )
    parser.add_argument(
        "--drive", required=True, metavar="NAME",
        help="make of drive: a name in config/drives/, or your own file",
    )
    place = parser.add_argument_group("its address")
    place.add_argument(
        "--host", default="127.0.0.1",
        help="address of this machine on which it listens; there is no protection: anyone who "
        "reaches it can run it (default: %(default)s)",
    )
    place.add_argument(
        "--port", type=within(0, _LAST_PORT - 1, int), default=_PORT,
        help="TCP port of the drive, 0 for a free one; or of a gateway to its serial port if the "
        "make has no Ethernet port (default: %(default)s)",
    )
    place.add_argument(
        "--serial", metavar="DEVICE",
        help="a serial line instead (Modbus RTU), such as /dev/ttyUSB0; 'pty' makes a "
        "pseudo-terminal, whose name for the client is in the first line",
    )
    place.add_argument(
        "--at", metavar="mqtt://HOST[:PORT]/DEVICE",
        help="for a relay: its broker, and its topic there",
    )
    place.add_argument(
        "--workbench", type=within(0, _LAST_PORT, int), metavar="PORT",
        help="TCP port of the workbench, 0 for a free one (default: the next after --port)",
    )
    model = parser.add_argument_group("its properties and settings")
    model.add_argument(
        "--ramp", type=within(0, 3600), default=5.0, metavar="S",
        help="time from rest to rated speed, and back (s, default: %(default)g)",
    )
    model.add_argument(
        "--boot", type=within(0, 3600), default=3.0, metavar="S",
        help="time from power-up until it answers (s, default: %(default)g)",
    )
    model.add_argument(
        "--timeout", type=within(0.1, 3600), default=5.0, metavar="S",
        help="its communication timeout (s, default: %(default)g), after which it stops; rounded "
        "to what its register holds",
    )
    model.add_argument(
        "--as-delivered", action="store_true",
        help="the factory setting of the timeout, which may be none. A relay then has none, and "
        "is on after power-up",
    )
    model.add_argument(
        "--speed", type=within(1e-3, 1e6), default=1.0, metavar="FACTOR",
        help="ramps faster by this factor, for a graph that is faster than real time; the timeout "
        "is not scaled (default: %(default)g)",
    )
    add_site(model, "site file, for drives that report their flow")
    faults.add_option(parser, {**DRIVE_FAULTS, **RELAY_FAULTS})
    return parser


@command
def main() -> None:
    """Simulate the drive or relay that the command line asks for."""
    arguments = make_parser().parse_args()
    check_installed()
    path = find_drive_file(arguments.drive)
    is_relay = "protocol" in read_yaml(path)
    if is_relay != bool(arguments.at):
        raise ConfigurationError(
            "must give the address of a relay: mqtt://HOST[:PORT]/DEVICE" if is_relay
            else "is for a relay; a drive on Modbus has --port or --serial",
            key="--at", value=arguments.at,
        )
    faults = RELAY_FAULTS if is_relay else DRIVE_FAULTS
    if arguments.fault[0] not in faults:
        raise ConfigurationError(
            must_be_one_of(faults, arguments.fault[0]), key="--fault", value=arguments.fault[0]
        )
    bench = (_relay if is_relay else _drive)(path, arguments)
    bench.serve(*arguments.fault)


def _drive(path: Path, arguments: argparse.Namespace) -> Bench:
    from greenroof_ros.live.simulators.control_profiles import profile_of
    from greenroof_ros.live.simulators.simulated_drive import DriveBench, DriveSettings

    file = read_drive_file(path)
    address = Address(host=arguments.host, port=arguments.port)
    return DriveBench(
        profile_of(file.make),
        file,
        DriveSettings(
            ramp_s=arguments.ramp, boot_s=arguments.boot, speed=arguments.speed,
            timeout_s=None if arguments.as_delivered else arguments.timeout,
        ),
        Address(line=arguments.serial) if arguments.serial else address,
        _workbench(arguments),
        read_site(arguments.site),
    )


def _relay(path: Path, arguments: argparse.Namespace) -> Bench:
    from greenroof_ros.live.simulators.simulated_relay import RelayBench, relay_of

    broker, device = parse_topic(arguments.at, "--at")
    make, as_delivered = relay_of(read_relay_file(path).make), arguments.as_delivered
    relay = make(device, None if as_delivered else arguments.timeout, as_delivered)
    return RelayBench(relay, broker, device, arguments.boot, _workbench(arguments))


def _workbench(arguments: argparse.Namespace) -> Address:
    port = arguments.workbench
    if port is None:
        port = arguments.port + 1 if arguments.port else 0
    return Address(host=arguments.host, port=port)
