"""The model predictive controller as a node."""

from __future__ import annotations

import math
import sys

from rclpy.node import Node

from greenroof_ros.controllers.mpc import Mpc
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.lockstep import Link
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site
from greenroof_ros.nodes.controller import ControllerNode, publish_solver


def build(node: Node) -> Link:
    """Declare the parameters and put the controller into the graph."""
    site = declare_site(node)
    weight = declare(
        node, "weight", 0.001, "lambda of Eq. (11): price of pumping (1); may be changed in a run",
        *CONTROLLERS["mpc"]["weight"], read_only=False,
    )
    max_command = declare(
        node, "max_command", math.inf, "largest command (1)", *CONTROLLERS["mpc"]["max_command"]
    )
    controller = Mpc(site, weight, max_command)
    part = ControllerNode(node, "mpc", controller, "weight")
    publish_solver(part, controller)
    return part.link


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("mpc", build, args))


if __name__ == "__main__":
    main()
