"""Show the state of the roof on a page: ``greenroof watch``."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import suppress
from pathlib import Path

from greenroof_ros.base.command_line import Parser, command, make_number_type
from greenroof_ros.base.errors import ConfigurationError, describe_extra
from greenroof_ros.base.files import state_directory
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.ros.domain import add_namespace
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.foxglove_server import FoxgloveServer
from greenroof_ros.watch.lines import read_last_seen
from greenroof_ros.watch.listening import (
    LOOPBACK,
    PORTS,
    Listener,
    listen,
    new_token,
    read_token,
)
from greenroof_ros.watch.store import GraphStore

# Niceness, as a watcher must not slow down others: on a busy core, it gets a tenth of the time.
_NICENESS = 10

_DESCRIPTION = """\
Show the state of the roof on a page in a browser: levels, pump, rain, the controller's plan, alarms
and advice. The page shows any graph in this ROS domain, either live or simulated at up to 60 times
real time. Any number of watchers may be started and stopped at any time, since no run waits for
them. The page can stop the pump and close the outlet valve, and can also release both with
--allow-release. With --foxglove, there is no page: Foxglove or Lichtblick shows the graph instead.

The page shows the values that the watcher itself has received in the past week. The values of a
live site are saved for the next start, every 10 minutes and when the command ends, in
$XDG_STATE_HOME/greenroof_ros or ~/.local/state/greenroof_ros. To show the bag of a run or a site,
use greenroof report.

The command prints the page's address, which only this machine can reach. From another machine, use
an ssh tunnel:
  ssh -L 8080:localhost:8080 NAME_OF_THIS_MACHINE
and open http://localhost:8080 there.
"""
_EPILOG = """\
examples:
  greenroof watch                       the graph in this ROS domain
  greenroof watch --namespace site1 --port 8081
  greenroof watch --host 0.0.0.0        for other machines, with a token
  greenroof watch --allow-release --port 8080 --token-file token
                                        with an address that can be bookmarked
  greenroof run --speed 60 --watch      a run, and its page alongside it
  greenroof watch --foxglove            for Foxglove, at ws://127.0.0.1:8765

When a run ends, the page waits for the next one and shows it. Ctrl-C ends the command.

exit codes: 0 ended on request, 1 failed, 2 bad usage or configuration
"""


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        prog="greenroof watch",
        usage="%(prog)s [options]",
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    add_namespace(parser)
    parser.add_argument(
        "--foxglove", nargs="?", const=8765, type=make_number_type(0, 65535, int), metavar="PORT",
        help="instead of the page, serve the graph to Foxglove or Lichtblick on this machine, at "
        "the address printed. PORT is 8765, as their viewers expect, if omitted; 0 selects any "
        "free port. Requires the extra [foxglove]",
    )
    parser.add_argument(
        "--allow-release", action="store_true",
        help="allow the page to release the pump, whoever holds it, to clear the fault "
        "speed_not_followed, to open and release the outlet valve and, if the site file allows "
        "doses, to request a dose. The page then requires its token on this machine as well",
    )
    parser.add_argument(
        "--host", metavar="ADDRESS",
        help="serve the page at this address, where other machines can view the page and stop the "
        "pump; 0.0.0.0 means all addresses. An address that other machines can reach requires "
        "a token, which is printed with the address; the connection is not encrypted "
        f"(default: {LOOPBACK})",
    )
    parser.add_argument(
        "--port", type=make_number_type(1, 65535, int), metavar="N",
        help=f"serve the page on this TCP port (default: {PORTS[0]} or, if that is in use, the "
        "next free port)",
    )
    parser.add_argument(
        "--token-file", type=Path, metavar="FILE",
        help="read the page's token from this file, so that the address stays the same; the page "
        "then always requires the token. If the file does not exist, it is created with a new "
        "token. The file must be accessible only to its owner (default: if the page requires a "
        "token, a new token at each start)",
    )
    return parser


def _refuse_wrong(arguments: argparse.Namespace) -> None:
    """Reject options for the page if --foxglove is given, since no page is then served.

    Raises:
        ConfigurationError: if --foxglove is used with an option for the page.
    """
    for option in ("allow_release", "host", "port", "token_file"):
        if arguments.foxglove is not None and getattr(arguments, option):
            raise ConfigurationError(
                "applies only to the page; omit this option or "
                "--foxglove", key=f"--{option.replace('_', '-')}"
            )


def find_past_file(namespace: str) -> Path:
    """Return the history file for this domain and namespace, whose names contain no dot."""
    place = [os.environ.get("ROS_DOMAIN_ID") or "0", *filter(None, namespace.split("/"))]
    return state_directory() / f"watch_{'.'.join(place)}.npz"


def _print_address(listener: Listener, token: str, port: int | None, *, release: bool) -> None:
    """Print the page's address, and warnings about what it allows other people to do."""
    if port is None and f":{PORTS[0]}/" not in listener.url:
        print(f"port {PORTS[0]} is in use, perhaps by another watcher", file=sys.stderr)
    if not listener.is_loopback:
        print(
            "anyone who has the address, including its token, can view the page, stop the pump "
            "and close the outlet valve; the connection is not encrypted", file=sys.stderr,
        )
    if release:
        print(
            "anyone who has the address, including its token, can release the pump, open the "
            "outlet valve, and request a dose if the site file allows doses", file=sys.stderr,
        )
    print(listener.url + (f"#token={token}" if token else ""), flush=True)


@command
def main() -> None:
    """Watch the graph until a signal arrives."""
    arguments = make_parser().parse_args()
    _refuse_wrong(arguments)
    os.nice(_NICENESS)
    if arguments.foxglove is not None:
        signals, server = Signals(), FoxgloveServer(arguments.namespace, arguments.foxglove)
        print(server.url, flush=True)
        with suppress(InterruptedRun):
            server.run(signals)
        return
    store = GraphStore(arguments.namespace)
    store.allow_release = arguments.allow_release
    past_file = find_past_file(arguments.namespace)
    store.seen_at = read_last_seen(past_file)
    try:
        from greenroof_ros.watch.server import PageServer
    except ModuleNotFoundError as error:
        raise ConfigurationError(f"needs {error.name}: {describe_extra('watch')}") from error
    listener = listen(arguments.host or LOOPBACK, arguments.port)
    # Releasing always needs a token, since behind a proxy every request comes from this machine.
    needed = store.allow_release or not listener.is_loopback
    token = new_token() if needed else ""
    if arguments.token_file is not None:
        token = read_token(arguments.token_file)
    signals = Signals()
    with (
        suppress(InterruptedRun),
        Feed(store, past_file) as feed,
    ):
        _print_address(listener, token, arguments.port, release=store.allow_release)
        PageServer(store, feed, listener, token or None).serve(signals)
