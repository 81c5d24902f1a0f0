"""Shared by commands that make a request to the pump node, and print its answer."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import closing

from greenroof_ros.common.command_line import EXIT_DONE, EXIT_FAILED
from greenroof_ros.graph.domain import importing_ros
from greenroof_ros.watch.graph_client import GraphClient, PumpRequestError

# How long a command waits for the pump node (s): to discover it takes seconds.
_PATIENCE_S = 20.0


def request_of_pump(namespace: str, request: Callable[[GraphClient, float], str]) -> int:
    """Make a request to the pump node of a graph, print the answer, and return the exit code.

    Args:
        namespace: the graph's namespace, such as ``/site1``; empty for none.
        request: a method of the client, with the longest wait for the answer (s).

    Raises:
        ConfigurationError: ROS 2 is not installed.
    """
    try:
        with importing_ros(), closing(GraphClient(namespace, lambda *_: None)) as client:
            client.connect_pump(f"{namespace}/pump")
            print(request(client, _PATIENCE_S))
    except PumpRequestError as failure:
        print(f"error: {failure}", file=sys.stderr)
        return EXIT_FAILED
    return EXIT_DONE
