"""The controller node, which runs any controller and publishes the controller's command.

``python -m greenroof_ros.nodes.controller --controller NAME`` runs a controller of this package, or
any class given as ``package.module:Class``. The node has the name of the controller.
"""

from __future__ import annotations

from greenroof_ros.ros import begin_node

begin_node(__name__)

from typing import Any

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.controllers.decide import decide, may_decide, read_statistics
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.protocol import set_optional
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.interface.topics import optional_topics
from greenroof_ros.physics.storm_water import WITHOUT_RAIN
from greenroof_ros.ros.controller_parameters import ControllerParameters
from greenroof_ros.ros.executable import node_command
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.inputs import Input
from greenroof_ros.ros.lockstep import CLOCK
from greenroof_ros.ros.node import SimulationNode
from greenroof_ros.ros.parameters import declare, site_file

LEVELS = "/cistern/level", "/roof/level"
FORECASTS = "/forecast/precipitation", "/forecast/evapotranspiration"
FROST = "/weather/frost"
Outputs = dict[str, Any]
"""values of a controller's optional outputs, by attribute; empty if it has not decided"""


def parameters(choice: ControllerChoice | None) -> list[Parameter]:
    """Return the parameters of a controller's node; None for the parameters of every controller."""
    return [site_file(), WITHOUT_RAIN, *([] if choice is None else choice.parameters.values())]


class ControllerNode(GraphNode):
    """Node that runs a controller, commanding 0 in frost, in quiet hours and for invalid inputs.

    At a site with an outlet valve, the node also commands the valve, even in frost and in quiet
    hours. A subclass, which adds the pace, opens the inputs.

    Attributes:
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
        self._settings = ControllerParameters(self, choice, self._site)
        self._optional = optional_topics(choice.outputs)
        self.open_outputs("/pump/command", *(topic.name for topic, _ in self._optional))
        self._outlet: OutletPolicy | None = None
        self._own_steps: int | None = None  # of a forecast; None for all
        self._quiet = False
        self.command = 0.0

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
        return self.decide(may_decide(self._settings.controller, allowed, self._quiet))

    def decide(self, decides: bool) -> tuple[float, Outputs]:
        """Return the controller's command and optional outputs, or 0 if it must not decide.

        Raises:
            ConfigurationError: if the controller's code fails, or cannot use the forecast.
        """
        controller = self._settings.controller
        if self._site.quiet is not None:
            set_optional(controller, time_ns=self.time_ns)
        rain, evapotranspiration, forecast = self._rain, self._evapotranspiration, ((), ())
        if decides and rain.good and evapotranspiration.good:
            forecast = self._choice.own_forecast(
                self._own_steps, rain.value, evapotranspiration.value, rain.name
            )
        levels = self._cistern.value, self._roof.value
        command = decide(controller, decides, *levels, *forecast, self._quiet)
        if not decides:
            return command, {}
        return command, {name: getattr(controller, name) for _, name in self._optional}

    def _command_outlet(self, outlet: OutletPolicy) -> float:
        levels, share = (self._cistern.value, self._roof.value), 0.0
        if self.good:  # the policy must not learn from a rejected input: it would be a 0
            share = outlet(*levels, self._rain.value, self._evapotranspiration.value)
        elif not self._rain.good:
            outlet(*levels, (), ())  # unknown rain counts as wet weather
        return 0.0 if self._site.valve_closed_in_frost and self._frost.value else share

    def progress(self) -> dict[str, Any]:
        """Return the changes to the controller's parameters."""
        return self._settings.changes()


class SimulatedController(ControllerNode, SimulationNode):
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
        made, values = self._settings.make(), self._settings.values
        without_rain = declare(self, [WITHOUT_RAIN])[WITHOUT_RAIN.name]
        self._outlet = choice.make_outlet(self._site, values, made, without_rain)
        self._own_steps = choice.count_own_steps(self._site, values)
        if self._outlet is not None:
            self.open_outputs("/outlet/command")
        self._cistern, self._roof, self._rain, self._evapotranspiration, self._frost = (
            self.subscribe(name) for name in (*LEVELS, *FORECASTS, FROST)
        )
        if self._site.quiet is None:
            self.listen(CLOCK, self.set_time)
        else:
            self.follow_clock()

    def summary(self) -> dict[str, Any]:
        """Return the solver's statistics."""
        return {"solver": read_statistics(self._settings.controller)}


main = node_command(SimulatedController, __doc__, "--controller")


if __name__ == "__main__":
    main()
