"""The on/off controller as a node."""

from __future__ import annotations

import sys

from rclpy.node import Node

from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.lockstep import Link
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site
from greenroof_ros.nodes.controller import ControllerNode


def build(node: Node) -> Link:
    """Declare the parameters and put the controller into the graph."""
    site = declare_site(node)
    fraction = declare(
        node, "fraction", 1.0, "v of Eq. (12): command when pumping (1); may be changed in a run",
        *CONTROLLERS["onoff"]["fraction"], read_only=False,
    )
    controller = OnOff(site, fraction)
    return ControllerNode(node, "onoff", controller, "fraction").link


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("onoff", build, args))


if __name__ == "__main__":
    main()
