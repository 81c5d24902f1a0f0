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
from greenroof_ros.controllers.protocol import set_optional
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.interface.topics import optional_topics
from greenroof_ros.physics.storm_water import WITHOUT_RAIN
from greenroof_ros.ros.controller_parameters import ControllerParameters, of_reference
from greenroof_ros.ros.executable import node_command
from greenroof_ros.ros.lockstep import CLOCK
from greenroof_ros.ros.node import SimulationNode
from greenroof_ros.ros.parameters import declare, site_file


def parameters(choice: ControllerChoice | None) -> list[Parameter]:
    """Return the parameters of a controller's node; None for the parameters of every controller."""
    return [site_file(), WITHOUT_RAIN, *([] if choice is None else choice.parameters.values())]


class ControllerNode(SimulationNode):
    """Node that runs a controller, commanding 0 in frost, in quiet hours and for invalid inputs.

    At a site with an outlet valve, the node also commands the valve, even in frost and in quiet
    hours.
    """

    def __init__(self, controller: str) -> None:
        """Declare the controller's parameters and open the topics.

        Args:
            controller: name of a controller, or ``package.module:Class``.

        Raises:
            ConfigurationError: if the controller does not exist.
        """
        self._choice = choice = find_controller(controller)
        _ = choice.kind  # fail before a node is made
        super().__init__(choice.name, "controller")
        self._site = site = self.declare_site()
        self._settings = ControllerParameters(self, choice, site, lambda: self.lockstep.tick)
        self._controller = self._settings.make()
        self._outlet = self._settings.make_outlet(
            declare(self, [WITHOUT_RAIN])[WITHOUT_RAIN.name]
        )
        self._own_steps = self._settings.count_own_steps()
        self._optional = optional_topics(choice.outputs)
        if self._outlet is not None:
            self.open_outputs("/outlet/command")
        self.open_outputs("/pump/command", *(topic.name for topic, _ in self._optional))
        self._cistern, self._roof, self._rain, self._evapotranspiration, self._frost = (
            self.subscribe(name) for name in (
                "/cistern/level", "/roof/level", "/forecast/precipitation",
                "/forecast/evapotranspiration", "/weather/frost",
            )
        )
        if site.quiet is None:
            self.listen(CLOCK, self.set_time)
        else:
            self._time = self.subscribe(CLOCK)  # a tick has to wait for its time

    def on_inputs(self) -> None:
        """Publish the command and the controller's optional outputs."""
        controller = self._controller
        allowed, quiet = self.good and self._site.irrigated and not self._frost.value, False
        if self._site.quiet is not None:
            time_ns = self._time.value
            self.set_time(time_ns)
            set_optional(controller, time_ns=time_ns)
            quiet = self._site.quiet.quiet_at(time_ns)
            allowed = may_decide(controller, allowed, quiet)
        levels = self._cistern.value, self._roof.value
        rain, evapotranspiration = self._rain.value, self._evapotranspiration.value
        own = self._choice.own_forecast(
            self._own_steps, rain, evapotranspiration, self._rain.name
        )
        self.publish("/pump/command", decide(controller, allowed, *levels, *own, quiet))
        if self._outlet is not None:
            share = 0.0
            if self.good:  # the policy must not learn from a rejected input: it would be a 0
                share = self._outlet(*levels, rain, evapotranspiration)
            elif not self._rain.good:
                self._outlet(*levels, (), ())  # unknown rain counts as wet weather
            closed = self._site.valve_closed_in_frost and self._frost.value
            self.publish("/outlet/command", 0.0 if closed else share)
        for topic, attribute in self._optional:
            value = getattr(controller, attribute) if allowed else topic.undecided
            self.publish(topic.name, value)

    def progress(self) -> dict[str, Any]:
        """Return the changes to the controller's parameters."""
        return self._settings.changes()

    def summary(self) -> dict[str, Any]:
        """Return the solver's statistics."""
        return {"solver": read_statistics(self._controller)}


main = node_command(
    ControllerNode, "nodes.controller", __doc__, of_reference(parameters), "--controller"
)


if __name__ == "__main__":
    main()
