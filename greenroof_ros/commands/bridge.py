"""Publish the values shown on the page of 'greenroof watch' over MQTT.

These are levels, pump, outlet valve, rain, frost, the controller's plan, and alarms with their
codes. Home Assistant discovers the site automatically. The bridge works alongside any graph in this
ROS domain, simulated or live, and may be started and stopped at any time, since no node waits for
it. If it cannot reach the broker, it reports this and keeps trying.

Anyone who may publish on the topics greenroof/SITE/stop and greenroof/SITE/valve_close can stop
the pump and close the outlet valve, and open it with --allow-open. Nothing else can be requested.

Examples:
  greenroof bridge --broker mqtt://127.0.0.1
  greenroof bridge --broker mqtts://home.example --login login.yaml
  greenroof bridge --broker mqtt://127.0.0.1 --namespace north

Exit codes: 0 ended on request, 1 failed, 2 bad usage or configuration
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress

from greenroof_ros.base.command_line import Parser, command
from greenroof_ros.base.mqtt import parse_broker
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.commands.watch import NICENESS, open_store
from greenroof_ros.ros.domain import add_namespace
from greenroof_ros.watch.bridge import Bridge
from greenroof_ros.watch.feed import Feed


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("bridge", __doc__, "--broker mqtt://HOST[:PORT] [options]")
    parser.add_argument(
        "--broker", required=True, metavar="ADDRESS",
        help="broker: mqtt://HOST[:PORT], or mqtts://HOST[:PORT] for TLS (ports 1883 and 8883)",
    )
    parser.add_argument(
        "--login", default="", metavar="FILE",
        help="YAML file with username and password, which only its owner may read (chmod 600)",
    )
    parser.add_argument(
        "--authority", default="", metavar="FILE",
        help="PEM file of the certificates to trust for mqtts:// (default: the system's)",
    )
    parser.add_argument(
        "--allow-open", action="store_true",
        help="allow the outlet valve to be opened over MQTT, for 30 minutes at a time",
    )
    add_namespace(
        parser, "namespace of the graph and name of the site on MQTT, greenroof/NAMESPACE/... "
        "(roof if there is none), so two sites on one broker need different namespaces",
    )
    return parser


@command
def main() -> None:
    """Publish a site until the command is stopped."""
    arguments = make_parser().parse_args()
    broker = parse_broker(arguments.broker, "--broker", arguments.login, arguments.authority)
    os.nice(NICENESS)
    # A script that starts this in its background has it ignore SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    store, signals = open_store(arguments.namespace), Signals()
    with suppress(InterruptedRun), Feed(store) as feed:
        Bridge(store, feed, broker, arguments.allow_open).run(signals)
