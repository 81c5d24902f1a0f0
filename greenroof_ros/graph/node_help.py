"""The command line of a node: its own arguments, its ``--help``, and its start."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import NoReturn

from rclpy.utilities import remove_ros_args

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_USAGE, command
from greenroof_ros.common.interface import read_topics
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import default_site, type_name
from greenroof_ros.model.site import Site


class NodeParser(argparse.ArgumentParser):
    """Reads a node's own arguments, those before ``--ros-args``; a mistake is one line."""

    def __init__(self) -> None:
        super().__init__(add_help=False, allow_abbrev=False)
        self.add_argument("-h", "--help", action="store_true")

    def own_arguments(self) -> argparse.Namespace:
        """Parse the process's command line."""
        try:
            own = remove_ros_args(sys.argv)
        except RuntimeError as error:  # of rcl: arguments that it cannot read
            self.error(" ".join(str(error).split()))
        return self.parse_args(own[1:])

    def error(self, message: str) -> NoReturn:
        """End the process with a mistake's one line."""
        self.exit(EXIT_USAGE, f"error: {message}; --help shows what the node takes\n")


def node_command(
    make: Callable[[], LinkedNode],
    module: str,
    role: str,
    purpose: str | None,
    parameters: Callable[[Site], Iterable[Parameter]],
    example: str,
    *,
    always_live: bool = False,
) -> Callable[[], NoReturn]:
    """Return the executable of a node that has no arguments of its own; see :func:`node_help`."""

    @command
    def main() -> int:
        """Run the node, or print its help."""
        if not NodeParser().own_arguments().help:
            return run_node(make)
        declared = parameters(default_site())
        print(node_help(module, role, purpose, declared, example, always_live=always_live))
        return EXIT_DONE

    return main


def node_help(
    module: str,
    role: str,
    purpose: str | None,
    parameters: Iterable[Parameter],
    example: str,
    outputs: Collection[str] = (),
    *,
    always_live: bool = False,
) -> str:
    """Return the text of a node's ``--help``.

    Args:
        module: its module, and arguments that it must have.
        role: what the interface calls it.
        purpose: what it is for.
        parameters: all that it declares.
        example: arguments of a start.
        outputs: the optional topics that it publishes.
        always_live: whether it is for live graphs alone.
    """
    start = f"python -m greenroof_ros.nodes.{module}"
    topics = [topic for topic in read_topics().values() if topic.live or not always_live]
    sections = {
        "parameters, after --ros-args as -p NAME:=VALUE or by --params-file FILE": [
            (one.name, _about(one), one.description) for one in parameters
        ],
        **{
            heading: [
                (topic.name, f"{topic.type}{topic.unit and ', unit '}{topic.unit}", topic.meaning)
                for topic in topics if role in roles(topic)
                and (heading != "publishes" or not topic.optional or topic.name in outputs)
            ]
            for heading, roles in {
                "publishes": lambda topic: (*topic.publishers, *topic.live_publishers),
                "subscribes to": lambda topic: topic.subscribers,
                "in a live graph also to": lambda topic: topic.live_subscribers,
            }.items()
        },
    }
    return "\n".join([
        f"usage: {start} [--help] [--ros-args ...]\n",
        f"{purpose}".strip().replace("``", "`"),
        *(line for heading in sections for line in _section(heading, sections[heading])),
        f"\nexample:\n  {start} {example}",
    ])


def _section(heading: str, entries: list[tuple[str, str, str]]) -> Iterator[str]:
    """Yield the lines of a section; none where it has no entry."""
    if entries:
        yield f"\n{heading}:"
    for name, about, meaning in entries:
        yield f"  {name} ({about})"
        yield textwrap.fill(
            meaning, 96, initial_indent=" " * 6, subsequent_indent=" " * 6, break_on_hyphens=False
        )


def _about(one: Parameter) -> str:
    """Return type, range and default of a parameter, written as in a parameter file."""
    default = one.default
    if isinstance(default, list):
        default = f"[{', '.join(default)}]"
    elif isinstance(default, bool):
        default = str(default).lower()
    elif isinstance(default, float):
        default = f"{default:.7g}" if default % 1 else f"{default:.1f}"
    limits = f"{one.limits and ', '}{one.limits}"
    changes = "; may change in a run" if one.may_change else ""
    return f"{type_name(one)}{limits}; default {str(default) or 'empty'}{changes}"
