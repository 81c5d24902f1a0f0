"""End the hold of the pump: ``greenroof release``."""

from __future__ import annotations

from greenroof_ros.commands.pump_request import request_of_pump
from greenroof_ros.common.command_line import Parser, add_namespace, command
from greenroof_ros.watch.graph_client import GraphClient


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(
        prog="greenroof release",
        description="End the hold of the pump, whoever made it. The pump then starts automatically "
        "when the controller asks for it and nothing else keeps it off. A fault remains.",
        epilog="exit codes: 0 released, 1 the pump node did not confirm it, 2 bad usage",
    )
    add_namespace(parser)
    return parser


@command
def main() -> int:
    """Release the pump, and print what the pump node answers."""
    arguments = make_parser().parse_args()
    return request_of_pump(arguments.namespace, GraphClient.release_pump)
