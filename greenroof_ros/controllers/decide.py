"""Decisions in each tick: whether the controller is called, and the command to the valve.

The module also truncates the forecast to the part that the controller receives.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np

from greenroof_ros.common.errors import ConfigurationError, HangError, describe_value
from greenroof_ros.controllers.failure import ControllerError, find_place, locate_error
from greenroof_ros.controllers.outlet import OutletPolicy
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.controllers.registry import ControllerChoice


def may_decide(controller: Controller, allowed: bool, quiet: bool) -> bool:
    """Return whether a controller decides in a tick; in quiet hours, only if it uses the time."""
    return allowed and (not quiet or hasattr(controller, "time_ns"))


def decide(
    controller: Controller,
    allowed: bool,
    cistern_level: float,
    roof_level: float,
    precipitation: Any,
    evapotranspiration: Sequence[float],
    quiet: bool = False,
) -> float:
    """Return the command for a tick: the controller's command if pumping is allowed, otherwise 0.

    Pumping is not allowed in frost, which can burst the pipe of a running pump. Nor is pumping
    allowed after an input has been rejected, because a command based on a level that was not
    measured must not reach the pump. In quiet hours the command is also 0, but a controller that
    uses the time is still called, so that it continues to learn and plan.

    Args:
        controller: controller that computes the command or skips the tick.
        allowed: whether pumping is allowed.
        cistern_level: level in the cistern (m).
        roof_level: level on the roof (m).
        precipitation: forecast of rain (m/s), in the shape that the controller accepts.
        evapotranspiration: forecast of evapotranspiration (m3/s).
        quiet: whether the tick is in the site's quiet hours.

    Raises:
        ControllerError: if the controller raised an error or returned an invalid command.
        ConfigurationError: if the controller cannot use the forecast.
    """
    try:
        if not may_decide(controller, allowed, quiet):
            controller.skip()
            return 0.0
        command = controller.command(cistern_level, roof_level, precipitation, evapotranspiration)
    except (ConfigurationError, HangError):
        raise
    except (Exception, SystemExit) as error:
        raise locate_error(type(controller), error) from error
    if is_finite_number(command) and command >= 0:
        return 0.0 if quiet else float(command)
    file, line = find_place(type(controller), "command")
    raise ControllerError(
        "must be a finite number and not negative (greenroof check-controller detects this before "
        "a run)", file=file, line=line,
        key=f"the command of {type(controller).__name__} = {describe_value(command)}",
    )


def decide_outlet(
    policy: OutletPolicy,
    closed: bool,
    cistern_level: float,
    roof_level: float,
    precipitation: Any,
    evapotranspiration: Sequence[float],
) -> float:
    """Return the command to the outlet valve in a tick; call this after :func:`decide`.

    The policy is called even if frost closes the valve, because the policy counts the time without
    rain.

    Args:
        policy: policy that commands the valve.
        closed: whether frost closes the valve.
        cistern_level: level in the cistern (m).
        roof_level: level on the roof (m).
        precipitation: forecast of rain (m/s), in the shape that the controller accepts.
        evapotranspiration: forecast of evapotranspiration (m3/s).

    Raises:
        ControllerError: if a controller that commands the valve itself sets an invalid command.
    """
    share = policy.command(cistern_level, roof_level, precipitation, evapotranspiration)
    return 0.0 if closed else share


def is_finite_number(value: Any) -> bool:
    """Return whether a value is a real Python or numpy number that is finite as a float."""
    try:
        # Float first: checking for Real alone takes a tenth of a simulated tick.
        is_number = isinstance(value, (float, Real)) and not isinstance(value, bool)
        return is_number and math.isfinite(value)
    except OverflowError:
        return False


def read_statistics(controller: Controller) -> dict[str, float] | None:
    """Return the statistics of a controller's solver; None if the controller has no solver.

    Raises:
        ControllerError: if the controller's code raised an error.
    """
    try:
        return controller.statistics()
    except Exception as error:
        raise locate_error(type(controller), error) from error


def cut_forecast(
    choice: ControllerChoice, steps: int, rain: Any, evapotranspiration: Any
) -> tuple[Any, Any]:
    """Truncate forecasts that were extended for the outlet's plan to the controller's own steps.

    Args:
        choice: the chosen controller, which receives only the first member unless it accepts all
            members.
        steps: number of steps that the controller uses.
        rain: forecast of rain, shape (steps,) or (members, steps).
        evapotranspiration: forecast of evapotranspiration, shape (steps,).
    """
    if isinstance(rain, np.ndarray):
        rain = rain[:, :steps] if choice.ensemble else array("d", rain[0, :steps])
    return rain[:steps] if isinstance(rain, array) else rain, evapotranspiration[:steps]


def shape_rain(choice: ControllerChoice, rain: Any, topic: str) -> Any:
    """Return a forecast of rain in the shape that a controller accepts.

    Args:
        choice: the controller.
        rain: value received on the topic, either a single row or an array of members.
        topic: name of the topic, for error messages.

    Raises:
        ConfigurationError: if the forecast has more than one member, but the controller accepts
            only one.
    """
    if choice.ensemble:
        return np.atleast_2d(rain)
    if isinstance(rain, np.ndarray):
        raise ConfigurationError(
            f"has {len(rain)} members, but {choice.name} takes only one; set all_members of the "
            "weather node to false", key=topic,
        )
    return rain
