"""The command line of a node: its own arguments, and what ``--help`` says."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Collection, Iterable, Iterator
from typing import NoReturn

from rclpy.utilities import remove_ros_args

from greenroof_ros.common.command_line import EXIT_USAGE
from greenroof_ros.common.interface import Topic, read_topics
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.graph.parameters import type_name


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


def node_help(
    command: str,
    role: str,
    purpose: str,
    parameters: Iterable[Parameter],
    example: str,
    outputs: Collection[str] = (),
    *,
    always_live: bool = False,
) -> str:
    """Return the text of a node's ``--help``.

    Args:
        command: its module, and arguments that it must have.
        role: what the interface calls it.
        purpose: what it is for.
        parameters: all that it declares.
        example: arguments of a start.
        outputs: the optional topics that it publishes.
        always_live: whether it is for live graphs alone.
    """
    module = f"python -m greenroof_ros.nodes.{command}"
    topics = [topic for topic in read_topics().values() if topic.live or not always_live]
    published = [
        topic for topic in topics
        if role in {*topic.publishers, *topic.live_publishers}
        and (not topic.optional or topic.name in outputs)
    ]
    subscribed = [topic for topic in topics if role in topic.subscribers]
    live = [topic for topic in topics if role in topic.live_subscribers]
    return "\n".join([
        f"usage: {module} [--help] [--ros-args ...]", "",
        purpose.strip().replace("``", "`"), "",
        "parameters, after --ros-args as -p NAME:=VALUE or by --params-file FILE:",
        *(line for one in parameters for line in _parameter(one)), "",
        "publishes:", *(line for one in published for line in _topic(one)), "",
        "subscribes to:", *(line for one in subscribed for line in _topic(one)), "",
        *(
            ["in a live graph also to:", *(line for one in live for line in _topic(one)), ""]
            if live else []
        ),
        "example:", f"  {module} {example}",
    ])


def _parameter(one: Parameter) -> Iterator[str]:
    kind = f"{type_name(one)}{one.limits and ', '}{one.limits}"
    changes = "; may change in a run" if one.may_change else ""
    yield f"  {one.name} ({kind}; default {_written(one.default)}{changes})"
    yield _indented(one.description)


def _written(value: str | float | int | bool | list[str]) -> str:
    """Return a value as it is written in a parameter file."""
    if isinstance(value, list):
        return f"[{', '.join(value)}]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.7g}" if value % 1 else f"{value:.1f}"
    return str(value) or "empty"


def _topic(one: Topic) -> Iterator[str]:
    yield f"  {one.name} ({one.type}{one.unit and ', unit '}{one.unit})"
    yield _indented(one.meaning)


def _indented(text: str) -> str:
    return textwrap.fill(
        text, 96, initial_indent=" " * 6, subsequent_indent=" " * 6, break_on_hyphens=False
    )
