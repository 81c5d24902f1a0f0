"""Everything of a live site that neither drives the pump nor is the user's code, in one process.

``python -m greenroof_ros.live.station --sensors sensors.yaml --weather`` creates a node for every
section of the sensor file, the weather node, the recorder and the alarms node. A node that fails is
destroyed and made again, after 1, 2, 4, 8 and 10 s, while the others go on. A node that fails more
than ten times in ten minutes is left out until the site is restarted; its failure stays an alarm.
Without the alarms node, and if a node hangs, bringup restarts the process.
"""

from __future__ import annotations

from greenroof_ros.ros import begin_node

begin_node(__name__)

import argparse
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rclpy.executors import SingleThreadedExecutor

from greenroof_ros.base.command_line import command
from greenroof_ros.base.standard_error import Lines
from greenroof_ros.live.node import LiveNode
from greenroof_ros.live.recorder import LiveRecorderNode
from greenroof_ros.live.restarts import Restarts
from greenroof_ros.live.sensors import sensor_makers
from greenroof_ros.live.weather import LiveWeatherNode
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.ros.errors import print_failure
from greenroof_ros.ros.executable import NodeParser, run_nodes
from greenroof_ros.ros.spin import end_nodes, start_receiving

# Longest wait for a message while no node asks for less (s).
_WAIT_S = 0.05

Make = Callable[[], LiveNode | AlarmsNode]


class _Place:
    """A node's place in the station: what makes it, and when."""

    def __init__(self, make: Make, node: LiveNode | AlarmsNode) -> None:
        self.make = make
        self.node: LiveNode | AlarmsNode | None = node
        self.is_required = isinstance(node, AlarmsNode)  # without it, nobody reports an alarm
        self.due = math.inf  # when it is made again (steady clock, s)
        self._restarts = Restarts()

    def fail(self, now: float) -> None:
        """Note a failure, and set when the node is made again."""
        self.node, wait = None, self._restarts.wait(now)
        self.due = math.inf if wait is None else now + wait


def keep_nodes(
    makers: Sequence[Make], nodes: list[LiveNode | AlarmsNode], check: Callable[[], None]
) -> None:
    """Run nodes, and make those again that fail, until a check ends them.

    Args:
        makers: functions that make the nodes.
        nodes: the nodes, in the same order; from then on, those that are running.
        check: function that is called at least 20 times a second and may raise an exception.
    """
    executor = SingleThreadedExecutor()
    places = [_Place(make, node) for make, node in zip(makers, nodes, strict=True)]
    for node in nodes:
        node.on_start()
        start_receiving(executor, node)
    while True:
        check()
        executor.spin_once(timeout_sec=min([_WAIT_S, *(node.wait_s for node in nodes)]))
        for place in places:
            now = time.monotonic()
            try:
                if place.node is not None:
                    place.node.check(now)
                elif now >= place.due:
                    place.node = place.make()
                    nodes.append(place.node)
                    place.node.on_start()
                    start_receiving(executor, place.node)
            except Exception as error:  # whatever it is, it must not end the other nodes
                failure, _ = print_failure(error)
                failed = place.node
                if failed is not None:
                    nodes.remove(failed)
                    executor.remove_node(failed)
                    end_nodes([failed], failure)
                    failed.destroy_node()
                place.fail(now)
                if math.isinf(place.due) and place.is_required:
                    raise


def _list_makers(arguments: argparse.Namespace) -> list[Make]:
    """Return what makes the nodes of the command line, in the order in which they end."""
    makers: list[Make] = []
    if arguments.sensors is not None:
        makers += sensor_makers(arguments.sensors)
    if arguments.weather:
        makers.append(LiveWeatherNode)
    return [*makers, LiveRecorderNode, partial(AlarmsNode, Lines(1))]


@command
def main() -> int:
    """Run the nodes."""
    parser = NodeParser(description=__doc__)
    parser.add_argument("--sensors", type=Path, help="sensor file")
    parser.add_argument("--weather", action="store_true", help="run the weather node")
    makers = _list_makers(parser.parse_own_args())
    return run_nodes(lambda: [make() for make in makers], partial(keep_nodes, makers))


if __name__ == "__main__":
    main()
