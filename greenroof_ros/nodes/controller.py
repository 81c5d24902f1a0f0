"""The controller node, whichever controller it runs: levels and forecasts in, one command out.

``python -m greenroof_ros.nodes.controller --controller NAME`` runs a registered controller, or any
class as ``package.module:Class``; the node is named after it.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from greenroof_ros.common.command_line import EXIT_DONE, command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import optional_topics
from greenroof_ros.controllers.decide import decide
from greenroof_ros.controllers.registry import ControllerChoice, controller_names, find_controller
from greenroof_ros.graph.lockstep import CLOCK, LockstepNode
from greenroof_ros.graph.node_help import NodeParser, node_help
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import declare, declare_site, of_controller, site_file
from greenroof_ros.graph.serialization import decode_clock


class ControllerNode(LockstepNode):
    """Runs one controller in the graph; it commands 0 where an input was refused, and in frost."""

    def __init__(self, choice: ControllerChoice) -> None:
        """Declare the controller's parameters and open the topics."""
        super().__init__(choice.name, "controller")
        site = declare_site(self)
        values = declare(self, of_controller(choice.kind.parameters))
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

    def progress(self) -> dict[str, Any]:
        """Return the parameters that changed."""
        return {"parameter_changes": self._parameter_changes}

    def summary(self) -> dict[str, Any]:
        """Return the solver's figures."""
        return {"solver": self._controller.statistics()}

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


def _help(choice: ControllerChoice | None) -> str:
    """Return the help of a controller's node; without a controller, what all have in common."""
    own = [] if choice is None else of_controller(choice.kind.parameters)
    return node_help(
        f"controller --controller {'NAME' if choice is None else choice.reference}",
        "controller",
        f"{__doc__}\nRegistered are {', '.join(controller_names())}.",
        [site_file(), *own],
        "--ros-args "
        + (f"-p {own[0].name}:={own[0].default}" if own else "--params-file FILE"),
        () if choice is None else choice.outputs,
    )


def _run(controller: str | None) -> int:
    """Run the node.

    Args:
        controller: which; that of the command line's ``--controller`` if None.

    Raises:
        ConfigurationError: there is no such controller.
    """
    parser = NodeParser()
    if controller is None:
        parser.add_argument("--controller", metavar="NAME")
    else:
        parser.set_defaults(controller=controller)
    arguments = parser.own_arguments()
    choice = None if arguments.controller is None else find_controller(arguments.controller)
    if arguments.help:
        print(_help(choice))
        return EXIT_DONE
    if choice is None:
        parser.error("--controller NAME is missing")
    _ = choice.kind
    return run_node(partial(ControllerNode, choice))


main = command(partial(_run, None))
# The executables of this package's controllers.
mpc = command(partial(_run, "mpc"))
onoff = command(partial(_run, "onoff"))
planning_mpc = command(partial(_run, "planning_mpc"))
anticipating_onoff = command(partial(_run, "anticipating_onoff"))
scenario_mpc = command(partial(_run, "scenario_mpc"))


if __name__ == "__main__":
    main()
