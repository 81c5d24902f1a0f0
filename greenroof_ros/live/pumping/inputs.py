"""The inputs of the pump node: one row each.

A new input is a row here, its topic with its greatest age in ``msg_defs/topics.yaml``, and its
conditions in ``msg_defs/conditions.yaml``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

from greenroof_ros.common.conditions import Problem
from greenroof_ros.common.parameter import Parameter

Rule = Callable[[float, Mapping[str, Any], Collection[str]], Problem | None]


class PumpInput(NamedTuple):
    """An input of the pump node.

    Attributes:
        name: what it is; without a rule, a field of
            :class:`greenroof_ros.live.pumping.pump_control.Observation`, which decides about it.
        topic: in the interface.
        unknown: code of the interlock while it is not known; empty if the pump runs without it.
        rule: returns the reason against running now, if there is one; None for no rule. It is given
            the value, the values of the node's parameters, and the codes of the interlocks that are
            active, so that it can have a hysteresis.
        parameters: of the rule.
        declared_by: the parameter among these that says whether the site has the input: a silent
            sensor must not count as absent. Empty: every site has it.
    """

    name: str
    topic: str
    unknown: str = ""
    rule: Rule | None = None
    parameters: tuple[Parameter, ...] = ()
    declared_by: str = ""

    def is_at(self, values: Mapping[str, Any]) -> bool:
        """Return whether a site has it, by the values of the node's parameters."""
        return not self.declared_by or bool(values[self.declared_by])


INPUTS = (
    PumpInput("command", "/pump/command", "command_unknown"),
    PumpInput("cistern_level", "/cistern/level", "cistern_level_unknown"),
    PumpInput("roof_level", "/roof/level", "roof_level_unknown"),
    PumpInput("frost", "/weather/frost", "frost_unknown"),
    PumpInput("flow", "/pump/meter"),
)
IN_LOOP = tuple(row for row in INPUTS if row.unknown and not row.declared_by)
"""Those that a simulated plant, its weather and its controller publish."""
