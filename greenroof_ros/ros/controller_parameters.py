"""Parameters of a controller's node, from which the controller is created."""

from __future__ import annotations

import copy
from collections import deque
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter as RosParameter

from greenroof_ros.base.parameter import replace_infinity
from greenroof_ros.controllers.decide import locate_error
from greenroof_ros.controllers.registry import ControllerChoice
from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.parameters import declare
from greenroof_ros.site.site import Site

# How many of the newest parameter changes are kept; all are counted.
_CHANGES = 50


class ControllerParameters:
    """A controller created from its node's parameters, some of which may change during a run.

    Attributes:
        values: values of the parameters, by name.
        controller: the controller; None before the first call to :meth:`make`, or if the last call
            failed.
    """

    def __init__(self, node: GraphNode, choice: ControllerChoice, site: Site) -> None:
        """Declare the parameters.

        Args:
            node: the node.
            choice: the chosen controller.
            site: the site.

        Raises:
            ConfigurationError: if a value is invalid.
        """
        self._node, self._choice, self._site = node, choice, site
        self.values = declare(node, choice.parameters_on(site))
        self.controller: Any = None
        # Limited, since every report contains them, and a program may change a parameter in every
        # tick.
        self._changes: deque[dict[str, Any]] = deque(maxlen=_CHANGES)
        self._change_count = 0
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def make(self) -> Any:
        """Create the controller with the current values of its parameters, and return it.

        Raises:
            ConfigurationError: if :meth:`ControllerChoice.make` raises one.
        """
        self.controller = None
        self.controller = self._choice.make(self._site, self.values)
        return self.controller

    def changes(self) -> dict[str, Any]:
        """Return the latest parameter changes and their total number, for reports."""
        return {
            "parameter_changes": list(self._changes), "parameter_change_count": self._change_count,
        }

    def _check(self, changes: list[RosParameter]) -> SetParametersResult:
        """Try the changes on a copy of the controller; other checks may still reject them."""
        tried = copy.copy(self.controller)
        for name, value in self._select_changeable(changes):
            try:
                if tried is not None:
                    setattr(tried, name, value)
            except (Exception, SystemExit) as error:  # whatever a user's class raises
                reason = str(locate_error(self._choice.kind, error))
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _apply(self, changes: list[RosParameter]) -> None:
        """Apply changes that every check has accepted."""
        tick = self._node.tick
        for name, value in self._select_changeable(changes):
            if self.controller is not None:
                setattr(self.controller, name, value)
            before, self.values[name] = self.values[name], value
            self._change_count += 1
            self._changes.append({
                "tick": tick, "parameter": name,
                **replace_infinity({"before": before, "value": value}),
            })
            self._node.get_logger().info(f"{name} is {value:g} from tick {tick} on")

    def _select_changeable(self, changes: list[RosParameter]) -> list[tuple[str, Any]]:
        may_change = {
            parameter.name for parameter in self._choice.kind.parameters if parameter.may_change
        }
        return [(each.name, each.value) for each in changes if each.name in may_change]
