"""The options of a graph of nodes, the same for ``run`` and ``live``."""

from __future__ import annotations

import argparse
from pathlib import Path

from greenroof_ros.common.command_line import add_foxglove, namespace, within
from greenroof_ros.controllers.registry import EXTERNAL


def add_graph_arguments(parser: argparse.ArgumentParser, pump: str = "") -> None:
    """Add the options of the graph and its drive.

    Args:
        parser: the command's parser.
        pump: the default of ``--pump``; if empty, ``external`` is the only choice.
    """
    group = parser.add_argument_group("the graph")
    group.add_argument(
        "--pump", choices=[*filter(None, [pump]), EXTERNAL], default=pump,
        help="external: /pump/flow comes from a pump driver that you start yourself"
        + (f" (default: {pump})" if pump else ""),
    )
    group.add_argument(
        "--namespace", type=namespace, default="", metavar="NAME",
        help="put the whole graph, including its clock, under /NAME, so that several run side by "
        "side in one domain (default: none)",
    )
    group.add_argument(
        "--peer-limit", type=within(2, 1e6), default=5.0, metavar="S",
        help="longest wait for a node, in wall time, at least 2 s: joining nodes listen for one "
        "second (default: %(default)s s)",
    )
    group.add_argument(
        "--watch", action="store_true",
        help="show the graph on a page in a browser, whose address is printed. The page ends with "
        "the graph; the graph does not need it. The page of greenroof watch stays. Needs "
        "the extra [watch]",
    )
    add_foxglove(
        group, "serve the graph to Foxglove or Lichtblick on this machine, at the address that is "
        "printed, until the graph ends; the graph does not need it.",
    )
    group = parser.add_argument_group(
        "the drive",
        "With --drive the pump node takes the commands and runs a drive over Modbus, or a relay\n"
        "over MQTT, real or simulated.",
    )
    group.add_argument(
        "--drive", metavar="{NAME,FILE}",
        help="make of the drive: a name in config/drives/, or a drive file",
    )
    group.add_argument(
        "--drive-at", metavar="ADDRESS",
        help="its address: tcp://HOST:PORT if it has its own Ethernet port, gateway://HOST:PORT "
        "for a gateway to its serial port, or a serial line such as /dev/ttyUSB0; append a comma "
        "and its device id if that differs from its file's, such as gateway://HOST:PORT,17; for a "
        "relay mqtt://HOST[:PORT]/DEVICE (its topic at a broker), mqtts:// for TLS",
    )
    for option, metavar, meaning in (
        ("--broker-login", "FILE", "for a relay: YAML file with username and password"),
        ("--broker-authority", "FILE", "for a relay: file of trusted certificates (PEM), if the "
         "system does not know the broker's"),
    ):
        group.add_argument(option, default="", metavar=metavar, help=meaning)
    group.add_argument(
        "--state", type=Path, metavar="DIR",
        help="directory for what must survive a restart: a stop, a fault, the pump's use of the "
        "day; live, also for bag, logs and summary (default: the drive's own, a file by its "
        "address in ~/.local/state/greenroof_ros; live: live)",
    )
    group.add_argument(
        "--node-parameters", type=Path, metavar="FILE",
        help="ROS 2 parameter file for what bringup does not decide, such as the pump node's "
        "limits; each node's --help lists its parameters; unknown ones are refused. The drive, "
        "its address and its state directory are set only by --drive, --drive-at and --state",
    )
