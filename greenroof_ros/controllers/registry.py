"""Lookup of controllers: those of this package by name, and any other class by its path."""

from __future__ import annotations

import functools
import importlib.util
import re
import sys
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from greenroof_ros.base.errors import ConfigurationError, describe_choices, suggest_names
from greenroof_ros.base.parameter import OF_EVERY_NODE, Parameter, read_sections
from greenroof_ros.controllers import outlet
from greenroof_ros.controllers.decide import OwnCode, find_frame
from greenroof_ros.controllers.outlet import OutletPolicy, requested_share
from greenroof_ros.controllers.protocol import Controller, adapt, set_optional
from greenroof_ros.interface.states import EXTERNAL
from greenroof_ros.interface.topics import node_names
from greenroof_ros.site.horizon import MAX_HORIZON, look_ahead_ends
from greenroof_ros.site.site import Site

_HERE = "greenroof_ros.controllers"
BUILT_IN = {
    "mpc": f"{_HERE}.mpc:Mpc",
    "onoff": f"{_HERE}.onoff:OnOff",
    "anticipating_onoff": f"{_HERE}.onoff:AnticipatingOnOff",
    "lookahead": f"{_HERE}.lookahead:Lookahead",
}
# The controller that runs unless a user chooses another.
DEFAULT = "onoff"
FOR_A_SITE = "lookahead"
"""the default of a live site, for which the paper's controller is not suitable"""
_PATHS = {**BUILT_IN, EXTERNAL: f"{_HERE}.registry:External"}
# Every controller's node has these parameters.
_OF_EVERY_NODE = {
    "site_file", "state_file", "time_without_rain", "use_sim_time", "level_limit",
    "forecast_limit", "frost_limit", "gauge_limit", "flow_limit", "recovery_time",
    "frozen_movement", "jump_tolerance", "hold_limit", "external_pump",
}


