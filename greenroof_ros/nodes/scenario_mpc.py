"""The planning controller over an ensemble of forecasts, as a node."""

from __future__ import annotations

import sys

from rclpy.node import Node

from greenroof_ros.controllers.planning_mpc import PlanningMpc
from greenroof_ros.controllers.planning_program import Ensemble
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.lockstep import Link
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site
from greenroof_ros.nodes.controller import ControllerNode, declare_trust, publish_solver


def build(node: Node) -> Link:
    """Declare the parameters and put the controller into the graph."""
    site = declare_site(node)
    ranges = CONTROLLERS["scenario_mpc"]
    observer_time_constant, max_waiting_loss = declare_trust(node, "scenario_mpc")
    controller = PlanningMpc(
        site,
        declare(node, "horizon", 12.0, "how far it plans (h)", *ranges["horizon"]),
        declare(node, "max_command", 1.0, "largest command (1)", *ranges["max_command"]),
        ensemble=Ensemble(
            declare(
                node, "cvar_level", 0.8, "of the conditional value-at-risk; 0 is the mean of all",
                *ranges["cvar_level"],
            ),
            3600 * declare(
                node, "recourse", 6.0, "until then one plan serves all members (h)",
                *ranges["recourse"],
            ),
        ),
        observer_time_constant=observer_time_constant,
        max_waiting_loss=max_waiting_loss,
    )
    part = ControllerNode(node, "scenario_mpc", controller)
    publish_solver(part, controller)
    return part.link


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("scenario_mpc", build, args))


if __name__ == "__main__":
    main()
