"""Print the topics of the graph as a table: ``greenroof topics``."""

from __future__ import annotations

from greenroof_ros.common.command_line import Parser, command
from greenroof_ros.common.interface import markdown_table, read_topics


def make_parser() -> Parser:
    """Return the command's parser."""
    return Parser(
        prog="greenroof topics",
        description="Print the topics of the node graph (msg_defs/topics.yaml) as a table.",
    )


@command
def main() -> None:
    """Print the table."""
    make_parser().parse_args()
    print(markdown_table(read_topics().values()))
