"""The controller node, which runs any controller and publishes the controller's command.

``python -m greenroof_ros.nodes.controller --controller NAME`` runs a controller of this package, or
any class given as ``package.module:Class``. The node has the name of the controller.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import copy
from collections import deque
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter as RosParameter

from greenroof_ros.base.parameter import Parameter, replace_infinity
from greenroof_ros.controllers.decide import decide, locate_error, may_decide, read_statistics
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.protocol import set_optional
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.interface.topics import optional_topics
from greenroof_ros.physics.storm_water import WITHOUT_RAIN
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.lockstep import CLOCK, LockstepNode
from greenroof_ros.ros.messages import Input
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.ros.spin import node_command

LEVELS = "/cistern/level", "/roof/level"
FORECASTS = "/forecast/precipitation", "/forecast/evapotranspiration"
FROST = "/weather/frost"
Outputs = dict[str, Any]
"""values of a controller's optional outputs, by attribute; empty if it has not decided"""
# How many of the newest parameter changes every report contains: a program may change a parameter
# in every tick. All are counted.
_CHANGES = 50


def parameters(choice: ControllerChoice | None) -> list[Parameter]:
    """Return the parameters of a controller's node; None for the parameters of every controller."""
    return [site_file(), WITHOUT_RAIN, *([] if choice is None else choice.parameters.values())]


