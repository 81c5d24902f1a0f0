"""The controller node, whichever controller it runs: levels and forecasts in, one command out.

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
from rclpy.parameter import Parameter

from greenroof_ros.common.command_line import EXIT_DONE, command
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import optional_topics
from greenroof_ros.controllers.decide import decide
from greenroof_ros.controllers.registry import ControllerChoice, controller_names, find_controller
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.live import (
    FROZEN_MOVEMENT,
    JUMP_TOLERANCE,
    LEVEL_PARAMETERS,
    live_parameters,
)
from greenroof_ros.graph.lockstep import CLOCK
from greenroof_ros.graph.node_help import NodeParser, node_help
from greenroof_ros.graph.node_process import run_node
from greenroof_ros.graph.parameters import LIVE, declare, of_controller, site_file
from greenroof_ros.graph.serialization import decode_clock
from greenroof_ros.graph.validation import Input
from greenroof_ros.model.plant import pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.pumping.input_rules import (
    LevelRule,
    cistern_reach,
    expected_rise,
    roof_reach,
)

# The inputs that it needs; live it looks at two more, if they are there.
_NEEDED = (
    "/cistern/level", "/roof/level", "/forecast/precipitation", "/forecast/evapotranspiration",
    "/weather/frost",
)
_FLOW, _GAUGE = "/pump/flow", "/gauge/precipitation"
# So many changes of parameters a live node keeps, the newest; all are counted.
_LIVE_CHANGES = 20
LIVE_PARAMETERS = [*live_parameters([*_NEEDED, _FLOW, _GAUGE]), *LEVEL_PARAMETERS]


class _Expectation:
    """What the levels must do, by what is pumped and what the site's gauge measures.

    A forecast of rain says nothing here: what it says need not fall.
    """

    def __init__(
        self, site: Site, cistern: LevelRule, roof: LevelRule, flow: Input, gauge: Input
    ) -> None:
        self._site = site
        self._cistern, self._roof = cistern, roof
        self._flow, self._gauge = flow, gauge

    def note(self, command: float, cistern_level: float, roof_level: float) -> None:
        """Expect of the levels what a command does in a tick; a flow that is heard knows better."""
        site = self._site
        if self._flow.good:
            flow = self._flow.value
        else:
            volumes = site.cistern_volume(cistern_level), site.roof_volume(roof_level)
            flow = pump_flow(site, *volumes, min(command, 1.0))
        rain = self._gauge.value if self._gauge.good else 0.0
        cistern, roof = expected_rise(site, flow, rain, cistern_level, roof_level)
        self._cistern.expect(cistern * site.tau)
        self._roof.expect(roof * site.tau)


class ControllerNode(LinkedNode):
    """Runs one controller in the graph; it commands 0 where an input is not good, and in frost."""

    def __init__(self, choice: ControllerChoice) -> None:
        """Declare the controller's parameters and open the topics."""
        super().__init__(choice.name, "controller")
        site = self.declare_site()
        self.act_every(site.tau)
        values = declare(self, of_controller(choice.kind.parameters))
        live = declare(self, LIVE_PARAMETERS)
        self._controller = choice.make(site, values)
        self._ensemble = choice.ensemble
        self._may_change = {
            one.name: values[one.name] for one in choice.kind.parameters if one.may_change
        }
        self._tick = 0
        # A live site runs for months.
        self._parameter_changes: deque[dict[str, Any]] = deque(
            maxlen=_LIVE_CHANGES if self.live else None
        )
        self._parameter_change_count = 0
        self._shown: dict[str, float | None] = {}
        cistern_rule, roof_rule = (
            LevelRule(reach, live[FROZEN_MOVEMENT.name], live[JUMP_TOLERANCE.name])
            for reach in (cistern_reach(site), roof_reach(site))
        )
        self._cistern = self.subscribe("/cistern/level", level=cistern_rule)
        self._roof = self.subscribe("/roof/level", level=roof_rule)
        self._rain = self.subscribe("/forecast/precipitation")
        self._evapotranspiration = self.subscribe("/forecast/evapotranspiration")
        self._frost = self.subscribe("/weather/frost")
        if self.live:
            self._expectation = _Expectation(
                site, cistern_rule, roof_rule,
                self.subscribe(_FLOW, optional=True), self.subscribe(_GAUGE, optional=True),
            )
        else:
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
        if self.live:
            allowed = self._command_live(allowed)
        else:
            self._publish_command(self._decide(allowed))
        self._tick += 1
        for publish, attribute, undecided in self._publish_outputs:
            publish(getattr(self._controller, attribute) if allowed else undecided)

    def _decide(self, allowed: bool) -> float:
        return decide(
            self._controller, allowed, self._cistern.value, self._roof.value,
            self._rain_forecast() if allowed else self._rain.value, self._evapotranspiration.value,
        )

    def _command_live(self, allowed: bool) -> bool:
        """Command, or 0 where the controller cannot, or its inputs were too old when it had.

        Args:
            allowed: whether it may pump.

        Returns:
            Whether it did decide.
        """
        try:
            command = self._decide(allowed)
        except ConfigurationError as error:
            self.refuse(self._rain.topic.name, str(error))
            command, allowed = self._decide(False), False
        if command and not self.good:
            command = 0.0
        self._publish_command(command)
        self._expectation.note(command, self._cistern.value, self._roof.value)
        self._shown = {
            "command": command,
            "cistern_level": self._cistern.value if self._cistern.good else None,
            "roof_level": self._roof.value if self._roof.good else None,
        }
        return allowed

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
        """Return the parameters that changed and, live, what bringup shows."""
        count = {"parameter_change_count": self._parameter_change_count} if self.live else {}
        return {"parameter_changes": list(self._parameter_changes), **count, **self._shown}

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
            self._parameter_change_count += 1
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
        [LIVE, site_file(), *own, *LIVE_PARAMETERS],
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
