"""Publish a site over MQTT, for Home Assistant and other clients: ``greenroof bridge``."""

from __future__ import annotations

import os
import signal
from contextlib import suppress

from greenroof_ros.base.command_line import Parser, command
from greenroof_ros.base.mqtt import parse_broker
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.commands.watch import find_past_file
from greenroof_ros.ros.domain import add_namespace
from greenroof_ros.watch.bridge import Bridge
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.lines import read_last_seen
from greenroof_ros.watch.store import GraphStore

# Niceness, as for the page: about a tenth of a core if other processes want all of it.
_NICENESS = 10

_DESCRIPTION = """\
Publish the values shown on the page of 'greenroof watch' over MQTT: levels, pump, outlet valve,
rain, frost, the controller's plan, and alarms with their codes. Home Assistant discovers the site
automatically. The bridge works alongside any graph in this ROS domain, simulated or live. The
bridge may be started and stopped at any time, since no node waits for it.

Anyone who may publish on the topics greenroof/SITE/stop and greenroof/SITE/valve_close can stop
the pump and close the outlet valve, and open it with --allow-open. Nothing else can be requested.
"""
_EPILOG = """\
examples:
  greenroof bridge --broker mqtt://127.0.0.1
  greenroof bridge --broker mqtts://home.example --login login.yaml
  greenroof bridge --broker mqtt://127.0.0.1 --namespace north

If there is a namespace, it is part of the topics: greenroof/north/...

A login file has two lines, username: NAME and password: WORD. The file must be readable only by its
owner (chmod 600). If the bridge cannot reach the broker, it reports this and keeps trying. Ctrl-C
stops the bridge.

exit codes: 0 ended on request, 1 failed, 2 bad usage or configuration
"""


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof bridge",
        usage="%(prog)s --broker mqtt://HOST[:PORT] [options]",
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    parser.add_argument(
        "--broker", required=True, metavar="ADDRESS",
        help="publish to this broker: mqtt://HOST[:PORT], or mqtts://HOST[:PORT] for TLS (default "
        "ports: 1883 and 8883)",
    )
    parser.add_argument(
        "--login", default="", metavar="FILE",
        help="log in with username and password from this YAML file (default: no login)",
    )
    parser.add_argument(
        "--authority", default="", metavar="FILE",
        help="trust the certificates in this PEM file for mqtts:// (default: the system's "
             "certificates)",
    )
    parser.add_argument(
        "--allow-open", action="store_true",
        help="allow the outlet valve to be opened over MQTT, for 30 minutes at a time",
    )
    add_namespace(
        parser, "namespace of the graph; it is also the site's name on MQTT (roof if there is no "
        "namespace), so two sites on one broker need different namespaces",
    )
    return parser


@command
def main() -> None:
    """Publish a site until the command is stopped."""
    arguments = make_parser().parse_args()
    broker = parse_broker(arguments.broker, "--broker", arguments.login, arguments.authority)
    os.nice(_NICENESS)
    # A script that starts this in its background has it ignore SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    store, signals = GraphStore(arguments.namespace), Signals()
    store.seen_at = read_last_seen(find_past_file(arguments.namespace))
    with suppress(InterruptedRun), Feed(store) as feed:
        Bridge(store, feed, broker, arguments.allow_open).run(signals)