class ControllerNode(GraphNode):
    """Node that runs a controller, commanding 0 in frost, in quiet hours and for invalid inputs.

    At a site with an outlet valve, the node also commands the valve, even in frost and in quiet
    hours. A subclass, which adds the pace, opens the inputs.

    Attributes:
        controller: the controller; None before it is made, or if making it failed.
        command: the latest command (share of the maximum flow).
    """

    _cistern: Input
    _roof: Input
    _rain: Input
    _evapotranspiration: Input
    _frost: Input

    def prepare(self, choice: ControllerChoice) -> None:
        """Declare the controller's parameters and open the outputs.

        Raises:
            ConfigurationError: if a parameter is invalid.
        """
        self._choice, self._site = choice, self.declare_site()
        self._values = declare(self, choice.parameters_on(self._site))
        self._changes: deque[dict[str, Any]] = deque(maxlen=_CHANGES)
        self._change_count = 0
        self._optional = optional_topics(choice.outputs)
        self.open_outputs("/pump/command", *(topic.name for topic, _ in self._optional))
        self._outlet: OutletPolicy | None = None
        self._own_steps: int | None = None  # of a forecast; None for all
        self._quiet = False
        self.controller: Any = None
        self.command = 0.0
        self.add_on_set_parameters_callback(self._try_changes)
        self.add_post_set_parameters_callback(self._apply_changes)

    def make_controller(self) -> None:
        """Create the controller with the current values of its parameters.

        Raises:
            ConfigurationError: if the controller's code fails.
        """
        self.controller = None
        self.controller = self._choice.make(self._site, self._values)

    # --- parameters that change during a run --------------------------------------------------

    def _try_changes(self, changes: list[RosParameter]) -> SetParametersResult:
        """Try the changes on a copy of the controller; other checks may still reject them."""
        tried = copy.copy(self.controller)
        for each in changes:
            try:
                if each.name in self._values and tried is not None:
                    setattr(tried, each.name, each.value)
            except (Exception, SystemExit) as error:  # whatever a user's class raises
                reason = str(locate_error(self._choice.kind, error))
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _apply_changes(self, changes: list[RosParameter]) -> None:
        """Apply changes that every check has accepted."""
        for each in changes:
            if each.name not in self._values:
                continue
            if self.controller is not None:
                setattr(self.controller, each.name, each.value)
            values = {"before": self._values[each.name], "value": each.value}
            self._values[each.name] = each.value
            self._change_count += 1
            self._changes.append(
                {"tick": self.tick, "parameter": each.name, **replace_infinity(values)}
            )
            self.get_logger().info(f"{each.name} is {each.value:g} from tick {self.tick} on")

    def progress(self) -> dict[str, Any]:
        """Return the latest changes to the controller's parameters, and their total number."""
        return {
            "parameter_changes": list(self._changes), "parameter_change_count": self._change_count,
        }

    # --- decisions ----------------------------------------------------------------------------

    def on_inputs(self) -> None:
        """Publish the command and, if the controller has decided, its optional outputs."""
        allowed = bool(self.good and self._site.irrigated and not self._frost.value)
        if self._site.quiet is not None:
            self._quiet = self._site.quiet.quiet_at(self.time_ns)
        self.command, outputs = self.find_command(allowed)
        self.publish("/pump/command", self.command)
        if self._outlet is not None:
            self.publish("/outlet/command", self._command_outlet(self._outlet))
        self.publish_outputs(outputs)

    def publish_outputs(self, outputs: Outputs) -> None:
        """Publish the optional outputs."""
        for topic, attribute in self._optional:
            self.publish(topic.name, outputs[attribute] if outputs else topic.undecided)

    def find_command(self, allowed: bool) -> tuple[float, Outputs]:
        """Return the command, and the values of the optional outputs.

        Args:
            allowed: whether pumping is allowed.
        """
        return self.decide(may_decide(self.controller, allowed, self._quiet))

    def decide(self, decides: bool) -> tuple[float, Outputs]:
        """Return the controller's command and optional outputs, or 0 if it must not decide.

        Raises:
            ConfigurationError: if the controller's code fails, or cannot use the forecast.
        """
        set_optional(self.controller, time_ns=self.time_ns)
        rain, evapotranspiration, forecast = self._rain, self._evapotranspiration, ((), ())
        if decides and rain.good and evapotranspiration.good:
            forecast = self._choice.own_forecast(
                self._own_steps, rain.value, evapotranspiration.value, rain.name
            )
        levels = self._cistern.value, self._roof.value
        command = decide(self.controller, decides, *levels, *forecast, self._quiet)
        if not decides:
            return command, {}
        return command, {name: getattr(self.controller, name) for _, name in self._optional}

    def _command_outlet(self, outlet: OutletPolicy) -> float:
        levels, share = (self._cistern.value, self._roof.value), 0.0
        if self.good:  # the policy must not learn from a rejected input: it would be a 0
            share = outlet(*levels, self._rain.value, self._evapotranspiration.value)
        elif not self._rain.good:
            outlet(*levels, (), ())  # unknown rain counts as wet weather
        return 0.0 if self._site.valve_closed_in_frost and self._frost.value else share


class SimulatedController(ControllerNode, LockstepNode):
    """Controller node of a simulated graph."""

    def __init__(self, controller: str) -> None:
        """Declare the controller's parameters and open the topics.

        Args:
            controller: name of a controller, or ``package.module:Class``.

        Raises:
            ConfigurationError: if the controller does not exist.
        """
        choice = find_controller(controller)
        _ = choice.kind  # fail before a node is made
        super().__init__(choice.name, "controller")
        self.prepare(choice)
        self.make_controller()
        without_rain = declare(self, [WITHOUT_RAIN])[WITHOUT_RAIN.name]
        self._outlet = choice.make_outlet(self._site, self._values, self.controller, without_rain)
        self._own_steps = choice.count_own_steps(self._site, self._values)
        if self._outlet is not None:
            self.open_outputs("/outlet/command")
        self.subscribe(CLOCK)
        self._cistern, self._roof, self._rain, self._evapotranspiration, self._frost = (
            self.subscribe(name) for name in (*LEVELS, *FORECASTS, FROST)
        )

    def summary(self) -> dict[str, Any]:
        """Return the solver's statistics."""
        return {"solver": read_statistics(self.controller)}


main = node_command(SimulatedController, __doc__, "--controller")


if __name__ == "__main__":
    main()
