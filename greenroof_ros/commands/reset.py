"""Clear a latched fault of the pump: ``greenroof reset``."""

from __future__ import annotations

import sys
import time

from greenroof_ros.commands.pump_request import request_of_pump
from greenroof_ros.common.command_line import EXIT_FAILED, Parser, add_namespace, command
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import GraphClient
from greenroof_ros.watch.store import GraphStore

# How long it waits for the pump node's report, which comes four times a second, before it asks (s).
_LONGEST_S = 5.0
_QUESTION = (
    "The pump may start as soon as the fault is cleared. Is its cause remedied, and is no one "
    "working on the pump? [y/N] "
)


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof reset",
        description="Clear a latched fault of the pump, in the pump node and in its drive, once "
        "its cause is remedied. For the person at the pump: it asks first. A hold remains, until "
        "'greenroof release'. Afterwards the pump starts when the controller asks for it and "
        "nothing else keeps it off.",
        epilog="exit codes: 0 cleared, 1 not cleared, 2 bad usage",
    )
    parser.add_argument(
        "--yes", action="store_true", help="do not ask, for scripts"
    )
    add_namespace(parser)
    return parser


def _reported_fault(namespace: str) -> str:
    """Return what a reset would clear, as the pump node reports it; empty if it reports nothing."""
    store = GraphStore(namespace)
    until = time.monotonic() + _LONGEST_S
    with Feed(store, recording=False):
        while time.monotonic() < until:
            time.sleep(0.1)
            with store.lock:
                pump = store.alarms.registry.pump(time.monotonic())
                if pump is not None:
                    return pump.text("fault") or pump.text("unknown")
    return ""


def _confirmed(fault: str) -> bool:
    """Ask on the terminal; no answer is a no."""
    if fault:
        print(f"The fault: {fault}", file=sys.stderr)
    try:
        return input(_QUESTION).strip().lower() in ("y", "yes")
    except EOFError:
        print(file=sys.stderr)
        return False


@command
def main() -> int:
    """Clear the fault, and print what the pump node answers."""
    arguments = make_parser().parse_args()
    if not arguments.yes and not _confirmed(_reported_fault(arguments.namespace)):
        print("not cleared: it was not confirmed", file=sys.stderr)
        return EXIT_FAILED
    return request_of_pump(arguments.namespace, GraphClient.reset_fault)
