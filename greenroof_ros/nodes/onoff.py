"""The on/off controller as a node."""

from __future__ import annotations

import sys
from pathlib import Path

from rclpy.node import Node

from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.files import shared_directory
from greenroof_ros.lockstep import declare, run_node
from greenroof_ros.nodes.controller import ControllerNode
from greenroof_ros.site import read_site


def build(node: Node) -> ControllerNode:
    """Declare the parameters and put the controller into the graph."""
    site_file = declare(
        node, "site_file", str(shared_directory() / "config" / "site.yaml"), "Table I"
    )
    fraction = declare(
        node, "fraction", 1.0, "v of Eq. (12): command when pumping (1); may be changed in a run",
        low=1e-9, high=1e6, read_only=False,
    )
    controller = OnOff(read_site(Path(site_file)), fraction)
    return ControllerNode(node, "onoff", controller, "fraction")


def main(args: list[str] | None = None) -> None:
    """Run the node."""
    sys.exit(run_node("onoff", build, args))


if __name__ == "__main__":
    main()
