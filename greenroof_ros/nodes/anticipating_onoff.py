"""The anticipating on/off controller as a node."""

from __future__ import annotations

import sys

from rclpy.node import Node

from greenroof_ros.controllers.anticipating_onoff import AnticipatingOnOff
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.lockstep import Link
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site
from greenroof_ros.nodes.controller import ControllerNode, declare_trust


def build(node: Node) -> Link:
    """Declare the parameters and put the controller into the graph."""
    site = declare_site(node)
    ranges = CONTROLLERS["anticipating_onoff"]
    horizon = declare(node, "horizon", 12.0, "how far it looks ahead (h)", *ranges["horizon"])
    fraction = declare(
        node, "fraction", 1.0, "v of Eq. (12): command when pumping (1); may be changed in a run",
        *ranges["fraction"], read_only=False,
    )
    observer_time_constant, max_waiting_loss = declare_trust(node, "anticipating_onoff")
    controller = AnticipatingOnOff(site, horizon, fraction, observer_time_constant, max_waiting_loss)
    return ControllerNode(node, "anticipating_onoff", controller, "fraction").link


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("anticipating_onoff", build, args))


if __name__ == "__main__":
    main()
