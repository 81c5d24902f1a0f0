"""The controller node, whichever controller it runs: levels and forecasts in, one command out.

``python -m greenroof_ros.nodes.controller --controller NAME`` runs a registered controller, or any
class as ``package.module:Class``; the node is named after it.
"""

from __future__ import annotations

import argparse
import math
import sys
from functools import partial
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

from greenroof_ros.common.command_line import EXIT_USAGE
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import optional_topics
from greenroof_ros.controllers.decide import decide
from greenroof_ros.controllers.registry import ControllerChoice, controller_names, find_controller
from greenroof_ros.graph.lockstep import CLOCK, LockstepNode
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare_site, declare_table
from greenroof_ros.graph.serialization import decode_clock


class ControllerNode(LockstepNode):
    """Runs one controller in the graph; it commands 0 where an input was refused, and in frost."""

    def __init__(self, choice: ControllerChoice) -> None:
        """Declare the controller's parameters and open the topics."""
        super().__init__(choice.name, "controller")
        site = declare_site(self)
        values = declare_table(self, choice.kind.parameters)
        self._controller = choice.make(site, values)
        self._ensemble = choice.ensemble
        self._may_change = {
            one.name: values[one.name] for one in choice.kind.parameters if one.may_change
        }
        self._tick = 0
        self._parameter_changes: list[dict[str, Any]] = []
        self._cistern = self.subscribe("/cistern/level")
        self._roof = self.subscribe("/roof/level")
        self._rain = self.subscribe("/forecast/precipitation")
        self._evapotranspiration = self.subscribe("/forecast/evapotranspiration")
        self._frost = self.subscribe("/weather/frost")
        self.subscribe(CLOCK, self._on_clock, raw=True)
        self._publish_command = self.publish_topic("/pump/command")
        self._publish_outputs = [
            (self.publish_topic(topic.name), attribute, topic.undecided)
            for topic, attribute in optional_topics(choice.outputs)
        ]
        self.add_on_set_parameters_callback(self._on_parameters)

    def on_inputs(self) -> None:
        """Command, and publish what the controller says beside it."""
        allowed = self.good and not self._frost.value
        self._publish_command(
            decide(
                self._controller, allowed, self._cistern.value, self._roof.value,
                self._rain_forecast(), self._evapotranspiration.value,
            )
        )
        self._tick += 1
        for publish, attribute, undecided in self._publish_outputs:
            publish(getattr(self._controller, attribute) if allowed else undecided)

    def _rain_forecast(self) -> Any:
        """Return the forecast of rain in the shape that the controller takes.

        Raises:
            ConfigurationError: it is of several members, and the controller takes one.
        """
        rain = self._rain.value
        if self._ensemble:
            return np.atleast_2d(rain)
        if isinstance(rain, np.ndarray):
            raise ConfigurationError(
                f"has {len(rain)} members, and {self.get_name()} takes one; set all_members of "
                "the weather node to false", key=self._rain.name,
            )
        return rain

    def summary(self) -> dict[str, Any]:
        """Return the solver's figures, and the parameters that changed."""
        return {
            "solver": self._controller.statistics(),
            "parameter_changes": self._parameter_changes,
        }

    def _on_clock(self, message: bytes) -> None:
        self.set_time(decode_clock(message))

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name not in self._may_change:
                continue
            before = self._may_change[parameter.name]
            self._may_change[parameter.name] = parameter.value
            setattr(self._controller, parameter.name, parameter.value)
            self._parameter_changes.append({
                "tick": self._tick, "parameter": parameter.name,
                "before": _finite(before), "value": _finite(parameter.value),
            })
            self.get_logger().info(
                f"{parameter.name} is {parameter.value:g} from tick {self._tick} on"
            )
        return SetParametersResult(successful=True)


def _finite(value: float) -> float | None:
    """Return a parameter's value as a summary has it, in which null stands for no limit."""
    return value if math.isfinite(value) else None


def main(controller: str | None = None) -> None:
    """Run the node.

    Args:
        controller: which; that of the command line's ``--controller`` if None.
    """
    if controller is None:
        parser = argparse.ArgumentParser(
            description="Run a controller as a node of the graph. ROS arguments follow --ros-args."
        )
        parser.add_argument(
            "--controller", required=True, metavar="NAME",
            help=f"{', '.join(controller_names())}, or package.module:Class",
        )
        controller = parser.parse_args(remove_ros_args(sys.argv)[1:]).controller
    try:
        choice = find_controller(str(controller))
        _ = choice.kind
    except ConfigurationError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(EXIT_USAGE)
    sys.exit(run_node(partial(ControllerNode, choice)))


# The executables of this package's controllers.
mpc = partial(main, "mpc")
onoff = partial(main, "onoff")
planning_mpc = partial(main, "planning_mpc")
anticipating_onoff = partial(main, "anticipating_onoff")
scenario_mpc = partial(main, "scenario_mpc")


if __name__ == "__main__":
    main()
