"""The controllers by name, with their parameters."""

from __future__ import annotations

import math
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import YamlMapping, number, read_yaml
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.model.site import Site

# How far the controllers that plan trust the level sensor (s) and the forecast (h).
_TRUST = {"observer_time_constant": (0.0, 3600.0), "max_waiting_loss": (0.0, 1e6)}

# The parameters of each controller, in its YAML file and of its node, with their range; whole
# numbers where its ends are. A planner pumps nothing at commands below 1e-5.
CONTROLLERS = {
    "mpc": {"weight": (1e-9, 1e6), "max_command": (1e-9, math.inf)},
    "onoff": {"fraction": (1e-9, 1e6)},
    "planning_mpc": {
        "horizon": (0.1, 48.0),
        "max_command": (1e-5, math.inf),
        "power": (1, 2),
        "energy_weight": (0.0, 1e9),
        "start_weight": (0.0, 1e5),
        **_TRUST,
    },
    "anticipating_onoff": {"horizon": (0.1, 48.0), "fraction": (1e-9, 1e6), **_TRUST},
    "scenario_mpc": {
        "horizon": (0.1, 48.0),
        "max_command": (1e-5, math.inf),
        "cvar_level": (0.0, 0.99),
        "recourse": (0.0, 48.0),
        **_TRUST,
    },
}

# Those that take all members of an ensemble of forecasts; the others are told its first.
TAKE_ENSEMBLES = ("scenario_mpc",)


def read_parameters(path: Path, controller: str) -> dict[str, float]:
    """Read a controller's parameters from its ROS 2 parameter file.

    Raises:
        ConfigurationError: the file or a value in it is wrong.
    """
    mapping = read_yaml(path)
    section = mapping.get(controller)
    if not isinstance(section, YamlMapping) or not isinstance(
        section.get("ros__parameters"), YamlMapping
    ):
        raise ConfigurationError(
            f"must hold '{controller}:' and in it 'ros__parameters:'", file=path
        )
    parameters: YamlMapping = section["ros__parameters"]
    for key, line in parameters.lines.items():
        if key not in CONTROLLERS[controller]:
            raise ConfigurationError(
                f"is not a parameter of {controller}; they are "
                + ", ".join(CONTROLLERS[controller]),
                file=path, line=line, key=key,
            )
    values = {}
    for key in CONTROLLERS[controller]:
        if key not in parameters:
            raise ConfigurationError("is missing", file=path, key=key)
        values[key] = number(path, parameters, key)
        wrong = wrong_parameter(controller, key, values[key])
        if wrong:
            raise ConfigurationError(
                wrong, file=path, line=parameters.lines[key], key=key, value=parameters[key],
            )
    return values


def wrong_parameter(controller: str, key: str, value: float) -> str:
    """Return what a controller's parameter must be, if it is not; otherwise nothing."""
    low, high = CONTROLLERS[controller][key]
    whole = isinstance(low, int)
    if low <= value <= high and not (whole and value % 1):
        return ""
    return f"must be {'a whole number ' if whole else ''}from {low:g} to {high:g}"


def make_controller(name: str, site: Site, parameters: dict[str, float]) -> Controller:
    """Make a controller of the given name; the solver is imported only where it is used."""
    if name == "mpc":
        from greenroof_ros.controllers.mpc import Mpc

        return Mpc(site, parameters["weight"], parameters["max_command"])
    if name == "planning_mpc":
        from greenroof_ros.controllers.planning_mpc import PlanningMpc
        from greenroof_ros.controllers.planning_program import Prices

        return PlanningMpc(
            site, parameters["horizon"], parameters["max_command"], parameters["power"],
            Prices(parameters["energy_weight"], parameters["start_weight"]),
            observer_time_constant=parameters["observer_time_constant"],
            max_waiting_loss=parameters["max_waiting_loss"],
        )
    if name == "scenario_mpc":
        from greenroof_ros.controllers.planning_mpc import PlanningMpc
        from greenroof_ros.controllers.planning_program import Ensemble

        return PlanningMpc(
            site, parameters["horizon"], parameters["max_command"],
            ensemble=Ensemble(parameters["cvar_level"], parameters["recourse"] * 3600),
            observer_time_constant=parameters["observer_time_constant"],
            max_waiting_loss=parameters["max_waiting_loss"],
        )
    if name == "anticipating_onoff":
        from greenroof_ros.controllers.anticipating_onoff import AnticipatingOnOff

        return AnticipatingOnOff(
            site, parameters["horizon"], parameters["fraction"],
            parameters["observer_time_constant"], parameters["max_waiting_loss"],
        )
    from greenroof_ros.controllers.onoff import OnOff

    return OnOff(site, parameters["fraction"])
