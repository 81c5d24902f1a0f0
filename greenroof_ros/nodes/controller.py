"""What the controller nodes share: levels and forecasts in, one command out."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Float64

from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.controllers.registry import CONTROLLERS
from greenroof_ros.graph.lockstep import Link
from greenroof_ros.graph.parameters import declare


class ControllerNode:
    """Runs one controller in the graph.

    A tick in which any input was refused commands 0: what the controller would make of a level
    that nobody measured must not reach the pump. So does frost, which bursts a running pump's pipe.
    """

    def __init__(
        self,
        node: Node,
        role: str,
        controller: Controller,
        tunable: str = "",
    ) -> None:
        """Open the topics.

        Args:
            node: the rclpy node.
            role: the node's name in the contract.
            controller: decides the command.
            tunable: the parameter, and attribute of the controller, that may change in a run;
                empty if none may.
        """
        self._node = node
        self._controller = controller
        self._tunable = tunable
        self._tick = 0
        self._parameter_changes: list[dict[str, Any]] = []
        self.link = link = Link(node, role, self._on_inputs)
        self._cistern = link.take_topic("/cistern/level")
        self._roof = link.take_topic("/roof/level")
        self._rain = link.take_topic("/forecast/precipitation")
        self._evapotranspiration = link.take_topic("/forecast/evapotranspiration")
        self._frost = link.take_topic("/weather/frost")
        self._publish_command = link.publish_topic("/pump/command")
        self._message = Float64()
        # Called after each command with whether the controller decided it.
        self.after_command: Callable[[bool], None] = lambda decided: None
        link.summary = lambda: {
            "solver": controller.statistics(),
            "parameter_changes": self._parameter_changes,
        }
        node.add_on_set_parameters_callback(self._on_parameters)

    def _on_inputs(self) -> None:
        command = 0.0
        decided = self.link.good and not self._frost.value
        if decided:
            command = self._controller.command(
                self._cistern.value,
                self._roof.value,
                self._rain.value,
                self._evapotranspiration.value,
            )
        else:
            self._controller.skip()
        self._message.data = command
        self._publish_command(self._message)
        self._tick += 1
        self.after_command(decided)

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name != self._tunable:
                continue
            setattr(self._controller, self._tunable, parameter.value)
            self._parameter_changes.append(
                {"tick": self._tick, "parameter": parameter.name, "value": parameter.value}
            )
            self._node.get_logger().info(
                f"{parameter.name} is {parameter.value:g} from tick {self._tick} on"
            )
        return SetParametersResult(successful=True)


def declare_trust(node: Node, role: str) -> tuple[float, float]:
    """Declare and return a planning controller's ``observer_time_constant`` (s) and ``max_waiting_loss`` (h)."""
    ranges = CONTROLLERS[role]
    observer_time_constant = declare(
        node, "observer_time_constant", 300.0, "over how long readings of the roof are averaged (s)",
        *ranges["observer_time_constant"],
    )
    max_waiting_loss = declare(
        node, "max_waiting_loss", 1.0, "what waiting for rain may cost (h of an empty roof)",
        *ranges["max_waiting_loss"],
    )
    return observer_time_constant, max_waiting_loss


class Solving(Protocol):
    """A controller that has a solver."""

    @property
    def cost(self) -> float:
        """Objective of the last program; NaN if it was not solved."""
        ...

    @property
    def status(self) -> int:
        """The solver's status value of the last program."""
        ...


def publish_solver(part: ControllerNode, controller: Solving) -> None:
    """Publish objective and solver status after each command: what an operator plots."""
    publish_cost = part.link.publish_topic("/controller/cost")
    publish_status = part.link.publish_topic("/controller/solver_status")
    message = Float64()

    def after_command(decided: bool) -> None:
        message.data = controller.cost if decided else math.nan
        publish_cost(message)
        message.data = float(controller.status) if decided else 0.0
        publish_status(message)

    part.after_command = after_command