class External(Controller):
    """Placeholder for a node that the user runs; only the look-ahead of its controller is known.

    The node receives the forecasts of its graph, which cover ``horizon`` and have a single member.
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "horizon", 0.0, "h", 0.0, MAX_HORIZON, "length of the forecasts for the node, in "
            "growing steps; 0 for forecasts of the next M ticks",
        ),
    )

    outlet: ClassVar[float] = 0.0
    """the node commands the outlet valve itself"""

    def __init__(self, site: Site, horizon: float) -> None:
        """Raise an error, because an external controller does not run in this package's processes.

        Raises:
            ConfigurationError: always.
        """
        raise ConfigurationError(
            "is a node that you run yourself, so only greenroof run can use it", key="controller",
            value=EXTERNAL,
        )


@dataclass(frozen=True)
class ControllerChoice:
    """A chosen controller.

    Attributes:
        name: name of the controller's node and of its section in a parameter file, also used in
            results.
        reference: controller as specified by the user: the name of a built-in controller, or
            ``package.module:Class``.
        given: class that a program passed; None if the class has to be imported.
    """

    name: str
    reference: str
    given: Any = None

    @property
    def path(self) -> str:
        """The class as ``package.module:Class``."""
        return _PATHS.get(self.reference, self.reference)

    @functools.cached_property
    def kind(self) -> Any:
        """The class, imported on first use; only :meth:`make` imports the library of a solver.

        Raises:
            ConfigurationError: if the class cannot be imported, or is not a controller.
        """
        kind = self._import_class() if self.given is None else self.given
        needed = "parameters", "command"
        lacking = [name for name in needed if not hasattr(kind, name)]
        of_valve = () if hasattr(kind, "outlet") else outlet.PARAMETERS
        of_node = _OF_EVERY_NODE.union(parameter.name for parameter in of_valve)
        if lacking or not all(isinstance(parameter, Parameter) for parameter in kind.parameters):
            problem = (
                f"is not a controller: it lacks {', '.join(lacking) or 'a tuple of Parameter'}; "
                "see \"Your controller\" in the documentation"
            )
        elif taken := of_node.intersection(parameter.name for parameter in kind.parameters):
            problem = (
                f"has a parameter {taken.pop()}, but its node already has one of this name; rename "
                "the controller's parameter"
            )
        else:
            return kind
        raise ConfigurationError(problem, key="controller", value=self.reference)

    def _import_class(self) -> Any:
        module_name, _, class_name = self.path.partition(":")
        if self.reference == self.path and "" not in sys.path and str(Path.cwd()) not in sys.path:
            # A console script does not search the current directory; python -m does.
            sys.path.insert(0, str(Path.cwd()))
        try:
            return getattr(importlib.import_module(module_name), class_name)
        except (Exception, SystemExit) as error:  # anything that a user's module raises
            file, line, _ = find_frame(error)
            if isinstance(error, SyntaxError):
                file, line = error.filename, error.lineno
            raise ConfigurationError(
                f"cannot be imported: {type(error).__name__}: {error}", file=file, line=line,
                key="controller", value=self.reference,
            ) from error

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The parameters of the controller and of the outlet valve, by name."""
        return {parameter.name: parameter for parameter in (*self.kind.parameters, *self.of_valve)}

    @functools.cached_property
    def of_valve(self) -> tuple[Parameter, ...]:
        """The parameters of the outlet valve; none if the controller commands the valve itself.

        Raises:
            ConfigurationError: if the class names a policy that does not exist.
        """
        if hasattr(self.kind, "outlet"):
            return ()
        policy, *others = outlet.PARAMETERS
        default = policy.read(
            getattr(self.kind, "outlet_policy", policy.default),
            key=f"the attribute outlet_policy of {self.reference}",
        )
        return replace(policy, default=default), *others

    @property
    def ensemble(self) -> bool:
        """Whether the controller accepts all members of an ensemble, rather than only the first."""
        return bool(getattr(self.kind, "ensemble", False))

    @property
    def needs_forecast(self) -> bool:
        """Whether the controller needs a forecast to decide, which is the default."""
        return bool(getattr(self.kind, "needs_forecast", True))

    @property
    def outputs(self) -> dict[str, str]:
        """Additional topics that the controller's node publishes, each with its attribute."""
        return dict(getattr(self.kind, "outputs", {}))

    def make(self, site: Site, parameters: dict[str, Any]) -> Controller:
        """Make the controller; a valve that is always open is treated as if there were none.

        Raises:
            ConfigurationError: if the controller's code raised an error, for example because the
                library of its solver cannot be imported.
        """
        if parameters.get("outlet") == outlet.OPEN:
            site = replace(site, low_outlet_valve=False)
        own = {parameter.name: parameters[parameter.name] for parameter in self.kind.parameters}
        with OwnCode(self.kind):
            controller: Controller = adapt(self.kind, site.zone)(site, **own)
            ends = look_ahead_ends(site, parameters.get("horizon", 0.0))
            set_optional(controller, forecast_ends=ends)
            return controller

    def make_outlet(
        self, site: Site, parameters: dict[str, Any], controller: Controller,
        without_rain: float,
    ) -> OutletPolicy | None:
        """Make the policy of a site's outlet valve; return None for a site without a valve.

        Args:
            site: the site.
            parameters: as for :meth:`make`.
            controller: controller from :meth:`make`, or another object of its class.
            without_rain: time without rain before the first tick (s).

        Raises:
            ConfigurationError: if only the object, and not its class, has an attribute ``outlet``.
        """
        if not site.low_outlet_valve:
            return None
        if not self.of_valve:
            return functools.partial(requested_share, controller)
        if hasattr(controller, "outlet"):
            raise ConfigurationError(
                "must also be an attribute of the class, for example outlet = 0.0; the controller "
                "then commands the valve itself", key=f"the attribute outlet of {self.reference}",
            )
        ends = look_ahead_ends(
            site, parameters.get("horizon", 0.0), outlet.find_horizon(parameters)
        )
        of_valve = {parameter.name: parameters[parameter.name] for parameter in self.of_valve}
        policy = outlet.Policy(site, ends, without_rain, **of_valve).command
        return functools.partial(_prefer_opening, controller, policy)

    def count_own_steps(self, site: Site, parameters: Mapping[str, Any]) -> int | None:
        """Return the number of forecast steps that the controller itself takes; None for all.

        A plan for the outlet valve uses more steps.
        """
        if not outlet.find_horizon(parameters):
            return None
        return len(look_ahead_ends(site, parameters.get("horizon", 0.0))) - 1

    def own_forecast(
        self, steps: int | None, rain: Any, evapotranspiration: Any, topic: str = ""
    ) -> tuple[Any, Any]:
        """Return forecasts as the controller takes them, without what only the outlet's plan uses.

        Args:
            steps: number of steps, as returned by :meth:`count_own_steps`. Unless it is None, a
                controller that takes only one member receives the first one.
            rain: forecast of rain, shape (steps,), or an array of shape (members, steps).
            evapotranspiration: forecast of evapotranspiration, shape (steps,).
            topic: name of the topic of the rain, for error messages.

        Raises:
            ConfigurationError: if the forecast has more than one member, but the controller accepts
                only one.
        """
        if self.ensemble:
            return np.atleast_2d(rain)[:, :steps], evapotranspiration[:steps]
        if isinstance(rain, np.ndarray):
            if steps is None:
                raise ConfigurationError(
                    f"has {len(rain)} members, but {self.name} takes only one; set all_members of "
                    "the weather node to false", key=topic,
                )
            rain = array("d", rain[0])
        return rain[:steps], evapotranspiration[:steps]

    def parameters_on(self, site: Site) -> list[Parameter]:
        """Return the parameters of the controller, each with its default for a site's roof.

        If the site has an outlet valve, the parameters of the valve are included.
        """
        own = [
            parameter if site.field_capacity is None or parameter.on_field_capacity is None
            else replace(parameter, default=parameter.on_field_capacity)
            for parameter in self.kind.parameters
        ]
        if not (site.low_outlet_valve and self.of_valve):
            return own
        policy, reserve, *others = self.of_valve
        return [*own, policy, replace(reserve, default=outlet.find_reserve(site)), *others]

    def complete_parameters(self, site: Site, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the value of every parameter for a site: the user's value, or else the default.

        Raises:
            ConfigurationError: if a parameter is for the outlet valve, but the site has no such
                valve.
        """
        defaults = {parameter.name: parameter.default for parameter in self.parameters_on(site)}
        for name in given.keys() - defaults.keys():
            raise ConfigurationError(
                "is a parameter of the valve of the low outlet, which this site does not have "
                "(the site file would need low_outlet_valve: true)", key=name, value=given[name],
            )
        return {**defaults, **given}

    def read_parameters(self, path: Path, namespace: str = "") -> dict[str, Any]:
        """Return the values that a ROS 2 parameter file sets for the controller's node.

        A dump of the node's parameters contains additional parameters. Those that rclpy declares in
        every node are ignored, and so is ``site_file``, which an option of the command line sets.

        Args:
            path: the file.
            namespace: namespace of the node, such as ``/site1``; empty for none.

        Raises:
            ConfigurationError: if the file or a value in it is invalid, or if the file has no
                section for the node.
        """
        node, known, values = f"{namespace}/{self.name}", self.parameters, {}
        sections = read_sections(path)
        matching = [section for section in sections if section.applies_to(node)]
        if not matching:
            there = ", ".join(section.name for section in sections) or "nothing"
            raise ConfigurationError(
                f"must contain '/**/{self.name}:' and, below it, 'ros__parameters:' for the node "
                f"{node}; it contains {there}", file=path,
            )
        for section in matching:
            for key, value in section.values.items():
                line = section.values.lines[key]
                place: dict[str, Any] = {"file": path, "line": line, "key": key}
                if key in known:
                    values[key] = known[key].read(value, **place)
                elif key.partition(".")[0] not in {*OF_EVERY_NODE, "site_file"}:
                    hint = (
                        "set it with --node-parameters" if key in _OF_EVERY_NODE
                        else suggest_names(key, known)
                    )
                    raise ConfigurationError(
                        f"is not a parameter of {self.name}; {hint}", **place
                    )
        return values


def find_controller(reference: str) -> ControllerChoice:
    """Find a controller.

    Args:
        reference: name of a controller in :data:`BUILT_IN`, or ``package.module:Class``.

    Raises:
        ConfigurationError: if there is no such controller, or if the name of its node is already in
            use.
    """
    name = _node_name(reference.partition(":")[2])
    if reference in _PATHS:
        return ControllerChoice(reference, reference)
    if ":" not in reference:
        problem = describe_choices(BUILT_IN, reference, ", or package.module:Class")
    elif not re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", reference):
        problem = "must be of the form package.module:Class"
    elif name in BUILT_IN or name in node_names():  # a controller's node is named after it
        problem = f"the node would have the same name as another node, {name}; rename the class"
    else:
        return ControllerChoice(name, reference)
    raise ConfigurationError(problem, key="controller", value=reference)


def choose_class(kind: Any) -> ControllerChoice:
    """Return the choice for a class that a program passes; a built-in class keeps its name."""
    path = f"{kind.__module__}:{kind.__qualname__}"
    for name, own in BUILT_IN.items():
        if path == own:
            return ControllerChoice(name, name)
    return ControllerChoice(_node_name(kind.__name__), path, kind)


def _prefer_opening(controller: Any, policy: OutletPolicy, *inputs: Any) -> float:
    """Return the opening of the valve that a function returned with its command, or the policy's.

    The policy is called in every tick, because it counts the time without rain.
    """
    share, opening = policy(*inputs), getattr(controller, "opening", None)
    return share if opening is None else float(opening)


def _node_name(class_name: str) -> str:
    """Return a class's name in lower case, with underscores between its words."""
    words = re.sub(r"([a-z0-9])([A-Z])|([A-Z])([A-Z][a-z])", r"\1\3_\2\4", class_name)
    return words.lower().strip("_")
