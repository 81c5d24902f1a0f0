"""Show the state of the roof on a page in a browser.

The page has levels, pump, rain, the controller's plan, alarms and advice, and shows any graph in
this ROS domain, either live or simulated at up to 60 times real time. Any number of watchers may be
started and stopped at any time, since no run waits for them; when a run ends, the page waits for
the next one. The page can stop the pump and close the outlet valve, and can also release both with
--allow-release. With --foxglove, there is no page: Foxglove or Lichtblick shows the graph instead.

The page shows the values that the watcher itself has received in the past week. The values of a
live site are saved for the next start, every 10 minutes and when the command ends, in
$XDG_STATE_HOME/greenroof_ros or ~/.local/state/greenroof_ros. To show the bag of a run or a site,
use greenroof report.

The command prints the page's address, which only this machine can reach. From another machine, use
an ssh tunnel:
  ssh -L 8080:localhost:8080 NAME_OF_THIS_MACHINE
and open http://localhost:8080 there.

Examples:
  greenroof watch                       the graph in this ROS domain
  greenroof watch --namespace site1 --port 8081
  greenroof watch --host 0.0.0.0        for other machines, with a token
  greenroof watch --allow-release --port 8080 --token-file token
                                        with an address that can be bookmarked
  greenroof run --speed 60 --watch      a run, and its page alongside it
  greenroof watch --foxglove            for Foxglove, at ws://127.0.0.1:8765

Exit codes: 0 ended on request by Ctrl-C, 1 failed, 2 bad usage or configuration
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from greenroof_ros.base.command_line import Parser, command, make_number_type, print_lines
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.files import state_directory
from greenroof_ros.base.processes import InterruptedRun, Signals
from greenroof_ros.ros.domain import add_namespace
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.foxglove_server import FoxgloveServer
from greenroof_ros.watch.lines import read_last_seen
from greenroof_ros.watch.listening import LOOPBACK, PORTS, listen, new_token, read_token
from greenroof_ros.watch.store import GraphStore

NICENESS = 10
"""niceness of a watcher, which must not slow down others: on a busy core, it gets a tenth of the
time"""


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("watch", __doc__)
    add_namespace(parser)
    parser.add_argument(
        "--foxglove", nargs="?", const=8765, type=make_number_type(0, 65535, int), metavar="PORT",
        help="instead of the page, serve the graph to Foxglove or Lichtblick on this machine at "
        "this port (8765 if omitted, 0 for any free one). Requires the extra [foxglove]",
    )
    parser.add_argument(
        "--allow-release", action="store_true",
        help="allow the page to release the pump, whoever holds it, to clear the fault "
        "speed_not_followed, to open and release the outlet valve and to request doses that the "
        "site file allows; the page then always requires its token",
    )
    parser.add_argument(
        "--host", default=LOOPBACK, metavar="ADDRESS",
        help="serve the page at this address; 0.0.0.0 means all addresses. If other machines can "
        "reach it, the page requires a token, which is printed with the address; the connection is "
        "not encrypted (default: %(default)s)",
    )
    parser.add_argument(
        "--port", type=make_number_type(1, 65535, int), metavar="N",
        help=f"serve the page on this TCP port (default: {PORTS[0]} or the next free one)",
    )
    parser.add_argument(
        "--token-file", type=Path, metavar="FILE",
        help="always require the token in this file, which only its owner may read and which is "
        "created if it does not exist (default: a new token at each start, if one is required)",
    )
    return parser


def find_past_file(namespace: str) -> Path:
    """Return the history file for this domain and namespace, whose names contain no dot."""
    place = [os.environ.get("ROS_DOMAIN_ID") or "0", *filter(None, namespace.split("/"))]
    return state_directory() / f"watch_{'.'.join(place)}.npz"


def open_store(namespace: str) -> GraphStore:
    """Return an empty store of a graph's values, which knows when its site was last seen."""
    store = GraphStore(namespace)
    store.seen_at = read_last_seen(find_past_file(namespace))
    return store


@command
def main() -> None:
    """Watch the graph until a signal arrives."""
    arguments = make_parser().parse_args()
    release = arguments.allow_release
    os.nice(NICENESS)
    if arguments.foxglove is not None:
        signals, server = Signals(), FoxgloveServer(arguments.namespace, arguments.foxglove)
        print(server.url, flush=True)
        with suppress(InterruptedRun):
            server.run(signals)
        return
    store = open_store(arguments.namespace)
    store.allow_release = release
    with require_extra("watch"):
        from greenroof_ros.watch.server import PageServer
    listener, token = listen(arguments.host, arguments.port), ""
    if arguments.token_file is not None:
        token = read_token(arguments.token_file)
    elif release or not listener.is_loopback:
        # Releasing always needs a token, since behind a proxy every request is from this machine.
        token = new_token()
    signals = Signals()
    with suppress(InterruptedRun), Feed(store, find_past_file(arguments.namespace)) as feed:
        if token:
            print_lines("note", ["anyone who has the address can do what the page allows"])
        print(listener.url + (f"#token={token}" if token else ""), flush=True)
        PageServer(store, feed, listener, token or None).serve(signals)
