"""End the hold of the pump: ``greenroof release``."""

from __future__ import annotations

import sys

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED, Parser, command, namespace
from greenroof_ros.graph.looker import Looker, StopFailedError, ask_pump


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof release",
        description="End the hold of the pump, whoever made it. The pump then starts by itself "
        "when the controller asks for it and nothing else keeps it off. A fault remains.",
        epilog="exit codes: 0 released, 1 the pump node did not confirm it, 2 bad usage",
    )
    parser.add_argument(
        "--namespace", type=namespace, default="", metavar="NAME",
        help="namespace of the graph, as passed to bringup (default: none)",
    )
    return parser


@command
def main() -> int:
    """Release the pump, and print what the pump node answers."""
    arguments = make_parser().parse_args()
    try:
        print(ask_pump(arguments.namespace, Looker.release_pump))
    except StopFailedError as failure:
        print(f"error: {failure}", file=sys.stderr)
        return EXIT_FAILED
    return EXIT_DONE


if __name__ == "__main__":
    main()
