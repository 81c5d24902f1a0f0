"""The controller node, for any controller: levels and forecasts in, one command out.

``python -m greenroof_ros.nodes.controller --controller NAME`` runs a registered controller, or any
class as ``package.module:Class``; the node is named after it.
"""

from __future__ import annotations

import math
from collections import deque
from functools import partial
from typing import Any

import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter as RosParameter

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import optional_topics
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.decide import decide
from greenroof_ros.controllers.protocol import knows_time, set_time
from greenroof_ros.controllers.registry import ControllerChoice, controller_names, find_controller
from greenroof_ros.graph.executable import node_command, node_help
from greenroof_ros.graph.lockstep import CLOCK
from greenroof_ros.graph.node import SimulationNode
from greenroof_ros.graph.parameters import declare, site_file

# How many of the newest parameter changes are kept; all are counted.
_CHANGES = 50


def parameters(choice: ControllerChoice | None) -> list[Parameter]:
    """Return the parameters of a controller's node; without a controller, the common ones."""
    return [site_file(), *([] if choice is None else choice.kind.parameters)]


class ControllerNode(SimulationNode):
    """Runs one controller; commands 0 in frost, in quiet hours and on bad inputs."""

    def __init__(self, controller: str) -> None:
        """Declare the controller's parameters and open the topics.

        Args:
            controller: a registered name, or ``package.module:Class``.

        Raises:
            ConfigurationError: there is no such controller.
        """
        choice = find_controller(controller)
        _ = choice.kind  # fail before a node is made
        super().__init__(choice.name, "controller")
        self._choice = choice
        self._site = site = self.declare_site()
        self._values = declare(self, choice.parameters_on(site))
        self._controller = choice.make(site, self._values)
        # Limited, since each report has them, and a program may change a parameter in each tick.
        self._parameter_changes: deque[dict[str, Any]] = deque(maxlen=_CHANGES)
        self._parameter_change_count = 0
        self._cistern, self._roof, self._rain, self._evapotranspiration, self._frost = (
            self.subscribe(name) for name in (
                "/cistern/level", "/roof/level", "/forecast/precipitation",
                "/forecast/evapotranspiration", "/weather/frost",
            )
        )
        if site.quiet is None:
            self.listen(CLOCK, self.set_time)
        else:
            self._time = self.subscribe(CLOCK)  # a tick must wait for its time
        self._optional = list(optional_topics(choice.outputs))
        self.open_outputs("/pump/command", *(topic.name for topic, _ in self._optional))
        self.add_on_set_parameters_callback(self._on_parameters)

    def on_inputs(self) -> None:
        """Publish the command and the controller's optional outputs."""
        allowed, quiet = self.good and not self._frost.value, False
        if self._site.quiet is not None:
            time_ns = self._time.value
            self.set_time(time_ns)
            set_time(self._controller, time_ns)
            quiet = self._site.quiet.quiet_at(time_ns)
            allowed = allowed and (not quiet or knows_time(self._controller))
        self.publish("/pump/command", decide(
            self._controller, allowed, self._cistern.value, self._roof.value,
            self._rain_forecast(), self._evapotranspiration.value, quiet,
        ))
        for topic, attribute in self._optional:
            value = getattr(self._controller, attribute) if allowed else topic.undecided
            self.publish(topic.name, value)

    def _rain_forecast(self) -> Any:
        """Return the forecast of rain in the shape that the controller takes.

        Raises:
            ConfigurationError: it has several members, and the controller takes one.
        """
        rain = self._rain.value
        if self._choice.ensemble:
            return np.atleast_2d(rain)
        if isinstance(rain, np.ndarray):
            raise ConfigurationError(
                f"has {len(rain)} members, but {self.get_name()} takes one; set all_members of "
                "the weather node to false", key=self._rain.name,
            )
        return rain

    def progress(self) -> dict[str, Any]:
        """Return the parameter changes."""
        return {
            "parameter_changes": list(self._parameter_changes),
            "parameter_change_count": self._parameter_change_count,
        }

    def summary(self) -> dict[str, Any]:
        """Return the solver's statistics."""
        return {"solver": self._controller.statistics()}

    def _on_parameters(self, changes: list[RosParameter]) -> SetParametersResult:
        may_change = {
            parameter.name for parameter in self._choice.kind.parameters if parameter.may_change
        }
        for name, value in (
            (parameter.name, parameter.value) for parameter in changes
            if parameter.name in may_change
        ):
            before, self._values[name] = self._values[name], value
            setattr(self._controller, name, value)
            self._parameter_change_count += 1
            self._parameter_changes.append({
                "tick": self.lockstep.tick, "parameter": name,
                "before": _finite(before), "value": _finite(value),
            })
            self.get_logger().info(f"{name} is {value:g} from tick {self.lockstep.tick} on")
        return SetParametersResult(successful=True)


def _finite(value: float) -> float | None:
    """Return a parameter's value for a summary, in which null means no limit."""
    return value if math.isfinite(value) else None


def _help(controller: str | None) -> str:
    choice = None if controller is None else find_controller(controller)
    name, declared = ("NAME", ()) if choice is None else (choice.reference, choice.kind.parameters)
    start = f"-p {declared[0].name}:={declared[0].default}" if declared else "--params-file FILE"
    return node_help(
        f"nodes.controller --controller {name}", "controller",
        f"{__doc__}\nRegistered controllers: {', '.join(controller_names())}.",
        lambda _: parameters(choice), f"--ros-args {start}",
        () if choice is None else choice.outputs,
    )


_executable = partial(node_command, ControllerNode, _help, "--controller")
main = _executable()
# The executables of this package's controllers.
mpc = _executable(value="mpc")
onoff = _executable(value="onoff")
anticipating_onoff = _executable(value="anticipating_onoff")
lookahead = _executable(value="lookahead")


if __name__ == "__main__":
    main()
