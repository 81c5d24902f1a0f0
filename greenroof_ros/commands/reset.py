"""Clear a latched fault of the pump: ``greenroof reset``."""

from __future__ import annotations

import sys

from greenroof_ros.commands.pump_request import request_of_pump
from greenroof_ros.common.command_line import EXIT_FAILED, Parser, add_namespace, command
from greenroof_ros.watch.graph_client import GraphClient

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


def _confirmed() -> bool:
    """Ask on the terminal; no answer is a no."""
    try:
        return input(_QUESTION).strip().lower() in ("y", "yes")
    except EOFError:
        print(file=sys.stderr)
        return False


@command
def main() -> int:
    """Clear the fault, and print what the pump node answers."""
    arguments = make_parser().parse_args()
    if not arguments.yes and not _confirmed():
        print("not cleared: it was not confirmed", file=sys.stderr)
        return EXIT_FAILED
    return request_of_pump(arguments.namespace, GraphClient.reset_fault)
