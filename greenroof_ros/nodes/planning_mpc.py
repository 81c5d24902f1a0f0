"""The planning controller as a node; its objective and the solver's status are topics, too."""

from __future__ import annotations

import sys

from rclpy.node import Node

from greenroof_ros.controllers.planning_mpc import PlanningMpc
from greenroof_ros.controllers.planning_program import Prices
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.lockstep import Link
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site
from greenroof_ros.nodes.controller import ControllerNode, declare_trust, publish_solver


def build(node: Node) -> Link:
    """Declare the parameters and put the controller into the graph."""
    site = declare_site(node)
    ranges = CONTROLLERS["planning_mpc"]
    observer_time_constant, max_waiting_loss = declare_trust(node, "planning_mpc")
    controller = PlanningMpc(
        site,
        declare(node, "horizon", 12.0, "how far it plans (h)", *ranges["horizon"]),
        declare(node, "max_command", 1.0, "largest command (1)", *ranges["max_command"]),
        declare(node, "power", 1.0, "of the deviation in the objective: 1 or 2", *ranges["power"]),
        Prices(
            declare(
                node, "energy_weight", 0.0, "a kWh's worth of deviation (m3 s)",
                *ranges["energy_weight"],
            ),
            declare(
                node, "start_weight", 0.0, "a pump start's worth of deviation (m3 s)",
                *ranges["start_weight"],
            ),
        ),
        observer_time_constant=observer_time_constant,
        max_waiting_loss=max_waiting_loss,
    )
    part = ControllerNode(node, "planning_mpc", controller)
    publish_solver(part, controller)
    return part.link


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("planning_mpc", build, args))


if __name__ == "__main__":
    main()
